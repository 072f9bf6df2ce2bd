"""``jaxrl-vis phenotype run``."""

import dataclasses
import functools
import hashlib
import sys
from pathlib import Path
from typing import Annotated, Literal, Protocol

from jaxrl_vis.cli.checks import check_counts, check_extra
from jaxrl_vis.cli.parsing import AlsoPositional
from jaxrl_vis.cli.progress import progress
from jaxrl_vis.devices import check_devices, enable_compilation_cache
from jaxrl_vis.errors import RequestError, StorageError
from jaxrl_vis.evaluation_pool import share_accelerator
from jaxrl_vis.report.outputs import check_writable

SKIPPED = 3
"""Exit status where files were skipped."""


@dataclasses.dataclass(frozen=True)
class Run:
    """Count and measure the stalks in folders of stereo pairs: tables per stalk and per plot, and an overlay per image."""

    folder: Annotated[Path | None, AlsoPositional()] = None
    """A plot's folder of pairs (left_000.png, right_000.png, ...), or a folder of such folders; the short synthetic row that
    comes with the package if not given."""
    out: Path = Path("phenotype_results")
    """Folder for the results; a command that was stopped goes on where it was."""
    calibration: Path | None = None
    """Calibration of all plots (OpenCV, or ROS left.yaml and right.yaml); if not given, calibration.yaml of each plot's folder.
    Without one there are no millimetres."""
    calibration_unit: Literal["m", "mm"] | None = None
    """Unit of the calibration's baseline, where the file does not say it."""
    weights: Path | None = None
    """Weights from `phenotype train`; those that are shipped if not given."""
    masks: Literal["network", "truth"] = "network"
    """What finds stalks: the networks, or the truth of synthetic plots, to see what the rest makes of it."""
    method: Literal["strip", "ellipse"] = "strip"
    """How widths are taken: between two edges, or by ellipses as in the thesis."""
    least_score: float = 0.5
    """What the networks are less sure of is no stalk, 0 to 1."""
    speed: float | None = None
    """Speed of the robot in m/s, for an odometry.csv that holds times only."""
    disparity_scale: float = 256.0
    """What disparities in files of 16 bits (disparity_000.png beside the images) are divided by to be pixels: 256 as KITTI
    writes them, 64 as `phenotype synth` does."""
    workers: int = 1
    """How many processes look at pairs side by side; they share the GPUs and cores that there are. 1 to 2 GB each."""


def run(options: Run) -> int:
    """Writes tables and overlays."""
    if not 0.0 <= options.least_score <= 1.0:
        raise RequestError(f"--least-score must be from 0 to 1, not {options.least_score:g}")
    if options.speed is not None and not options.speed > 0:
        raise RequestError(f"--speed must be more than 0, not {options.speed:g}")
    if not options.disparity_scale > 0:
        raise RequestError(f"--disparity-scale must be more than 0, not {options.disparity_scale:g}")
    if options.masks == "truth" and options.weights is not None:
        raise RequestError("--masks truth uses no weights: leave out --weights")
    check_counts(workers=options.workers)
    check_extra("phenotype", "phenotyping")
    check_writable(options.out, "--out", folder=True)
    from jaxrl_vis.phenotyping.folders import SAMPLE, find_plots

    plots = find_plots(options.folder or SAMPLE)
    if options.folder is None:
        print("no folder given: this is the short synthetic row that comes with jaxrl-vis")
    calibrations = {plot.name: calibration_of(plot.folder, options) for plot in plots}
    if options.workers > 1:
        share_accelerator()
    check_devices()
    enable_compilation_cache()
    from jaxrl_vis.phenotyping.pipeline import Request, run
    from jaxrl_vis.phenotyping.results import NO_GROUND, NO_WIDTHS

    if options.masks == "truth":
        from jaxrl_vis.phenotyping.truth_on_disk import find_truth

        find, name = find_truth, "truth"
    else:
        _, name = networks(options.weights, options.least_score)  # says what is wrong with the weights
        find = functools.partial(_find, weights_of(options.weights)[0], options.least_score)

    request = Request(options.out, options.method, name, calibrations, options.speed, options.disparity_scale)
    for plot in plots:
        if calibrations[plot.name] is None:
            print(f"{plot.name}: no calibration, so no millimetres and no count: name one with --calibration", file=sys.stderr)

    uncounted: dict[str, str] = {}
    try:
        with progress("pairs") as done:
            rows, skipped = run(plots, find, request, done, options.workers, uncounted.__setitem__)
    except OSError as error:
        raise StorageError(
            f"cannot write to {options.out}: {error.strerror or error}; run the command again to go on"
        ) from error
    for name, why in uncounted.items():
        if calibrations[name] is not None:
            print(f"{name}: {why}, so no count", file=sys.stderr)
    for row in rows:
        if row["flag"] == NO_WIDTHS:
            print(
                f"{row['plot']}: no width: none of its {row['stalks']} stalks could be measured, see qc.html", file=sys.stderr
            )
        if row["flag"] == NO_GROUND:
            print(
                f"{row['plot']}: the ground is not seen, so nobody knows at what height the widths were taken", file=sys.stderr
            )
    for row in skipped:
        print(f"skipped {row['plot']}/{row['pair']}: {row['why']}", file=sys.stderr)
    print(f"{options.out}: stalks.csv, plots.csv, qc.html and overlays (plots: {len(plots)}, pairs skipped: {len(skipped)})")
    return SKIPPED if skipped else 0


def _find(weights: Path, least_score: float, image, plot, pair):
    """Finds the stalks of an image, in any process."""
    return _finder(weights, least_score)(image)


@functools.cache
def _finder(weights: Path, least_score: float):
    return networks(weights, least_score)[0]


def networks(weights: Path | None, least_score: float):
    """What finds stalks in an image, by networks, and its name, which changes with its weights.

    Raises:
        RequestError: The weights cannot be read.
    """
    from jaxrl_vis.phenotyping.detector.finder import Finder
    from jaxrl_vis.phenotyping.detector.weights import read_weights

    path, name = weights_of(weights)
    params, settings, _ = read_weights(path)
    return Finder(params, settings, least_score), f"{name}, least score {least_score:g}"


def weights_of(weights: Path | None) -> tuple[Path, str]:
    """The file of the networks' weights, the shipped one if none is named, and what tells the networks apart.

    Raises:
        RequestError: There is no such file.
    """
    from jaxrl_vis.phenotyping.detector.weights import SHIPPED

    path = SHIPPED if weights is None else weights
    if weights is None and not path.exists():
        raise RequestError(
            "no weights come with this version: make some with `jaxrl-vis phenotype train`, and name them with --weights"
        )
    if not path.is_file():
        raise RequestError(f"cannot read the weights {path}: no such file")
    return path, f"networks {hashlib.sha256(path.read_bytes()).hexdigest()[:12]}"


class CalibrationOptions(Protocol):
    """The options of a command that say what is known of the cameras."""

    @property
    def calibration(self) -> Path | None:
        """File or folder."""
        ...

    @property
    def calibration_unit(self) -> Literal["m", "mm"] | None:
        """Of the baseline."""
        ...


def calibration_of(folder: Path, options: CalibrationOptions):
    """Calibration of one folder of pairs; None where there is none."""
    from jaxrl_vis.phenotyping.calibration import read_calibration

    if options.calibration is not None:
        return read_calibration(options.calibration, options.calibration_unit)
    own = [folder / name for name in ("calibration.yaml", "calibration.yml", "calibration.xml")]
    found = next((path for path in own if path.exists()), None)
    return None if found is None else read_calibration(found, options.calibration_unit)
