"""Sweeps: which runs they consist of, and runs as jobs of submitit, with its local executor and small scripts as runs."""

import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest
import submitit
from test_studies_grid import CPU, Script, make_cell, seen

from jaxrl_vis import cli
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.devices import Device
from jaxrl_vis.studies.engine.cells import Cell, is_finished
from jaxrl_vis.studies.engine.cluster import Cluster, Job, Training
from jaxrl_vis.studies.engine.grid import run_cells
from jaxrl_vis.studies.engine.sweep import Request, make_cells, run_sweep


def make_request(runs: Path, **changes) -> Request:
    asked = {"tasks": ("FetchReach", "Reacher"), "methods": ("oracle", "indicator"), "preset": "debug", "runs": runs}
    return Request(**{**asked, "changes": {"seeds": 3, "env_steps": 300}, **changes})


def test_every_task_is_trained_with_every_method_and_seed(tmp_path: Path) -> None:
    cells = make_cells(make_request(tmp_path, seeds_per_run=2))
    assert [cell.name for cell in cells[:4]] == [
        "FetchReach-oracle-debug-seeds0to1-300",
        "FetchReach-oracle-debug-seed2-300",
        "FetchReach-indicator-debug-seeds0to1-300",
        "FetchReach-indicator-debug-seed2-300",
    ]
    assert len(cells) == 8 and {cell.config.environment.env for cell in cells} == {"FetchReach", "Reacher"}
    assert {(cell.config.reward.method, cell.config.run.seed, cell.config.run.seeds) for cell in cells} == {
        (method, *seeds) for method in ("oracle", "indicator") for seeds in ((0, 2), (2, 1))
    }


def test_a_finished_sweep_trains_nothing_and_shows_what_was_reached(tmp_path: Path) -> None:
    request = make_request(tmp_path, tasks=("Reacher",))
    assert run_cells(make_cells(request), tmp_path, lambda: CPU, command=Script(), echo=lambda line: None) == []
    said: list[str] = []
    assert run_sweep(request, said.append)
    head, *lines = said
    assert head.split()[:4] == ["task", "method", "steps", "seeds"] and len(lines) == 2
    assert lines[0].split() == ["Reacher", "oracle", "300", "3", "0.300", "0.300", "0.300"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["Nowhere"], "unknown environment 'Nowhere'"),
        (["Reacher", "--preset", "none"], "unknown preset 'none'"),
        (["Reacher", "--method", "hope"], "--method cannot be 'hope'"),
        (["Reacher", "--devices", "2", "--seeds", "2"], "a sweep has one device for each run"),
        (["Reacher", "--jobs", "0"], "--jobs must be at least 1"),
        (["Reacher", "--minutes", "0"], "--minutes must be positive"),
        (["Reacher", "--job-options", "timeout_min=5"], "--job-options go with --executor"),
        (["Reacher", "--executor", "local", "--job-options", "timeout_min"], "--job-options are name=value"),
        (["Reacher", "--executor", "slurm"], "--executor slurm cannot be used"),
    ],
)
def test_mistakes_are_reported_in_one_line(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))  # where there is no Slurm
    assert cli.main(["sweep", "--preset", "debug", *words, "--runs", str(tmp_path / "runs")]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert message in line


def run_jobs(cells: Sequence[Cell], runs: Path, command: Script, seconds: float | None = None) -> tuple[list[str], list[str]]:
    said: list[str] = []
    devices = [Device(f"GPU {number}", {"CUDA_VISIBLE_DEVICES": str(number)}) for number in (3, 5)]
    start = Cluster("local", runs / "submitit", ["timeout_min=5"]).start
    return run_cells(cells, runs, lambda: devices, seconds, command, said.append, start), said


def test_jobs_train_cells_each_on_its_device_and_failures_are_reported(tmp_path: Path) -> None:
    cells = [make_cell(name) for name in "abc"]
    failures, said = run_jobs(cells, tmp_path, Script(b="fails"))
    (line,) = failures
    assert line.startswith("b-300: failed with exit status 1") and "jaxrl-vis: out of luck" in line
    assert [is_finished(cell, tmp_path) for cell in cells] == [True, False, True]
    assert {seen(tmp_path, cell)[0][0] for cell in cells} == {"3", "5"}
    assert any(line.startswith("a-300: done in") for line in said)


def test_jobs_that_are_stopped_have_saved_and_go_on(tmp_path: Path) -> None:
    cells = [make_cell("a")]
    failures, said = run_jobs(cells, tmp_path, Script(a="waits"), seconds=4.0)
    assert (tmp_path / cells[0].name / "metrics.jsonl").exists() and not is_finished(cells[0], tmp_path)
    assert failures == [] and any("a-300: stopped" in line for line in said), said
    again = Script()
    assert run_jobs(cells, tmp_path, again)[0] == [] and again.calls == [("a", True)]
    assert is_finished(cells[0], tmp_path)


def test_a_job_that_is_queued_again_resumes(tmp_path: Path) -> None:
    """When a job's time is over under Slurm, submitit asks what to queue in its place."""
    code = "import sys, pathlib; pathlib.Path(sys.argv[1], 'words').write_text(' '.join(sys.argv[2:]))"
    run_dir = tmp_path / "run"
    run_dir.mkdir()
    training = Training([sys.executable, "-c", code, str(run_dir), "--run-dir", str(run_dir)], tmp_path / "log", {})
    assert training() == 0 and "--resume" not in (run_dir / "words").read_text()
    (run_dir / "config.json").write_text("{}")
    later = training.checkpoint()
    assert isinstance(later, submitit.helpers.DelayedSubmission)
    assert later.function() == 0 and (run_dir / "words").read_text().endswith("--resume")


def test_a_job_that_is_lost_counts_as_failed() -> None:
    class Lost:
        def done(self) -> bool:
            return True

        def result(self) -> int:
            raise RuntimeError("no result")

    assert Job(Lost()).poll() == 1


def test_waiting_for_a_job_has_an_end() -> None:
    class Queued:
        def done(self) -> bool:
            return False

    began = time.monotonic()
    with pytest.raises(subprocess.TimeoutExpired):
        Job(Queued()).wait(0.3)
    assert time.monotonic() - began < 5


def test_without_submitit(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "submitit", None)
    with pytest.raises(RequestError, match="--executor local needs submitit: .*cluster"):
        Cluster("local", tmp_path)
