"""Creation of figures: training of missing runs, plots and tables.

FIGURE.png   lines of finished cells; in figures 5.4, 5.5 and 5.7 also those released by the authors, dashed
FIGURE.md    tables, and a description of the runs
FIGURE.csv   the same numbers, for further processing

`ol_aux`, `indicator`, `goals` and `weightings` define the runs of a figure; files in this folder define how it looks.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

from jaxrl_vis.host import streams
from jaxrl_vis.host.devices import list_devices, shared
from jaxrl_vis.host.files import write_atomically
from jaxrl_vis.host.spreadsheets import to_csv
from jaxrl_vis.studies import goals, indicator, ol_aux, weightings
from jaxrl_vis.studies.engine.grid import run_cells
from jaxrl_vis.studies.engine.results import Line, read_lines
from jaxrl_vis.studies.engine.study import Study, make_cells
from jaxrl_vis.studies.figures import comparison_figure, indicator_figures, ol_aux_figures
from jaxrl_vis.studies.figures.drawing import draw_panels
from jaxrl_vis.studies.figures.show import FigureContent, Request

STUDIES: dict[str, Study] = {**indicator.STUDIES, **goals.STUDIES, **ol_aux.STUDIES, **weightings.STUDIES}
"""Studies by figure."""

_MAKE_CONTENT: dict[str, Callable[..., FigureContent]] = {
    goals.FAMILY.name: comparison_figure.make_content,
    weightings.FAMILY.name: comparison_figure.make_content,
    indicator.FAMILY.name: indicator_figures.make_content,
    ol_aux.FAMILY.name: ol_aux_figures.make_content,
}


def make_figure(request: Request, echo: Callable[[str], None] = streams.echo) -> bool:
    """Train missing cells, unless ``draw_only`` is set, and draw finished ones; the paths written are passed to ``echo``.

    Returns:
        True if all cells are finished and thus plotted.

    Raises:
        RequestError: The request cannot be fulfilled, see `make_cells` and `run_cells`.
        KeyboardInterrupt: Ctrl-C; nothing was drawn.
        Terminated: Another signal; nothing was drawn.
    """
    study = request.study
    tasks, variants = request.tasks or tuple(study.steps), request.variants or study.variants
    extra = tuple(name for name in study.extra_variants if name not in variants)
    cells = make_cells(study, tasks, (*extra, *variants), request.scope)
    if not request.draw_only:
        # A cell requested by several figures or methods is trained once.
        wanted = {cell.name: cell for parts in cells.values() for cell in parts}
        run_cells(
            list(wanted.values()), request.runs, lambda: shared(list_devices(), request.per_device), request.seconds, echo=echo
        )
    lines, unfinished = read_lines(cells, request.runs, ignore_settings=request.draw_only)
    for text in unfinished:
        echo(f"not drawn: {text}")
    if not any(variant in variants for _, variant in lines):
        echo("nothing to draw yet")
        return False
    for path in _write(request, lines, variants, unfinished):
        echo(str(path))
    return not unfinished


def _write(
    request: Request, lines: dict[tuple[str, str], Line], variants: Sequence[str], unfinished: Sequence[str]
) -> list[Path]:
    """Write the images and both tables; return their paths."""
    study = request.study
    tasks = [task for task in request.tasks or study.steps if any((task, variant) in lines for variant in variants)]
    content = _MAKE_CONTENT[study.family.name](request, lines, tasks, variants)
    about, title, pictures = _about(request, list(lines.values())), content.title or study.title, []
    for picture in content.pictures:
        pictures.append(request.out.with_stem(request.out.stem + picture.suffix))
        subtitle = "; ".join(part for part in (about, picture.subtitle) if part)
        draw_panels(pictures[-1], picture.rows, f"{title} (figure {request.figure})", subtitle)
    head = [f"# Figure {request.figure}: {title}", "", f"{about}.", ""]
    markdown, table = (request.out.with_suffix(suffix) for suffix in (".md", ".csv"))
    notes = [*content.notes, *_common_notes(study, lines, unfinished)]
    spaced = [line for note in notes for line in ((note,) if note.startswith("- ") else (note, ""))]
    write_atomically(markdown, "\n".join([*head, *content.text, *spaced]).rstrip() + "\n")
    write_atomically(table, to_csv(content.rows))
    return [*pictures, markdown, table]


def _about(request: Request, lines: Sequence[Line]) -> str:
    """Describe options, preset, seeds and update ratio, which every figure must state."""
    seeds = sorted({seed for line in lines for seed in line.seeds})
    seeds_text = f"seed {seeds[0]}" if len(seeds) == 1 else f"seeds {seeds[0]} to {seeds[-1]}; line: median, band: 25 to 75 %"
    ratios = sorted({f"{line.steps_per_update:.3g}" for line in lines}, key=float)
    options = ", ".join(request.scope.changes.get("env_options", ()))
    learning = f"preset {request.scope.preset}, one gradient step per {' or '.join(ratios)} environment steps"
    return "; ".join(part for part in (options, learning, seeds_text) if part)


def _common_notes(study: Study, lines: dict[tuple[str, str], Line], unfinished: Sequence[str]) -> list[str]:
    notes = [
        f"{task}, {study.family.variants[variant].label}: a run went on without its replay, and is not exact."
        for (task, variant), line in lines.items()
        if line.has_lost_replay()
    ]
    notes += [
        f"{task}, {study.family.variants[variant].label}: not as it would be trained now, "
        f"with {'; '.join(line.setting_differences)}."
        for (task, variant), line in lines.items()
        if line.setting_differences
    ]
    records = [record for line in lines.values() for record in line.records]
    for name, values in (
        ("Revision", {str(record.get("git_revision")) for record in records}),
        ("Device", {str(record.get("device", {}).get("kind")) for record in records}),
    ):
        if values:
            notes.append(f"{name}: {', '.join(sorted(values))}.")
    if unfinished:
        notes += ["Not finished, so not here:", *(f"- {text}" for text in unfinished)]
    return notes
