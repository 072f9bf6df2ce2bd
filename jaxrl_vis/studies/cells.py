"""Cells of a study: training runs with folders of their own, and what has become of them.

    runs/FAMILY-STEPS/      a run folder, such as VisualHandReach-ol_aux_5-paper-seeds0to4-2M
    runs/FAMILY-STEPS.log   what the processes that trained there have printed

Studies share folders: a cell that asks for 600 k steps is read off a run of the same family that goes on to 2 M. It is never
the other way round: a run that has ended keeps no replay, and could not be made longer without changing what it learns.

Nothing here imports JAX: the process that looks after cells must not hold an accelerator's memory.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxrl_vis.config import Config
from jaxrl_vis.errors import RequestError
from jaxrl_vis.run.folder import RunFolder, contradictions, read_config

# A run of another length, read up to the steps of a cell, must have been evaluated like the cell.
_MAY_DIFFER = ("preset", "env_folder", "env_steps", "checkpoint_interval", "full_checkpoint_interval")


@dataclasses.dataclass(frozen=True)
class Cell:
    """A training run that a study needs.

    Attributes:
        family: What it is called, whatever its length; the beginning of the folder's name.
        config: What it trains.
    """

    family: str
    config: Config

    @property
    def name(self) -> str:
        """Of the cell, and of its folder."""
        return f"{self.family}-{show_budget(self.config.env_steps)}"

    @property
    def seeds(self) -> range:
        """What it trains side by side."""
        return range(self.config.seed, self.config.seed + self.config.seeds)


def show_budget(steps: int) -> str:
    """``250k``, ``2.5M``; all digits where these would be rounded."""
    for size, letter in ((10**6, "M"), (10**3, "k")):
        if steps >= size and steps % (size // 100) == 0:
            return f"{steps / size:g}{letter}"
    return str(steps)


def split_seeds(cell: Cell, count: int) -> list[Cell]:
    """The cell as several ones of at most ``count`` seeds each, for devices with too little memory for all of them.

    Families end in the seeds that they train.
    """
    config = cell.config
    first = [config.seed + done for done in range(0, config.seeds, count)]
    last = [min(seed + count, config.seed + config.seeds) - 1 for seed in first]
    return [
        Cell(
            f"{cell.family}-seed{low}" if low == high else f"{cell.family}-seeds{low}to{high}",
            config.replace(seed=low, seeds=high - low + 1),
        )
        for low, high in zip(first, last, strict=True)
    ]


def folder_of(cell: Cell, runs: Path) -> Path:
    """Where the cell is: in a longer run of its family that has come far enough, or else in its own folder."""
    own = runs / cell.name
    if _reached(own, cell) is not None or not runs.is_dir():
        return own
    for folder in sorted(runs.glob(f"{cell.family}-*/")):
        try:
            config = read_config(folder)
        except RequestError:
            continue
        if contradictions(config, cell.config, _MAY_DIFFER) or config.env_steps < cell.config.env_steps:
            continue
        if _reached(folder, cell) is not None:
            return folder
    return own


def _reached(folder: Path, cell: Cell) -> int | None:
    """The first evaluation at or after the steps of the cell, in environment steps; None where there is none of all seeds."""
    steps: dict[int, set[int]] = {}
    for row in RunFolder(folder).rows():
        if row["env_steps"] >= cell.config.env_steps and "eval/success" in row:
            steps.setdefault(row["env_steps"], set()).add(row["seed"])
    return min((each for each, seeds in steps.items() if seeds >= set(cell.seeds)), default=None)


def differences(cell: Cell, runs: Path) -> list[str]:
    """In which settings the cell's run is another one, in words; none where it is not, or where there is none yet.

    Raises:
        RequestError: Its config.json cannot be read.
    """
    folder = folder_of(cell, runs)
    return contradictions(read_config(folder), cell.config) if RunFolder(folder).config.exists() else []


def contradiction(cell: Cell, runs: Path) -> str | None:
    """Why the cell's folder cannot be used for it, in one line; None where it can, or where there is none yet."""
    folder, mend = folder_of(cell, runs), "move it away, or take another --runs"
    try:
        found = differences(cell, runs)
    except RequestError:  # which tells how `train` would mend it, with options that studies and sweeps do not have
        return f"{folder} holds a config.json that is damaged, or of another version: {mend}"
    return f"{folder} holds another run, with {'; '.join(found)}: {mend}" if found else None


def is_finished(cell: Cell, runs: Path) -> bool:
    """Whether the cell has been trained and evaluated to its end."""
    return _reached(folder_of(cell, runs), cell) is not None and contradiction(cell, runs) is None


def rows_of(cell: Cell, runs: Path, as_it_is: bool = False) -> list[dict[str, Any]]:
    """The evaluations of a finished cell, up to its end, from metrics.jsonl; none where it is not finished.

    Args:
        cell: The cell.
        runs: The folder of run folders.
        as_it_is: A run of other settings will do, such as those that a preset had in an earlier version.
    """
    folder = folder_of(cell, runs)
    end = _reached(folder, cell)
    if end is None or not (as_it_is or contradiction(cell, runs) is None):
        return []
    return [row for row in RunFolder(folder).rows() if row["env_steps"] <= end]


def standing(cell: Cell, runs: Path) -> str:
    """How far an unfinished cell has come: ``not begun``, or ``120k of 250k steps``."""
    why = contradiction(cell, runs)
    if why is not None:
        return why
    latest = latest_rows(folder_of(cell, runs))
    if not latest:
        return "not begun" if not folder_of(cell, runs).exists() else "not evaluated yet"
    return f"{show_budget(latest[0]['env_steps'])} of {show_budget(cell.config.env_steps)} steps"


def latest_rows(folder: Path) -> Sequence[dict[str, Any]]:
    """The rows of a run's last evaluation, one a seed; none before the first."""
    rows = RunFolder(folder).rows()
    last = max((row["env_steps"] for row in rows), default=0)
    return [row for row in rows if row["env_steps"] == last]
