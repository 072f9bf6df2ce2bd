"""``jaxrl-vis figure``."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from jaxrl_vis.cli import grasp_figure
from jaxrl_vis.cli.checks import check_counts
from jaxrl_vis.cli.phenotype_figure import NAMES as CHAPTER_3
from jaxrl_vis.cli.phenotype_figure import make_figure
from jaxrl_vis.config import PRESETS
from jaxrl_vis.devices import check_devices
from jaxrl_vis.errors import RequestError, nearest
from jaxrl_vis.report.outputs import check_writable

if TYPE_CHECKING:
    from jaxrl_vis.studies.show import Request

_OfPlants = Literal["3.4", "3.5", "table3.1", "4.4", "4.5", "4.6"]
_OfLearners = Literal["5.1", "5.2", "estimators", "cameras", "5.4", "5.5", "5.6", "5.7", "quadratic"]
FigureName = Literal[_OfPlants, _OfLearners]
SUFFIXES = (".png", ".pdf", ".svg")
# Figures without training -> their options.
_DRAWN_HERE = {
    **dict.fromkeys(grasp_figure.NAMES, ("figure", "out", "seed", *grasp_figure.OPTIONS)),
    "quadratic": ("figure", "out"),
}
UNFINISHED = 3
"""Exit status: finished, with something left out."""


@dataclasses.dataclass(frozen=True)
class Figure:
    """Draw a figure: train or compute its content, and write it to a file, with tables beside it.

    3.4, 3.5, table3.1: counts, widths and times on synthetic plots of sorghum, beside the thesis's human results; from
    --evaluation, or from plots that are evaluated first. 4.4: from a stereo pair to grasp points, in a synthetic run chosen by
    --seed. 4.5: the planned and the executed path of the arm to a stalk of that run; --video shows all of its reaches. 4.6:
    attempts and grasps of 16 runs of half a metre; from --evaluation, or from runs that are evaluated first.

    5.1, 5.2: rewards with and without ground truth. estimators: rewards from inaccurate state estimators. cameras: noisy and
    randomised images. 5.4: weightings of auxiliary losses. 5.5: single auxiliary tasks. 5.6: their weights over training. 5.7:
    the benefit of OL-AUX-5's look-ahead. These train missing runs, one process per GPU, and resume unfinished ones, so they may
    be interrupted and started again at any time; the exit status is 3 if something is still missing.

    quadratic: adaptive weights of auxiliary losses on three losses of a point in the plane.
    """

    figure: Annotated[FigureName, tyro.conf.Positional]
    """Name of the figure."""
    out: Path | None = None
    """A .png, .pdf or .svg file, or .md for table3.1; figure_FIGURE.png (or quadratic.png, or table_3.1.md) in the current
    folder if not given. Tables are written beside it, as .md and .csv."""
    evaluation: Path | None = None
    """For 3.4, 3.5 and table3.1: output of `phenotype eval --json`; for 4.6: output of `grasp eval --reach --json`. If not
    given, plots or runs are evaluated."""
    wind: float = 10.0
    """For 4.5 and 4.6: amplitude of the stalks' sway in the wind, mm."""
    video: Path | None = None
    """For 4.5: a .gif, .mp4 or .html file of the arm's motion."""
    plots: int | None = None
    """For 3.4, 3.5 and table3.1: number of plots to evaluate; 10 if not given."""
    preset: str | None = None
    """Preset of all runs; paper for figures 5.4 to 5.7 and fast for the others if not given."""
    quick: bool = False
    """For a CPU: preset cpu, seed 0, VisualFetchReach. 5.4 to 5.7 take only a few steps, as a demonstration without
    learning."""
    tasks: tuple[str, ...] = ()
    """Only these environments; all of the figure's if not given."""
    methods: tuple[str, ...] = ()
    """These lines instead of the figure's own, such as none sum fixed_0.1 ol_aux_5."""
    seed: int | None = None
    """First seed; 0 if not given."""
    seeds: int | None = None
    """Number of seeds; 5 if not given."""
    seeds_per_run: int | None = None
    """Largest number of seeds in one program, to save memory; all of them if not given."""
    env_steps: int | None = None
    """Environment steps of every run; the figure's own budgets if not given."""
    env_options: tuple[str, ...] = ()
    """Settings of the environment in every run, as in `train`: view=fingertips tip_marks=faint."""
    runs: Path | None = None
    """Folder of all run folders and logs, shared by figures on one subject; runs/ol_aux or runs/indicator if not given."""
    minutes: float | None = None
    """Time limit in minutes: runs are saved, finished ones are drawn, and the next start resumes."""
    per_device: int = 1
    """Parallel runs per device: while one is compiled, another one computes."""
    draw_only: bool = False
    """Train nothing: draw existing runs, including those with other settings, such as an earlier version's, which the table
    notes."""


