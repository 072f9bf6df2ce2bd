"""The smoke test of the installation: it reports every unexpected result, and its commands are those of docs/start.md."""

import runpy
import shlex
from pathlib import Path

import pytest

from jaxrl_vis.cli import all_commands
from jaxrl_vis.cli.parsing import parse

SCRIPT = runpy.run_path(str(Path(__file__).resolve().parents[2] / "benchmarks" / "install_smoke_test.py"))


@pytest.fixture
def shell(tmp_path):
    return SCRIPT["Shell"](tmp_path, {"PATH": "/usr/bin:/bin"})


@pytest.mark.parametrize(
    ("words", "expectations"),
    [
        ("true", {}),
        ("echo it shows", {"shows": "shows"}),
        ("echo one line >&2; exit 2", {"status": 2}),
        ("test $NAME = value", {"NAME": "value"}),
    ],
)
def test_what_is_as_expected_is_not_a_failure(shell, words, expectations, capsys):
    shell.run(words, **expectations)
    assert not shell.failures
    assert ": as expected" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "expectations", "problem"),
    [
        ("false", {}, "exit status 1, not 0"),
        ("true", {"status": 2}, "exit status 0, not 2"),
        ("echo it", {"shows": "that"}, "'that' is missing"),
        ("echo one; echo two; exit 2", {"status": 2}, "2 lines, not one"),
        ("exit 2", {"status": 2}, "0 lines, not one"),
    ],
)
def test_what_is_not_as_expected_is_a_failure(shell, words, expectations, problem, capsys):
    shell.run(words, **expectations)
    (failure,) = shell.failures
    assert words in failure and problem in failure
    assert "NOT AS EXPECTED" in capsys.readouterr().out


def test_it_starts_without_the_settings_of_the_caller(monkeypatch, tmp_path):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "/warm")
    monkeypatch.setenv("PIP_INDEX_URL", "https://registry.example.org")
    environment = SCRIPT["new_shell"](tmp_path / "shell", Path("/usr/bin/python3")).environment
    assert "JAX_COMPILATION_CACHE_DIR" not in environment
    assert environment["PIP_INDEX_URL"] == "https://registry.example.org"
    assert not list(Path(environment["HOME"]).iterdir())


@pytest.mark.parametrize("line", SCRIPT["first_commands"]())
def test_first_commands_can_be_typed_and_made_tiny(line):
    for words in (shlex.split(line), shlex.split(SCRIPT["tiny"](line))):
        command, _ = all_commands()[words[1]]
        options = parse(command, words[2:])
    if words[1] == "train" and "--resume" not in words:
        assert options.preset == "debug"


def test_the_task_of_the_notebook_is_found():
    assert "class PuckPush(" in SCRIPT["puck_push"]()
