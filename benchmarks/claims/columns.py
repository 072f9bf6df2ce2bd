"""Statistics of a record over its seeds as cells of a table; a cell is empty if the run has no such evaluation."""

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from benchmarks.claims.permutation import permutation_p_value
from benchmarks.claims.records import DISTANCE, SUCCESS, Record
from jaxrl_vis.report.plots import format_steps
from jaxrl_vis.studies.figures.authors import mean_difference, released_curves
from jaxrl_vis.studies.seed_statistics import bootstrap_interval, interquartile_mean

SIGNIFICANT = 0.05
AUTHORS = "authors"
_TRUTH, _FILTERED = "train/filtered_false_share", "train/filtered_share"
_ACTIVE = 0.01  # fraction of dropped negatives below which a filter counts as inactive, and has no precision


class Column(NamedTuple):
    """Column of a table: its title, and a function that formats the cell of a record."""

    title: str
    cell: Callable[[Record], str]


def band(values: np.ndarray, digits: int = 3) -> str:
    """Format median and quartiles of values [N], ``0.665 (0.635 to 0.685)``; only the median if all three round to the same."""
    low, median, high = (f"{value:.{digits}f}" for value in np.percentile(values, [25, 50, 75]))
    return median if low == median == high else f"{median} ({low} to {high})"


def interval(values: np.ndarray, digits: int = 3) -> str:
    """Format the interquartile mean of values [N] and its 95 % bootstrap interval."""
    low, high = bootstrap_interval([values])
    return f"{interquartile_mean([values]):.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"


@functools.cache
def p_value(first: Record, second: Record, budget: int | None = None) -> float:
    """Return the p-value of an exact two-sided permutation test of two records' mean success up to a budget."""
    return permutation_p_value(first.means(budget), second.means(budget))


def show_p(value: float) -> str:
    """Format a p-value with three decimals; ``< 0.001`` below that."""
    return "< 0.001" if value < 0.0005 else f"{value:.3f}"


def p_text(first: Record, second: Record, budget: int | None = None) -> str:
    """Format the p-value of two records as in text: ``p = 0.032`` or ``p < 0.001``."""
    shown = show_p(p_value(first, second, budget))
    return f"p {shown}" if shown.startswith("<") else f"p = {shown}"


def verdict(record: Record, reference: Record, budget: int | None = None) -> str:
    """Return ``better`` or ``worse`` if a record's mean success differs significantly from a reference's, else ``level``.

    Args:
        record: The record.
        reference: Record to compare with.
        budget: Environment steps up to which success is averaged; None for all.
    """
    if p_value(record, reference, budget) > SIGNIFICANT:
        return "level"
    return "better" if record.means(budget).mean() > reference.means(budget).mean() else "worse"


def speed_up(record: Record, reference: Record, level: float) -> str:
    """Format the steps of ``reference`` to a level relative to those of ``record``: a lower bound if only ``record`` reaches
    it, empty if ``record`` does not.
    """
    steps, baseline = record.steps_to(level), reference.steps_to(level)
    if not steps:
        return ""
    return f"{'' if baseline else '> '}{(baseline or reference.points[-1][0]) / steps:.1f}"


def steps_cell(record: Record, level: float) -> str:
    """Format the environment steps until the median success reaches a level, or ``> STEPS`` of the last evaluation if never."""
    steps = record.steps_to(level)
    return f"> {format_steps(record.points[-1][0])}" if steps is None else format_steps(steps)


def _source(record: Record) -> str:
    return AUTHORS if record.name.startswith(AUTHORS) else "here"


@functools.cache
def authors(task: str, variant: str, budget: int) -> Record:
    """Return the authors' released curve of a task and variant up to ``budget`` environment steps, as a record of one seed."""
    points = [point for point in released_curves()[task, variant] if point[0] <= budget]
    return Record(f"{AUTHORS}/{task}-{variant}", tuple({"seed": 0, "env_steps": at, SUCCESS: value} for at, value in points))


