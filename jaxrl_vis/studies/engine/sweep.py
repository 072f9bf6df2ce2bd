"""Sweep over tasks x methods x seeds, trained by `grid` and shown as a table of results."""

import dataclasses
import statistics
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxrl_vis.config import changes, preset, validate
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host import streams
from jaxrl_vis.host.devices import Device, list_devices
from jaxrl_vis.studies.engine.cells import Cell, describe_progress, finished_rows, format_budget, split_seeds
from jaxrl_vis.studies.engine.cluster import Cluster, ExecutorName
from jaxrl_vis.studies.engine.grid import run_cells, start_process

SUBMITTED = "submitit"
"""Name of the folder of submitit's own files, within the folder of runs."""


@dataclasses.dataclass(frozen=True)
class Request:
    """Request for a sweep.

    Attributes:
        tasks: Environments.
        methods: Methods, the sources of rewards.
        preset: Preset of all runs.
        changes: Values of `Config` fields that differ from the preset in all runs.
        runs: Folder of the run folders.
        seeds_per_run: Maximum number of seeds in one program; None for all.
        seconds: Time in seconds after which training stops; None if unlimited.
        executor: Executor of `cluster`; None for processes on this machine, one per device.
        jobs: Maximum number of simultaneous jobs on a cluster.
        job_options: See `Cluster`.
    """

    tasks: tuple[str, ...]
    methods: tuple[str, ...]
    preset: str
    changes: Mapping[str, Any]
    runs: Path
    seeds_per_run: int | None = None
    seconds: float | None = None
    executor: ExecutorName | None = None
    jobs: int = 64
    job_options: tuple[str, ...] = ()


def make_cells(request: Request) -> list[Cell]:
    """Create the cells of a sweep, task by task.

    Raises:
        RequestError: A configuration is invalid.
    """
    cells: list[Cell] = []
    for task in request.tasks:
        for method in request.methods:
            config = validate(preset(request.preset, **{**request.changes, **changes(env=task, method=method)}))
            if config.run.devices > 1 and request.executor != "slurm":
                raise RequestError("a sweep has one device for each run: leave out --devices, or use --executor slurm")
            name = f"{task.replace(':', '-')}-{method}-{request.preset}"
            cells += split_seeds(Cell(name, config), request.seeds_per_run or config.run.seeds)
    return cells


def run_sweep(request: Request, echo: Callable[[str], None] = streams.echo) -> bool:
    """Train missing cells, resume unfinished ones, and print a table.

    Returns:
        True if all cells are finished.

    Raises:
        RequestError: See `make_cells` and `run_cells`.
        KeyboardInterrupt, Terminated: A signal arrived; raised after all runs have saved.
    """
    cells = make_cells(request)
    find_devices, start = list_devices, start_process
    if request.executor is not None:
        start = Cluster(request.executor, request.runs / SUBMITTED, request.job_options).start
    if request.executor == "slurm":
        devices = [Device("Slurm", {})] * min(request.jobs, len(cells))
        find_devices = lambda: devices  # noqa: E731
    run_cells(cells, request.runs, find_devices, request.seconds, echo=echo, start=start)
    lines, unfinished = _table(cells, request.runs)
    for line in [*lines, *unfinished]:
        echo(line)
    return not unfinished


def _table(cells: Sequence[Cell], runs: Path) -> tuple[list[str], list[str]]:
    """Return the lines of a table of finished cells, and a line for each unfinished one."""
    results: dict[tuple[str, str], dict[int, float]] = {}
    unfinished = []
    for cell in cells:
        rows = finished_rows(cell, runs)
        if not rows:
            unfinished.append(f"not finished: {cell.name}: {describe_progress(cell, runs)}")
            continue
        last = max(row["env_steps"] for row in rows)
        reached = {row["seed"]: row["eval/success"] for row in rows if row["env_steps"] == last}
        results.setdefault((cell.config.environment.env, cell.config.reward.method), {}).update(reached)
    lines = [f"{'task':28}{'method':28}{'steps':>8}{'seeds':>7}{'success: median':>17}{'least':>8}{'most':>8}"]
    for (task, method), success in results.items():
        steps = format_budget(cells[0].config.run.env_steps)
        values = [value for value in success.values() if value is not None]
        figures = (statistics.median(values), min(values), max(values)) if values else (float("nan"),) * 3
        lines.append(f"{task:28}{method:28}{steps:>8}{len(success):7}{figures[0]:17.3f}{figures[1]:8.3f}{figures[2]:8.3f}")
    return (lines if results else []), unfinished
