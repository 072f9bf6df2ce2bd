"""The grid engine, with small scripts in place of training runs."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from jaxrl_vis.cli.parsing import parse
from jaxrl_vis.cli.train import Train, training_config
from jaxrl_vis.config import preset
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.devices import Device, list_devices
from jaxrl_vis.run.storage.folder import SCHEMA
from jaxrl_vis.studies.engine.cells import (
    Cell,
    describe_progress,
    find_folder,
    finished_rows,
    format_budget,
    is_finished,
    split_seeds,
)
from jaxrl_vis.studies.engine.grid import run_cells, train_command

CPU = [Device("the CPU", {})]

# A run that evaluates every 100 steps, and records how it was started; one word selects what else it does.
SCRIPT = """
import json, os, pathlib, signal, sys, time
folder, config, behaviour = pathlib.Path(sys.argv[1]), sys.argv[4], sys.argv[5]
steps, seeds = int(sys.argv[2]), int(sys.argv[3])
folder.mkdir(exist_ok=True)
(folder / "config.json").write_text(config)
signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
with open(folder / "seen", "a") as file:
    file.write(json.dumps([os.environ.get("CUDA_VISIBLE_DEVICES"), sys.argv[6:], time.time(), os.getpid()]) + "\\n")
if behaviour == "fails":
    print("first words")
    sys.exit("jaxrl-vis: out of luck")