def show_seeds(record: Record) -> str:
    """Format the first and last seed, or the only one; empty for a published curve."""
    if _source(record) == AUTHORS:
        return ""
    return f"{record.seeds[0]} to {record.seeds[-1]}" if len(record.seeds) > 1 else str(record.seeds[0])


def _if_several_seeds(record: Record, text: Callable[[], str]) -> str:
    return text() if len(record.seeds) > 1 else ""


def seeds() -> Column:
    """Return the column of the first and last seed."""
    return Column("seeds", show_seeds)


def steps_to(level: float, *references: Record) -> Column:
    """Return the column of steps to a success level, with the speed-up over the reference of the same source in parentheses."""

    def cell(record: Record) -> str:
        same = [reference for reference in references if _source(reference) == _source(record)]
        factor = "" if not same or record in references else speed_up(record, same[0], level)
        return steps_cell(record, level) + (f" ({factor})" if factor else "")

    return Column(f"steps to {level:g}", cell)


def median_at(steps: int, digits: int = 2, metric: str = SUCCESS, title: str | None = None) -> Column:
    """Return the column of a metric's median over seeds at one evaluation; a cell is empty if there is none.

    Args:
        steps: Environment steps of the evaluation.
        digits: Number of decimals.
        metric: Name of the metric.
        title: Title of the column; None for ``steps``.
    """

    def cell(record: Record) -> str:
        values = record.at(steps, metric)
        return "" if values is None else f"{np.median(values):.{digits}f}"

    return Column(title or format_steps(steps), cell)


def values_at(steps: int, digits: int = 2) -> Column:
    """Return the column of every seed's success at the evaluation at ``steps``, with ``digits`` decimals; empty without it."""

    def cell(record: Record) -> str:
        values = record.at(steps)
        return "" if values is None else ", ".join(f"{value:.{digits}f}" for value in values)

    return Column(format_steps(steps), cell)


def min_success(steps: int) -> Column:
    """Return the column of the minimum success over seeds at the evaluation at ``steps``; empty without that evaluation."""

    def cell(record: Record) -> str:
        values = record.at(steps)
        return "" if values is None else f"{values.min():.2f}"

    return Column(f"least at {format_steps(steps)}", cell)


def mean_at(steps: int) -> Column:
    """Return the column of the mean success over seeds at the evaluation at ``steps``; empty without that evaluation."""

    def cell(record: Record) -> str:
        values = record.at(steps)
        return "" if values is None else f"{values.mean():.2f}"

    return Column(format_steps(steps), cell)


def success_at(steps: int) -> Column:
    """Return the column of median and quartiles of success over seeds at the evaluation at ``steps``; empty without it."""

    def cell(record: Record) -> str:
        values = record.at(steps)
        return "" if values is None else band(values)

    return Column(f"success at {format_steps(steps)}", cell)


def final(metric: str = SUCCESS, title: str = "success at the end", digits: int = 3) -> Column:
    """Return the column of median and quartiles of a metric over seeds at the last evaluation; empty if it was not recorded.

    Args:
        metric: Name of the metric.
        title: Title of the column.
        digits: Number of decimals.
    """

    def cell(record: Record) -> str:
        values = record.at(record.end, metric)
        return "" if values is None else band(values, digits)

    return Column(title, cell)


def final_distance() -> Column:
    """Return the column of median and quartiles of the final distance at the last evaluation."""
    return final(DISTANCE, "distance at the end")


def final_median(metric: str, title: str, digits: int = 3) -> Column:
    """Return the column of a metric's median over seeds at the last evaluation; empty if it was not recorded.

    Args:
        metric: Name of the metric.
        title: Title of the column.
        digits: Number of decimals.
    """

    def cell(record: Record) -> str:
        values = record.at(record.end, metric)
        return "" if values is None else f"{np.median(values):.{digits}f}"

    return Column(title, cell)


def training_mean(metric: str, title: str, digits: int = 3) -> Column:
    """Return the column of the median over seeds of a metric's mean over training.

    Args:
        metric: Name of the metric.
        title: Title of the column.
        digits: Number of decimals.
    """
    return Column(title, lambda record: f"{np.median(record.means(metric=metric)):.{digits}f}")


