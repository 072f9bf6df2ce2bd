"""Shared fixtures and hooks. Tests run on the CPU and share a persistent compilation cache across workers and runs."""

import functools
import gc
import getpass
import itertools
import os
import signal
import sys
import sysconfig
import tempfile
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

# Compilation allocates millions of small objects, which takes a tenth less time with this allocator. pytest's workers inherit
# it, as do processes that tests start.
if (allocator := Path(sysconfig.get_path("purelib"), "cmeel.prefix/lib/libmimalloc.so")).exists() and sys.platform == "linux":
    os.environ.setdefault("LD_PRELOAD", str(allocator))
    os.environ.setdefault("MIMALLOC_PURGE_DELAY", "-1")

# Programs that tests start would compile the package's modules each time.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# Read by JAX at its first import, so set before any test module is imported.
os.environ["JAX_PLATFORMS"] = "cpu"
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(tempfile.gettempdir()) / f"jaxrl-vis-tests-{getpass.getuser()}"))
# Also what compiles in a moment: there are thousands of it, and reading takes half as long.
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("MPLBACKEND", "Agg")
# Tests replace parts of the package, which programs that an earlier test has kept would not show.
os.environ["JAXRL_VIS_KEEP_PROGRAMS"] = "0"
# Where each operation was called from, all the way up, is a twentieth of what there is to compile.
os.environ.setdefault("JAX_INCLUDE_FULL_TRACEBACKS_IN_LOCATIONS", "0")
# Programs of tests run for a moment: optimising their machine code takes longer. What XLA makes of them before is the same.
# Three passes that improve loops take an eighth of the rest, and change no result. Nine more, for loops, scatters and large
# products, of which the programs of tests have few, take a twelfth.
# Both cores are busy with tests, so a program is not split into parts that could be compiled side by side either.
# Fusion emitters take as long to compile as all the rest, and programs of environments do without them anyway, see
# `compilation.compiler_options`. JAX 0.11 does not know the option any more, and would end the process.
os.environ["XLA_FLAGS"] = " ".join(
    (
        os.environ.get("XLA_FLAGS", ""),
        "--xla_backend_optimization_level=0",
        "--xla_cpu_parallel_codegen_split_count=1",
        "--xla_disable_hlo_passes=while-loop-invariant-code-motion,simplify-while-loops,apply-xla-transforms"
        ",while-loop-constant-sinking,simplify-conditional,reshape-mover,post_scatter_expansion_simplification"
        ",dynamic-dimension-simplifier,tree_reduction_rewriter,batch-dot-simplification,gemv-rewriter"
        ",cpu-parallel-task-assigner",
        *(["--xla_cpu_use_fusion_emitters=false"] if version("jaxlib").startswith("0.10.") else []),
    )
)

import hypothesis
import jax
import pytest
import quick_jax  # noqa: F401 (its import is what counts)

# Test files share fixtures and small helpers across folders.
sys.path.extend(str(folder) for folder in sorted(Path(__file__).parent.iterdir()) if folder.is_dir())

# A script's shell lets what it starts in the background ignore Ctrl-C, which would be passed on to runs that tests interrupt.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# The suite tries the same examples each time, so that a failure is of the change that is tested; `make fuzz` tries others.
hypothesis.settings.register_profile(
    "suite",
    max_examples=40,
    derandomize=True,
    database=None,
    deadline=None,
    phases=[hypothesis.Phase.explicit, hypothesis.Phase.generate, hypothesis.Phase.shrink],
    suppress_health_check=[hypothesis.HealthCheck.too_slow, hypothesis.HealthCheck.data_too_large],
)
hypothesis.settings.register_profile(
    "fuzz",
    hypothesis.settings.get_profile("suite"),
    max_examples=int(os.environ.get("EXAMPLES", "2000")),
    derandomize=False,
    print_blob=True,
)
hypothesis.settings.load_profile("suite")


