"""``jaxrl-vis phenotype eval``: score detections, counts and widths against ground truth."""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from jaxrl_vis.cli.checks import check_counts
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.devices import check_devices, enable_compilation_cache
from jaxrl_vis.host.worker_pool import Record, replace_non_finite, share_accelerator
from jaxrl_vis.report.outputs import check_writable
from jaxrl_vis.stalks.cli.options import EvaluationOptions, check_extra, check_masks

if TYPE_CHECKING:
    from jaxrl_vis_envs.plants import Family


@dataclasses.dataclass(frozen=True, kw_only=True)
class Eval(EvaluationOptions):
    """Compare detections, counts and widths with the exact ground truth of synthetic plots, rendered on the fly."""

    masks: Literal["network", "truth"] = "network"
    """Source of masks: the networks, or the ground truth, to evaluate everything downstream of the masks."""
    plots: int = 10
    """Number of plots."""
    method: Literal["strip", "ellipse"] = "strip"
    """Method of measuring widths: between two edges (strip), or by ellipses as in the thesis."""
    min_score: float = 0.4
    """Minimum score of a detection that counts as a stalk, 0 to 1; without effect with --masks truth."""
    thesis: bool = False
    """Also score the thesis's methods (ellipses, semi-global matching, stalks per metre of image) on the same detections."""
    each_factor: bool = False
    """Evaluate the training family, each factor shifted alone, and all factors shifted, on --plots each, and print a table.
    --json is the file of the table; the files of the factors are written beside it."""


def evaluate(options: Eval) -> int:
    """Evaluate the plots, print their scores, and return the exit status.

    Raises:
        RequestError: An option or the file of weights is invalid, a package is missing, or no device works.
    """
    check_counts(plots=options.plots)
    options.check()
    if not 0.0 <= options.min_score <= 1.0:
        raise RequestError(f"--min-score must be from 0 to 1, not {options.min_score:g}")
    check_masks(options.masks, options.weights)
    check_extra("phenotyping")
    if options.json is not None:
        check_writable(options.json, "--json")
    if options.each_factor and (options.family or options.shift or options.spec):
        raise RequestError("--each-factor goes through the families by itself: leave out --family, --shift and --spec")
    family = options.read_family("phenotyping", "shifted")
    if options.workers > 1:
        share_accelerator()
    check_devices()
    enable_compilation_cache()
    weights, name = None, "truth"
    if options.masks == "network":
        from jaxrl_vis.stalks.phenotyping.detector.loading import detector_name, load_finder, resolve_weights

        weights = resolve_weights(options.weights)
        load_finder(weights, options.min_score)  # reports what is wrong with the weights
        name = detector_name(weights)
    summaries = _evaluate(options, _read_factors(options) if options.each_factor else {"": family}, weights, name)
    if options.each_factor:
        _write_table(options, name, summaries)
        return 0
    print(f"synthetic plots of family {family.name}, {name}, {options.method}:")
    for metric, value in summaries[""].items():
        print(f"  {metric:24} {value if isinstance(value, int) else f'{value:.4f}'}")
    return 0


def _read_factors(options: Eval) -> "dict[str, Family]":
    """Return the families of ``--each-factor``: unshifted (``none``), with each factor shifted alone, and with ``all``."""
    from jaxrl_vis_envs.plants import SHIFTS

    alone = {factor: dataclasses.replace(options, family="training", shift=(factor,)) for factor in SHIFTS}
    none, all_of_them = (dataclasses.replace(options, family=name) for name in ("training", "shifted"))
    shifted = {"none": none, **alone, "all": all_of_them}
    return {factor: changed.read_family("phenotyping") for factor, changed in shifted.items()}


def _evaluate(options: Eval, families: "Mapping[str, Family]", weights: Path | None, name: str) -> dict[str, dict[str, Any]]:
    """Evaluate all plots of each family, print one line per plot, and return the summary of each family by its key."""
    from jaxrl_vis.stalks.phenotyping.evaluation import records

    tasks = {
        factor: records.Task(family, weights, name, options.method, options.min_score, options.thesis, options.workers)
        for factor, family in families.items()
    }

    def started(count: int) -> None:
        if count:
            print(f"evaluated before: {count} of {len(tasks) * options.plots} plots, in {options.json}", flush=True)

    def done(factor: str, seed: int, record: Record) -> None:
        one = records.summarize(options.min_score, [record])
        print(
            f"{factor} plot {seed}: {record['counted']} of {record['true']} stalks, ".lstrip()
            + f"width error {one['width_mae_mm']:.2f} mm, F1 {one['f1']:.3f}",
            flush=True,
        )

    seeds = range(options.seed, options.seed + options.plots)
    return records.evaluate_tasks(tasks, seeds, {factor: _factor_file(options.json, factor) for factor in tasks}, started, done)


def _factor_file(path: Path | None, factor: str) -> Path | None:
    """Return the file of one factor, beside the table's ``path``; ``path`` itself if it is None or the factor is ""."""
    return path.with_name(f"{path.stem}-{factor}.json") if path and factor else path


_COLUMNS = ("count_r2", "count_mae", "count_bias", "width_mae_mm", "width_bias_mm", "ap50", "f1")


def _write_table(options: Eval, name: str, summaries: Mapping[str, dict[str, Any]]) -> None:
    """Print a Markdown table with one row per key of ``summaries``, and write all of them to ``--json``, if given."""
    from jaxrl_vis.host.files import write_atomically

    if options.json is not None:
        about = {"synthetic": True, "finder": name, "method": options.method, "factors": replace_non_finite(summaries)}
        write_atomically(options.json, json.dumps(about, indent=2) + "\n")
    print(f"\nsynthetic plots, {options.plots} each, {name}, {options.method}\n")
    print("| shifted | " + " | ".join(_COLUMNS) + " |")
    print("|---|" + "---|" * len(_COLUMNS))
    for factor, values in summaries.items():
        print(f"| {factor} | " + " | ".join(f"{values[column]:.3f}" for column in _COLUMNS) + " |")
