"""``jaxrl-vis grasp run``: detect grasp points in recorded stereo pairs."""

import dataclasses
import sys
from pathlib import Path
from typing import Annotated, Literal

from jaxrl_vis.cli.parsing import AlsoPositional
from jaxrl_vis.errors import RequestError, StorageError
from jaxrl_vis.host.devices import check_devices, enable_compilation_cache
from jaxrl_vis.report.outputs import check_writable
from jaxrl_vis.stalks.cli.options import CameraOptions, check_extra, check_masks, check_speed
from jaxrl_vis.stalks.cli.phenotype_run import SKIPPED


@dataclasses.dataclass(frozen=True, kw_only=True)
class Run(CameraOptions):
    """Detect grasp points in folders of stereo pairs: tables of points and of runs, and an overlay per run."""

    folder: Annotated[Path, AlsoPositional()]
    """Folder with the pairs of a run (left_000.png, right_000.png, ...), or a folder of such folders."""
    out: Path = Path("grasp_results")
    """Folder for the results; an interrupted command continues where it stopped."""
    height: float = 1.0
    """Height of the left camera above the ground, m."""
    pitch: float = 15.0
    """Downward pitch of the cameras, degrees."""
    weights: Path | None = None
    """Weights from `grasp train`; the shipped ones if not given."""
    masks: Literal["gan", "segmentation", "truth"] = "segmentation"
    """Source of masks: the shipped segmentation, a GAN that you have trained (--weights), or the truth of synthetic runs."""
    thesis: bool = False
    """Use the thesis's stitching and grasp point detection."""


def run(options: Run) -> int:
    """Process the runs, write tables and overlays, and return the exit status: 3 if pairs were skipped, 0 otherwise.

    Raises:
        RequestError: An option, a folder, a calibration or the weights are invalid, a package is missing, or no device works.
        StorageError: The results cannot be written.
    """
    check_speed(options.speed)
    if not 0.05 <= options.height <= 3.0:
        raise RequestError(f"--height must be from 0.05 to 3 m, not {options.height:g}")
    if not -60.0 <= options.pitch <= 60.0:
        raise RequestError(f"--pitch must be from -60 to 60 degrees, not {options.pitch:g}")
    check_masks(options.masks, options.weights)
    check_extra("grasping")
    check_writable(options.out, "--out", folder=True)

    runs = options.find_plots(options.folder, options.out)
    calibrations = {folder.name: options.read_calibration(folder) for folder in runs}
    for name, calibration in calibrations.items():
        if calibration is None:
            raise RequestError(f"{name} has no calibration, without which there are no metres: name one with --calibration")
    check_devices()
    enable_compilation_cache()
    from jaxrl_vis.stalks.grasping.evaluation.attempts import reachable_from_any_stop
    from jaxrl_vis.stalks.grasping.perception.cloud import Mount
    from jaxrl_vis.stalks.grasping.perception.perceive import DEFAULT_VARIANT, THESIS_VARIANT
    from jaxrl_vis.stalks.grasping.pipeline import Request, run

    if options.masks == "truth":
        from jaxrl_vis.stalks.grasping.evaluation.truth_on_disk import find_truth as find

        name = "truth"
    else:
        from jaxrl_vis.stalks.grasping.masks.loading import load_painter, resolve_weights

        weights, name = resolve_weights(options.weights, options.masks)
        painter = load_painter(weights)

        def find(image, plot, pair):
            return painter(image)

    known = {name: calibration for name, calibration in calibrations.items() if calibration is not None}
    variant, mount = THESIS_VARIANT if options.thesis else DEFAULT_VARIANT, Mount(options.height, options.pitch)
    request = Request(options.out, variant, name, known, mount, options.speed, reachable_from_any_stop)

    def echo(row) -> None:
        print(f"{row['run']}: {row['grasp_points']} grasp points in {row['pairs']} pairs: {row['flag']}", flush=True)

    try:
        skipped = run(runs, find, request, echo)
    except OSError as error:
        raise StorageError(
            f"cannot write to {options.out}: {error.strerror or error}; run the command again to go on"
        ) from error
    for row in skipped:
        print(f"skipped {row['run']}/{row['pair']}: {row['why']}", file=sys.stderr)
    print(f"{options.out}: points.csv, runs.csv and overlays (runs: {len(runs)}, pairs skipped: {len(skipped)})")
    return SKIPPED if skipped else 0
