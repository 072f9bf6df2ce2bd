"""Programs that an earlier process has traced: found, equal, and used only if nothing has changed."""

import dataclasses
import hashlib
import os
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np
import point_mass
import probe_environments as probes
import pytest
import small_program
from jax.experimental.compilation_cache import compilation_cache

import jaxrl_vis_envs
from jaxrl_vis import cli
from jaxrl_vis.config import preset
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.devices import enable_compilation_cache
from jaxrl_vis.learner import train_step
from jaxrl_vis.learner.environment import make_env
from jaxrl_vis.run import trainer
from jaxrl_vis.run.compiled import trace_cache
from jaxrl_vis.run.compiled.programs import Programs
from jaxrl_vis.run.compiled.trace_cache import CACHE_VARIABLE, fingerprint
from jaxrl_vis.run.storage.folder import RunFolder
from jaxrl_vis_envs import registry
from jaxrl_vis_envs.compiling import compilation
from jaxrl_vis_envs.compiling.compilation import kernels
from jaxrl_vis_envs.pixels import PixelsConfig

# Whatever is traced here is traced often, so it is the environment that takes least, without physics and renderer; and once
# the one of those that have them.
CONFIG = preset("debug", env="VisualTold", num_envs=2)
RENDERED = preset("debug", env="VisualPoint", image_size=8, num_envs=2)
NAMES = ["init", "learn", "play"]


class Told(probes.SeenGoWhereTold):
    """Probe whose module makes it a built-in task."""

    __module__ = "jaxrl_vis_envs.tasks.told"


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch) -> Iterator[Path]:
    """Folder in which programs of the registered tasks are kept."""
    monkeypatch.setattr(compilation, "_assumed", set())  # of kernels that other tests have let in
    monkeypatch.setitem(registry._ENTRIES, "VisualTold", registry._Entry(lambda _: Told(), PixelsConfig))
    with point_mass.registered(tmp_path, point_mass.SimulatedPointMass):
        yield tmp_path / "programs"


@pytest.fixture
def program():
    return small_program.make_train_step(make_env(CONFIG), CONFIG)


def untraceable(program, *names: str):
    """Return the same program with some functions that cannot be traced."""

    def refuse(*arguments):
        raise AssertionError("traced")

    return dataclasses.replace(program, **{name: jaxrl_vis_envs.jit(refuse) for name in names})


def results(made: Programs) -> list[np.ndarray]:
    """Return all arrays that two iterations and an evaluation return."""
    loop, first = made.train_iteration(made.init(made.run_keys))
    loop, second = made.train_iteration(loop)
    leaves = jax.tree.leaves((loop.replace(key=jax.random.key_data(loop.key)), first, second, made.evaluate(loop.train)))
    return [np.asarray(leaf) for leaf in leaves]


def assert_equal(found: list[np.ndarray], expected: list[np.ndarray]) -> None:
    assert len(found) == len(expected)
    assert all(np.array_equal(*pair, equal_nan=pair[0].dtype.kind == "f") for pair in zip(found, expected, strict=True))


def names_in(folder: Path) -> list[str]:
    return sorted(path.name.partition("-")[0] for path in folder.iterdir())


@pytest.mark.parametrize(("names", "config"), [(NAMES, RENDERED), (["evaluate", *NAMES], CONFIG)], ids=["cpu", "gpu"])
def test_what_was_traced_once_is_not_traced_again_and_computes_the_same(folder, monkeypatch, names, config):
    monkeypatch.setattr(train_step, "targets_cpu", lambda: "evaluate" not in names)
    program = train_step.make_train_step(make_env(config), config)
    straight = results(Programs(config, program))
    assert not folder.exists()
    first = Programs(config, program, keep=True)
    first.compile()
    assert names_in(folder) == names
    assert_equal(results(first), straight)
    again = Programs(config, untraceable(program, *(name for name in names if name != "init")), keep=True)
    again.compile()
    assert_equal(results(again), straight)
    assert again.compile()[names[-1]].memory_analysis().argument_size_in_bytes > 0
    with pytest.raises(AssertionError, match="traced"):
        Programs(config.replace(batch_size=8), untraceable(program, *names), keep=True).compile()


