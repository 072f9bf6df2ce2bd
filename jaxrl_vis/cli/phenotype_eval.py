"""``jaxrl-vis phenotype eval``."""

import dataclasses
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from jaxrl_vis.cli.checks import check_counts, check_extra
from jaxrl_vis.cli.families import family_of
from jaxrl_vis.cli.phenotype_run import networks, weights_of
from jaxrl_vis.devices import check_devices
from jaxrl_vis.errors import RequestError
from jaxrl_vis.report.outputs import check_writable

if TYPE_CHECKING:
    from jaxrl_vis.phenotyping.evaluation import Scorers
    from jaxrl_vis_envs.plants import Family


@dataclasses.dataclass(frozen=True)
class Eval:
    """Compare finds, counts and widths with the exact truth of synthetic plots, which are drawn for it."""

    weights: Path | None = None
    """Weights from `phenotype train`; those that are shipped if not given."""
    masks: Literal["network", "truth"] = "network"
    """What finds stalks: the networks, or the truth, to see what the rest makes of it."""
    family: Literal["training", "shifted"] | None = None
    """What plots are drawn from; shifted, if no --spec says otherwise."""
    shift: tuple[str, ...] = ()
    """Shift only these factors of the family: flash, lean, rig, noise, leaves, textures."""
    spec: Path | None = None
    """A JSON or TOML file with the values of a family of your own."""
    plots: int = 10
    """How many plots."""
    seed: int = 0
    """Seed of the first plot; the others have the numbers that follow."""
    frames: int | None = None
    """Pairs of a plot, in place of the family's 34."""
    width: int | None = None
    """Width of an image in pixels, in place of the family's 3376."""
    method: Literal["strip", "ellipse"] = "strip"
    """How widths are taken."""
    least_score: float = 0.5
    """What the networks are less sure of is no stalk, 0 to 1."""
    thesis: bool = False
    """Also what the thesis's ways (ellipses, semi-global matching, stalks per metre of image) make of the same finds."""
    each_factor: bool = False
    """A table: the training family, each factor of the world shifted alone, and all of them; --plots of each."""
    workers: int = 1
    """How many processes score plots, each a plot of its own; they share the GPUs that there are. About one for each core, if
    there is memory: 2 GB each. Figures do not depend on it, times do."""
    json: Path | None = None
    """A file for the figures of all plots together and of each; written after each plot. Plots that it holds already, of the
    same conditions, are not scored again. With --each-factor, the table; the files of the factors go beside it."""


def evaluate(options: Eval) -> int:
    """Prints the figures."""
    check_counts(plots=options.plots, frames=options.frames, width=options.width, workers=options.workers)
    if options.seed < 0:
        raise RequestError(f"--seed must be at least 0, not {options.seed}")
    if not 0.0 <= options.least_score <= 1.0:
        raise RequestError(f"--least-score must be from 0 to 1, not {options.least_score:g}")
    check_extra("phenotype", "phenotyping")
    if options.json is not None:
        check_writable(options.json, "--json")
    if options.each_factor and (options.family or options.shift or options.spec):
        raise RequestError("--each-factor goes through the families by itself: leave out --family, --shift and --spec")
    family = family_of(options, "phenotyping", "shifted")
    from jaxrl_vis.phenotyping.evaluation import Scorers, share_devices

    if options.workers > 1:
        share_devices()
    check_devices()
    weights, name = None, "truth"
    if options.masks == "network":
        networks(options.weights, options.least_score)  # says what is wrong with the weights
        weights, name = weights_of(options.weights)
    with Scorers(options.workers) as scorers:
        if options.each_factor:
            return _factor_table(options, weights, name, scorers)
        figures = _score(options, family, weights, name, scorers, options.json)
    print(f"synthetic plots of family {family.name}, {name}, {options.method}:")
    for each, value in figures.items():
        print(f"  {each:24} {value if isinstance(value, int) else f'{value:.4f}'}")
    return 0


_COLUMNS = ("count_r2", "count_mae", "count_bias", "width_mae_mm", "width_bias_mm", "ap50", "f1")


def _factor_table(options: Eval, weights: Path | None, name: str, scorers: "Scorers") -> int:
    """Prints a line of Markdown for each factor that is shifted alone."""
    from jaxrl_vis.files import write_atomically
    from jaxrl_vis_envs.plants import SHIFTS

    alone = [(factor, dataclasses.replace(options, family="training", shift=(factor,))) for factor in SHIFTS]
    none, all_of_them = (dataclasses.replace(options, family=name) for name in ("training", "shifted"))
    lines, table = [], {}
    for factor, drawn in [("none", none), *alone, ("all", all_of_them)]:
        path = options.json and options.json.with_name(f"{options.json.stem}-{factor}.json")
        figures = _score(options, family_of(drawn, "phenotyping"), weights, name, scorers, path)
        lines.append(f"| {factor} | " + " | ".join(f"{figures[column]:.3f}" for column in _COLUMNS) + " |")
        table[factor] = {column: value if math.isfinite(value) else None for column, value in figures.items()}
        if options.json is not None:
            about = {"synthetic": True, "finder": name, "method": options.method, "factors": table}
            write_atomically(options.json, json.dumps(about, indent=2) + "\n")
    print(f"\nsynthetic plots, {options.plots} each, {name}, {options.method}\n")
    print("| shifted | " + " | ".join(_COLUMNS) + " |")
    print("|---|" + "---|" * len(_COLUMNS))
    print("\n".join(lines))
    return 0


def _score(
    options: Eval, family: "Family", weights: Path | None, name: str, scorers: "Scorers", path: Path | None
) -> dict[str, Any]:
    """Figures of all plots of a family together; says something of each plot, and keeps the file at ``path``."""
    from jaxrl_vis import __version__
    from jaxrl_vis.phenotyping.evaluate import summary
    from jaxrl_vis.phenotyping.evaluation import Task, conditions, read_scores, write_evaluation
    from jaxrl_vis.provenance import device_name, revision

    task = Task(family, weights, options.method, options.least_score, options.thesis)
    same = conditions(task)
    about = {
        "device": device_name(),
        "workers": options.workers,
        "version": __version__,
        "revision": revision(),
        "finder": name,
        "method": options.method,
    }
    scores = [] if path is None else read_scores(path, same)
    wanted = range(options.seed, options.seed + options.plots)
    there = {each.seed for each in scores}
    if there:
        print(f"{path}: {len(there)} plots are there already", flush=True)
    for score in scorers.scores(task, [seed for seed in wanted if seed not in there]):
        scores = sorted([*scores, score], key=lambda each: each.seed)
        one = summary([score], options.least_score)
        print(
            f"plot {score.seed}: {score.counted} of {score.true} stalks, "
            f"width error {one['width_mae_mm']:.2f} mm, F1 {one['f1']:.3f}",
            flush=True,
        )
        if path is not None:
            write_evaluation(path, about, same, scores, task)
    return summary(scores, options.least_score)