def _call_with_room(function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    return function(*args, **kwargs)


# Python keeps the frames of calls in chunks of 16 KB, and returns a chunk to the system with the last call in it: tracing goes
# back and forth across the edge of one so often that it takes a fifteenth of the time of tests. The frame of this function
# needs a chunk of 2 MB and leaves half of it for all calls from it.
_call_with_room.__code__ = _call_with_room.__code__.replace(co_stacksize=131_072)
pytest.CallInfo.from_call = functools.partial(_call_with_room, pytest.CallInfo.from_call)


@pytest.fixture(scope="session", autouse=True)
def short_waits() -> Iterator[None]:
    """Look for the end of other processes more often than commands do, and measure the machine's speed for less long."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("jaxrl_vis.studies.engine.grid._POLL_S", 0.02)
        patch.setattr("jaxrl_vis.bench.conditions._SAMPLE_S", 0.02)
        patch.setattr("jaxrl_vis.bench.conditions._CALIBRATION_S", 0.002)
        yield


@pytest.fixture
def checkout() -> Path:
    """Root folder of the checkout, which holds pyproject.toml."""
    return Path(__file__).resolve().parents[1]


@pytest.fixture
def clean_environment(checkout: Path) -> dict[str, str]:
    """Environment variables for a subprocess that imports the checkout."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join((str(checkout), str(checkout / "envs")))}


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Empty current folder; modules imported and environments registered during the test are removed after it."""
    from jaxrl_vis_envs import registry

    folder = tmp_path / "here"
    folder.mkdir()
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "path", list(sys.path))
    before, registered = set(sys.modules), set(registry._ENTRIES)
    yield folder
    for name in set(registry._ENTRIES) - registered:
        if not registry.is_built_in(name):
            del registry._ENTRIES[name]
    for name in set(sys.modules) - before:
        if str(tmp_path) in str(getattr(sys.modules[name], "__file__", "") or ""):
            del sys.modules[name]


@pytest.fixture(scope="session")
def straight(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any, list]:
    """Uninterrupted run of the fake program over eight iterations: its folder, trainer and reports."""
    from fake_program import make_fake_trainer, small_config

    path = tmp_path_factory.mktemp("runs") / "straight"
    trainer = make_fake_trainer(small_config(), path)
    return path, trainer, list(trainer.run())


# Files whose tests play a task, and the tasks, by the word that names of files and tests have in common; the one that takes
# longest to compile first.
TASK_TESTS = ("controllers", "envs", "finger_turn", "hand_reach", "physics_parity", "sawyer_reach", "stalk_reach")
TASKS = ("hand", "sawyer", "fetch", "finger", "stalk", "reacher")
# At the end of a run no worker should wait for the other, so what takes longest comes first.
FIRST = (*TASKS, "test_trainer", "test_render_parity")
# Files that share the programs of another one: notebooks and pages train with the smallest preset, as tests of the trainer do.
# Not test_signals: it makes JAX forget what was traced.
SHARED = dict.fromkeys(("test_docs", "test_notebooks", "test_resume"), "test_trainer") | {
    "test_encoder": "test_audit",
    "test_export": "test_policy",
    "test_phenotype_train": "test_detector",
}


def group_of(nodeid: str) -> str:
    """Return the name of the group of tests that share compiled programs: the test's task, or else its file."""
    file = Path(nodeid.partition("::")[0]).stem
    names = [task for task in TASKS if task in nodeid.lower()] if file.removeprefix("test_") in TASK_TESTS else []
    return names[0] if names else SHARED.get(file, file)


SLOW_TESTS = Path(__file__).with_name("slow_tests.txt")


def mark_slow_tests(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark the tests that slow_tests.txt lists as slow.

    Raises:
        pytest.UsageError: All tests are collected, and a line names something else, or a slow test as the faster one.
    """
    by_name = {item.nodeid.removeprefix("tests/"): item for item in items}
    lines = [line for line in SLOW_TESTS.read_text().splitlines() if line and not line.startswith("#")]
    pairs = [line.partition(" <- ")[::2] for line in lines]
    for slow, _ in pairs:
        if slow in by_name:
            by_name[slow].add_marker(pytest.mark.slow)
    if config.args != config.getini("testpaths"):
        return
    for slow, faster in pairs:
        if slow not in by_name or faster not in by_name or by_name[faster].get_closest_marker("slow"):
            raise pytest.UsageError(f"{SLOW_TESTS.name}: correct `{slow} <- {faster}`: one is no test, or the faster is slow")


@pytest.hookimpl(tryfirst=True)  # before slow tests are left out
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    mark_slow_tests(config, items)

    def rank(item: pytest.Item) -> int:
        group = group_of(item.nodeid)
        return FIRST.index(group) if group in FIRST else len(FIRST)

    items.sort(key=rank)


_FILES_PER_COLLECTION = 5
_finished_files = itertools.count(1)


def _spare_the_collector() -> None:
    """Exempt present objects (modules, compiled programs), most of which stay, from further garbage collection."""
    gc.collect()
    gc.freeze()


def pytest_collection_finish() -> None:
    _spare_the_collector()


# Of the 65,530 that Linux gives a process by default; a compiled program takes some tens.
_MANY_MEMORY_MAPPINGS = 30_000


def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> None:
    """Release compiled programs between groups if the process might otherwise run out of memory mappings."""
    if nextitem is None or item.path == nextitem.path:
        return
    mappings = Path("/proc/self/maps")
    last_of_group = group_of(item.nodeid) != group_of(nextitem.nodeid)
    if last_of_group and mappings.exists() and mappings.read_bytes().count(b"\n") > _MANY_MEMORY_MAPPINGS:
        jax.clear_caches()
        gc.unfreeze()
        _spare_the_collector()
    elif next(_finished_files) % _FILES_PER_COLLECTION == 0:
        _spare_the_collector()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Return a scheduler that runs each group of tests in one process."""
    from xdist.scheduler import LoadScopeScheduling

    class OneProcessPerGroup(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return group_of(nodeid)

    config.option.loadscopereorder = False  # or else it would start with the group of most tests
    return OneProcessPerGroup(config, log)
