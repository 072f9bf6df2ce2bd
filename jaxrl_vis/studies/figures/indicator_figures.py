"""Content of figures 5.1, 5.2 and related ones: success, distance to the goal, and statistics of rewards."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxrl_vis.studies.engine.results import DISTANCE, SUCCESS, Line, area_quartiles, final_quartiles
from jaxrl_vis.studies.figures.drawing import Curve, Panel, Picture
from jaxrl_vis.studies.figures.show import FigureContent, Request
from jaxrl_vis.studies.figures.tables import table_row
from jaxrl_vis.studies.indicator import VARIANTS

_PRECISION, _FILTERED = "train/filter_precision", "train/filtered_share"
_REWARDS = {
    "train/positive_share": "positive rewards",
    _FILTERED: "negatives that the filter drops",
    _PRECISION: "dropped negatives that were false",
    "train/false_negative_share": "negatives that are false",
}
"""Logged statistics of rewards, and their titles in panels."""
_ACTIVE = 0.01  # fraction of dropped negatives below which the filter counts as inactive

# Metric and value that the oracle must reach for a meaningful comparison.
_ORACLE_WORKS: dict[str, tuple[str, float]] = {
    "VisualFetchReach": (SUCCESS, 0.97),
    "VisualSawyerReach": (SUCCESS, 0.90),
    "VisualReacher": (DISTANCE, 0.02),
}


def make_content(
    _: Request, lines: Mapping[tuple[str, str], Line], tasks: Sequence[str], variants: Sequence[str]
) -> FigureContent:
    """Create the panels and tables of a figure for these tasks and variants, from its lines by (task, variant)."""

    def row(metric: str, title: str, is_share: bool = True) -> list[Panel]:
        return [Panel(f"{task}: {title}", _curves(lines, task, variants, metric), is_share) for task in tasks]

    pictures = [Picture("", [row(SUCCESS, "success"), row(DISTANCE, "final distance to the goal (m)", is_share=False)])]
    rewards = [row(metric, title) for metric, title in _REWARDS.items()]
    rewards = [panels for panels in rewards if any(panel.has_values for panel in panels)]
    if rewards:
        pictures.append(Picture("_rewards", rewards))
    text, table = _tables(lines, tasks)
    notes = [
        "At the end: the last evaluation, in the median over seeds; in brackets the middle half of the seeds. Area: mean "
        "success over all evaluations. Rewards: means over training, in the median over seeds. The precision of a filter that "
        f"drops less than {_ACTIVE:.0%} of the negatives is not given: it is inactive. Distances are in metres."
    ]
    return FigureContent(pictures, text, table, [*notes, *_oracle_notes(lines)])


def _curves(lines: Mapping[tuple[str, str], Line], task: str, variants: Sequence[str], metric: str) -> list[Curve]:
    return [
        Curve(VARIANTS[variant].label, VARIANTS[variant].colour, *_values(lines[task, variant], metric))
        for variant in variants
        if (task, variant) in lines
    ]


def _values(line: Line, metric: str) -> tuple[np.ndarray, np.ndarray]:
    """Return env_steps [P] and the metric [S, P]; the filter's precision is NaN where it is inactive, as in the tables."""
    steps, values = line.values(metric)
    if metric == _PRECISION:
        values = np.where(line.values(_FILTERED)[1] >= _ACTIVE, values, np.nan)
    return steps, values


def _tables(lines: Mapping[tuple[str, str], Line], tasks: Sequence[str]) -> tuple[list[str], list[dict[str, Any]]]:
    text, rows = [], []
    columns = ["method", "success at the end", "area", "distance at the end", "positive rewards", "false positives"]
    columns += ["negatives that are false", "negatives dropped", "of them false", "value at goals"]
    for task in tasks:
        text += [f"### {task}", "", table_row(columns), table_row(["---"] * len(columns))]
        for (of_task, variant), line in lines.items():
            if of_task == task:
                statistics = _statistics(line)
                text.append(table_row([VARIANTS[variant].label, *_cells(statistics)]))
                names = {f"{name}{end}": value for name, values in statistics.items() for end, value in _csv(values)}
                rows.append(dict(task=task, method=variant, seeds=len(line.seeds), env_steps=line.end, **names))
        text.append("")
    return text, rows


Quartiles = tuple[float, float, float]


def _statistics(line: Line) -> dict[str, Quartiles | float]:
    """Compute quartiles over seeds of evaluation metrics, and medians of reward statistics."""
    filtered = _mean(line, _FILTERED)
    return {
        "final_success": final_quartiles(line, SUCCESS),
        "area": area_quartiles(line),
        "final_distance": final_quartiles(line, DISTANCE),
        "positive_share": _mean(line, "train/positive_share"),
        "false_positive_share": _mean(line, "train/false_positive_share"),
        "false_negative_share": _mean(line, "train/false_negative_share"),
        "filtered_share": filtered,
        # A ratio of means: the fraction among all dropped samples.
        "filter_precision": _mean(line, "train/filtered_false_share") / filtered if filtered >= _ACTIVE else float("nan"),
        "value_at_goals": _last(line, "train/value_at_goals"),
    }


def _mean(line: Line, metric: str) -> float:
    """Compute the mean of a metric over training, in the median over seeds; NaN if it was never logged."""
    _, values = line.values(metric)
    per_seed = [float(np.nanmean(row)) for row in values if np.isfinite(row).any()]
    return float(np.median(per_seed)) if per_seed else float("nan")


def _last(line: Line, metric: str) -> float:
    """Return the metric at the last evaluation, in the median over seeds; NaN if it was not logged there."""
    values = line.values(metric)[1][:, -1]
    return float(np.median(values[np.isfinite(values)])) if np.isfinite(values).any() else float("nan")


def _cells(statistics: Mapping[str, Quartiles | float]) -> list[str]:
    cells = []
    for value in statistics.values():
        low, median, high = value if isinstance(value, tuple) else (value, value, value)
        text = "–" if np.isnan(median) else f"{median:.3f}"
        cells.append(f"{text} ({low:.3f} to {high:.3f})" if low < high else text)
    return cells


def _csv(value: Quartiles | float) -> list[tuple[str, float | None]]:
    """Return the suffixes of a column's name in the CSV file, with their values."""
    low, median, high = value if isinstance(value, tuple) else (None, value, None)
    rounded = [
        (end, None if number is None or np.isnan(number) else round(number, 5))
        for end, number in (("", median), ("_25", low), ("_75", high))
    ]
    return rounded if isinstance(value, tuple) else rounded[:1]


def _oracle_notes(lines: Mapping[tuple[str, str], Line]) -> list[str]:
    """Return notes on tasks where the oracle itself fails, so that methods cannot be compared."""
    notes = []
    for (task, variant), line in lines.items():
        if variant == "oracle" and task in _ORACLE_WORKS:
            metric, required = _ORACLE_WORKS[task]
            _, median, _ = final_quartiles(line, metric)
            if median < required if metric == SUCCESS else median > required:
                quantity, bound = ("success", "at least") if metric == SUCCESS else ("final distance", "at most")
                notes.append(
                    f"{task}: the oracle itself ends at a {quantity} of {median:.3f}, where {bound} {required:g} is asked for: "
                    "this comparison of methods does not count."
                )
    return notes
