"""Base classes of the options of ``phenotype`` and ``grasp``, and checks of options."""

from __future__ import annotations

import dataclasses
import importlib.util
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from jaxrl_vis.cli.checks import check_counts
from jaxrl_vis.cli.parsing import AlsoPositional
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.provenance import install_command

if TYPE_CHECKING:
    from jaxrl_vis.stalks.phenotyping.io.folders import Patterns, PlotFolder
    from jaxrl_vis_envs.plants import Calibration, Family

# Packages of an extra: module -> package.
_GRASPING = {"cv2": "opencv-python-headless", "scipy": "scipy", "yaml": "pyyaml"}
_EXTRAS = {"phenotyping": {**_GRASPING, "tifffile": "tifffile", "pandas": "pandas"}, "grasping": _GRASPING}
_COMMANDS = {"phenotyping": "phenotype", "grasping": "grasp"}
Purpose = Literal["phenotyping", "grasping"]
DEFAULT_STEPS = 20_000
"""Default maximum number of updates of a training on synthetic images."""
DEFAULT_IMAGES = 800
"""Default maximum number of synthetic images of a training."""
DEFAULT_WORKERS = 4
"""Default number of processes that render synthetic images."""
BAND_WEIGHTS = "weights for stalks in the band; the backbone is kept, and the output layers start anew, for sections"
"""Note on weights that are trained further for other targets."""


def check_extra(extra: Purpose) -> None:
    """Check that the packages of an extra are installed.

    Raises:
        RequestError: Some are missing.
    """
    missing = [package for module, package in _EXTRAS[extra].items() if importlib.util.find_spec(module) is None]
    if missing:
        raise RequestError(f"{_COMMANDS[extra]} needs {', '.join(missing)}: {install_command(extra)}")


def check_masks(masks: str, weights: Path | None) -> None:
    """Check that no weights are given if the masks are the ground truth.

    Raises:
        RequestError: There are weights.
    """
    if masks == "truth" and weights is not None:
        raise RequestError("--masks truth uses no weights: leave out --weights")


