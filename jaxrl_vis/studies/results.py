"""What finished cells say: curves of success and of weights, and the figures that tables hold."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.report.learning import curve, steps_to
from jaxrl_vis.report.plots import gather, show_steps
from jaxrl_vis.run.folder import read_record
from jaxrl_vis.studies.cells import Cell, differences, folder_of, rows_of, standing

SUCCESS = "eval/success"
DISTANCE = "eval/goal_distance"


@dataclasses.dataclass(frozen=True)
class Line:
    """One line of a figure: all seeds of a variant on a task.

    Attributes:
        task, variant: Their names.
        rows: Evaluations of all seeds, from metrics.jsonl.
        records: config.json of each run that it was read from.
        unlike: In which settings these runs are not what would be trained now.
    """

    task: str
    variant: str
    rows: Sequence[Mapping[str, Any]]
    records: Sequence[Mapping[str, Any]] = ()
    unlike: Sequence[str] = ()

    @property
    def points(self) -> list[tuple[int, float]]:
        """(environment steps, median success over seeds)."""
        return curve(self.rows, SUCCESS)

    @property
    def seeds(self) -> list[int]:
        """The seeds, ascending."""
        return sorted({row["seed"] for row in self.rows})

    @property
    def end(self) -> int:
        """The environment steps of the last evaluation."""
        return max(row["env_steps"] for row in self.rows)

    @property
    def steps_per_update(self) -> float:
        """Environment steps for each gradient step."""
        return self.end / max(1, max(row["updates"] for row in self.rows))

    def values(self, metric: str) -> tuple[np.ndarray, np.ndarray]:
        """env_steps [P] and the metric [S, P]."""
        return gather(self.rows, metric)

    def has_lost_replay(self) -> bool:
        """Whether a run went on without its replay, so that it is not the run that it would have been."""
        return any("resume/replay_lost_at" in row for row in self.rows)


def read_lines(
    cells: Mapping[tuple[str, str], Sequence[Cell]], runs: Path, as_they_are: bool = False
) -> tuple[dict[tuple[str, str], Line], list[str]]:
    """The lines of finished cells, and what is missing.

    Args:
        cells: (task, variant) -> the runs of a line.
        runs: The folder of run folders.
        as_they_are: Also read runs of other settings, such as those that a preset had in an earlier version.

    Returns:
        (task, variant) -> line, without those of which a cell is not finished; and a text for each cell that is not.
    """
    lines, unfinished = {}, []
    for (task, variant), parts in cells.items():
        found = [rows_of(cell, runs, as_they_are) for cell in parts]
        unfinished += [f"{cell.name}: {standing(cell, runs)}" for cell, rows in zip(parts, found, strict=True) if not rows]
        if all(found):
            records = [_record(folder_of(cell, runs)) for cell in parts]
            unlike = sorted({each for cell in parts for each in _differences(cell, runs)})
            lines[task, variant] = Line(task, variant, [row for rows in found for row in rows], records, unlike)
    return lines, unfinished


def _differences(cell: Cell, runs: Path) -> list[str]:
    try:
        return differences(cell, runs)
    except RequestError as error:
        return [str(error)]


def _record(folder: Path) -> dict[str, Any]:
    try:
        return read_record(folder)
    except RequestError:
        return {}


@dataclasses.dataclass(frozen=True)
class Reached:
    """When a level of success was reached, in environment steps: `jaxrl_vis.report.learning`.

    Attributes:
        level: The share.
        steps: In the median over seeds; None: not within the budget.
        low, high: The middle half of what single seeds needed; None where that is beyond the budget.
        budget: The last evaluation.
    """

    level: float
    steps: int | None
    low: float | None
    high: float | None
    budget: int

    def ratio(self, other: "Reached") -> str:
        """How many times the steps of this one the other needed: ``2.0``, or a bound where one of them did not reach it."""
        if self.steps and other.steps:
            return f"{other.steps / self.steps:.1f}"
        if self.steps:
            return f"> {other.budget / self.steps:.1f}"
        return f"< {other.steps / self.budget:.1f}" if other.steps else "–"

    def __str__(self) -> str:
        """``120 k (100 k to 140 k)``, or ``> 250 k`` where it was not reached."""
        if self.steps is None:
            return f"> {show_steps(self.budget)}"
        if self.low is None:
            return show_steps(self.steps)
        high = "> " + show_steps(self.budget) if self.high is None else show_steps(self.high)
        return f"{show_steps(self.steps)} ({show_steps(self.low)} to {high})"


def reached(line: Line, level: float) -> Reached:
    """When a line reached a level."""
    median = steps_to(line.points, level)
    if len(line.seeds) == 1:
        return Reached(level, median, None, None, line.end)
    each = [steps_to(curve([row for row in line.rows if row["seed"] == seed], SUCCESS), level) for seed in line.seeds]
    # The quartile of numbers some of which are only known to be large: one of them, never a number between.
    quartiles = np.percentile([np.inf if steps is None else steps for steps in each], [25, 75], method="inverted_cdf")
    low, high = (float(value) if np.isfinite(value) else None for value in quartiles)
    return Reached(level, median, low, high, line.end)


def mean_success(line: Line, up_to: int) -> float:
    """The mean of the median success over all evaluations up to some environment steps; 0.0 where there is none."""
    values = [success for steps, success in line.points if steps <= up_to]
    return float(np.mean(values)) if values else 0.0


def final(line: Line, metric: str = SUCCESS) -> tuple[float, float, float]:
    """Quartiles over seeds of a metric at the end: 25 %, median, 75 %."""
    found = [row[metric] for row in line.rows if row["env_steps"] == line.end and row.get(metric) is not None]
    return _quartiles(found)


def area(line: Line) -> tuple[float, float, float]:
    """Quartiles over seeds of the mean success over all evaluations, which is the area under the curve: 25 %, median, 75 %."""
    return _quartiles([float(np.nanmean(row)) for row in line.values(SUCCESS)[1]])


def _quartiles(values: Sequence[float]) -> tuple[float, float, float]:
    low, median, high = np.percentile(values, [25, 50, 75])
    return float(low), float(median), float(high)


def mean_weight(line: Line, name: str) -> float:
    """The mean weight of an auxiliary loss over training, in the median over seeds; NaN where none was logged."""
    _, values = line.values(f"train/weight/{name}")
    per_seed = [np.nanmean(row) for row in values if np.isfinite(row).any()]
    return float(np.median(per_seed)) if per_seed else float("nan")
