"""Figures 5.4 to 5.7 from the first process to the last file: trains what is missing, draws, and writes the table beside.

FIGURE.png   the lines of finished cells; behind them, dashed, what the authors released
FIGURE.md    steps to levels of success, speed-ups, and what the runs were
FIGURE.csv   the same figures, to compute with
"""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from jaxrl_vis.devices import list_devices
from jaxrl_vis.files import write_atomically
from jaxrl_vis.report.plots import show_steps
from jaxrl_vis.studies import ol_aux
from jaxrl_vis.studies.authors import mean_difference, released_curves
from jaxrl_vis.studies.drawing import Curve, Panel, draw_panels
from jaxrl_vis.studies.grid import run_cells
from jaxrl_vis.studies.ol_aux import LEVELS, STUDIES, VARIANTS, Scope, Study, cells_of
from jaxrl_vis.studies.results import SUCCESS, Line, read_lines
from jaxrl_vis.studies.tables import BASELINE, Named, steps_table, to_csv, weights_table

_AUTHORS = "authors' release"
_ALONE = "5.5"  # the figure whose runs have single tasks


@dataclasses.dataclass(frozen=True)
class Request:
    """A figure that is asked for.

    Attributes:
        figure: One of `STUDIES`.
        out: The picture; the tables go beside it.
        runs: The folder of run folders.
        tasks: Environments; none: those of the study.
        variants: Names of `VARIANTS`; none: those of the study.
        scope: How it is run.
        draw_only: Train nothing.
        seconds: Stop training after so long.
    """

    figure: str
    out: Path
    runs: Path
    tasks: tuple[str, ...] = ()
    variants: tuple[str, ...] = ()
    scope: Scope = Scope()
    draw_only: bool = False
    seconds: float | None = None

    @property
    def study(self) -> Study:
        """What the figure shows."""
        return STUDIES[self.figure]


def make_figure(request: Request, say: Callable[[str], None] = print) -> bool:
    """Trains what is missing and draws what is finished.

    Returns:
        Whether all cells are finished, and so drawn.

    Raises:
        RequestError: Something that was asked for cannot be, see `cells_of` and `run_cells`.
        KeyboardInterrupt: Ctrl-C; nothing was drawn.
        Terminated: SIGTERM; nothing was drawn.
    """
    study = request.study
    tasks, shown = request.tasks or tuple(study.steps), request.variants or study.variants
    extra = tuple(name for name in study.extra if name not in shown)
    cells = cells_of(study, tasks, (*extra, *shown), request.scope)
    if not request.draw_only:
        # A cell that several figures or methods ask for is one cell.
        wanted = {cell.name: cell for parts in cells.values() for cell in parts}
        run_cells(list(wanted.values()), request.runs, list_devices, request.seconds, say=say)
    lines, unfinished = read_lines(cells, request.runs)
    for text in unfinished:
        say(f"not drawn: {text}")
    if not any(variant in shown for _, variant in lines):
        say("nothing to draw yet")
        return False
    for path in _write(request, lines, shown, unfinished):
        say(str(path))
    return not unfinished


def _write(request: Request, lines: dict[tuple[str, str], Line], shown: Sequence[str], unfinished: list[str]) -> list[Path]:
    """Writes the picture and both tables; their paths."""
    is_weights = request.figure == "5.6"
    tasks = [task for task in request.tasks or request.study.steps if any((task, variant) in lines for variant in shown)]
    panels = [Panel(task, _weights(lines, task, shown) if is_weights else _success(lines, task, shown)) for task in tasks]
    about = _about(request, list(lines.values()))
    subtitle = about + ("; dashed: authors' release" if any(c.behind for panel in panels for c in panel.curves) else "")
    draw_panels(request.out, panels, f"{request.study.title} (figure {request.figure})", subtitle, is_share=not is_weights)
    text, rows = _weights_table(request, lines, tasks) if is_weights else _steps_table(lines, tasks)
    head = [f"# Figure {request.figure}: {request.study.title}", "", f"{about}.", ""]
    notes = _notes(request, lines, unfinished)
    markdown, table = (request.out.with_suffix(suffix) for suffix in (".md", ".csv"))
    write_atomically(markdown, "\n".join([*head, *text, *notes]).rstrip() + "\n")
    write_atomically(table, to_csv(rows))
    return [request.out, markdown, table]


