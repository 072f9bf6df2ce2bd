"""Content of figures ``goals`` and ``weightings``: success against steps and wall-clock time, and a table with intervals."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxrl_vis.studies.engine.results import SUCCESS, Line, final_quartiles, find_steps
from jaxrl_vis.studies.engine.study import Variant
from jaxrl_vis.studies.figures.drawing import Curve, Panel, Picture
from jaxrl_vis.studies.figures.show import FigureContent, Request
from jaxrl_vis.studies.figures.tables import table_row
from jaxrl_vis.studies.seed_statistics import bootstrap_interval, interquartile_mean

LEVEL = 0.9
"""Level of success for which steps and seconds are reported."""
_WALL, _COMPILATION = "time/wall_s", "time/compile_s"


def make_content(
    request: Request, lines: Mapping[tuple[str, str], Line], tasks: Sequence[str], variants: Sequence[str]
) -> FigureContent:
    """Create the panels and tables of the figure for these tasks and variants, from its lines by (task, variant)."""
    shown = {key: line for key, line in lines.items() if key[1] in variants}
    known = request.study.family.variants
    of_steps = [Panel(f"{task}: success", _curves(shown, known, task)) for task in tasks]
    of_seconds = [
        Panel(
            f"{task}: success", _curves(shown, known, task, by_seconds=True), x_label="seconds without compilation, all seeds"
        )
        for task in tasks
    ]
    text, rows = _tables(shown, known, tasks)
    notes = [
        "Mean success: over all evaluations of a run, the area under its curve; interquartile mean over seeds with its 95 % "
        f"bootstrap interval. Steps to {LEVEL:g}: the evaluation there and the next two are at least that, in the median over "
        "seeds. Seconds: of all seeds in one program, without compilation. No method was tuned for this figure: all have the "
        "preset's settings for any task."
    ]
    return FigureContent([Picture("", [of_steps, of_seconds])], text, rows, notes)


def _curves(
    lines: Mapping[tuple[str, str], Line], known: Mapping[str, Variant], task: str, by_seconds: bool = False
) -> list[Curve]:
    curves = []
    for (of_task, variant), line in lines.items():
        if of_task == task:
            steps, values = line.values(SUCCESS)
            positions = np.array([_seconds(line, count) for count in steps]) if by_seconds else steps
            curves.append(Curve(known[variant].label, known[variant].colour, positions, values))
    return curves


def _seconds(line: Line, steps: int) -> float:
    """Return the wall-clock seconds, for all seeds together and without compilation, up to a number of environment steps."""
    row = next(row for row in line.rows if row["env_steps"] >= steps)
    return float((row.get(_WALL) or 0.0) - (row.get(_COMPILATION) or 0.0))


def _tables(
    lines: Mapping[tuple[str, str], Line], known: Mapping[str, Variant], tasks: Sequence[str]
) -> tuple[list[str], list[dict[str, Any]]]:
    text, rows = [], []
    columns = ["method", "mean success, IQM (95 %)", "success at the end", f"steps to {LEVEL:g}", f"s to {LEVEL:g}", "s in all"]
    for task in tasks:
        text += [f"### {task}", "", table_row(columns), table_row(["---"] * len(columns))]
        for (of_task, variant), line in lines.items():
            if of_task != task:
                continue
            areas = [np.array([float(np.nanmean(row)) for row in line.values(SUCCESS)[1]])]
            mean, (low, high) = interquartile_mean(areas), bootstrap_interval(areas)
            until = find_steps(line, LEVEL)
            seconds = None if until.steps is None else _seconds(line, until.steps)
            end = final_quartiles(line)
            cells = [f"{mean:.3f} ({low:.3f} to {high:.3f})", f"{end[1]:.3f} ({end[0]:.3f} to {end[2]:.3f})", str(until)]
            cells += ["–" if seconds is None else f"{seconds:.0f}", f"{_seconds(line, line.end):.0f}"]
            text.append(table_row([known[variant].label, *cells]))
            rows.append(
                dict(
                    task=task,
                    method=variant,
                    seeds=len(line.seeds),
                    env_steps=line.end,
                    mean_success=round(mean, 5),
                    mean_success_low=round(low, 5),
                    mean_success_high=round(high, 5),
                    final_success=round(end[1], 5),
                    steps_to_level=until.steps,
                    seconds_to_level=None if seconds is None else round(seconds, 1),
                    seconds=round(_seconds(line, line.end), 1),
                )
            )
        text.append("")
    return text, rows