def test_damaged_and_unsuitable_programs_are_traced_anew(folder, program):
    Programs(CONFIG, program, keep=True).compile()
    files = {path.name.partition("-")[0]: path for path in folder.iterdir()}
    good = {name: path.read_bytes() for name, path in files.items()}
    files["learn"].write_bytes(good["learn"][:-100])
    files["init"].write_bytes(b"")
    Programs(CONFIG, program, keep=True).compile()
    assert {path.name.partition("-")[0]: path.read_bytes() for path in folder.iterdir()} == good
    files["learn"].write_bytes(good["play"])  # whole, but renamed
    Programs(CONFIG, program, keep=True).compile()
    assert {path.name.partition("-")[0]: path.read_bytes() for path in folder.iterdir()} == good
    data = good["play"][32:]  # of something else, with a digest that fits
    files["learn"].write_bytes(hashlib.sha256(files["learn"].name.encode() + b"\0" + data).digest() + data)
    unsuitable = Programs(CONFIG, program, keep=True)
    unsuitable.compile()
    assert_equal(results(unsuitable), results(Programs(CONFIG, program)))
    assert names_in(folder) == []
    Programs(CONFIG, program, keep=True).compile()
    assert names_in(folder) == NAMES


def test_a_folder_that_cannot_be_written_to_keeps_nothing_and_hinders_nothing(folder, program):
    folder.write_text("a file")
    Programs(CONFIG, program, keep=True).compile()
    assert folder.read_text() == "a file"


def test_the_oldest_programs_make_room(folder, program, monkeypatch):
    folder.mkdir()
    for age in range(5):
        path = folder / f"init-{age}.stablehlo"
        path.write_bytes(b"old")
        os.utime(path, (1000 - age, 1000 - age))
    monkeypatch.setattr(trace_cache, "MAX_FILES", 5)
    Programs(CONFIG, program, keep=True).compile()
    assert names_in(folder) == ["init", "init", "init", "learn", "play"]
    assert {"init-0.stablehlo", "init-1.stablehlo"} <= {path.name for path in folder.iterdir()}


def test_a_fingerprint_is_of_all_that_is_compiled_in(folder, monkeypatch):
    env = make_env(CONFIG)
    own = fingerprint(CONFIG, env)
    assert own is not None
    assert own == fingerprint(CONFIG.replace(seed=7, env_steps=12_345, eval_interval=3), env)
    others = [fingerprint(CONFIG.replace(**{name: value}), env) for name, value in (("seeds", 2), ("discount", 0.5))]
    before = jax.config.jax_default_matmul_precision
    try:
        jax.config.update("jax_default_matmul_precision", "highest")
        others.append(fingerprint(CONFIG, env))
    finally:
        jax.config.update("jax_default_matmul_precision", before)
    monkeypatch.setattr(trace_cache, "versions", lambda: {"jax": "0"})
    others.append(fingerprint(CONFIG, env))
    monkeypatch.setattr(trace_cache, "_code", lambda: "other")
    others.append(fingerprint(CONFIG, env))
    assert len({own, *others}) == 1 + len(others)


def test_a_fingerprint_sees_whether_kernels_are_used(folder, monkeypatch):
    env = make_env(CONFIG)
    monkeypatch.setattr(trace_cache, "use_gpu_kernels", lambda: True)
    with_kernels = fingerprint(CONFIG, env)
    monkeypatch.setattr(trace_cache, "use_gpu_kernels", lambda: False)
    assert with_kernels != fingerprint(CONFIG, env)
    with kernels(False):
        assert fingerprint(CONFIG, env) is not None


def test_a_change_of_any_file_of_a_package_is_another_program(tmp_path, monkeypatch):
    package = tmp_path / "some_package"
    (package / "assets").mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package / "assets" / "model.xml").write_text("<mujoco/>")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(trace_cache, "_PACKAGES", ("some_package",))
    digest = trace_cache._code.__wrapped__
    before = digest()
    (package / "__pycache__").mkdir()
    (package / "__pycache__" / "x.pyc").write_bytes(b"1")
    assert digest() == before
    (package / "assets" / "model.xml").write_text("<mujoco />")
    assert digest() != before


def test_environments_from_elsewhere_are_not_kept(folder, monkeypatch):
    env = make_env(CONFIG)

    class Own(type(env)):
        pass

    assert fingerprint(CONFIG, object.__new__(Own)) is None
    monkeypatch.setenv(CACHE_VARIABLE, "0")
    assert fingerprint(CONFIG, env) is None