def run(options: Figure) -> int:
    """Draws one figure; returns `UNFINISHED` if a run of it is not finished."""
    if options.figure in CHAPTER_3:
        return _draw_chapter_3(options)
    if options.figure != "4.6":
        _refuse_options(options, ("evaluation",), "figures 3.4, 3.5, 4.6 and table3.1")
    _refuse_options(options, ("plots",), "figures 3.4, 3.5 and table3.1")
    if options.figure != "4.5":
        _refuse_options(options, ("video",), "figure 4.5")
    if options.figure not in ("4.5", "4.6"):
        _refuse_options(options, ("wind",), "figures 4.5 and 4.6")
    is_quadratic = options.figure == "quadratic"
    is_drawn_here = options.figure in _DRAWN_HERE
    out = options.out or Path("quadratic.png" if is_quadratic else f"figure_{options.figure}.png")
    if out.suffix.lower() not in SUFFIXES:
        raise RequestError(f"--out {out}: a figure is a file that ends in {', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]}")
    if is_drawn_here:
        _refuse_options_of_runs(options, _DRAWN_HERE[options.figure])
    for file in (out,) if is_drawn_here else (out, out.with_suffix(".md"), out.with_suffix(".csv")):
        check_writable(file, "--out")
    if is_quadratic:
        from jaxrl_vis.studies import quadratic

        check_devices()
        quadratic.draw(out)
        print(out)
        return 0
    if options.figure in grasp_figure.NAMES:
        return grasp_figure.make_figure(options.figure, out, options)
    # Nothing below initialises JAX in this process: the accelerator's memory is for the runs.
    from jaxrl_vis.studies import figures

    return 0 if figures.make_figure(_request(options, out)) else UNFINISHED


def _draw_chapter_3(options: Figure) -> int:
    is_table = options.figure == "table3.1"
    suffixes = (".md",) if is_table else SUFFIXES
    out = options.out or Path("table_3.1.md" if is_table else f"figure_{options.figure}.png")
    if out.suffix.lower() not in suffixes:
        raise RequestError(f"--out {out}: {options.figure} is a file that ends in {' or '.join(suffixes)}")
    _refuse_options_of_runs(options, ("figure", "out", "evaluation", "plots", "quick"))
    if options.evaluation is not None and (options.plots is not None or options.quick):
        raise RequestError("--evaluation has results of evaluated plots: leave out --plots and --quick")
    check_counts(plots=options.plots)
    for file in (out, out.with_suffix(".md"), out.with_suffix(".csv")):
        check_writable(file, "--out")
    return make_figure(options.figure, out, options.evaluation, options.plots, options.quick)


def _refuse_options_of_runs(options: Figure, known: Sequence[str]) -> None:
    others = [field.name for field in dataclasses.fields(options) if field.name not in known]
    _refuse_options(options, others, f"figures of training runs, not with {options.figure}")


def _refuse_options(options: Figure, names: Sequence[str], where: str) -> None:
    defaults = {field.name: field.default for field in dataclasses.fields(options)}
    for name in names:
        if getattr(options, name) != defaults[name]:
            raise RequestError(f"--{name.replace('_', '-')} goes with {where}")


def _request(options: Figure, out: Path) -> "Request":
    """Makes the request for a figure from the options.

    Raises:
        RequestError: An option is invalid.
    """
    from jaxrl_vis.studies.figures import STUDIES
    from jaxrl_vis.studies.ol_aux import FETCH, WEIGHTS, check_weights
    from jaxrl_vis.studies.show import Request
    from jaxrl_vis.studies.study import Scope

    study = STUDIES[options.figure]
    if options.quick and options.preset is not None:
        raise RequestError("--quick has the preset cpu: give --quick or --preset")
    name = "cpu" if options.quick else options.preset or study.family.preset
    if name not in PRESETS:
        raise RequestError(f"unknown preset {name!r}{nearest(name, list(PRESETS))}")
    check_counts(
        seeds=options.seeds, seeds_per_run=options.seeds_per_run, env_steps=options.env_steps, per_device=options.per_device
    )
    if options.minutes is not None and options.minutes <= 0:
        raise RequestError(f"--minutes must be positive, not {options.minutes:g}")
    if options.draw_only and options.minutes is not None:
        raise RequestError("--draw-only trains nothing: leave out --minutes")
    if options.figure == WEIGHTS:
        check_weights(tuple(dict.fromkeys(options.methods)))
    runs = options.runs or Path("runs") / study.family.name
    if not options.draw_only:
        check_writable(runs, "--runs", folder=True)
    elif not runs.is_dir():
        raise RequestError(f"--runs {runs} is no folder, and --draw-only draws trained runs: name their folder")
    quick = dict(study.family.quick) if options.quick else {}
    if options.env_steps is not None:
        quick.pop("env_steps", None)
    scope = Scope(
        preset=name,
        seed=options.seed or 0,
        seeds=options.seeds or (1 if options.quick else 5),
        seeds_per_run=options.seeds_per_run,
        env_steps=options.env_steps,
        changes=quick | ({"env_options": options.env_options} if options.env_options else {}),
    )
    return Request(
        figure=options.figure,
        study=study,
        out=out,
        runs=runs,
        tasks=tuple(dict.fromkeys(options.tasks)) or ((FETCH,) if options.quick else ()),
        variants=tuple(dict.fromkeys(options.methods)),
        scope=scope,
        draw_only=options.draw_only,
        seconds=None if options.minutes is None else 60.0 * options.minutes,
        per_device=options.per_device,
    )
