"""`jaxrl-vis search`: Optuna proposes, scripts train, and interrupted searches continue."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from test_studies_grid import CPU, saved

from jaxrl_vis import cli
from jaxrl_vis.cli.parsing import parse
from jaxrl_vis.cli.train import Train, training_config
from jaxrl_vis.config import preset
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.devices import Device
from jaxrl_vis.studies.engine.cells import Cell
from jaxrl_vis.studies.engine.search import JOURNAL, Range, Request, read_range, run_search

optuna = pytest.importorskip("optuna")

# A run whose one evaluation is the better, the nearer its batch is to 40.
SCRIPT = """
import json, pathlib, sys, time
folder, config, steps, batch, behaviour = pathlib.Path(sys.argv[1]), *sys.argv[2:6]
folder.mkdir(exist_ok=True)
(folder / "config.json").write_text(config)
if behaviour == "fails":
    sys.exit("jaxrl-vis: out of luck")
if behaviour == "waits":
    time.sleep(60)
with open(folder / "metrics.jsonl", "a") as file:
    for seed in range(2):
        value = 1 - abs(int(batch) - 40) / 100
        row = {"seed": seed, "iteration": 3, "env_steps": int(steps), "updates": 3}
        row |= {"eval/success": value, "eval/goal_distance": value}
        file.write(json.dumps(row) + "\\n")
