"""A grid of tasks x methods x seeds: trained by `grid`, and shown as a table of what has been reached."""

import dataclasses
import statistics
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxrl_vis import streams
from jaxrl_vis.config import preset
from jaxrl_vis.devices import Device, list_devices
from jaxrl_vis.errors import RequestError
from jaxrl_vis.studies.cells import Cell, rows_of, show_budget, split_seeds, standing
from jaxrl_vis.studies.cluster import Cluster, ExecutorName
from jaxrl_vis.studies.grid import run_cells, start_process
from jaxrl_vis.validation import validate

SUBMITTED = "submitit"
"""Folder of submitit's own files, within that of the runs."""


@dataclasses.dataclass(frozen=True)
class Request:
    """A sweep that is asked for.

    Attributes:
        tasks: Environments.
        methods: Where rewards come from.
        preset: Of all runs.
        changes: Fields of `Config` that differ from it, in all runs.
        runs: The folder of run folders.
        seeds_per_run: At most so many seeds in one program; None: all.
        seconds: Stop training after so long.
        executor: None: processes of this machine, one a device; else how `cluster` starts them.
        jobs: At most so many at a time, on a cluster.
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


def cells_of(request: Request) -> list[Cell]:
    """The cells of a sweep, task after task.

    Raises:
        RequestError: A configuration makes no sense.
    """
    cells: list[Cell] = []
    for task in request.tasks:
        for method in request.methods:
            config = validate(preset(request.preset, **{**request.changes, "env": task, "method": method}))
            if config.devices > 1 and request.executor != "slurm":
                raise RequestError("a sweep has one device for each run: leave out --devices, or use --executor slurm")
            name = f"{task.replace(':', '-')}-{method}-{request.preset}"
            cells += split_seeds(Cell(name, config), request.seeds_per_run or config.seeds)
    return cells


def run_sweep(request: Request, say: Callable[[str], None] = streams.say) -> bool:
    """Trains what is missing, resumes what was begun, and prints a table.

    Returns:
        Whether everything is finished.

    Raises:
        RequestError: See `cells_of` and `run_cells`.
        KeyboardInterrupt, Terminated: After all runs have saved.
    """
    cells = cells_of(request)
    find_devices, start = list_devices, start_process
    if request.executor is not None:
        start = Cluster(request.executor, request.runs / SUBMITTED, request.job_options).start
    if request.executor == "slurm":
        places = [Device("Slurm", {})] * min(request.jobs, len(cells))
        find_devices = lambda: places  # noqa: E731
    run_cells(cells, request.runs, find_devices, request.seconds, say=say, start=start)
    lines, unfinished = _table(cells, request.runs)
    for line in [*lines, *unfinished]:
        say(line)
    return not unfinished


def _table(cells: Sequence[Cell], runs: Path) -> tuple[list[str], list[str]]:
    """Lines on finished cells, and on those that are not."""
    found: dict[tuple[str, str], dict[int, float]] = {}
    unfinished = []
    for cell in cells:
        rows = rows_of(cell, runs)
        if not rows:
            unfinished.append(f"not finished: {cell.name}: {standing(cell, runs)}")
            continue
        last = max(row["env_steps"] for row in rows)
        reached = {row["seed"]: row["eval/success"] for row in rows if row["env_steps"] == last}
        found.setdefault((cell.config.env, cell.config.method), {}).update(reached)
    lines = [f"{'task':28}{'method':28}{'steps':>8}{'seeds':>7}{'success: median':>17}{'least':>8}{'most':>8}"]
    for (task, method), success in found.items():
        steps = show_budget(cells[0].config.env_steps)
        values = [value for value in success.values() if value is not None]
        figures = (statistics.median(values), min(values), max(values)) if values else (float("nan"),) * 3
        lines.append(f"{task:28}{method:28}{steps:>8}{len(success):7}{figures[0]:17.3f}{figures[1]:8.3f}{figures[2]:8.3f}")
    return (lines if found else []), unfinished
