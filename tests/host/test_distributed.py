"""Training in several processes: how they find each other, what they learn and save, and how they end."""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import probe_environments as probes
import pytest
from fake_program import as_plain, rows_without_time

from jaxrl_vis import cli
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.distributed import Rank, find_rank
from jaxrl_vis.learner.train_step import make_train_step
from jaxrl_vis.run.compiled.programs import Programs
from jaxrl_vis.run.storage.checkpoint import Checkpoints
from jaxrl_vis.run.storage.folder import read_config

SRUN = {"SLURM_STEP_NUM_TASKS": "4", "SLURM_PROCID": "3", "SLURM_STEP_NODELIST": "node[1-2]"}
MPIRUN = {"OMPI_COMM_WORLD_SIZE": "2", "OMPI_COMM_WORLD_RANK": "1", "OMPI_MCA_orte_hnp_uri": "1.0;tcp://10.0.0.1:1"}


def test_place_by_options_and_by_launchers() -> None:
    assert find_rank(variables={}) is None
    assert find_rank("node1:1234", 2, 1, variables=SRUN) == Rank("node1:1234", 2, 1)
    assert find_rank("node1:1234", 1, 0, variables={}) is None
    assert find_rank(variables=SRUN) == Rank(None, 4, 3)
    assert find_rank(variables=MPIRUN) == Rank(None, 2, 1)
    assert find_rank(variables=SRUN | {"SLURM_STEP_NUM_TASKS": "1"}) is None
    # In a batch script, without srun, there is no step.
    assert find_rank(variables={"SLURM_NTASKS": "4", "SLURM_PROCID": "0"}) is None


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("node1:1234", 2, None), "belong together: --process-id is missing"),
        ((None, 2, None), "--coordinator and --process-id is missing"),
        (("node1", 2, 0), "--coordinator must be HOST:PORT"),
        (("node1:99999", 2, 0), "--coordinator must be HOST:PORT"),
        (("node1:1234", 0, 0), "--num-processes must be at least 1, not 0"),
        (("node1:1234", 2, 2), "--process-id must be one of 0 to 1, not 2"),
    ],
)
def test_options_that_make_no_sense(options: tuple, message: str) -> None:
    with pytest.raises(RequestError, match=message):
        find_rank(*options, variables={})


def test_a_process_that_cannot_reach_the_first(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    words = ["--coordinator", f"127.0.0.1:{free_port()}", "--num-processes", "2", "--process-id", "1", "--start-timeout", "1"]
    assert cli.main(["train", "Reacher", "--preset", "debug", "--run-dir", str(tmp_path / "run"), *words]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "the first process does not answer at 127.0.0.1:" in line
    assert not (tmp_path / "run").exists()


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def start(run_dir: Path, count: int, devices: int, *options: str) -> list[subprocess.Popen]:
    """Start ``count`` processes of `two_processes`, with ``devices`` devices each, and return them."""
    tests = Path(__file__).parents[1]
    paths = (tests, tests.parent, tests.parent / "envs")
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, paths)), "XLA_FLAGS": flags}
    shared = [sys.executable, str(tests / "two_processes.py"), str(run_dir), f"127.0.0.1:{free_port()}", str(count)]
    return [
        subprocess.Popen(
            [*shared, str(index), *options], env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        for index in range(count)
    ]


def wait_for_processes(processes: Sequence[subprocess.Popen], seconds: float = 120.0) -> list[tuple[int, str, str]]:
    """Wait for processes to end, for at most ``seconds`` each, and return the exit status and output of each."""
    try:
        outputs = [process.communicate(timeout=seconds) for process in processes]
    finally:
        for process in processes:
            process.kill()
    return [(process.returncode, *words) for process, words in zip(processes, outputs, strict=True)]


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list, list, float]:
    """Run of two processes with one device each, of which the second dies, and which two others resume.

    Returns its folder, the results of the first two and of the other two (see `ended`), and the seconds from the death of the
    second process to the end of the first.
    """
    run_dir = tmp_path_factory.mktemp("processes") / "pair"
    processes = start(run_dir, 2, 1, "die_at=3")
    processes[1].wait(200)
    died = time.monotonic()
    ends = wait_for_processes(processes)
    seconds = time.monotonic() - died
    assert Checkpoints(run_dir / "checkpoints", read_only=True).newest() == 2
    return run_dir, ends, wait_for_processes(start(run_dir, 2, 1, "resume=1")), seconds


