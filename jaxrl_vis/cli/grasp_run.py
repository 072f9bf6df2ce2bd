"""``jaxrl-vis grasp run``."""

import dataclasses
import sys
from pathlib import Path
from typing import Annotated, Literal

from jaxrl_vis.cli.checks import check_extra
from jaxrl_vis.cli.grasp import painter_of
from jaxrl_vis.cli.parsing import AlsoPositional
from jaxrl_vis.cli.phenotype_run import SKIPPED, calibration_of
from jaxrl_vis.devices import check_devices, enable_compilation_cache
from jaxrl_vis.errors import RequestError, StorageError
from jaxrl_vis.report.outputs import check_writable


@dataclasses.dataclass(frozen=True)
class Run:
    """Find grasp points in folders of stereo pairs: a table of points and of runs, and an overlay per run."""

    folder: Annotated[Path, AlsoPositional()]
    """A run's folder of pairs (left_000.png, right_000.png, ...), or a folder of such folders."""
    out: Path = Path("grasp_results")
    """Folder for the results; a command that was stopped goes on where it was."""
    calibration: Path | None = None
    """Calibration of all runs (OpenCV, or ROS left.yaml and right.yaml); calibration.yaml of each run's folder if not given."""
    calibration_unit: Literal["m", "mm"] | None = None
    """Unit of the calibration's baseline, where the file does not say it."""
    height: float = 1.0
    """Height of the left camera above the ground, m."""
    pitch: float = 15.0
    """By how much the cameras look down, degrees."""
    weights: Path | None = None
    """Weights from `grasp train`; those that are shipped if not given."""
    masks: Literal["gan", "segmentation", "truth"] = "segmentation"
    """What finds the pixels of stalks: one of the networks that are shipped, or the truth of synthetic runs."""
    thesis: bool = False
    """Stitch and find grasp points as the thesis describes it."""
    speed: float | None = None
    """Speed of the robot in m/s, for an odometry.csv that holds times only."""


def run(options: Run) -> int:
    """Writes tables and overlays."""
    if options.speed is not None and not options.speed > 0:
        raise RequestError(f"--speed must be more than 0, not {options.speed:g}")
    if not 0.05 <= options.height <= 3.0:
        raise RequestError(f"--height must be from 0.05 to 3 m, not {options.height:g}")
    if not -60.0 <= options.pitch <= 60.0:
        raise RequestError(f"--pitch must be from -60 to 60 degrees, not {options.pitch:g}")
    if options.masks == "truth" and options.weights is not None:
        raise RequestError("--masks truth uses no weights: leave out --weights")
    check_extra("grasp", "grasping")
    check_writable(options.out, "--out", folder=True)
    from jaxrl_vis.phenotyping.folders import find_plots

    runs = find_plots(options.folder)
    calibrations = {each.name: calibration_of(each.folder, options) for each in runs}
    for name, each in calibrations.items():
        if each is None:
            raise RequestError(f"{name} has no calibration, without which there are no metres: name one with --calibration")
    check_devices()
    enable_compilation_cache()
    from jaxrl_vis.grasping.attempts import from_any_stop
    from jaxrl_vis.grasping.cloud import Mount
    from jaxrl_vis.grasping.perceive import ORIGINAL, OURS
    from jaxrl_vis.grasping.pipeline import Request, run

    if options.masks == "truth":
        find, name = _truth, "truth"
    else:
        painter, name = painter_of(options.weights, options.masks)

        def find(image, folder, pair):
            return painter(image)

    known = {name: each for name, each in calibrations.items() if each is not None}
    ways, mount = ORIGINAL if options.thesis else OURS, Mount(options.height, options.pitch)
    request = Request(options.out, ways, name, known, mount, options.speed, from_any_stop)

    def say(row) -> None:
        print(f"{row['run']}: {row['grasp_points']} grasp points in {row['pairs']} pairs: {row['flag']}", flush=True)

    try:
        skipped = run(runs, find, request, say)
    except OSError as error:
        raise StorageError(
            f"cannot write to {options.out}: {error.strerror or error}; run the command again to go on"
        ) from error
    for row in skipped:
        print(f"skipped {row['run']}/{row['pair']}: {row['why']}", file=sys.stderr)
    print(f"{options.out}: points.csv, runs.csv and overlays (runs: {len(runs)}, pairs skipped: {len(skipped)})")
    return SKIPPED if skipped else 0


def _truth(image, folder, pair):
    """The true mask of a pair of a synthetic run.

    Raises:
        RequestError: The run is not synthetic, or was written without masks.
    """
    from jaxrl_vis.grasping.masks.examples import true_mask
    from jaxrl_vis.phenotyping.images import image_size, read_image
    from jaxrl_vis_envs.documents import read_json

    try:
        count = int(read_json(folder.folder / "plot.json")["count"])
        truth = folder.folder / "truth" / f"instance_{pair.name}.png"
        if pair.left is None or image_size(truth) != image_size(pair.left):
            raise ValueError("masks of another image")
        instance = read_image(truth).astype(int) - 1
    except (OSError, ValueError, KeyError, TypeError, OverflowError) as error:
        raise RequestError(
            f"{folder.folder} holds no true masks: write it with `jaxrl-vis grasp synth`, or use --masks segmentation"
        ) from error
    return true_mask(instance, count)
