"""``jaxrl-vis phenotype eval``: score detections, counts and widths against ground truth."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from jaxrl_vis.cli.checks import check_counts
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.devices import check_devices, enable_compilation_cache
from jaxrl_vis.host.worker_pool import Record, share_accelerator
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
    summary = _evaluate(options, family, weights, name)
    print(f"synthetic plots of family {family.name}, {name}, {options.method}:")
    for metric, value in summary.items():
        print(f"  {metric:24} {value if isinstance(value, int) else f'{value:.4f}'}")
    return 0


def _evaluate(options: Eval, family: "Family", weights: Path | None, name: str) -> dict[str, Any]:
    """Evaluate all plots, print one line per plot, and return their summary."""
    from jaxrl_vis.stalks.phenotyping.evaluation import records

    def started(count: int) -> None:
        if count:
            print(f"evaluated before: {count} of {options.plots} plots, in {options.json}", flush=True)

    def done(record: Record) -> None:
        one = records.summarize(options.min_score, [record])
        print(
            f"plot {record['seed']}: {record['counted']} of {record['true']} stalks, "
            f"width error {one['width_mae_mm']:.2f} mm, F1 {one['f1']:.3f}",
            flush=True,
        )

    task = records.Task(family, weights, name, options.method, options.min_score, options.thesis, options.workers)
    return records.evaluate_plots(task, range(options.seed, options.seed + options.plots), options.json, started, done)