def test_a_process_that_dies_ends_the_others_and_leaves_the_checkpoint(pair: tuple[Path, list, list, float]) -> None:
    _, ((first, _, words), (second, _, _)), ends, seconds = pair
    assert (first, second) == (1, 9), words
    assert seconds < 60
    assert "start all of them again with --resume" in words
    assert [status for status, _, _ in ends] == [0, 0], ends
    assert "resumed at iteration 2 of 4, exactly" in ends[0][1]


def test_two_processes_learn_and_save_what_one_does(pair: tuple[Path, list, list, float], tmp_path: Path) -> None:
    run_dir, *_ = pair
    ((status, _, words),) = wait_for_processes(start(tmp_path / "one", 1, 2))
    assert status == 0, words
    for ours, theirs in zip(rows_without_time(run_dir), rows_without_time(tmp_path / "one"), strict=True):
        assert ours == pytest.approx(theirs, abs=1e-5, nan_ok=True)
    config = read_config(run_dir).replace(devices=1)
    shapes = Programs(config, make_train_step(probes.GoWhereTold(), config)).shapes
    folders = [path / "checkpoints" for path in (run_dir, tmp_path / "one")]
    saved = [Checkpoints(folder, read_only=True).restore_for_resume(shapes) for folder in folders]
    assert [restored.iteration for restored in saved if restored is not None and restored.loop is not None] == [4, 4]
    for ours, theirs in zip(*(as_plain(restored.loop) for restored in saved if restored is not None), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-4)


def two_trainings(*words: str) -> list[tuple[int, str, str]]:
    """Run `jaxrl-vis train` in two processes with one device each; return exit statuses and outputs."""
    train = [sys.executable, "-m", "jaxrl_vis", "train", *words, "--preset", "debug", "--env-steps", "40"]
    place = ["--coordinator", f"127.0.0.1:{free_port()}", "--num-processes", "2", "--process-id"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return wait_for_processes([subprocess.Popen([*train, *place, index], **pipes) for index in ("0", "1")], 200)


def test_processes_train_a_task_with_physics(tmp_path: Path) -> None:
    """Each process must place the task's model on its own devices."""
    task = ["point_mass:StatePointMass", "--env-folder", str(Path(__file__).parents[1])]
    ends = two_trainings(*task, "--seeds", "2", "--run-dir", str(tmp_path / "run"))
    assert [status for status, _, _ in ends] == [0, 0], ends
    assert {row["seed"] for row in rows_without_time(tmp_path / "run")} == {0, 1}


def test_each_process_says_why_it_refuses(tmp_path: Path) -> None:
    """JAX does not end a process because the other one has ended first."""
    ends = two_trainings("Reacher", "--seeds", "3", "--run-dir", str(tmp_path / "run"))
    assert [status for status, _, _ in ends] == [2, 2], ends
    assert all("seeds 3 cannot be divided among 2 devices" in words.splitlines()[-1] for _, _, words in ends), ends


def test_only_the_first_process_writes_and_speaks(pair: tuple[Path, list, list, float]) -> None:
    run_dir, _, ((_, first, _), (_, second, _)), _ = pair
    assert "success at the end" in first and "success" not in second
    assert [row["iteration"] for row in rows_without_time(run_dir)] == [2, 4]
    names = ["checkpoints", "config.json", "curve.png", "metrics.jsonl", "processes.jsonl"]
    assert sorted(path.name for path in run_dir.iterdir()) == names
    assert len((run_dir / "processes.jsonl").read_text().splitlines()) == 2  # of the first one, before and after


def test_a_signal_to_one_process_saves_and_ends_all(tmp_path: Path) -> None:
    processes = start(tmp_path / "run", 2, 1, "iterations=10000")
    second = processes[1].stdout
    assert second is not None
    while not second.readline().startswith("report"):
        assert processes[1].poll() is None
    processes[1].send_signal(signal.SIGUSR2)
    ends = wait_for_processes(processes)
    assert [status for status, _, _ in ends] == [128 + signal.SIGUSR2] * 2, ends
    assert "SIGUSR2: saving" in ends[0][1]
    checkpoints = Checkpoints(tmp_path / "run" / "checkpoints", read_only=True)
    assert checkpoints.iterations("full")[-1] == checkpoints.iterations("light")[-1] > 0
