"""Results of finished cells: curves of success and weights, and the numbers in tables."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.report.learning import curve, steps_to
from jaxrl_vis.report.plots import format_steps, gather
from jaxrl_vis.run.storage.folder import read_record
from jaxrl_vis.studies.engine.cells import Cell, describe_progress, differences, find_folder, finished_rows

SUCCESS = "eval/success"
DISTANCE = "eval/goal_distance"


@dataclasses.dataclass(frozen=True)
class Line:
    """Line of a figure: all seeds of a variant on a task.

    Attributes:
        task, variant: Names of the task and the variant.
        rows: Evaluations of all seeds, from metrics.jsonl.
        records: Contents of config.json of each of its runs.
        setting_differences: Settings in which these runs differ from those that would be trained now.
    """

    task: str
    variant: str
    rows: Sequence[Mapping[str, Any]]
    records: Sequence[Mapping[str, Any]] = ()
    setting_differences: Sequence[str] = ()

    @property
    def points(self) -> list[tuple[int, float]]:
        """Curve of (environment steps, median success over seeds)."""
        return curve(self.rows, SUCCESS)

    @property
    def seeds(self) -> list[int]:
        """Seeds, in ascending order."""
        return sorted({row["seed"] for row in self.rows})

    @property
    def end(self) -> int:
        """Environment steps of the last evaluation."""
        return max(row["env_steps"] for row in self.rows)

    @property
    def steps_per_update(self) -> float:
        """Environment steps per gradient step."""
        return self.end / max(1, max(row["updates"] for row in self.rows))

    def values(self, metric: str) -> tuple[np.ndarray, np.ndarray]:
        """Return env_steps [P], ascending, and the metric [S, P]; NaN for missing values."""
        return gather(self.rows, metric)

    def has_lost_replay(self) -> bool:
        """Return True if a run was resumed without its replay, and so deviates from an uninterrupted one."""
        return any("resume/replay_lost_at" in row for row in self.rows)


def read_lines(
    cells: Mapping[tuple[str, str], Sequence[Cell]], runs: Path, ignore_settings: bool = False
) -> tuple[dict[tuple[str, str], Line], list[str]]:
    """Read the lines of finished cells, and list unfinished ones.

    Args:
        cells: Runs of each line, by (task, variant).
        runs: Folder of the run folders.
        ignore_settings: Whether to read runs with other settings as well, such as those of a preset in an earlier version.

    Returns:
        Lines by (task, variant), without those with an unfinished cell; and a text for each unfinished cell.
    """
    lines, unfinished = {}, []
    for (task, variant), parts in cells.items():
        rows_by_cell = [finished_rows(cell, runs, ignore_settings) for cell in parts]
        unfinished += [
            f"{cell.name}: {describe_progress(cell, runs)}" for cell, rows in zip(parts, rows_by_cell, strict=True) if not rows
        ]
        if all(rows_by_cell):
            records = [_record(find_folder(cell, runs)) for cell in parts]
            setting_differences = sorted({text for cell in parts for text in _differences(cell, runs)})
            lines[task, variant] = Line(
                task, variant, [row for rows in rows_by_cell for row in rows], records, setting_differences
            )
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
class StepsToLevel:
    """Environment steps at which a level of success was reached, as defined in `jaxrl_vis.report.learning`.

    Attributes:
        level: Level of success, a fraction.
        steps: Steps at which the median over seeds reached the level; None if not within the budget.
        low, high: Quartiles of the steps of single seeds; None if beyond the budget, or for a single seed.
        budget: Environment steps of the last evaluation.
    """

    level: float
    steps: int | None
    low: float | None
    high: float | None
    budget: int

    def ratio(self, other: "StepsToLevel") -> str:
        """Format the ratio of the other's steps to these: ``2.0``, or a bound if one of them did not reach the level."""
        if self.steps and other.steps:
            return f"{other.steps / self.steps:.1f}"
        if self.steps:
            return f"> {other.budget / self.steps:.1f}"
        return f"< {other.steps / self.budget:.1f}" if other.steps else "–"

    def __str__(self) -> str:
        """Format the steps as ``120 k (100 k to 140 k)``, or ``> 250 k`` if the level was not reached."""
        if self.steps is None:
            return f"> {format_steps(self.budget)}"
        if self.low is None:
            return format_steps(self.steps)
        high = "> " + format_steps(self.budget) if self.high is None else format_steps(self.high)
        return f"{format_steps(self.steps)} ({format_steps(self.low)} to {high})"


def find_steps(line: Line, level: float) -> StepsToLevel:
    """Find the steps at which a line reached a level."""
    median = steps_to(line.points, level)
    if len(line.seeds) == 1:
        return StepsToLevel(level, median, None, None, line.end)
    per_seed = [steps_to(curve([row for row in line.rows if row["seed"] == seed], SUCCESS), level) for seed in line.seeds]
    # Some values are only known to exceed the budget, so use quartiles without interpolation.
    quartiles = np.percentile([np.inf if steps is None else steps for steps in per_seed], [25, 75], method="inverted_cdf")
    low, high = (float(value) if np.isfinite(value) else None for value in quartiles)
    return StepsToLevel(level, median, low, high, line.end)


def mean_success(line: Line, up_to: int) -> float:
    """Average the median success over all evaluations up to a number of environment steps; 0.0 if there are none."""
    values = [success for steps, success in line.points if steps <= up_to]
    return float(np.mean(values)) if values else 0.0


def final_quartiles(line: Line, metric: str = SUCCESS) -> tuple[float, float, float]:
    """Compute quartiles over seeds of a metric at the last evaluation: 25 %, median, 75 %."""
    values = [row[metric] for row in line.rows if row["env_steps"] == line.end and row.get(metric) is not None]
    return _quartiles(values)


def area_quartiles(line: Line) -> tuple[float, float, float]:
    """Compute quartiles over seeds of the mean success over all evaluations, the area under the curve: 25 %, median, 75 %."""
    return _quartiles([float(np.nanmean(row)) for row in line.values(SUCCESS)[1]])


def _quartiles(values: Sequence[float]) -> tuple[float, float, float]:
    low, median, high = np.percentile(values, [25, 50, 75])
    return float(low), float(median), float(high)


def mean_weight(line: Line, name: str) -> float:
    """Average the weight of an auxiliary loss over training, in the median over seeds; NaN if none was logged."""
    _, values = line.values(f"train/weight/{name}")
    per_seed = [np.nanmean(row) for row in values if np.isfinite(row).any()]
    return float(np.median(per_seed)) if per_seed else float("nan")