def check_speed(speed: float | None) -> None:
    """Check that the speed of the robot in m/s is positive, if it is given.

    Raises:
        RequestError: It is not.
    """
    if speed is not None and not speed > 0:
        raise RequestError(f"--speed must be more than 0, not {speed:g}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlantOptions:
    """Options of a command that renders synthetic plants."""

    family: Literal["training", "shifted"] | None = None
    """Family of plants: `training`, the training distribution, or `shifted`, with all factors shifted. If not given, `shifted`
    for `phenotype eval` without --shift and `training` otherwise."""
    shift: tuple[str, ...] = ()
    """Factors of the family to shift alone: flash, lean, rig, noise, leaves, textures."""
    spec: Path | None = None
    """JSON or TOML file with the values of a custom family, instead of --family and --shift."""
    frames: int | None = None
    """Number of pairs per plot or run; that of the family if not given: 34 for `phenotype`, 5 for `grasp`."""
    width: int | None = None
    """Image width in pixels, with the field of view unchanged; that of the family if not given: 3376 for `phenotype`, 1024 for
    `grasp`."""
    seed: int = 0
    """Seed of the first plot or run; the others follow consecutively. In training, the random seed."""

    def check(self) -> None:
        """Check the values of the options.

        Raises:
            RequestError: A value is invalid.
        """
        check_counts(frames=self.frames, width=self.width)
        if self.seed < 0:
            raise RequestError(f"--seed must be at least 0, not {self.seed}")

    def read_family(self, purpose: Purpose, default: str = "training") -> Family:
        """Return the family that the options select.

        Args:
            purpose: Application, whose families are meant by ``--family``.
            default: Name of the family if neither ``--family``, ``--shift`` nor ``--spec`` is given.

        Raises:
            RequestError: The options contradict each other, or a value or the file of a family is invalid.
        """
        from jaxrl_vis_envs.plants import FAMILIES, read, shift
        from jaxrl_vis_envs.plants.grasping import GRASPING_FAMILIES

        families = FAMILIES if purpose == "phenotyping" else GRASPING_FAMILIES
        if self.spec is not None and (self.shift or self.family not in (None, "training")):
            raise RequestError("--spec describes the whole family: leave out --family and --shift")
        try:
            name = self.family or ("training" if self.shift else default)
            family = families[name] if self.spec is None else read(self.spec, families)
            if self.shift:
                family = shift(family, *self.shift)
            if self.width is not None:
                family = family.at_width(self.width)
            if self.frames is not None:
                family = dataclasses.replace(family, rig=dataclasses.replace(family.rig, frames=self.frames))
        except ValueError as error:
            raise RequestError(str(error)) from error
        return family


@dataclasses.dataclass(frozen=True, kw_only=True)
class SynthOptions(PlantOptions):
    """Options of a command that writes synthetic plots or runs."""

    out: Annotated[Path, AlsoPositional()]
    """Folder to write to; plots or runs that it already holds are not rendered again."""
    format: Literal["png", "tiff", "jpeg"] = "png"
    """Format of the camera images."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainingOptions(PlantOptions):
    """Options of a command that trains networks."""

    out: Annotated[Path, AlsoPositional()]
    """File of the weights, .safetensors, for --weights of `run` and `eval`."""
    minutes: float | None = None
    """Maximum duration in minutes, including compilation; the weights are written at the end and every half minute before.
    With `phenotype train --data`, compilation and reading do not count, and the best weights so far are written."""
    steps: int | None = None
    """Maximum number of updates; if not given, 20,000, or 1,500 for `phenotype train --data`."""
    images: int | None = None
    """Maximum number of synthetic training images; if not given, 800. Not with `phenotype train --data`."""
    batch: int = 16
    """Batch size in images or crops."""
    rate: float | None = None
    """Peak learning rate. If not given, 0.001, but 0.0004 for `grasp train --loss gan`, and 0.0003 if `phenotype train` starts
    from weights."""
    workers: int | None = None
    """Number of processes that render synthetic images during training; with 1, a thread of the main process does. If not
    given, 4. Not with `phenotype train --data`."""

    def check(self) -> None:
        """Check the values of the options.

        Raises:
            RequestError: A value is invalid.
        """
        check_counts(steps=self.steps, images=self.images, batch=self.batch, workers=self.workers)
        super().check()
        if self.minutes is not None and not self.minutes > 0:
            raise RequestError(f"--minutes must be more than 0, not {self.minutes:g}")
        if self.rate is not None and not self.rate > 0:
            raise RequestError(f"--rate must be more than 0, not {self.rate:g}")
        if self.out.suffix != ".safetensors":
            raise RequestError(f"the weights go into a file that ends in .safetensors, not {self.out}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class DetectorTraining(TrainingOptions):
    """Train the networks that detect and segment stalks, on synthetic plots or on your own annotated images."""

    mix: tuple[Path, ...] = ()
    """Files of further families, as for --spec: plots of each family take turns."""
    data: Path | None = None
    """Folder of annotated images to train on instead of synthetic plots: COCO (of CVAT, Roboflow, Label Studio, ...), Pascal
    VOC, LabelMe, YOLO, CVAT or Label Studio, with the images beside the annotations or in subfolders."""
    label: tuple[str, ...] = ()
    """Labels that count as stalks in --data, such as `stem`; all others are background. If not given, labels that mean stalk,
    or all annotations if none has a label."""
    start: str | None = None
    """Initial weights: a file of an earlier training, `shipped` for those of the package, or `random`. If not given, `random`,
    but `shipped` for --data, as a few images do not suffice to train from scratch."""
    batch: int = 8
    """Batch size in images."""
    crops: int = 32
    """Number of full-resolution stalk crops per update, for the masks; ignored with --data if no annotation has an outline,
    unless training starts from random weights."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class EvaluationOptions(PlantOptions):
    """Options of a command that scores results against the ground truth of synthetic plots or runs."""

    weights: Path | None = None
    """Weights from `train`; the shipped ones if not given. Not with --masks truth."""
    workers: int = 1
    """Number of processes that evaluate plots or runs in parallel; they share the GPUs and cores, and take about 2 GB of memory
    each. It affects times, but no scores."""
    json: Path | None = None
    """File for the scores of each plot or run and their summary, updated after each. Those that it already holds, under the
    same conditions, are not evaluated again."""

    def check(self) -> None:
        """Check the values of the options.

        Raises:
            RequestError: A value is invalid.
        """
        check_counts(workers=self.workers)
        super().check()


@dataclasses.dataclass(frozen=True, kw_only=True)
class CameraOptions:
    """Options of a command that reads folders of stereo pairs."""

    calibration: Path | None = None
    """Calibration of all folders: a file of OpenCV, RealSense, Middlebury or KITTI, or a folder with left.yaml and right.yaml
    of ROS. If not given, the one in each folder: calibration.yaml, extrinsics.yml, calib.txt, or left.yaml and right.yaml.
    Without a calibration there are no metric lengths."""
    calibration_unit: str | None = None
    """Unit of the calibration's baseline: m, cm or mm, or the side of a chessboard square, such as 24mm, if lengths are in
    squares. If not given, the unit that the file states or its program uses, or else m."""
    speed: float | None = None
    """Speed of the robot in m/s, for an odometry.csv that holds only times."""

    left: str | None = None
    """Glob pattern of the left images within each plot's folder, such as 'image_02/*.png', with --right; images are paired by
    the text that the wildcards match, or by nearest timestamps. If not given, sides are recognised by name: left and right, L
    and R, cam0 and cam1, ... For a ROS recording (.bag, .mcap, .db3): topic of the left images."""
    right: str | None = None
    """Glob pattern or topic of the right images, with --left."""

    def patterns(self) -> Patterns | None:
        """Return the patterns of the images' names; None if none are given.

        Raises:
            RequestError: The pattern of only one side is given.
        """
        from jaxrl_vis.stalks.phenotyping.io.folders import Patterns

        if (self.left is None) != (self.right is None):
            raise RequestError("--left and --right go together: give a pattern for each side")
        return None if self.left is None or self.right is None else Patterns(self.left, self.right)

    def find_plots(self, folder: Path, out: Path) -> list[PlotFolder]:
        """Find the plots in a folder, or in a recording, whose images are extracted to the folder ``recording`` in ``out``.

        Raises:
            RequestError: There are none, they are ambiguous, or the recording cannot be read.
        """
        from jaxrl_vis.stalks.phenotyping.io.folders import find_plots
        from jaxrl_vis.stalks.phenotyping.io.recording import Topics, extract_recording, is_recording

        patterns = self.patterns()
        if not is_recording(folder):
            return find_plots(folder, patterns)
        topics = None if patterns is None else Topics(patterns.left, patterns.right)
        return find_plots(extract_recording(folder, out / "recording", topics))

    def read_calibration(self, plot: PlotFolder) -> Calibration | None:
        """Read the calibration of one folder of pairs; return None if there is none.

        Raises:
            RequestError: The file cannot be read, or is not a valid calibration.
        """
        from jaxrl_vis.stalks.phenotyping.io.calibration import find_calibration, read_calibration

        path = self.calibration or find_calibration(plot.folder)
        image = next((pair.left for pair in plot.pairs if pair.left is not None), None)
        return None if path is None else read_calibration(path, self.calibration_unit, image)
