"""Tables of a figure, as Markdown and CSV: steps to levels of success, and speed-ups over a baseline."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from scipy.stats import spearmanr

from jaxrl_vis.report.plots import format_steps
from jaxrl_vis.studies.engine.results import Line, final_quartiles, find_steps, mean_success, mean_weight

BASELINE = "none"


@dataclasses.dataclass(frozen=True)
class LabelledLine:
    """Line with its label in tables.

    Attributes:
        label: Label of the method.
        line: Results of the method.
        source: Origin of the results: ``here``, or their publisher.
    """

    label: str
    line: Line
    source: str = "here"


def steps_table(
    lines: Mapping[str, Sequence[LabelledLine]], levels: Mapping[str, Sequence[float]]
) -> tuple[list[str], list[dict[str, Any]]]:
    """Tabulate steps to each level, and speed-ups over the baseline of the same source.

    Args:
        lines: Lines by task.
        levels: Levels of success by task.

    Returns:
        Lines of Markdown, one table per task; and rows for `spreadsheets.to_csv`.
    """
    text: list[str] = []
    rows: list[dict[str, Any]] = []
    for task, named in lines.items():
        common = min(entry.line.end for entry in named)
        heads = [part for level in levels[task] for part in (f"steps to {level:g}", "speed-up")]
        columns = ["method", *heads, f"mean success to {format_steps(common)}", "success at the end"]
        text += [f"### {task}", "", table_row(columns), table_row(["---"] * len(columns))]
        for entry in named:
            base = next((b.line for b in named if b.line.variant == BASELINE and b.source == entry.source), None)
            text.append(table_row(_cells(entry, base, levels[task], common)))
            rows += _csv_rows(entry, base, levels[task], common)
        text.append("")
    return text, rows


def _label(named: LabelledLine) -> str:
    return named.label if named.source == "here" else f"{named.label} ({named.source})"


def _cells(named: LabelledLine, base: Line | None, levels: Sequence[float], common: int) -> list[str]:
    cells = [_label(named)]
    for level in levels:
        result = find_steps(named.line, level)
        is_base = base is None or named.line.variant == BASELINE
        cells += [str(result), "" if base is None or is_base else result.ratio(find_steps(base, level))]
    low, median, high = final_quartiles(named.line)
    end = f"{median:.2f}" if len(named.line.seeds) == 1 else f"{median:.2f} ({low:.2f} to {high:.2f})"
    return [*cells, f"{mean_success(named.line, common):.3f}", end]


def _csv_rows(named: LabelledLine, base: Line | None, levels: Sequence[float], common: int) -> list[dict[str, Any]]:
    rows = []
    for level in levels:
        result = find_steps(named.line, level)
        rows.append(
            dict(
                task=named.line.task,
                method=named.line.variant,
                source=named.source,
                seeds=len(named.line.seeds),
                level=level,
                steps=result.steps,
                steps_25=result.low,
                steps_75=result.high,
                budget=result.budget,
                speed_up="" if base is None or named.line.variant == BASELINE else result.ratio(find_steps(base, level)),
                mean_success=round(mean_success(named.line, common), 4),
                mean_success_to=common,
                final_success=round(final_quartiles(named.line)[1], 4),
            )
        )
    return rows


def weights_table(
    weighted: Mapping[str, Line], alone: Mapping[tuple[str, str], Line], bases: Mapping[str, Line], names: Mapping[str, str]
) -> tuple[list[str], list[dict[str, Any]]]:
    """Tabulate the mean weight of each auxiliary loss and its gain alone, with Spearman's rank correlation between the two.

    The gain is the mean success of the run with this loss alone minus that of the run without auxiliary losses, both up to the
    end of the shorter run.

    Args:
        weighted: Runs with all losses, by task.
        alone: Runs with a single auxiliary loss, by (task, auxiliary loss); those that do not exist yet are left out.
        bases: Runs without auxiliary losses, by task; those that do not exist yet are left out.
        names: Labels of the auxiliary losses, by name.

    Returns:
        Lines of Markdown, a table for each task followed by the correlation once all gains are known; and rows for
        `spreadsheets.to_csv`, whose ``gain_alone`` is None where a run is missing.
    """
    text: list[str] = []
    rows: list[dict[str, Any]] = []
    for task, line in weighted.items():
        text += [f"### {task}", "", table_row(["auxiliary loss", "mean weight", "gain alone"]), table_row(["---"] * 3)]
        weights, gains = [], []
        for name, label in names.items():
            weight, gain = mean_weight(line, name), _gain(alone.get((task, name)), bases.get(task))
            text.append(table_row([label, f"{weight:.3f}", "not there yet" if gain is None else f"{gain:+.3f}"]))
            rows.append({"task": task, "auxiliary_loss": name, "mean_weight": weight, "gain_alone": gain})
            if gain is not None:
                weights.append(weight)
                gains.append(gain)
        text += ["", _correlation(weights, gains, len(names)), ""]
    return text, rows


def _gain(alone: Line | None, base: Line | None) -> float | None:
    if alone is None or base is None:
        return None
    common = min(alone.end, base.end)
    return mean_success(alone, common) - mean_success(base, common)


def _correlation(weights: Sequence[float], gains: Sequence[float], minimum: int) -> str:
    if len(gains) < minimum:
        return "Rank correlation of mean weight and gain alone: not known before all runs of figure 5.5 are there."
    if len(set(weights)) < 2 or len(set(gains)) < 2:
        return "Rank correlation of mean weight and gain alone: not defined, since all are equal."
    rho = float(spearmanr(weights, gains).statistic)
    return f"Rank correlation of mean weight and gain alone: {rho:+.2f} (of {len(gains)} losses)."


def table_row(cells: Sequence[str]) -> str:
    """Format a row of a Markdown table."""
    return "| " + " | ".join(cells) + " |"