"""
BATCH = read_range("batch_size=4..80")
NOISE = read_range("action-noise=0.1,0.2")


class Script:
    """Function that returns the command of a trial, with a given behaviour for some families, and records its calls."""

    def __init__(self, **behaviour: str):
        self.behaviour, self.calls = behaviour, []

    def __call__(self, cell: Cell, folder: Path, is_resumed: bool) -> Sequence[str]:
        self.calls.append((cell.family, cell.config.run.batch_size))
        words = [str(folder), saved(cell), str(cell.config.run.env_steps), str(cell.config.run.batch_size)]
        return [sys.executable, "-c", SCRIPT, *words, self.behaviour.get(cell.family, "")]


def request(runs: Path, trials: int = 2, ranges: tuple[Range, ...] = (BATCH, NOISE), **changes: Any) -> Request:
    config = preset("debug", env="Reacher", **{"seeds": 2, "env_steps": 300, **changes})
    return Request(config, ranges, trials, runs)


def search(asked: Request, script: Script, **options: Any) -> tuple[bool, list[str]]:
    said: list[str] = []
    return run_search(asked, said.append, **{"find_devices": lambda: CPU, "command": script, **options}), said


def scored(runs: Path) -> dict[int, Any]:
    storage = optuna.storages.JournalStorage(optuna.storages.journal.JournalFileBackend(str(runs / JOURNAL)))
    return {trial.number: trial for trial in optuna.load_study(study_name="search", storage=storage).trials}


def test_two_trials_are_trained_and_the_best_is_reported(tmp_path: Path) -> None:
    script = Script()
    is_done, said = search(request(tmp_path), script)
    assert is_done and [family for family, _ in script.calls] == ["trial-0", "trial-1"]
    batches = dict(script.calls)
    assert batches["trial-0"] != batches["trial-1"] and all(4 <= size <= 80 for size in batches.values())
    for number, trial in scored(tmp_path).items():
        assert trial.value == pytest.approx(1 - abs(batches[f"trial-{number}"] - 40) / 100)
    nearest = min(batches, key=lambda family: abs(batches[family] - 40))
    assert "2 of 2 trials done" in said and [line for line in said if line.startswith(nearest)]
    words = said[-1].partition("jaxrl-vis train ")[2].split()
    assert training_config(parse(Train, words)).run.batch_size == batches[nearest]
    again = Script()
    assert search(request(tmp_path), again)[0] and again.calls == []  # nothing is left to do
    assert search(request(tmp_path, trials=3), again)[0] and [family for family, _ in again.calls] == ["trial-2"]


def test_a_trial_that_was_interrupted_goes_on_with_its_values(tmp_path: Path) -> None:
    first = Script(**{"trial-0": "waits"})
    asked = request(tmp_path)
    is_done, said = search(Request(asked.config, asked.ranges, 2, tmp_path, seconds=1.5), first)
    assert not is_done and "start again to go on" in said and "0 of 2 trials done" in said
    again = Script()
    assert search(asked, again)[0] and again.calls[0] == first.calls[0]
    assert [trial.state.name for trial in scored(tmp_path).values()] == ["COMPLETE", "COMPLETE"]


def test_failed_trials_are_reported_and_left_out(tmp_path: Path) -> None:
    is_done, said = search(request(tmp_path, best_by="goal_distance"), Script(**{"trial-0": "fails"}))
    assert is_done and any("trial-0-300: failed with exit status 1" in line for line in said)
    assert "1 of 2 trials done, 1 failed" in said and any("goal_distance" in line for line in said)


def test_devices_train_side_by_side_and_contradictory_values_train_nothing(tmp_path: Path) -> None:
    devices = [Device(f"GPU {number}", {}) for number in range(2)]
    script = Script()
    ranges = (read_range("actor_interval=3,5"),)  # neither divides the preset's four gradient steps
    assert search(request(tmp_path / "a", ranges=ranges), script)[1][-1] == "0 of 2 trials done, 2 failed"
    assert script.calls == []
    is_done, said = search(request(tmp_path / "b", trials=4), script, find_devices=lambda: devices)
    assert is_done and sum("starts on GPU 1" in line for line in said) == 2


def test_another_search_is_refused(tmp_path: Path) -> None:
    search(request(tmp_path, trials=1), Script())
    for asked, words in (
        (request(tmp_path, ranges=(BATCH,)), "with other action_noise, vary|with other vary"),
        (request(tmp_path, env_steps=600), "holds another search, with other env_steps"),
    ):
        with pytest.raises(RequestError, match=words):
            search(asked, Script())
    (tmp_path / JOURNAL).write_text("no journal\n")
    with pytest.raises(RequestError, match="search.journal is not a journal of a search"):
        search(request(tmp_path), Script())


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("batch_size", "write NAME=LOW..HIGH"),
        ("batch_siz=1..2", "unknown option 'batch_siz'; did you mean batch_size"),
        ("lr=1..2", "unknown option 'lr'; see jaxrl-vis train --help"),
        ("batch_size=80..4", "LOW must lie below HIGH"),
        ("random_shift=0..4,log", "above 0 for ,log"),
        ("batch_size=0..4", "batch_size must be at least 1"),
        ("batch_size=4..x", "batch_size"),
        ("batch_size=4", "name two values or more, or set it with --batch-size"),
        ("pixels=rgb,hyperspectral", "pixels cannot be 'hyperspectral'"),
        ("encoders=a..b", "encoders is not a number: list its values"),
    ],
)
def test_ranges_that_cannot_be_are_reported_in_one_line(text: str, words: str) -> None:
    with pytest.raises(RequestError, match=words):
        read_range(text)


def test_the_command_line_tells_what_is_wrong(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    runs = ["--preset", "debug", "--runs", str(tmp_path / "runs")]
    vary = ["--vary", "batch_size=4,8"]
    for words, said in (
        (["Reacher", *runs], "nothing varies"),
        (["Nowhere", *runs, *vary], "unknown environment 'Nowhere'"),
        (["Reacher", *runs, *vary, "batch_size=2..3"], "--vary names an option twice"),
        (["Reacher", *runs, *vary, "--trials", "0"], "--trials must be at least 1"),
        (["Reacher", *runs, *vary, "--devices", "2"], "one device for each run"),
    ):
        assert cli.main(["search", *words]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert said in line
    monkeypatch.setitem(sys.modules, "optuna", None)
    assert cli.main(["search", "Reacher", *runs, *vary]) == 2
    assert "a search needs optuna: " in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()