def mean_success(budget: int | None = None) -> Column:
    """Return the column of the interquartile mean of the mean success, with 95 % bootstrap interval; empty for one seed.

    Args:
        budget: Environment steps up to which success is averaged; None for all.
    """
    title = f"mean success to {format_steps(budget)}" if budget else "mean success over training"
    return Column(f"{title}, IQM (95 %)", lambda record: _if_several_seeds(record, lambda: interval(record.means(budget))))


def p_value_against(reference: Record, label: str, budget: int | None = None) -> Column:
    """Return the column of the p-value of the permutation test of mean success against a reference.

    Args:
        reference: Record to compare with; its own cell is empty, as are those of single seeds.
        label: Name of the reference in the title.
        budget: Environment steps up to which success is averaged; None for all.
    """

    def cell(record: Record) -> str:
        return "" if record is reference else _if_several_seeds(record, lambda: show_p(p_value(record, reference, budget)))

    return Column(f"p against {label}", cell)


def seconds() -> Column:
    """Return the column of wall-clock seconds, summed over the programs that trained the seeds, without compilation."""

    def cell(record: Record) -> str:
        # Seeds of one program have the same times.
        last = {row["seed"]: (row["time/wall_s"], row["time/compile_s"]) for row in record.rows}
        return f"{sum(wall - compilation for wall, compilation in set(last.values())):,.0f}"

    return Column("seconds without compilation", cell)


def training_precision() -> Column:
    """Return the column of the fraction of dropped negatives that were false over training; empty for an inactive filter."""

    def cell(record: Record) -> str:
        dropped = np.median(record.means(metric=_FILTERED))
        return f"{np.median(record.means(metric=_TRUTH)) / dropped:.3f}" if dropped >= _ACTIVE else ""

    return Column("of them false, over training", cell)


def final_precision() -> Column:
    """Return the column of the median of the filter's final precision; empty if the filter was inactive over training."""

    def cell(record: Record) -> str:
        if np.median(record.means(metric=_FILTERED)) < _ACTIVE:
            return ""
        precision = record.at(record.end, "train/filter_precision")
        return "" if precision is None else f"{np.median(precision):.3f}"

    return Column("of them false, at the end", cell)


def to_authors(task: str, variant: str) -> Column:
    """Return the column of the mean absolute difference between the median success and the authors' released curve.

    The 95 % bootstrap interval over seeds is added in parentheses. The cell of the authors' own curve is empty.
    """
    curve = released_curves()[task, variant]

    def cell(record: Record) -> str:
        if _source(record) == AUTHORS:
            return ""
        low, high = np.quantile([mean_difference(points, curve) for points in _resampled_medians(record)], [0.025, 0.975])
        return f"{mean_difference(record.points, curve):.3f} ({low:.3f} to {high:.3f})"

    return Column("distance to the authors' curve (95 %)", cell)


def _resampled_medians(record: Record, count: int = 2_000) -> list[list[tuple[int, float]]]:
    """Return the median success curves, pairs of (environment steps, success), of ``count`` bootstrap samples of seeds."""
    steps = [at for at, _ in record.points]
    success = np.stack([record.at(at) for at in steps])
    draws = np.random.default_rng(0).integers(len(record.seeds), size=(count, len(record.seeds)))
    return [list(zip(steps, median, strict=True)) for median in np.median(success[:, draws], axis=-1).T]


def names() -> Column:
    """Return the column of the record's path below benchmarks/results without its first folder; empty for a published curve."""
    return Column("record", lambda record: "" if _source(record) == AUTHORS else f"`{record.name.partition('/')[2]}`")


def weights(losses: Sequence[str]) -> list[Column]:
    """Return a column per auxiliary loss: the median over seeds of its mean weight over training."""
    return [
        Column(
            loss.replace("_", " "), lambda record, loss=loss: _weight(np.median(record.means(metric=f"train/weight/{loss}")))
        )
        for loss in losses
    ]


def _weight(value: float) -> str:
    return f"{value:.0f}" if value >= 10 else f"{value:.1f}"
