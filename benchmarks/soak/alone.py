"""Faults injected into a run, study or set of plots of their own: a non-finite number, or a killed run, job or pool worker.

Each is a function of the folder to create, a random generator and the results of undisturbed commands. It raises `Broken` if
the command does not handle the fault, and `NotStruck` if it finished first.
"""

import dataclasses
import json
import os
import random
import re
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from benchmarks.soak.run_process import Broken, RunProcess, kill_on_exit, list_checkpoints, read_rows

TASK = """
import dataclasses
import os

import jax
import jax.numpy as jnp
from jaxrl_vis_envs.registry import register
from jaxrl_vis_envs.tasks.reacher import Reacher, ReacherConfig

PROBABILITY = float(os.environ.get("SOAK_NAN", "0"))  # of a broken sensor, in each episode


@dataclasses.dataclass(frozen=True)
class BrokenConfig(ReacherConfig):
    pass


class BrokenReach(Reacher):
    def __init__(self, config: BrokenConfig):
        super().__init__(config)

    def sample_start(self, key):
        start = super().sample_start(key)
        broken = jax.random.uniform(jax.random.fold_in(key, 7)) < PROBABILITY
        return start.replace(qpos=jnp.where(broken, jnp.nan, start.qpos))


register("BrokenReach", BrokenReach, BrokenConfig)
"""
FEW_STALKS = {
    "layout": {"rows_behind": 0, "stalks_mean": 5, "stalks_sd": 0, "tillers": 0, "plot_length": 0.5, "spacing_minimum": 0.06},
    "leaves": {"density": 0.2, "litter": 0},
    "stalks": {"diameter_mean": 0.03},
}
FEW_TO_GRASP = {
    "layout": {"rows_behind": 0, "stalks_mean": 7, "stalks_sd": 0, "tillers": 0, "spacing_minimum": 0.08, "plot_length": 1.0},
    "leaves": {"density": 0.4, "litter": 10},
    "stalks": {"diameter_mean": 0.024, "diameter_sd": 0.002, "lean_sd": [1, 1]},
    "imaging": {"samples": 1},
}
_CLI = (sys.executable, "-m", "jaxrl_vis")


def _start_command(arguments: Sequence[str], folder: Path, **variables: str) -> RunProcess:
    return RunProcess.start_command([*_CLI, *arguments], folder, variables)


def _wait_until_finished(process: RunProcess, *statuses: int) -> RunProcess:
    with kill_on_exit(process):
        status = process.wait()
    process.check_output()
    if status not in statuses:
        raise Broken(f"ended with {status}, not {statuses}: {process.lines[-6:]}")
    return process


def nan_on_one_seed(folder: Path, rng: random.Random, _: "References") -> None:
    """Make a reward NaN on one of two seeds: the run stops, names the seed, and resumes from its last intact checkpoint."""
    folder.mkdir()
    (folder / "broken_task.py").write_text(TASK)
    run, steps = folder / "run", 4 * 50
    options = ["broken_task:BrokenReach", "--env-folder", str(folder), "--preset", "debug", "--seeds", "2"]
    options += ["--env-steps", str(400 * steps), "--seed", str(rng.randrange(10**6)), "--checkpoint-interval", "3"]
    process = RunProcess.start(run, {"SOAK_NAN": str(1.0 / rng.uniform(100, 800))}, options)
    _wait_until_finished(process, 4)
    (line,) = [line for line in process.lines if "non-finite" in line]
    seeds = re.search(r"seeds? ([\d, ]+)", line)
    if seeds is None or "," in seeds.group(1):
        raise Broken(f"not one seed is named: {line}")
    if not list((run / "nonfinite").glob("*.npz")):
        raise Broken(f"nothing was dumped: {line}")
    saved = list_checkpoints(run)
    if not saved:
        return  # in the very first iterations there is nothing to resume from, which the line reports
    rows = read_rows(run)
    again = _wait_until_finished(RunProcess.start(run, None, ["--env-steps", str((saved[-1][0] + 6) * steps)]), 0)
    if not again.count("resumed at iteration"):
        raise Broken(f"it did not go on from the last good checkpoint: {again.lines}")
    if [row for row in read_rows(run) if row in rows] != rows:
        raise Broken("rows were lost")


def _list_descendants(process: int) -> list[int]:
    """List all descendants of a process."""
    processes = []
    for task in Path(f"/proc/{process}/task").glob("*/children"):
        try:
            own = [int(word) for word in task.read_text().split()]
        except OSError:
            continue
        processes += own + [other for child in own for other in _list_descendants(child)]
    return processes