metrics = folder / "metrics.jsonl"
done = len(metrics.read_text().splitlines()) // seeds if metrics.exists() else 0
for number in range(done + 1, -(-steps // 100) + 1):
    with open(metrics, "a") as file:
        for seed in range(seeds):
            row = {"seed": seed, "iteration": number, "env_steps": 100 * number, "updates": number, "eval/success": number / 10}
            file.write(json.dumps(row) + "\\n")
    if behaviour == "waits":
        time.sleep(60)
    if behaviour == "ends early":
        break
time.sleep(0.3)
"""


def make_cell(name: str, **changes) -> Cell:
    return Cell(name, preset("debug", **{"env_steps": 300, "seeds": 2, **changes}))


def saved(cell: Cell) -> str:
    return json.dumps({"schema": SCHEMA, "config": dataclasses.asdict(cell.config)})


class Script:
    """Commands of cells, with special behaviour of some families; it records its calls."""

    def __init__(self, **behaviour: str):
        self.behaviour, self.calls = behaviour, []

    def __call__(self, cell: Cell, folder: Path, is_resumed: bool) -> Sequence[str]:
        self.calls.append((cell.family, is_resumed))
        words = [str(folder), str(cell.config.run.env_steps), str(cell.config.run.seeds), saved(cell)]
        return [sys.executable, "-c", SCRIPT, *words, self.behaviour.get(cell.family, ""), *["--resume"] * is_resumed]


def seen(runs: Path, cell: Cell) -> list[list]:
    return [json.loads(line) for line in (runs / cell.name / "seen").read_text().splitlines()]


def run(cells: Sequence[Cell], runs: Path, command: Script, devices=CPU, seconds: float | None = None):
    said: list[str] = []
    return run_cells(cells, runs, lambda: devices, seconds, command, said.append), said


def test_what_is_missing_is_trained_what_is_begun_goes_on_and_what_is_there_stays(tmp_path: Path) -> None:
    cells, runs = [make_cell(name) for name in ("a", "b", "c")], tmp_path / "new" / "runs"
    failures, said = run(cells, runs, Script(b="ends early"))
    assert len(failures) == 1 and "b-300: ended before it was finished" in failures[0] and failures[0] in said
    assert [is_finished(cell, runs) for cell in cells] == [True, False, True]
    assert describe_progress(cells[1], runs) == "100 of 300 steps"
    again = Script()
    assert run(cells, runs, again)[0] == []
    assert again.calls == [("b", True)] and seen(runs, cells[1])[1][1] == ["--resume"]
    assert {row["env_steps"] for row in finished_rows(cells[1], runs)} == {100, 200, 300}
    none = Script()
    assert run_cells(cells, runs, lambda: pytest.fail("asked for devices"), command=none) == [] and not none.calls


def test_a_cell_that_fails_is_reported_in_one_line_and_the_others_go_on(tmp_path: Path) -> None:
    cells = [make_cell("a"), make_cell("b")]
    failures, said = run(cells, tmp_path, Script(a="fails"))
    (line,) = failures
    assert line.startswith("a-300: failed with exit status 1") and "jaxrl-vis: out of luck" in line and "\n" not in line
    log = Path(line.partition("(log: ")[2].rstrip(")"))
    assert log.read_text().splitlines() == ["first words", "jaxrl-vis: out of luck"]
    assert is_finished(cells[1], tmp_path) and said[-1].startswith("b-300: done in") and "success 0.30" in said[-1]


def test_a_cell_that_trained_with_other_settings_says_which(tmp_path: Path) -> None:
    """The log ends like that of any good run; another version may have been installed while a figure was trained."""
    cell = make_cell("a")
    script = Script()

    def trains_another(_: Cell, folder: Path, is_resumed: bool) -> Sequence[str]:
        return script(dataclasses.replace(cell, config=cell.config.replace(discount=0.5)), folder, is_resumed)

    (failure,) = run_cells([cell], tmp_path, lambda: CPU, command=trains_another, echo=lambda _: None)
    assert "ended before it was finished" in failure and "discount (saved 0.5, asked" in failure


def test_the_longest_begin_first(tmp_path: Path) -> None:
    with_losses = {"aux_tasks": ("egomotion",), "weighting": "sum"}
    cells = [make_cell("short"), make_cell("like it"), make_cell("weighted", **with_losses), make_cell("long", env_steps=600)]
    script = Script()
    assert run(cells, tmp_path, script)[0] == []
    assert [family for family, _ in script.calls] == ["weighted", "long", "short", "like it"]


def test_every_device_has_one_process_at_a_time(tmp_path: Path) -> None:
    cells = [make_cell(name) for name in "abcde"]
    devices = [Device(f"GPU {number}", {"CUDA_VISIBLE_DEVICES": str(number)}) for number in (3, 5)]
    assert run(cells, tmp_path, Script(), devices)[0] == []
    order = sorted((tuple(seen(tmp_path, cell)[0][:1]), seen(tmp_path, cell)[0][2]) for cell in cells)
    assert {device for (device,), _ in order} == {"3", "5"}
    for one in ("3", "5"):
        starts = [at for (device,), at in order if device == one]
        assert len(starts) >= 2 and all(later - before > 0.29 for before, later in zip(starts, starts[1:]))
    first = sorted(at for _, at in order)[:2]
    assert first[1] - first[0] < 0.29  # side by side


def test_time_that_is_up_stops_cells_and_they_are_no_failures(tmp_path: Path) -> None:
    cells = [make_cell("a"), make_cell("b")]
    failures, said = run(cells, tmp_path, Script(a="waits"), seconds=1.0)
    assert failures == [] and any("a-300: stopped" in line and "start again to resume" in line for line in said)
    assert not (tmp_path / cells[1].name).exists()
    assert run(cells, tmp_path, Script())[0] == [] and all(is_finished(cell, tmp_path) for cell in cells)


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_signals_end_the_cells_after_saving(
    tmp_path: Path, clean_environment: dict[str, str], number: int, status: int
) -> None:
    code = f"""
import sys
sys.path[:0] = [{str(Path(__file__).parent)!r}, {str(Path(__file__).parents[1])!r}]
from pathlib import Path
from test_studies_grid import CPU, Script, make_cell
from jaxrl_vis.errors import Terminated
from jaxrl_vis.studies.engine.grid import run_cells
try:
    run_cells([make_cell("a"), make_cell("b")], Path({str(tmp_path)!r}), lambda: CPU, command=Script(a="waits"))
except KeyboardInterrupt:
    sys.exit(130)
"""
    process = subprocess.Popen(
        [sys.executable, "-u", "-c", code], env=clean_environment, stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    cell = make_cell("a")
    deadline = time.monotonic() + 60
    while not (tmp_path / cell.name / "metrics.jsonl").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    # As a terminal and `timeout` send it, to the whole group: the cells hear of it once, from the engine.
    os.killpg(process.pid, number)
    out, _ = process.communicate(timeout=60)
    assert process.returncode == status and "a-300: stopped" in out and "b-300" not in out
    with pytest.raises(ProcessLookupError):
        os.kill(seen(tmp_path, cell)[0][3], 0)


def test_a_second_signal_does_not_wait(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After the second signal, a process that ignores SIGTERM is not waited for, and is not left running."""
    monkeypatch.setattr("jaxrl_vis.studies.engine.grid._GRACE_S", 0.5)
    cell = make_cell("a")
    pids: list[int] = []

    def deaf(*_):
        code = "import pathlib, signal, sys, time; signal.signal(signal.SIGTERM, signal.SIG_IGN)"
        code += "; pathlib.Path(sys.argv[1]).touch(); time.sleep(60)"
        return [sys.executable, "-c", code, str(tmp_path / "deaf")]

    class Watched(subprocess.Popen):
        def __init__(self, *args, **options):
            super().__init__(*args, **options)
            pids.append(self.pid)

    monkeypatch.setattr(subprocess, "Popen", Watched)
    polls = 0

    def sleep(seconds: float) -> None:
        nonlocal polls
        if (tmp_path / "deaf").exists():
            polls += 1
            if polls in (1, 3):
                signal.raise_signal(signal.SIGINT)
        real_sleep(seconds)

    real_sleep = time.sleep
    monkeypatch.setattr("jaxrl_vis.studies.engine.grid.time.sleep", sleep)
    with pytest.raises(KeyboardInterrupt):
        run_cells([cell], tmp_path, lambda: CPU, command=deaf, echo=lambda _: None)
    with pytest.raises(ProcessLookupError):
        os.kill(pids[0], 0)


def test_a_folder_with_another_run_is_refused_before_anything_starts(tmp_path: Path) -> None:
    cell = make_cell("a")
    run([make_cell("a", batch_size=8)], tmp_path, Script())
    command = Script()
    failures, _ = run([cell, make_cell("b")], tmp_path, command)
    assert "batch_size (saved 8, asked 16)" in failures[0] and "--runs" in failures[0]
    assert command.calls == [("b", False)] and finished_rows(cell, tmp_path) == []


@pytest.mark.parametrize("contents", ['{"schema": ', '{"schema": 99}'])
def test_a_damaged_run_is_reported_with_a_mend_that_there_is(contents: str, tmp_path: Path) -> None:
    """`train --overwrite` would mend it; a sweep and a figure have no such option."""
    cell = make_cell("a")
    (tmp_path / cell.name).mkdir()
    (tmp_path / cell.name / "config.json").write_text(contents)
    (failure,), said = run([cell], tmp_path, Script())
    assert "move it away" in failure and "--overwrite" not in failure and said == [failure]


def test_a_longer_run_serves_a_shorter_cell_and_never_the_other_way_round(tmp_path: Path) -> None:
    long, short = make_cell("a", env_steps=1000), make_cell("a", env_steps=250)
    run([short], tmp_path, Script())
    assert not is_finished(long, tmp_path)
    run([long], tmp_path, Script())
    other = make_cell("a", env_steps=450)
    assert find_folder(other, tmp_path) == tmp_path / long.name
    assert {row["env_steps"] for row in finished_rows(other, tmp_path)} == {100, 200, 300, 400, 500}
    assert find_folder(short, tmp_path) == tmp_path / short.name
    # Neither another configuration nor other evaluations.
    for changes in ({"batch_size": 8}, {"eval_interval": 1}):
        assert not is_finished(make_cell("a", env_steps=450, **changes), tmp_path)


def test_seeds_can_be_split_and_names_say_which() -> None:
    parts = split_seeds(make_cell("a", seeds=5, seed=3, env_steps=250_000), 2)
    assert [part.name for part in parts] == ["a-seeds3to4-250k", "a-seeds5to6-250k", "a-seed7-250k"]
    assert [list(part.seeds) for part in parts] == [[3, 4], [5, 6], [7]]
    assert [format_budget(steps) for steps in (800, 1234, 19_200, 600_000, 1_440_000)] == [
        "800",
        "1234",
        "19.2k",
        "600k",
        "1.44M",
    ]


@pytest.mark.parametrize("name", ["paper", "fast", "cpu"])
def test_the_command_trains_what_the_cell_says(name: str, tmp_path: Path) -> None:
    """The command is right even if a preset has settings of its own for a task, and a cell restores the general ones."""
    config = preset(name, env="VisualHandReach", aux_tasks=("egomotion",), weighting="balance").replace(num_envs=100)
    words = train_command(Cell("a", config), tmp_path, True)
    assert words[1:4] == ["-m", "jaxrl_vis", "train"] and words[-1] == "--resume"
    asked = parse(Train, words[4:])
    assert asked.run_dir == tmp_path and asked.resume
    assert training_config(dataclasses.replace(asked, resume=False)) == config


def test_the_engine_starts_no_jax(clean_environment: dict[str, str]) -> None:
    code = "import sys; from jaxrl_vis.studies.figures import make; assert 'jax' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], env=clean_environment, check=True)


def answer(monkeypatch: pytest.MonkeyPatch, order: object, status: int = 0) -> None:
    done = subprocess.CompletedProcess([], status, json.dumps(order), "jaxlib grumbles\nJAX finds no such device\n")
    monkeypatch.setattr("jaxrl_vis.host.devices.subprocess.run", lambda *_, **__: done)


def test_devices_are_distinguished(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    answer(monkeypatch, [["gpu", "H200"]] * 2)
    assert [device.environment for device in list_devices()] == [{"CUDA_VISIBLE_DEVICES": "0"}, {"CUDA_VISIBLE_DEVICES": "1"}]
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "4, GPU-ab")
    assert [device.environment["CUDA_VISIBLE_DEVICES"] for device in list_devices()] == ["4", "GPU-ab"]
    answer(monkeypatch, [["gpu", "H200"]])
    assert list_devices() == [Device("H200", {})]
    answer(monkeypatch, [["cpu", "cpu"]])
    assert list_devices() == [Device("the CPU", {})]
    answer(monkeypatch, None, status=1)
    with pytest.raises(RequestError, match="^JAX finds no such device$"):
        list_devices()


def test_devices_are_asked_for_in_a_process_of_their_own() -> None:
    assert list_devices() == [Device("the CPU", {})]


def test_real_runs_are_trained_and_a_wrong_one_says_why(tmp_path: Path) -> None:
    """Runs are trained by processes of their own, on a task that compiles in a moment."""
    own = {"env": "point_mass:PointMass", "env_folder": str(Path(__file__).parents[1]), "env_steps": 80, "seeds": 1}
    own |= {"image_size": 8, "encoder_filters": (4,), "eval_episodes": 2}  # as in test_own_tasks: it is compiled once for both
    cells = [make_cell("wrong", **own, batch_size=0), make_cell("right", **own)]
    failures = run_cells(cells, tmp_path, lambda: CPU, echo=lambda _: None)
    assert len(failures) == 1 and "wrong-80: failed with exit status 2" in failures[0]
    assert "batch_size must be at least 1, not 0" in failures[0]
    assert not (tmp_path / cells[0].name).exists()
    assert is_finished(cells[1], tmp_path) and (tmp_path / cells[1].name / "video.gif").exists()
    assert "success at the end" in (tmp_path / f"{cells[1].name}.log").read_text()
