"""``jaxrl-vis phenotype eval``."""

import dataclasses
import functools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from jaxrl_vis.cli.checks import check_counts, check_extra
from jaxrl_vis.cli.families import family_of
from jaxrl_vis.cli.phenotype_run import networks, weights_of
from jaxrl_vis.devices import check_devices, enable_compilation_cache
from jaxrl_vis.errors import RequestError
from jaxrl_vis.evaluation_pool import Record, RecordFile, evaluate_all, finite, share_accelerator
from jaxrl_vis.report.outputs import check_writable

if TYPE_CHECKING:
    from jaxrl_vis.phenotyping.evaluation import Task
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
    if options.masks == "truth" and options.weights is not None:
        raise RequestError("--masks truth uses no weights: leave out --weights")
    check_extra("phenotype", "phenotyping")
    if options.json is not None:
        check_writable(options.json, "--json")
    if options.each_factor and (options.family or options.shift or options.spec):
        raise RequestError("--each-factor goes through the families by itself: leave out --family, --shift and --spec")
    family = family_of(options, "phenotyping", "shifted")
    if options.workers > 1:
        share_accelerator()
    check_devices()
    enable_compilation_cache()
    weights, name = None, "truth"
    if options.masks == "network":
        networks(options.weights, options.least_score)  # says what is wrong with the weights
        weights, name = weights_of(options.weights)
    from jaxrl_vis.phenotyping.evaluation import Task

    families = _factors(options) if options.each_factor else {"": family}
    tasks = {
        factor: Task(each, weights, options.method, options.least_score, options.thesis, options.workers)
        for factor, each in families.items()
    }
    figures = _evaluate(options, tasks, name)
    if options.each_factor:
        _write_table(options, name, figures)
        return 0
    print(f"synthetic plots of family {family.name}, {name}, {options.method}:")
    for each, value in figures[""].items():
        print(f"  {each:24} {value if isinstance(value, int) else f'{value:.4f}'}")
    return 0


def _factors(options: Eval) -> "dict[str, Family]":
    """The training family, each factor shifted alone, and all of them, by name."""
    from jaxrl_vis_envs.plants import SHIFTS

    alone = {factor: dataclasses.replace(options, family="training", shift=(factor,)) for factor in SHIFTS}
    none, all_of_them = (dataclasses.replace(options, family=name) for name in ("training", "shifted"))
    return {factor: family_of(drawn, "phenotyping") for factor, drawn in {"none": none, **alone, "all": all_of_them}.items()}


def _evaluate(options: Eval, tasks: "Mapping[str, Task]", name: str) -> dict[str, dict[str, Any]]:
    """Figures of all plots of each task together; says something of each plot, and keeps the files."""
    from jaxrl_vis.phenotyping import evaluation

    summary_of = functools.partial(evaluation.summary_of, options.least_score)
    wanted = range(options.seed, options.seed + options.plots)
    kept = {
        factor: RecordFile(_path(options.json, factor), {**evaluation.conditions(task), "finder": name}, summary_of)
        for factor, task in tasks.items()
    }
    there = sum(seed in each for each in kept.values() for seed in wanted)
    if there:
        print(f"evaluated before: {there} of {len(tasks) * len(wanted)} plots, in {options.json}", flush=True)
    factors = list(tasks)
    jobs = [(place, seed) for place, factor in enumerate(factors) for seed in wanted if seed not in kept[factor]]

    def done(number: int, record: Record) -> None:
        place, seed = jobs[number]
        kept[factors[place]].add(seed, record)
        one = summary_of([kept[factors[place]].records[seed]])
        print(
            f"{factors[place]} plot {seed}: {record['counted']} of {record['true']} stalks, ".lstrip()
            + f"width error {one['width_mae_mm']:.2f} mm, F1 {one['f1']:.3f}",
            flush=True,
        )

    evaluate_all(
        functools.partial(evaluation.evaluate_job, list(tasks.values()), jobs), range(len(jobs)), options.workers, done
    )
    return {factor: summary_of([each.records[seed] for seed in wanted]) for factor, each in kept.items()}


def _path(path: Path | None, factor: str) -> Path | None:
    """The file of one factor: beside that of the table."""
    return path.with_name(f"{path.stem}-{factor}.json") if path and factor else path


_COLUMNS = ("count_r2", "count_mae", "count_bias", "width_mae_mm", "width_bias_mm", "ap50", "f1")


def _write_table(options: Eval, name: str, figures: Mapping[str, dict[str, Any]]) -> None:
    """Prints a line of Markdown for each factor that is shifted alone, and writes the file."""
    from jaxrl_vis.files import write_atomically

    if options.json is not None:
        about = {"synthetic": True, "finder": name, "method": options.method, "factors": finite(figures)}
        write_atomically(options.json, json.dumps(about, indent=2) + "\n")
    print(f"\nsynthetic plots, {options.plots} each, {name}, {options.method}\n")
    print("| shifted | " + " | ".join(_COLUMNS) + " |")
    print("|---|" + "---|" * len(_COLUMNS))
    for factor, values in figures.items():
        print(f"| {factor} | " + " | ".join(f"{values[column]:.3f}" for column in _COLUMNS) + " |")
