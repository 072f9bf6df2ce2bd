"""What JAX computes on: told in one line where it is not there, and guessed where help must not wait for JAX."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from jaxrl_vis import devices
from jaxrl_vis.run.memory import show_bytes

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
    """Every command says in one line what was asked for, what there is and how to mend it."""
    run = tmp_path / "run"
    run.mkdir()
    (run / "config.json").write_text(json.dumps({"schema": 1, "config": {"env": "Reacher"}}))
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
    """A first refusal, which looks for what there is, must not let the second attempt run on that."""
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
    monkeypatch.setattr(devices, "_is_there", lambda _: there)
    assert devices.guess_accelerator() is expected


def test_a_gpu_without_its_packages_is_mended_by_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(devices, "_is_installed", lambda _: False)
    monkeypatch.setattr(devices, "_is_there", lambda _: True)
    assert devices._mend("cuda") == "; install this project with the extra cuda12 or cuda13"


def test_sizes_are_all_in_one_unit() -> None:
    sizes = [show_bytes(count) for count in (0, 1000, 5 * 2**20, 2**27, 3 * 2**30, 2**45)]
    assert sizes == ["under 0.001 GiB", "under 0.001 GiB", "0.005 GiB", "0.1 GiB", "3.0 GiB", "32768.0 GiB"]


@pytest.mark.parametrize("given", [{}, {"XLA_CLIENT_MEM_FRACTION": "0.5"}, {"XLA_PYTHON_CLIENT_MEM_FRACTION": "0.4"}])
def test_training_claims_most_of_a_gpu_unless_told_how_much(given: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    names = ("XLA_CLIENT_MEM_FRACTION", "XLA_PYTHON_CLIENT_MEM_FRACTION")
    for name in names:
        monkeypatch.setenv(name, "")  # so that what is set here ends with the test
        monkeypatch.delenv(name)
    for name, value in given.items():
        monkeypatch.setenv(name, value)
    devices.claim_memory()
    # JAX refuses to start with both.
    assert {name: os.environ[name] for name in names if name in os.environ} == (given or {names[1]: "0.9"})
