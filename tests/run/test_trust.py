"""Run folders that bring code of their own: users are asked before it runs, and their answer is remembered."""

import io
import json
import shutil
import sys
from pathlib import Path

import pytest

import jaxrl_vis
from jaxrl_vis import cli
from jaxrl_vis.config import preset
from jaxrl_vis.errors import RequestError
from jaxrl_vis.run import trust
from jaxrl_vis.run.storage.folder import RunFolder, read_config
from jaxrl_vis.run.trained import restored_run

EVIL = """
from pathlib import Path
Path("ran").write_text("ran")
"""
CONFIG = preset("debug", env="evil:Reach")
COMMANDS = {
    "eval": ["eval", "run"],
    "play": ["play", "run"],
    "aux": ["play", "run", "--aux"],
    "resume": ["train", "--resume", "--run-dir", "run"],
    "grasp": ["grasp", "eval", "--reach", "--loops", "policy", "--policy", "run", "--runs", "1"],
}


@pytest.fixture
def cache(tmp_path, monkeypatch) -> Path:
    """Folder of trusted runs in the user's cache, which is empty."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(trust, "_trusted_here", set())
    return tmp_path / "cache" / "jaxrl-vis" / "trusted"


@pytest.fixture
def stranger(here, cache) -> Path:
    """Run of another user in the current folder, with code in its folder."""
    run = here / "run"
    config = CONFIG.replace(env_folder="run", aux_tasks=("autoencoder",), weighting="fixed")
    RunFolder(run).open(config)
    (run / "evil.py").write_text(EVIL)
    return run


@pytest.mark.parametrize("command", COMMANDS)
def test_a_strangers_code_does_not_run_without_a_word(stranger, capsys, command):
    assert cli.main(COMMANDS[command]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "evil:Reach" in error and str(stranger / "evil.py") in error and "--trust" in error
    assert not Path("ran").exists() and "evil" not in sys.modules
    if command == "grasp":
        return  # which evaluates for long before it loads the policy
    assert cli.main([*COMMANDS[command], "--trust"]) == 2  # it holds no such task, which only those learn who import it
    assert "evil has no Reach" in capsys.readouterr().err and Path("ran").exists()


def test_python_needs_a_word_as_well(stranger, tmp_path):
    for use in (
        jaxrl_vis.load_policy,
        restored_run.evaluate_run,
        restored_run.open_run,
        lambda run: restored_run.play_run(run, "a.gif"),
    ):
        with pytest.raises(RequestError, match="runs code that is not of this project.*pass trust=True"):
            use("run")
    assert not Path("ran").exists()
    with pytest.raises(RequestError, match="evil has no Reach"):
        jaxrl_vis.load_policy("run", trust=True)
    assert Path("ran").exists()


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(("answer", "runs"), [("y\n", True), ("Yes\n", True), ("\n", False), ("n\n", False), ("", False)])
def test_on_a_terminal_there_is_a_question(stranger, monkeypatch, answer, runs):
    monkeypatch.setattr(sys, "stdin", Terminal(answer))
    monkeypatch.setattr(sys, "stderr", Terminal())
    assert cli.main(["eval", "run"]) == 2
    assert "Run it? [y/N]" in sys.stderr.getvalue() and Path("ran").exists() == runs  # type: ignore[attr-defined]


def test_what_was_trusted_is_remembered_for_that_run_and_that_code(stranger, cache, here, monkeypatch):
    config = read_config(stranger)
    trust.check(stranger, config, is_permitted=True)
    monkeypatch.setattr(trust, "_trusted_here", set())  # as another process
    assert trust.is_trusted(stranger, config)
    copy = shutil.copytree(stranger, here / "copy")
    assert not trust.is_trusted(copy, read_config(copy))
    assert not trust.is_trusted(stranger, config.replace(env="evil:Other"))
    (stranger / "helper.py").write_text("")  # which evil.py could import
    assert not trust.is_trusted(stranger, config)
    (stranger / "helper.py").unlink()
    assert trust.is_trusted(stranger, config)
    (stranger / "evil.py").write_text(EVIL + "1")
    assert not trust.is_trusted(stranger, config)
    (stranger / "evil.py").write_text(EVIL)
    record = json.loads((stranger / "config.json").read_text())
    (stranger / "config.json").write_text(json.dumps({**record, "run_id": "0" * 32}))
    assert not trust.is_trusted(stranger, config)
    (stranger / "config.json").write_text(json.dumps(record))
    (file,) = cache.iterdir()
    file.chmod(0o666)  # anybody could have written that
    assert not trust.is_trusted(stranger, config)


def test_whoever_has_trained_a_run_is_not_asked(here, cache, monkeypatch):
    """The code may change, because those who train with it also edit it."""
    (here / "mine.py").write_text("")
    config = CONFIG.replace(env="mine:Reach", env_folder=str(here))
    run = here / "runs" / "mine"
    RunFolder(run).open(config)
    trust.trust(run, config, was_trained_here=True)
    monkeypatch.setattr(trust, "_trusted_here", set())
    (here / "mine.py").write_text("changed = True")
    assert trust.is_trusted(run, config)
    monkeypatch.chdir("/")
    assert trust.is_trusted(run, config)
    (run / "mine.py").write_text("")  # as somebody else may put it there
    assert not trust.is_trusted(run, config.replace(env_folder=str(run)))


def test_a_cache_that_cannot_be_written_is_not_an_obstacle(stranger, cache):
    cache.parent.parent.mkdir()
    cache.parent.write_text("a file")
    config = read_config(stranger)
    trust.check(stranger, config, is_permitted=True)
    assert trust.is_trusted(stranger, config)  # by this process


@pytest.mark.parametrize("env", ["a/b:Reach", "a:b:c", ":", "a\0b:Reach"])
def test_a_task_that_is_not_so_written_is_one_line(stranger, capsys, env):
    record = json.loads((stranger / "config.json").read_text())
    record["config"]["environment"]["env"] = env
    (stranger / "config.json").write_text(json.dumps(record))
    assert cli.main(["eval", "run"]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_tasks_of_this_project_are_not_asked_about(here, cache):
    run = here / "run"
    RunFolder(run).open(preset("debug"))
    trust.check(run, read_config(run), is_permitted=False)
    assert not cache.exists()