def _has_command(process: int, command: str) -> bool:
    try:
        return command.encode() in Path(f"/proc/{process}/cmdline").read_bytes().replace(b"\0", b" ")
    except OSError:
        return False


def _kill_a_worker(process: RunProcess, command: str, rng: random.Random, delay: float, is_ready: Callable[[], bool]) -> bool:
    """Kill a descendant of a process after a random delay; return True if there was one.

    Args:
        process: The process.
        command: Text that the command line of the descendant must contain.
        rng: Source of the delay and of the choice among several.
        delay: Maximum delay, s, once there is such a descendant and ``is_ready`` returns True.
        is_ready: Function that returns True when the descendant may be killed.
    """

    def workers() -> list[int]:
        return [pid for pid in _list_descendants(process.popen.pid) if _has_command(pid, command)]

    process.wait_for(lambda: bool(workers()) and is_ready())
    time.sleep(rng.uniform(0.0, delay))
    running = workers()
    if not running or not process.is_running():
        return False
    try:
        os.kill(rng.choice(running), signal.SIGKILL)
    except ProcessLookupError:
        return False
    return True


def _check_single_line(process: RunProcess, text: str) -> None:
    if sum(text in line for line in process.lines) != 1:
        raise Broken(f"not one line says {text!r}: {process.lines[-8:]}")


def worker_of_a_study(folder: Path, rng: random.Random, references: "References", executor: Sequence[str] = ()) -> None:
    """Kill the run of one of two cells: the other continues, and the next start finishes both, with undisturbed rows."""
    words = _sweep_arguments(folder, executor)
    process = _start_command(words, folder)
    with kill_on_exit(process):
        cells = folder / "runs"
        struck = _kill_a_worker(process, "jaxrl_vis train", rng, 1.0, lambda: bool(list(cells.glob("*/checkpoints"))))
        process.wait()
    process.check_output()
    if struck:
        if process.popen.returncode == 0:
            raise NotStruck
        if process.popen.returncode not in (1, 3):
            raise Broken(f"ended with {process.popen.returncode}: {process.lines[-5:]}")
        _check_single_line(process, "failed with exit status")
    _wait_until_finished(_start_command(words, folder), 0)
    if _cell_rows(folder) != references.study():
        raise Broken(f"rows differ from those of an undisturbed study: {process.lines}")
    if not struck:
        raise NotStruck


def _sweep_arguments(folder: Path, executor: Sequence[str] = ()) -> list[str]:
    words = ["sweep", "Reacher", "--preset", "debug", "--seeds", "2", "--seeds-per-run", "1", "--env-steps", "24000"]
    return [*words, "--updates-per-iteration", "20", "--eval-interval", "20", "--runs", str(folder / "runs"), *executor]


def _cell_rows(folder: Path) -> dict[str, list]:
    return {path.parent.name: read_rows(path.parent) for path in sorted((folder / "runs").glob("*/metrics.jsonl"))}


def job_of_a_study(folder: Path, rng: random.Random, references: "References") -> None:
    """Kill a run of a sweep whose runs are submitit jobs; the next start finishes the sweep."""
    worker_of_a_study(folder, rng, references, ("--executor", "local"))


def _phenotype_arguments(folder: Path, plots: Path) -> list[str]:
    return ["phenotype", "run", str(plots), "--out", str(folder / "out"), "--masks", "truth", "--workers", "2"]


def _tables(out: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in sorted(out.glob("*.csv"))}


def worker_of_phenotyping(folder: Path, rng: random.Random, references: "References") -> None:
    """Kill a worker of ``phenotype run``; the next start writes the same tables."""
    plots, tables = references.phenotyping()
    _check_pool(_phenotype_arguments(folder, plots), folder, rng)
    if _tables(folder / "out") != tables:
        raise Broken("tables differ from those of an undisturbed run")


def _grasp_arguments(folder: Path, spec: Path) -> list[str]:
    words = ["grasp", "eval", "--masks", "truth", "--width", "256", "--frames", "3", "--runs", "3", "--spec", str(spec)]
    return [*words, "--workers", "2", "--json", str(folder / "eval.json")]


def _run_results(file: Path) -> list[dict[str, Any]]:
    """Read the results of each run, without durations."""
    runs = json.loads(file.read_text())["each"]
    for record in runs:
        del record["score"]["seconds"]
    return runs


def worker_of_grasping(folder: Path, rng: random.Random, references: "References") -> None:
    """Kill a worker of ``grasp eval``; the next start gives the same results."""
    spec, expected = references.grasping()
    _check_pool(_grasp_arguments(folder, spec), folder, rng)
    if _run_results(folder / "eval.json") != expected:
        raise Broken("results differ from those of an undisturbed evaluation")


