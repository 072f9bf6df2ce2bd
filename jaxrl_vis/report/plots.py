"""Learning curves. curve.png of a run: success and distance to the goal at the end of an episode, against environment steps."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator, PercentFormatter

INK, FAINT = "#22252a", "#8b919a"
"""Colours of primary and secondary text."""
_SUCCESS, _DISTANCE = "#0f7b6c", "#b4531f"


def gather(rows: Sequence[Mapping[str, Any]], name: str) -> tuple[np.ndarray, np.ndarray]:
    """Collect one metric as an array.

    Args:
        rows: The rows of metrics.jsonl, in any order.
        name: The metric, such as ``eval/success``.

    Returns:
        env_steps [P], ascending, and values [S, P] float64; NaN for missing values.
    """
    steps = sorted({row["env_steps"] for row in rows})
    seeds = sorted({row["seed"] for row in rows})
    values = np.full((len(seeds), len(steps)), np.nan)
    for row in rows:
        value = row.get(name)
        values[seeds.index(row["seed"]), steps.index(row["env_steps"])] = np.nan if value is None else value
    return np.asarray(steps, np.int64), values


def format_steps(count: float, _: int | None = None) -> str:
    """Format a number of steps as ``250 k`` or ``1.44 M``; the second argument, Matplotlib's tick position, is ignored."""
    if count >= 1e6:
        return f"{count / 1e6:g} M"
    return f"{count / 1e3:g} k" if count >= 1e3 else f"{count:g}"


def draw_median(axes: Axes, steps: np.ndarray, values: np.ndarray, colour: str, label: str | None = None) -> float:
    """Draw the median over seeds as a thick line, and the middle half of the seeds as a band.

    Args:
        axes: Axes to draw on.
        steps: [P] env_steps.
        values: [S, P], NaN for gaps.
        colour: The colour of both.
        label: Label in the legend; None for no entry.

    Returns:
        The last median; NaN if there is no number at all.
    """
    measured = ~np.isnan(values).all(axis=0)
    steps, values = steps[measured], values[:, measured]
    if not steps.size:
        return float("nan")
    low, median, high = np.nanpercentile(values, [25, 50, 75], axis=0)
    marker = "o" if steps.size == 1 else None
    if values.shape[0] > 1:
        axes.fill_between(steps, low, high, color=colour, alpha=0.16, linewidth=0)
    axes.plot(steps, median, color=colour, linewidth=2.6, solid_capstyle="round", marker=marker, label=label)
    return float(median[-1])


def draw_curves(axes: Axes, steps: np.ndarray, values: np.ndarray, colour: str) -> float:
    """Draw the median and its band, every seed as a thin line, and a dot at the end.

    Args:
        axes: Axes to draw on.
        steps: [P] env_steps.
        values: [S, P], NaN for gaps.
        colour: The colour of all of these.

    Returns:
        The last median; NaN if there is no number at all.
    """
    measured = ~np.isnan(values).all(axis=0)
    steps, values = steps[measured], values[:, measured]
    if values.shape[0] > 1:
        for seed_values in values:
            axes.plot(steps, seed_values, color=colour, alpha=0.4, linewidth=0.9)
    last = draw_median(axes, steps, values, colour)
    if steps.size:
        axes.plot(steps[-1], last, "o", color=colour, markersize=6.5, markeredgecolor="white", markeredgewidth=1.2)
    return last


def style_curves(axes: Axes, title: str) -> None:
    """Style the axes of a metric against environment steps."""
    axes.set_title(title, loc="left", fontsize=11, color=INK, pad=8)
    axes.grid(axis="y", color="#e6e8eb", linewidth=0.8)
    axes.set_axisbelow(True)
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)
    axes.spines["bottom"].set_color("#c9cdd3")
    axes.tick_params(colors=FAINT, labelcolor=INK, length=0, labelsize=9.5)
    axes.xaxis.set_major_formatter(FuncFormatter(format_steps))
    axes.xaxis.set_major_locator(MaxNLocator(6))
    axes.yaxis.set_major_locator(MaxNLocator(6))


def _label_end(axes: Axes, steps: np.ndarray, value: float, text: str, colour: str) -> None:
    options = {"xytext": (9, 0), "textcoords": "offset points", "va": "center"}
    axes.annotate(text, (steps[-1], value), color=colour, fontsize=11, weight="bold", **options)


def plot_run(
    rows: Sequence[Mapping[str, Any]],
    path: Path,
    title: str,
    subtitle: str = "",
    unit: str = "m",
    threshold: float | None = None,
) -> bool:
    """Write the learning curve of a run.

    Args:
        rows: The rows of metrics.jsonl.
        path: A .png, or any other format that Matplotlib can write.
        title: The first line, bold.
        subtitle: The second line.
        unit: The unit of eval/goal_distance.
        threshold: The maximum distance of a success, drawn as a dashed line; None for no line.

    Returns:
        False if there are no rows and nothing was written.
    """
    if not rows:
        return False
    figure = Figure(figsize=(10.5, 4.4), dpi=150, facecolor="white")
    success_axes, distance_axes = figure.subplots(1, 2)
    steps, success = gather(rows, "eval/success")
    _, distance = gather(rows, "eval/goal_distance")

    last = draw_curves(success_axes, steps, success, _SUCCESS)
    style_curves(success_axes, "Success at the end of an episode")
    success_axes.set_ylim(-0.02, 1.03)
    success_axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    if np.isfinite(last):
        _label_end(success_axes, steps, last, f"{last:.0%}", _SUCCESS)

    last = draw_curves(distance_axes, steps, distance, _DISTANCE)
    style_curves(distance_axes, f"Distance to the goal at the end of an episode ({unit})")
    finite = distance[np.isfinite(distance)]
    distance_axes.set_ylim(0.0, 1.08 * max(finite.max(initial=0.0), threshold or 0.0) or 1.0)
    if np.isfinite(last):
        _label_end(distance_axes, steps, last, f"{last:.3f}", _DISTANCE)
    if threshold is not None:
        distance_axes.axhline(threshold, color=FAINT, linewidth=1.1, linestyle=(0, (5, 4)))
        distance_axes.annotate(
            f"threshold {threshold:g} {unit}", (1, threshold), xycoords=("axes fraction", "data"), xytext=(-2, 4),
            textcoords="offset points", ha="right", color=FAINT, fontsize=9,  # curves come down from the left
        )  # fmt: skip
    for axes in (success_axes, distance_axes):
        axes.set_xlim(0, steps[-1] * 1.02 if steps[-1] > 0 else 1)
        axes.set_xlabel("environment steps per seed", fontsize=9.5, color=INK)
    figure.text(0.035, 0.945, title, fontsize=14, weight="bold", color=INK, va="center")
    figure.text(0.035, 0.885, subtitle, fontsize=10, color=FAINT, va="center")
    figure.subplots_adjust(left=0.065, right=0.945, bottom=0.135, top=0.755, wspace=0.27)
    figure.savefig(path)
    return True
