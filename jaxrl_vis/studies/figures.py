"""Figures of training runs from the first process to the last file: trains what is missing, draws, and writes tables beside.

FIGURE.png   the lines of finished cells; of figures 5.4 to 5.7 behind them, dashed, what the authors released
FIGURE.md    the tables, and what the runs were
FIGURE.csv   the same figures, to compute with

`ol_aux` and `indicator` say which runs a figure is made of; `ol_aux_figures` and `indicator_figures` what it shows of them.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

from jaxrl_vis import streams
from jaxrl_vis.devices import list_devices, shared
from jaxrl_vis.files import write_atomically
from jaxrl_vis.spreadsheets import to_csv
from jaxrl_vis.studies import indicator, indicator_figures, ol_aux, ol_aux_figures
from jaxrl_vis.studies.drawing import draw_panels
from jaxrl_vis.studies.grid import run_cells
from jaxrl_vis.studies.results import Line, read_lines
from jaxrl_vis.studies.show import Request, Shown
from jaxrl_vis.studies.study import Study, cells_of

STUDIES: dict[str, Study] = {**indicator.STUDIES, **ol_aux.STUDIES}
"""Figure -> what it shows."""

_SHOW: dict[str, Callable[..., Shown]] = {
    indicator.FAMILY.name: indicator_figures.show,
    ol_aux.FAMILY.name: ol_aux_figures.show,
}


def make_figure(request: Request, say: Callable[[str], None] = streams.say) -> bool:
    """Trains what is missing and draws what is finished.

    Returns:
        Whether all cells are finished, and so drawn.

    Raises:
        RequestError: Something that was asked for cannot be, see `cells_of` and `run_cells`.
        KeyboardInterrupt: Ctrl-C; nothing was drawn.
        Terminated: Another signal; nothing was drawn.
    """
    study = request.study
    tasks, variants = request.tasks or tuple(study.steps), request.variants or study.variants
    extra = tuple(name for name in study.extra if name not in variants)
    cells = cells_of(study, tasks, (*extra, *variants), request.scope)
    if not request.draw_only:
        # A cell that several figures or methods ask for is one cell.
        wanted = {cell.name: cell for parts in cells.values() for cell in parts}
        run_cells(
            list(wanted.values()), request.runs, lambda: shared(list_devices(), request.per_device), request.seconds, say=say
        )
    lines, unfinished = read_lines(cells, request.runs, as_they_are=request.draw_only)
    for text in unfinished:
        say(f"not drawn: {text}")
    if not any(variant in variants for _, variant in lines):
        say("nothing to draw yet")
        return False
    for path in _write(request, lines, variants, unfinished):
        say(str(path))
    return not unfinished


def _write(
    request: Request, lines: dict[tuple[str, str], Line], variants: Sequence[str], unfinished: Sequence[str]
) -> list[Path]:
    """Writes the pictures and both tables; their paths."""
    study = request.study
    tasks = [task for task in request.tasks or study.steps if any((task, variant) in lines for variant in variants)]
    shown = _SHOW[study.family.name](request, lines, tasks, variants)
    about, title, pictures = _about(request, list(lines.values())), shown.title or study.title, []
    for picture in shown.pictures:
        pictures.append(request.out.with_stem(request.out.stem + picture.suffix))
        subtitle = "; ".join(part for part in (about, picture.subtitle) if part)
        draw_panels(pictures[-1], picture.rows, f"{title} ({_name(request.figure)})", subtitle)
    head = [f"# {_name(request.figure).capitalize()}: {title}", "", f"{about}.", ""]
    markdown, table = (request.out.with_suffix(suffix) for suffix in (".md", ".csv"))
    notes = [*shown.notes, *_common_notes(study, lines, unfinished)]
    spaced = [line for note in notes for line in ((note,) if note.startswith("- ") else (note, ""))]
    write_atomically(markdown, "\n".join([*head, *shown.text, *spaced]).rstrip() + "\n")
    write_atomically(table, to_csv(shown.rows))
    return [*pictures, markdown, table]


def _name(figure: str) -> str:
    return f"figure {figure}"


def _about(request: Request, lines: Sequence[Line]) -> str:
    """The preset, the seeds, the updates per step: what every figure must say."""
    seeds = sorted({seed for line in lines for seed in line.seeds})
    which = f"seed {seeds[0]}" if len(seeds) == 1 else f"seeds {seeds[0]} to {seeds[-1]}; line: median, band: 25 to 75 %"
    often = sorted({f"{line.steps_per_update:.3g}" for line in lines}, key=float)
    options = ", ".join(request.scope.changes.get("env_options", ()))
    learning = f"preset {request.scope.preset}, one gradient step per {' or '.join(often)} environment steps"
    return "; ".join(part for part in (options, learning, which) if part)


def _common_notes(study: Study, lines: dict[tuple[str, str], Line], unfinished: Sequence[str]) -> list[str]:
    notes = [
        f"{task}, {study.family.variants[variant].label}: a run went on without its replay, and is not exact."
        for (task, variant), line in lines.items()
        if line.has_lost_replay()
    ]
    notes += [
        f"{task}, {study.family.variants[variant].label}: not as it would be trained now, with {'; '.join(line.unlike)}."
        for (task, variant), line in lines.items()
        if line.unlike
    ]
    records = [record for line in lines.values() for record in line.records]
    for name, found in (
        ("Revision", {str(record.get("git_revision")) for record in records}),
        ("Device", {str(record.get("device", {}).get("kind")) for record in records}),
    ):
        if found:
            notes.append(f"{name}: {', '.join(sorted(found))}.")
    if unfinished:
        notes += ["Not finished, so not here:", *(f"- {text}" for text in unfinished)]
    return notes
