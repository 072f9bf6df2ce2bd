"""Command ``jaxrl-vis figure``: train the runs of a figure of the thesis, and draw it."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from jaxrl_vis.cli.checks import check_counts
from jaxrl_vis.config import PRESETS
from jaxrl_vis.errors import RequestError, nearest
from jaxrl_vis.host.devices import check_devices
from jaxrl_vis.report.outputs import check_figure, check_writable

if TYPE_CHECKING:
    from jaxrl_vis.studies.figures.show import Request

FigureName = Literal[
    "5.1", "5.2", "estimators", "cameras", "goals", "5.4", "5.5", "5.6", "5.7", "weightings", "quadratic", "pareto"
]
UNFINISHED = 3
"""Exit status of an incomplete figure."""


@dataclasses.dataclass(frozen=True)
class Figure:
    """Draw a figure: train or compute its content, and write it to a file, with tables beside it.

    5.1, 5.2: rewards with and without ground truth. estimators: rewards from imperfect state estimators. cameras: noisy and
    randomized images. goals: comparison of all kinds of rewards, TD3 and contrastive RL. 5.4: auxiliary losses and their
    weightings. 5.5: single auxiliary tasks. 5.6: their weights over training. 5.7: effect of looking ahead in OL-AUX-5.
    weightings: all weightings of five auxiliary losses. These train missing runs, one process per GPU, and resume unfinished
    ones, so they may be interrupted and started again at any time; the exit status is 3 if something is still missing.

    quadratic: adaptive weights of auxiliary losses on three losses of a point in the plane. pareto: paths to the Pareto front
    of two losses, by twelve weightings. These train nothing, and --out is their only option. Figures of stalks:
    `phenotype figure`, `grasp figure`.
    """

    figure: Annotated[FigureName, tyro.conf.Positional]
    """Name of the figure."""
    out: Path | None = None
    """A .png, .pdf or .svg file; figure_FIGURE.png (or quadratic.png, pareto.png) in the current folder if not given. Tables of
    training runs are written beside it, as .md and .csv."""
    preset: str | None = None
    """Preset of all runs; paper for figures 5.4 to 5.7 and fast for the others if not given. Not with --quick."""
    quick: bool = False
    """For a CPU: preset cpu, one seed, VisualFetchReach. 5.4 to 5.7 take only a few steps, as a demonstration without
    learning."""
    tasks: tuple[str, ...] = ()
    """Only these environments; all of the figure's, or VisualFetchReach with --quick, if not given."""
    methods: tuple[str, ...] = ()
    """Methods to be compared instead of the figure's own, such as none sum fixed_0.1 ol_aux_5."""
    seed: int | None = None
    """First seed; 0 if not given."""
    seeds: int | None = None
    """Number of seeds; 5, or 1 with --quick, if not given."""
    seeds_per_run: int | None = None
    """Maximum number of seeds per program, to save memory; all of them if not given."""
    env_steps: int | None = None
    """Environment steps of every run; the figure's own budgets if not given."""
    env_options: tuple[str, ...] = ()
    """Settings of the environment in every run, as in `train`: view=fingertips tip_marks=faint."""
    runs: Path | None = None
    """Folder of all run folders and logs, shared by figures on one subject; runs/ol_aux, runs/indicator, runs/goals or
    runs/weightings if not given."""
    minutes: float | None = None
    """Time limit in minutes: runs are saved, finished ones are drawn, and the next start resumes."""
    per_device: int = 1
    """Parallel runs per device, so that one can compute while another compiles."""
    draw_only: bool = False
    """Train nothing: draw existing runs, including those with other settings (such as an earlier version's), which are noted in
    the table."""


def run(options: Figure) -> int:
    """Draw one figure; return `UNFINISHED` if one of its runs is not finished."""
    if options.figure in ("quadratic", "pareto"):
        return _draw_example(options)
    out = options.out or Path(f"figure_{options.figure}.png")
    check_figure(out)
    for file in (out.with_suffix(".md"), out.with_suffix(".csv")):
        check_writable(file, "--out")
    # Nothing below initialises JAX in this process: the accelerator's memory is for the runs.
    from jaxrl_vis.studies.figures import make

    return 0 if make.make_figure(_request(options, out)) else UNFINISHED


def _draw_example(options: Figure) -> int:
    """Draw an example figure with a few losses in the plane."""
    for field in dataclasses.fields(options):
        if field.name not in ("figure", "out") and getattr(options, field.name) != field.default:
            raise RequestError(
                f"--{field.name.replace('_', '-')} goes with figures of training runs, not with {options.figure}"
            )
    out = options.out or Path(f"{options.figure}.png")
    check_figure(out)
    from jaxrl_vis.studies import pareto, quadratic

    check_devices()
    {"quadratic": quadratic, "pareto": pareto}[options.figure].draw(out)
    print(out)
    return 0


def _request(options: Figure, out: Path) -> "Request":
    """Build the request for a figure from the options.

    Raises:
        RequestError: An option is invalid.
    """
    from jaxrl_vis.studies.engine.study import Scope
    from jaxrl_vis.studies.figures.make import STUDIES
    from jaxrl_vis.studies.figures.show import Request
    from jaxrl_vis.studies.ol_aux import FETCH, WEIGHTS, check_weights

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
        raise RequestError(f"--runs {runs} is not a folder, and --draw-only draws trained runs: name their folder")
    quick = dict(study.family.quick_changes) if options.quick else {}
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
