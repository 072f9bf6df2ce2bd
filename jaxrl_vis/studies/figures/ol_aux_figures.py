"""Content of figures 5.4 to 5.7: curves of success, with those of the authors, curves of weights, and tables."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from jaxrl_vis.report.plots import format_steps
from jaxrl_vis.run.storage.metrics import RowKeys
from jaxrl_vis.studies.engine.results import SUCCESS, Line, read_lines
from jaxrl_vis.studies.engine.study import make_cells
from jaxrl_vis.studies.figures.authors import mean_difference, released_curves
from jaxrl_vis.studies.figures.drawing import Curve, Panel, Picture
from jaxrl_vis.studies.figures.show import FigureContent, Request
from jaxrl_vis.studies.figures.tables import BASELINE, LabelledLine, steps_table, weights_table
from jaxrl_vis.studies.ol_aux import AUX_TASKS, LEVELS, STUDIES, VARIANTS, WEIGHTS

_AUTHORS = "authors' release"
_ALONE = "5.5"  # the figure with runs of single tasks

Lines = Mapping[tuple[str, str], Line]


def make_content(request: Request, lines: Lines, tasks: Sequence[str], variants: Sequence[str]) -> FigureContent:
    """Create the panels and tables of a figure for these tasks and variants, from its lines by (task, variant)."""
    is_weights = request.figure == WEIGHTS
    panels = [Panel(task, (_weights if is_weights else _success)(lines, task, variants), not is_weights) for task in tasks]
    text, rows = _weights_table(request, lines, tasks) if is_weights else _steps_table(lines, tasks)
    subtitle = "dashed: authors' release" if any(c.is_reference for panel in panels for c in panel.curves) else ""
    title = f"Weights of the auxiliary losses in {VARIANTS[variants[0]].label}" if is_weights else ""
    return FigureContent([Picture("", [panels], subtitle)], text, rows, _notes(request, lines), title)


def _success(lines: Lines, task: str, shown: Sequence[str]) -> list[Curve]:
    ours = [
        Curve(VARIANTS[variant].label, VARIANTS[variant].colour, *lines[task, variant].values(SUCCESS))
        for variant in shown
        if (task, variant) in lines
    ]
    end, theirs = max(lines[task, variant].end for variant in shown if (task, variant) in lines), []
    for variant in shown:
        points = [point for point in released_curves().get((task, variant), ()) if point[0] <= end]
        if len(points) > 1:
            steps, success = np.array(points).T
            label = f"{VARIANTS[variant].label} ({_AUTHORS})"
            theirs.append(Curve(label, VARIANTS[variant].colour, steps, success[None], is_reference=True))
    return theirs + ours


def _weights(lines: Lines, task: str, shown: Sequence[str]) -> list[Curve]:
    # A single variant, because a figure of the weights of several would not be legible.
    line = next(lines[task, variant] for variant in shown if (task, variant) in lines)
    return [Curve(name.replace("_", " "), VARIANTS[name].colour, *line.values(f"train/weight/{name}")) for name in AUX_TASKS]


def _steps_table(lines: Lines, tasks: Sequence[str]):
    named = {
        task: [LabelledLine(VARIANTS[variant].label, line) for (of_task, variant), line in lines.items() if of_task == task]
        for task in tasks
    }
    ends = {task: max(entry.line.end for entry in entries) for task, entries in named.items()}
    released = released_curves()
    for task, variant in sorted(released, key=lambda key: list(VARIANTS).index(key[1])):
        points = released[task, variant]
        known = [(steps, value) for steps, value in points if steps <= ends.get(task, 0)]
        if known:
            rows = [
                RowKeys(seed=0, iteration=0, updates=0, env_steps=steps)._asdict() | {SUCCESS: value} for steps, value in known
            ]
            named[task].append(LabelledLine(VARIANTS[variant].label, Line(task, variant, rows), _AUTHORS))
    return steps_table(named, LEVELS)


def _weights_table(request: Request, lines: Lines, tasks: Sequence[str]):
    # Weights may have another budget than single tasks: then the runs of figure 5.5 provide the gains.
    scopes = (dataclasses.replace(request.scope, env_steps=None), request.scope)
    cells = [make_cells(STUDIES[_ALONE], tasks, (BASELINE, *AUX_TASKS), scope) for scope in scopes]
    others = {key: line for part in cells for key, line in read_lines(part, request.runs)[0].items()}
    weighted = {task: next(line for (of_task, _), line in lines.items() if of_task == task) for task in tasks}
    bases = {task: line for (task, variant), line in others.items() if variant == BASELINE}
    names = {name: name.replace("_", " ") for name in AUX_TASKS}
    return weights_table(weighted, others, bases, names)


def _notes(request: Request, lines: Lines) -> list[str]:
    if request.figure == WEIGHTS:
        return ["Weights are means over training, in the median over seeds; gains are differences of mean success."]
    notes = [
        "Steps to a level: the evaluation there and the next two reach it, in the median over seeds; in brackets the middle "
        "half of single seeds. Speed-ups are the steps without auxiliary losses, of the same source, divided by these."
    ]
    for (task, variant), line in lines.items():
        released = released_curves().get((task, variant))
        if request.scope.preset == "paper" and variant == BASELINE and released:
            difference = mean_difference(line.points, released)
            if difference is not None:
                notes.append(
                    f"{task} without auxiliary losses: mean absolute difference to the authors' curve {difference:.3f}, over "
                    f"its points to {format_steps(line.end)} steps."
                )
    return notes
