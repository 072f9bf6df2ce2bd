"""``jaxrl-vis phenotype run``: count and measure stalks in recorded stereo pairs."""

import dataclasses
import functools
import sys
from pathlib import Path
from typing import Annotated, Any, Literal

from jaxrl_vis.cli.checks import check_counts
from jaxrl_vis.cli.parsing import AlsoPositional
from jaxrl_vis.errors import RequestError, StorageError
from jaxrl_vis.host.devices import check_devices, enable_compilation_cache
from jaxrl_vis.host.worker_pool import share_accelerator
from jaxrl_vis.report.outputs import check_writable
from jaxrl_vis.stalks.cli.options import CameraOptions, check_extra, check_masks, check_speed
from jaxrl_vis.stalks.cli.progress import progress

SKIPPED = 3
"""Exit status if files were skipped."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Run(CameraOptions):
    """Count and measure the stalks in folders of stereo pairs: tables per stalk and per plot, and an overlay per pair."""

    folder: Annotated[Path | None, AlsoPositional()] = None
    """Folder with the pairs of a plot (left_000.png, right_000.png, ...), a folder of such folders, or a ROS recording (.bag,
    .mcap, .db3; needs the extra `bags`); a short synthetic row that ships with the package if not given."""
    out: Path = Path("phenotype_results")
    """Folder for the results; an interrupted command continues where it stopped."""
    weights: Path | None = None
    """Weights from `phenotype train`; the shipped ones if not given."""
    masks: Literal["network", "truth"] = "network"
    """Source of masks: the networks, or the ground truth of synthetic plots, to evaluate everything downstream of the masks."""
    method: Literal["strip", "ellipse"] = "strip"
    """Method of measuring widths: between two edges (strip), or by ellipses as in the thesis."""
    min_score: float = 0.4
    """Minimum score of a detection that counts as a stalk, 0 to 1; without effect with --masks truth."""
    disparity_scale: float = 256.0
    """Scale of 16-bit disparity files (disparity_000.png beside the images): their values divided by it are pixels. 256 for
    KITTI, 64 for `phenotype synth`."""
    field: Path | None = None
    """Field plan: a CSV or an export of Field Book, whose rows are matched to folders by column plot_id (or plot, or range and
    row). Its other columns (range, genotype, replicate, ...) are joined to the results in --format."""
    format: Literal["plain", "brapi", "miappe", "plantcv"] = "plain"
    """Format of the plots' results that are written beside plots.csv, with units and ontology terms: traits.csv (plain), BrAPI,
    MIAPPE or PlantCV."""
    term: tuple[str, ...] = ()
    """Ontology terms of columns of plots.csv, such as `stalks=CO_324:0000001`, instead of the built-in ones."""
    workers: int = 1
    """Number of processes that handle pairs in parallel; they share the GPUs and cores, and take 1 to 2 GB of memory each."""


def run(options: Run) -> int:
    """Process the plots, write tables, the page and overlays, and return the exit status: 3 if pairs were skipped, else 0.

    Raises:
        RequestError: An option, a folder, a calibration, the field plan or the weights are invalid, a package is missing, or no
            device works.
        StorageError: The results cannot be written.
    """
    if not 0.0 <= options.min_score <= 1.0:
        raise RequestError(f"--min-score must be from 0 to 1, not {options.min_score:g}")
    check_speed(options.speed)
    if not options.disparity_scale > 0:
        raise RequestError(f"--disparity-scale must be more than 0, not {options.disparity_scale:g}")
    check_masks(options.masks, options.weights)
    check_counts(workers=options.workers)
    check_extra("phenotyping")
    check_writable(options.out, "--out", folder=True)
    from jaxrl_vis.stalks.phenotyping.io.folders import SAMPLE
    from jaxrl_vis.stalks.phenotyping.io.tables.field_plan import missing_plots_message, read_field_plan
    from jaxrl_vis.stalks.phenotyping.report.exchange import replace_terms, write_exchange

    traits = replace_terms(options.term)
    plots = options.find_plots(options.folder or SAMPLE, options.out)
    if options.folder is None:
        print("no folder given: this is the short synthetic row that comes with jaxrl-vis")
    calibrations = {plot.name: options.read_calibration(plot) for plot in plots}
    columns, plan = ([], {}) if options.field is None else read_field_plan(options.field, [plot.name for plot in plots])
    message = None if options.field is None else missing_plots_message(plan, [plot.name for plot in plots])
    if message is not None:
        print(f"{options.field}: {message}", file=sys.stderr)
    if options.workers > 1:
        share_accelerator()
    check_devices()
    enable_compilation_cache()
    from jaxrl_vis.stalks.phenotyping.measure.lens import VALIDATED
    from jaxrl_vis.stalks.phenotyping.pipeline import Request, run

    if options.masks == "truth":
        from jaxrl_vis.stalks.phenotyping.evaluation.truth_on_disk import find_truth

        find, name = find_truth, "truth"
    else:
        from jaxrl_vis.stalks.phenotyping.detector.loading import detector_name, find_stalks, load_finder, resolve_weights

        weights = resolve_weights(options.weights)
        name = f"{detector_name(weights)}, least score {options.min_score:g}"
        if load_finder(weights, options.min_score).gate is None:  # reports what is wrong with the weights
            print(
                "these weights have no gate: nothing tells whether your images are like those that they know", file=sys.stderr
            )
        find = functools.partial(find_stalks, weights, options.min_score)

    tried = VALIDATED if options.masks == "network" else None
    request = Request(options.out, options.method, name, calibrations, options.speed, options.disparity_scale, tried)
    for plot in plots:
        if calibrations[plot.name] is None:
            print(f"{plot.name}: no calibration, so no millimetres and no count: name one with --calibration", file=sys.stderr)

    uncounted: dict[str, str] = {}
    try:
        with progress("pairs") as done:
            rows, skipped = run(plots, find, request, done, options.workers, uncounted.__setitem__)
        written = write_exchange(options.out, options.format, rows, columns, plan, traits)
    except OSError as error:
        raise StorageError(
            f"cannot write to {options.out}: {error.strerror or error}; run the command again to go on"
        ) from error
    for name, why in uncounted.items():
        if calibrations[name] is not None:
            print(f"{name}: {why}, so no count", file=sys.stderr)
    _warn_of_flags(rows)
    for row in skipped:
        print(f"skipped {row['plot']}/{row['pair']}: {row['why']}", file=sys.stderr)
    counts = f"plots: {len(plots)}, pairs skipped: {len(skipped)}"
    print(f"{options.out}: stalks.csv, plots.csv, {written}, qc.html and overlays ({counts})")
    return SKIPPED if skipped else 0


def _warn_of_flags(rows: list[dict[str, Any]]) -> None:
    """Print a line for each flag of each row of plots.csv, with a hint."""
    from jaxrl_vis.stalks.phenotyping.report.tables import FEW_FRAMES, NO_GROUND, NO_WIDTHS, UNFAMILIAR

    hints = {
        NO_WIDTHS: "no width: none of its {stalks} stalks could be measured, see qc.html",
        NO_GROUND: "the ground is not seen, so nobody knows at what height the widths were taken",
        UNFAMILIAR: "its images are unlike those that the networks read rightly: look at its overlays before you trust "
        "a number",
        FEW_FRAMES: "most widths were measured in fewer than three pairs: take more of them",
    }
    for row in rows:
        for flag, hint in hints.items():
            if flag in row["flag"]:
                print(f"{row['plot']}: {hint.format(stalks=row['stalks'])}", file=sys.stderr)