def _success(lines: dict[tuple[str, str], Line], task: str, shown: Sequence[str]) -> list[Curve]:
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
            theirs.append(Curve(label, VARIANTS[variant].colour, steps, success[None], behind=True))
    return theirs + ours


def _weights(lines: dict[tuple[str, str], Line], task: str, shown: Sequence[str]) -> list[Curve]:
    # One variant is drawn: a figure of the weights of several would not be legible.
    line = next(lines[task, variant] for variant in shown if (task, variant) in lines)
    return [
        Curve(name.replace("_", " "), VARIANTS[name].colour, *line.values(f"train/weight/{name}")) for name in ol_aux.AUX_TASKS
    ]


def _steps_table(lines: dict[tuple[str, str], Line], tasks: Sequence[str]):
    named = {
        task: [Named(VARIANTS[variant].label, line) for (of_task, variant), line in lines.items() if of_task == task]
        for task in tasks
    }
    ends = {task: max(each.line.end for each in found) for task, found in named.items()}
    released = released_curves()
    for task, variant in sorted(released, key=lambda key: list(VARIANTS).index(key[1])):
        points = released[task, variant]
        known = [(steps, value) for steps, value in points if steps <= ends.get(task, 0)]
        if known:
            rows = [{"seed": 0, "env_steps": steps, "updates": 0, SUCCESS: value} for steps, value in known]
            named[task].append(Named(VARIANTS[variant].label, Line(task, variant, rows), _AUTHORS))
    return steps_table(named, LEVELS)


def _weights_table(request: Request, lines: dict[tuple[str, str], Line], tasks: Sequence[str]):
    cells = cells_of(STUDIES[_ALONE], tasks, (BASELINE, *ol_aux.AUX_TASKS), request.scope)
    others, _ = read_lines(cells, request.runs)
    weighted = {task: next(line for (of_task, _), line in lines.items() if of_task == task) for task in tasks}
    bases = {task: line for (task, variant), line in others.items() if variant == BASELINE}
    names = {name: name.replace("_", " ") for name in ol_aux.AUX_TASKS}
    return weights_table(weighted, others, bases, names)


def _about(request: Request, lines: Sequence[Line]) -> str:
    """The preset, the seeds, the updates per step: what every figure must say."""
    seeds = sorted({seed for line in lines for seed in line.seeds})
    which = f"seed {seeds[0]}" if len(seeds) == 1 else f"seeds {seeds[0]} to {seeds[-1]}; line: median, band: 25 to 75 %"
    often = sorted({f"{line.steps_per_update:.3g}" for line in lines}, key=float)
    return f"preset {request.scope.preset}, one gradient step per {' or '.join(often)} environment steps; {which}"


def _notes(request: Request, lines: dict[tuple[str, str], Line], unfinished: list[str]) -> list[str]:
    notes = [
        "Steps to a level: the evaluation there and the next two reach it, in the median over seeds; in brackets the middle "
        "half of single seeds. Speed-ups are the steps without auxiliary losses, of the same source, divided by these."
    ]
    if request.figure == "5.6":
        notes = ["Weights are means over training, in the median over seeds; gains are differences of mean success."]
    for (task, variant), line in lines.items():
        released = released_curves().get((task, variant))
        if request.scope.preset == "paper" and variant == BASELINE and released and request.figure != "5.6":
            difference = mean_difference(line.points, released)
            if difference is not None:
                notes.append(
                    f"{task} without auxiliary losses: mean absolute difference to the authors' curve {difference:.3f}, over "
                    f"its points to {show_steps(line.end)} steps."
                )
        if line.has_lost_replay():
            notes.append(f"{task}, {VARIANTS[variant].label}: a run went on without its replay, and is not exact.")
    records = [record for line in lines.values() for record in line.records]
    for name, found in (
        ("Revision", {str(record.get("git_revision")) for record in records}),
        ("Device", {str(record.get("device", {}).get("kind")) for record in records}),
    ):
        if found:
            notes.append(f"{name}: {', '.join(sorted(found))}.")
    if unfinished:
        notes += ["Not finished, so not here:", *(f"- {text}" for text in unfinished)]
    return [line for note in notes for line in ((note,) if note.startswith("- ") else (note, ""))]
