"""Devices of JAX: reported in one line if missing, and guessed for help texts, which must not wait for JAX."""

import json
import logging
import os
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
from fake_program import make_fake_trainer, small_config

from jaxrl_vis import cli
from jaxrl_vis.host import devices
from jaxrl_vis.run.compiled.memory import format_bytes

_PROGRAM = """
import contextlib, io, json, sys
from jaxrl_vis import cli
told = []
commands = json.loads(sys.argv[1])
for words in commands:
    out, err = io.StringIO(), io.StringIO()
    sys.argv = ["jaxrl-vis", *words]
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            cli.entry()  # whole, as its end must not look for devices either
    except SystemExit as end:
        told.append([end.code, out.getvalue(), err.getvalue()])
print(json.dumps(told))
"""


@pytest.mark.parametrize("asked", ["cuda", "gpu", "tpu", "nonsense", "CPU"])
def test_no_accelerator_where_one_is_asked_for(
    asked: str, clean_environment: dict[str, str], tmp_path: Path, checkout: Path
) -> None:
    """Every command reports in one line which platform was requested, which one there is, and how to correct the request."""
    run = tmp_path / "run"
    run.mkdir()
    (run / "config.json").write_text(json.dumps({"schema": 2, "config": {"environment": {"env": "Reacher"}}}))
    (tmp_path / "my_task.py").write_text("import jax\njax.numpy.ones(3)")
    commands = [["doctor"], ["train"], ["train", "--preset", "debug"], ["train", "my_task:MyReach"], ["eval", str(run)]]
    commands += [["play", str(run)], ["envs"], ["bench", "env"]]
    environment = {**clean_environment, "JAX_PLATFORMS": asked}
    program = [sys.executable, "-c", _PROGRAM, json.dumps(commands if asked == "cuda" else commands[:2])]
    done = subprocess.run(program, env=environment, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    expected = f"JAX_PLATFORMS={asked}, but JAX finds no such device here, only cpu; "
    (status, out, _), *others = json.loads(done.stdout.splitlines()[-1])
    assert status == 2 and out.splitlines()[0].startswith("ok    versions")
    assert out.splitlines()[1].startswith(f"FAIL  devices        {expected}") and len(out.splitlines()) == 2
    for words, (status, out, err) in zip(commands[1:], others):
        assert status == 2 and out == "", words
        (line,) = err.splitlines()
        assert line.startswith(f"jaxrl-vis: {expected}"), words
        assert line.endswith("write JAX_PLATFORMS=cpu" if asked == "CPU" else "unset JAX_PLATFORMS to run on that"), words
    assert [path.name for path in run.iterdir()] == ["config.json"] and not (tmp_path / "runs").exists()


def test_asking_python_again_does_not_change_the_answer(clean_environment: dict[str, str]) -> None:
    """The first refusal initialises the existing devices; a second attempt must not use them."""
    code = """
import jaxrl_vis
for _ in range(2):
    try:
        jaxrl_vis.make_trainer(jaxrl_vis.preset("debug"))
    except jaxrl_vis.RequestError as error:
        print(error)
"""
    environment = {**clean_environment, "JAX_PLATFORMS": "cuda"}
    lines = subprocess.check_output([sys.executable, "-c", code], env=environment, text=True).splitlines()
    assert len(lines) == 2 and lines[0] == lines[1] and lines[0].startswith("JAX_PLATFORMS=cuda, but")


@pytest.mark.parametrize(
    ("asked", "packages", "there", "expected"),
    [
        ("cpu", True, True, False),
        ("cuda,cpu", False, False, True),
        ("", True, True, True),
        ("", True, False, False),
        ("", False, True, False),
    ],
)
def test_the_guess_follows_what_is_asked_for_installed_and_there(
    asked: str, packages: bool, there: bool, expected: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("JAX_PLATFORMS", asked)
    monkeypatch.setattr(devices, "_is_installed", lambda _: packages)
    monkeypatch.setattr(devices, "_exists", lambda _: there)
    assert devices.guess_accelerator() is expected


def test_a_gpu_without_its_packages_is_mended_by_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(devices, "_is_installed", lambda _: False)
    monkeypatch.setattr(devices, "_exists", lambda _: True)
    assert devices._hint("cuda") == "; install this project with the extra cuda12 or cuda13"


def test_sizes_are_all_in_one_unit() -> None:
    sizes = [format_bytes(count) for count in (0, 1000, 5 * 2**20, 2**27, 3 * 2**30, 2**45)]
    assert sizes == ["under 0.001 GiB", "under 0.001 GiB", "0.005 GiB", "0.1 GiB", "3.0 GiB", "32768.0 GiB"]


@pytest.mark.parametrize("variables", [{}, {"XLA_CLIENT_MEM_FRACTION": "0.5"}, {"XLA_PYTHON_CLIENT_MEM_FRACTION": "0.4"}])
def test_training_claims_most_of_a_gpu_unless_limited(variables: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    names = ("XLA_CLIENT_MEM_FRACTION", "XLA_PYTHON_CLIENT_MEM_FRACTION")
    for name in names:
        monkeypatch.setenv(name, "")  # so that what is set here ends with the test
        monkeypatch.delenv(name)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    devices.claim_memory()
    # JAX refuses to start with both.
    assert {name: os.environ[name] for name in names if name in os.environ} == (variables or {names[1]: "0.9"})


@pytest.fixture
def jax_config():
    """Function that changes a setting of JAX; after the test, settings are restored and the compilation cache is reset."""
    import jax
    from jax.experimental.compilation_cache import compilation_cache

    names = ("compilation_cache_dir", "enable_compilation_cache", "compilation_cache_max_size", "disable_jit")
    names = tuple(f"jax_{name}" for name in (*names, "persistent_cache_min_compile_time_secs"))
    before = {name: getattr(jax.config, name) for name in names}
    with warnings.catch_warnings():
        yield lambda name, value: jax.config.update(f"jax_{name}", value)
    for name, value in before.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()


def test_what_a_run_says_of_the_cache_is_true(
    tmp_path: Path, jax_config, monkeypatch: pytest.MonkeyPatch, capsys, recwarn
) -> None:
    from jax.experimental.compilation_cache import compilation_cache

    said = make_fake_trainer(small_config(), None).programs.cache_message
    home, elsewhere, file = tmp_path / "home", tmp_path / "elsewhere", tmp_path / "a file"
    file.touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(home))
    jax_config("compilation_cache_dir", None)
    assert said() == "once; the next start finds it in the cache" and (home / "jaxrl-vis" / "xla").is_dir()
    jax_config("compilation_cache_dir", str(elsewhere))
    assert said() == f"once; the next start finds it in {elsewhere}" and elsewhere.is_dir()
    jax_config("persistent_cache_min_compile_time_secs", 30.0)
    monkeypatch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "30")
    assert said() == "as will every start: only programs that take 30 s or more to compile are cached"
    jax_config("enable_compilation_cache", False)
    assert said() == "as will every start: the compilation cache is disabled in JAX"
    jax_config("enable_compilation_cache", True)
    monkeypatch.setenv("XDG_CACHE_HOME", str(file))
    jax_config("compilation_cache_dir", None)
    assert said().endswith("cannot be written (Not a directory); set JAX_COMPILATION_CACHE_DIR to a writable folder")
    assert devices.enable_compilation_cache() == ""
    # And nobody else complains of it.
    jax_config("compilation_cache_dir", str(file / "cache"))
    jax_config("persistent_cache_min_compile_time_secs", 0.0)
    compilation_cache.reset_cache()
    assert len(list(make_fake_trainer(small_config(), tmp_path / "run").run())) == 8
    printed = capsys.readouterr()
    assert f"compiling (as will every start: {file / 'cache'} cannot be written (Not a directory)) ..." in printed.out
    assert printed.err == "" and not recwarn.list


def test_a_jax_that_does_not_compile_is_refused(tmp_path: Path, jax_config, capsys) -> None:
    jax_config("disable_jit", True)
    assert cli.main(["train", "--preset", "debug", "--run-dir", str(tmp_path / "run")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("jaxrl-vis: compilation is disabled in JAX") and "unset JAX_DISABLE_JIT" in line
    assert not (tmp_path / "run").exists()


def test_matplotlib_does_not_complain_of_its_folder(caplog: pytest.LogCaptureFixture) -> None:
    import jaxrl_vis.report  # noqa: F401 - what everything that draws imports

    log = logging.getLogger("matplotlib")
    log.warning("mkdir -p failed for path %s: %s", "/proc/nope", "why")
    log.warning("Matplotlib created a temporary cache directory at %s because there was an issue with %s", "/tmp/x", "y")
    log.warning("something else")
    assert [record.getMessage() for record in caplog.records] == ["something else"]
