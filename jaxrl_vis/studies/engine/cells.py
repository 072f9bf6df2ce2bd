"""Cells of a study: training runs with their folders, and their progress.

    runs/FAMILY-STEPS/      a run folder, such as VisualHandReach-ol_aux_5-paper-seeds0to4-2M
    runs/FAMILY-STEPS.log   output of the processes that trained there

Studies share folders: a cell of 600 k steps is read from a run of the same family with 2 M. The reverse is impossible: a
finished run has no replay, and cannot be extended exactly.

Nothing here imports JAX: the process that manages cells must not occupy an accelerator's memory.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxrl_vis.config import UNMEASURED, Config
from jaxrl_vis.errors import RequestError
from jaxrl_vis.run.storage import scores
from jaxrl_vis.run.storage.folder import RunFolder, contradictions, read_config


@dataclasses.dataclass(frozen=True)
class Cell:
    """Training run that a study needs.

    Attributes:
        family: Name without the number of steps; prefix of the folder's name.
        config: Configuration of the run.
    """

    family: str
    config: Config

    @property
    def name(self) -> str:
        """Name of the cell and of its folder."""
        return f"{self.family}-{format_budget(self.config.run.env_steps)}"

    @property
    def seeds(self) -> range:
        """Seeds that are trained in parallel."""
        return range(self.config.run.seed, self.config.run.seed + self.config.run.seeds)


def format_budget(steps: int) -> str:
    """Format a number of steps as ``250k`` or ``2.5M``, or with all digits if that would be inexact."""
    for size, letter in ((10**6, "M"), (10**3, "k")):
        if steps >= size and steps % (size // 100) == 0:
            return f"{steps / size:g}{letter}"
    return str(steps)


def split_seeds(cell: Cell, count: int) -> list[Cell]:
    """Split a cell into cells of at most ``count`` seeds, for devices with too little memory for all of them.

    The seeds are appended to their families.
    """
    config = cell.config
    first = [config.run.seed + offset for offset in range(0, config.run.seeds, count)]
    last = [min(seed + count, config.run.seed + config.run.seeds) - 1 for seed in first]
    return [
        Cell(
            f"{cell.family}-seed{low}" if low == high else f"{cell.family}-seeds{low}to{high}",
            config.replace(seed=low, seeds=high - low + 1),
        )
        for low, high in zip(first, last, strict=True)
    ]


def find_folder(cell: Cell, runs: Path) -> Path:
    """Find the folder of a cell: its own, unless only a longer run of its family has reached the cell's steps."""
    own = runs / cell.name
    if _final_env_steps(own, cell) is not None or not runs.is_dir():
        return own
    for folder in sorted(runs.glob(f"{cell.family}-*/")):
        try:
            config = read_config(folder)
        except RequestError:
            continue
        if contradictions(config, cell.config, UNMEASURED) or config.run.env_steps < cell.config.run.env_steps:
            continue
        if _final_env_steps(folder, cell) is not None:
            return folder
    return own


def _final_env_steps(folder: Path, cell: Cell) -> int | None:
    """Return the steps of the first evaluation of all seeds at or after the cell's environment steps; None without one.

    For a run that stops early, the evaluation at which it stops is sufficient.
    """
    steps: dict[int, set[int]] = {}
    rows = RunFolder(folder).rows()
    if cell.config.run.stop_at is not None and (ended := scores.enough_at(cell.config, rows, cell.seeds)):
        return next(row["env_steps"] for row in rows if row["iteration"] == ended[0])
    for row in rows:
        if row["env_steps"] >= cell.config.run.env_steps and "eval/success" in row:
            steps.setdefault(row["env_steps"], set()).add(row["seed"])
    return min((count for count, seeds in steps.items() if seeds >= set(cell.seeds)), default=None)


def differences(cell: Cell, runs: Path) -> list[str]:
    """Describe settings in which the cell's run differs; empty if there is no difference, or no run yet.

    Raises:
        RequestError: The run's config.json cannot be read.
    """
    folder = find_folder(cell, runs)
    return contradictions(read_config(folder), cell.config) if RunFolder(folder).config.exists() else []


def contradiction(cell: Cell, runs: Path) -> str | None:
    """Return the reason why a cell's folder cannot be used, in one line; None if it can, or does not exist yet."""
    folder, hint = find_folder(cell, runs), "move it away, or choose another --runs"
    try:
        changes = differences(cell, runs)
    except RequestError:  # its remedy names options of `train` that studies and sweeps do not have
        return f"{folder} holds a config.json that is damaged, or of another version: {hint}"
    return f"{folder} holds another run, with {'; '.join(changes)}: {hint}" if changes else None


def is_finished(cell: Cell, runs: Path) -> bool:
    """Return True if a cell is completely trained and evaluated."""
    return _final_env_steps(find_folder(cell, runs), cell) is not None and contradiction(cell, runs) is None


def finished_rows(cell: Cell, runs: Path, ignore_settings: bool = False) -> list[dict[str, Any]]:
    """Read the evaluations of a finished cell, up to its end, from metrics.jsonl; empty if it is not finished.

    Args:
        cell: The cell.
        runs: The folder of run folders.
        ignore_settings: Whether to accept a run with other settings, such as those of a preset in an earlier version.
    """
    folder = find_folder(cell, runs)
    end = _final_env_steps(folder, cell)
    if end is None or not (ignore_settings or contradiction(cell, runs) is None):
        return []
    return [row for row in RunFolder(folder).rows() if row["env_steps"] <= end]


def describe_progress(cell: Cell, runs: Path) -> str:
    """Describe the progress of an unfinished cell, such as ``not begun`` or ``120k of 250k steps``."""
    reason = contradiction(cell, runs)
    if reason is not None:
        return reason
    latest = latest_rows(find_folder(cell, runs))
    if not latest:
        return "not begun" if not find_folder(cell, runs).exists() else "not evaluated yet"
    return f"{format_budget(latest[0]['env_steps'])} of {format_budget(cell.config.run.env_steps)} steps"


def latest_rows(folder: Path) -> Sequence[dict[str, Any]]:
    """Return the rows of a run's last evaluation, one per seed; empty before the first."""
    rows = RunFolder(folder).rows()
    last = max((row["env_steps"] for row in rows), default=0)
    return [row for row in rows if row["env_steps"] == last]