@pytest.mark.parametrize("command", ["eval", "play"])
def test_commands_find_what_training_has_traced(command, tmp_path, monkeypatch, capsys):
    run_dir = tmp_path / "run"
    run_dir.mkdir()
    RunFolder(run_dir).open(CONFIG, False, False, ())
    (run_dir / "checkpoints" / "light" / "2").mkdir(parents=True)
    asked = []

    def remember(config, program, keep=False):
        asked.append(keep)
        raise RequestError("enough")

    monkeypatch.setattr(trainer, "Programs", remember)
    assert cli.main([command, str(run_dir)]) == 2
    assert asked == [True] and "enough" in capsys.readouterr().err


def test_commands_cache_programs_and_scripts_do_not(tmp_path, monkeypatch, capsys):
    asked = []

    def remember(config, program, keep=False):
        asked.append(keep)
        raise RequestError("enough")

    monkeypatch.setattr(trainer, "Programs", remember)
    assert cli.main(["train", "VisualFetchReach", "--preset", "debug", "--run-dir", str(tmp_path / "run")]) == 2
    with pytest.raises(RequestError, match="enough"):
        trainer.make_trainer(CONFIG)
    assert asked == [True, False]
    assert "enough" in capsys.readouterr().err


@pytest.fixture
def kept(folder) -> trace_cache.TraceCache:
    """Cache that holds a program, which is a few bytes and not one of JAX."""
    made = trace_cache.TraceCache(folder, "0" * 64)
    made._fresh["play"] = b"a program"
    made.write()
    trace_cache._print_once.cache_clear()
    return made


needs_owners = pytest.mark.skipif(os.name != "posix", reason="owners and modes are POSIX")


@needs_owners
def test_programs_are_kept_for_their_user_alone(folder, kept):
    (path,) = folder.iterdir()
    assert (folder.stat().st_mode & 0o777, path.stat().st_mode & 0o777) == (0o700, 0o600)
    assert kept._read("play") == b"a program"
    folder.chmod(0o777)  # as an umask of earlier versions may have left it
    assert kept._read("play") == b"a program" and folder.stat().st_mode & 0o777 == 0o700
    path.chmod(0o666)  # but what others could have changed in the meantime is not believed
    assert kept._read("play") is None


@needs_owners
@pytest.mark.parametrize("whose", ["folder", "file", "link"])
def test_another_users_programs_are_not_used(folder, kept, monkeypatch, capsys, whose):
    (path,) = folder.iterdir()
    stranger = os.geteuid() + 4000
    if whose == "link":
        path.rename(folder / "elsewhere")
        path.symlink_to(folder / "elsewhere")
    elif os.geteuid() == 0:
        os.chown(folder if whose == "folder" else path, stranger, -1)
    else:
        monkeypatch.setattr(os, "geteuid", lambda: stranger)
    before = path.read_bytes()
    assert kept._read("play") is None and kept._read("play") is None
    said = capsys.readouterr().err
    if whose == "folder":
        assert said.count("belongs to another user") == 1 and said.count("\n") == 1 and str(folder) in said
        kept._fresh["play"] = b"another"
        kept.write()
        assert path.read_bytes() == before


def test_a_program_under_another_ones_name_is_not_used(folder, kept):
    (path,) = folder.iterdir()
    path.rename(folder / path.name.replace("play", "learn"))
    assert kept._read("learn") is None


@pytest.mark.parametrize("damage", ["cut", "flipped", "empty"])
def test_a_damaged_entry_of_xlas_cache_is_mended_and_not_reported(tmp_path, recwarn, damage):
    before = (jax.config.jax_compilation_cache_dir, jax.config.jax_persistent_cache_min_compile_time_secs)

    def compile_anew() -> None:
        def mended(x):
            return jax.numpy.sin(x) @ x

        jax.jit(mended).lower(np.ones((3, 3), np.float32)).compile()

    try:
        jax.config.update("jax_compilation_cache_dir", str(tmp_path))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
        compilation_cache.reset_cache()
        enable_compilation_cache()
        compile_anew()
        (entry,) = tmp_path.glob("jit_mended-*-cache")
        whole = entry.read_bytes()
        damaged = {"cut": whole[: len(whole) // 2], "flipped": bytes([whole[0] ^ 0xFF]) + whole[1:], "empty": b""}[damage]
        entry.write_bytes(damaged)
        jax.clear_caches()
        compile_anew()
        assert len(entry.read_bytes()) > len(whole) // 2 and entry.read_bytes() != damaged
    finally:
        for name, value in zip(("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs"), before):
            jax.config.update(name, value)
        compilation_cache.reset_cache()
    assert not [warning for warning in recwarn if "compilation cache" in str(warning.message)]