class NotStruck(Exception):
    """Signal that the command finished before the fault."""


def _check_pool(arguments: Sequence[str], folder: Path, rng: random.Random) -> None:
    """Kill a worker of a pool, and check that the same command finishes when started again."""
    folder.mkdir(exist_ok=True)
    process = _start_command(arguments, folder)
    with kill_on_exit(process):
        struck = _kill_a_worker(process, "spawn_main", rng, 4.0, lambda: True)
        process.wait()
    process.check_output()
    if struck and process.popen.returncode == 0:
        raise NotStruck  # the worker had finished its work
    if struck:
        if process.popen.returncode not in (1, 2):
            raise Broken(f"ended with {process.popen.returncode}: {process.lines[-5:]}")
        _check_single_line(process, "processes was killed from outside")
    _wait_until_finished(_start_command(arguments, folder), 0)
    if not struck:
        raise NotStruck


class References:
    """Results of undisturbed commands, computed on first use.

    Args:
        folder: Folder of the results.
    """

    def __init__(self, folder: Path):
        self._folder, self._lock = folder, threading.Lock()
        self._made: dict[str, Any] = {}

    def _compute_once(self, name: str, make: Callable[[Path], Any]) -> Any:
        with self._lock:
            if name not in self._made:
                (self._folder / name).mkdir(parents=True)
                self._made[name] = make(self._folder / name)
            return self._made[name]

    def study(self) -> dict[str, list]:
        """Return the rows of each run of a sweep by the name of its cell."""

        def make(folder: Path) -> dict[str, list]:
            _wait_until_finished(_start_command(_sweep_arguments(folder), folder), 0)
            return _cell_rows(folder)

        return self._compute_once("study", make)

    def phenotyping(self) -> tuple[Path, dict[str, bytes]]:
        """Return the folder of plots, and the contents of their tables by file name."""

        def make(folder: Path) -> tuple[Path, dict[str, bytes]]:
            (folder / "few.json").write_text(json.dumps(FEW_STALKS))
            words = ["phenotype", "synth", str(folder / "plots"), "--spec", str(folder / "few.json"), "--width", "422"]
            _wait_until_finished(_start_command([*words, "--frames", "4", "--plots", "2"], folder), 0)
            _wait_until_finished(_start_command(_phenotype_arguments(folder, folder / "plots"), folder), 0)
            return folder / "plots", _tables(folder / "out")

        return self._compute_once("phenotyping", make)

    def grasping(self) -> tuple[Path, list]:
        """Return the file of a family, and the results of its runs without durations."""

        def make(folder: Path) -> tuple[Path, list]:
            spec = folder / "few.json"
            spec.write_text(json.dumps(FEW_TO_GRASP))
            _wait_until_finished(_start_command(_grasp_arguments(folder, spec), folder), 0)
            return spec, _run_results(folder / "eval.json")

        return self._compute_once("grasping", make)


@dataclasses.dataclass(frozen=True)
class SeparateFault:
    """Fault with a folder of its own.

    Attributes:
        strike: Function of the folder to create, a random generator and the references that injects the fault and checks the
            outcome; see the module.
        guarantee: Guaranteed outcome, for the table.
    """

    strike: Callable[[Path, random.Random, References], None]
    guarantee: str


SEPARATE_FAULTS: dict[str, SeparateFault] = {
    "NaN on one of two seeds": SeparateFault(
        nan_on_one_seed, "exit status 4; names the seed, dumps the state, and resumes from the last valid checkpoint"
    ),
    "killed run of a sweep": SeparateFault(
        worker_of_a_study, "one-line message; others continue; a restart yields the rows of an undisturbed sweep"
    ),
    "killed job of a sweep": SeparateFault(job_of_a_study, "the same for runs that are submitit jobs"),
    "killed worker of phenotype run": SeparateFault(
        worker_of_phenotyping, "one-line message; a restart yields the tables of an undisturbed run"
    ),
    "killed worker of grasp eval": SeparateFault(worker_of_grasping, "one-line message; a restart yields undisturbed results"),
}


def strike_alone(name: str, folder: Path, rng: random.Random, references: References) -> bool:
    """Inject a fault of `SEPARATE_FAULTS` in a new folder, which is then deleted; return False if the command finished first.

    Raises:
        Broken: The command does not handle the fault; the folder is left.
    """
    try:
        SEPARATE_FAULTS[name].strike(folder, rng, references)
    except NotStruck:
        return False
    shutil.rmtree(folder, ignore_errors=True)
    return True
