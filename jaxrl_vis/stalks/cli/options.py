"""Options that commands of the farm share by inheritance, and their checks."""

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

# Module -> package, for the packages of an extra.
_GRASPING = {"cv2": "opencv-python-headless", "scipy": "scipy", "yaml": "pyyaml"}
_EXTRAS = {"phenotyping": {**_GRASPING, "tifffile": "tifffile", "pandas": "pandas"}, "grasping": _GRASPING}
_COMMANDS = {"phenotyping": "phenotype", "grasping": "grasp"}
Purpose = Literal["phenotyping", "grasping"]
DEFAULT_STEPS = 20_000
"""Most updates of a training on synthetic images."""


def check_extra(extra: Purpose) -> None:
    """Check that the packages of an extra are installed.

    Raises:
        RequestError: Some are missing.
    """
    missing = [package for module, package in _EXTRAS[extra].items() if importlib.util.find_spec(module) is None]
    if missing:
        raise RequestError(f"{_COMMANDS[extra]} needs {', '.join(missing)}: {install_command(extra)}")


def check_masks(masks: str, weights: Path | None) -> None:
    """Check that no weights are named where masks are the truth.

    Raises:
        RequestError: They are.
    """
    if masks == "truth" and weights is not None:
        raise RequestError("--masks truth uses no weights: leave out --weights")


def check_speed(speed: float | None) -> None:
    """Check that the speed of the robot in m/s is positive, if it is known.

    Raises:
        RequestError: It is not.
    """
    if speed is not None and not speed > 0:
        raise RequestError(f"--speed must be more than 0, not {speed:g}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlantOptions:
    """Options of a command that draws synthetic plants."""

    family: Literal["training", "shifted"] | None = None
    """Family of plants: `training`, which networks learn from, or `shifted`, with every factor of the world shifted. If not
    given, `shifted` for `phenotype eval` and `training` elsewhere."""
    shift: tuple[str, ...] = ()
    """Shift only these factors of the family: flash, lean, rig, noise, leaves, textures."""
    spec: Path | None = None
    """A JSON or TOML file with the values of a family of your own."""
    frames: int | None = None
    """Pairs of a plot or run, in place of the family's: 34 for `phenotype`, 5 for `grasp`."""
    width: int | None = None
    """Width of an image in pixels, in place of the family's (3376 for `phenotype`, 1024 for `grasp`); the scene stays the
    same."""
    seed: int = 0
    """Seed of the first plot or run, the others have the numbers that follow; in training, the seed of everything random."""

    def check(self) -> None:
        """Check the values of the options.

        Raises:
            RequestError: One makes no sense.
        """
        check_counts(frames=self.frames, width=self.width)
        if self.seed < 0:
            raise RequestError(f"--seed must be at least 0, not {self.seed}")

    def read_family(self, purpose: Purpose, default: str = "training") -> Family:
        """Return the family that the options ask for.

        Args:
            purpose: Application whose families ``--family`` names.
            default: Name of the family to take where neither ``--family`` nor ``--spec`` is given.

        Raises:
            RequestError: The options contradict each other, or the file of a family makes no sense.
        """
        from jaxrl_vis_envs.plants import FAMILIES, read, shift
        from jaxrl_vis_envs.plants.grasping import GRASPING_FAMILIES

        families = FAMILIES if purpose == "phenotyping" else GRASPING_FAMILIES
        if self.spec is not None and (self.shift or self.family not in (None, "training")):
            raise RequestError("--spec describes the whole family: leave out --family and --shift")
        try:
            family = families[self.family or default] if self.spec is None else read(self.spec, families)
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
    """The folder to write to; plots or runs that it holds already are not drawn again."""
    format: Literal["png", "tiff", "jpeg"] = "png"
    """Format of the cameras' images."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainingOptions(PlantOptions):
    """Options of a command that trains networks."""

    out: Annotated[Path, AlsoPositional()]
    """The file to write, .safetensors; `run` and `eval` take it as --weights."""
    minutes: float | None = None
    """Most minutes; the weights are written at the end, and every half minute before."""
    steps: int | None = None
    """Most updates: 20,000 if not given, and 1,500 where `phenotype train` learns from --data."""
    images: int = 800
    """Number of images to learn from."""
    batch: int = 16
    """Images or crops per update."""
    rate: float | None = None
    """Highest learning rate. If not given, 0.001, but 0.0004 for `grasp train --loss gan`, and 0.0003 where `phenotype train`
    starts from weights."""
    workers: int = 4
    """Number of processes that draw synthetic images while the networks learn; 1: a thread of this one."""

    def check(self) -> None:
        """Check the values of the options.

        Raises:
            RequestError: One makes no sense.
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
    """Train the networks that find and outline stalks, on synthetic plots or on your own annotated images."""

    data: Path | None = None
    """A folder of annotated images, in place of synthetic plots: COCO (of CVAT, Roboflow, Label Studio, ...), Pascal VOC,
    LabelMe, YOLO, CVAT or Label Studio, with the images beside the annotations or in folders below."""
    label: tuple[str, ...] = ()
    """Names of what counts as a stalk in --data, as `stem`; what is called otherwise is background. If not given, what is
    called a stalk, or everything where nothing has a name."""
    start: str | None = None
    """Weights to start from: a file of an earlier training, `shipped` for those of the package, or `random`. If not given,
    `random`, and for --data `shipped`, as a few images are too few to learn everything from."""
    batch: int = 8
    """Images per update."""
    snips: int = 32
    """Strips at full resolution per update, for the masks."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class EvaluationOptions(PlantOptions):
    """Options of a command that scores results against the truth of synthetic plots or runs."""

    weights: Path | None = None
    """Weights from `train`; the shipped ones if not given."""
    workers: int = 1
    """Number of processes, each with a plot or run of its own; they share the GPUs and cores, and take about 2 GB of memory
    each. Figures do not depend on it, times do."""
    json: Path | None = None
    """A file for the figures of all plots or runs together and of each one, written after each. Those that it holds already,
    under the same conditions, are not evaluated again."""

    def check(self) -> None:
        """Check the values of the options.

        Raises:
            RequestError: One makes no sense.
        """
        check_counts(workers=self.workers)
        super().check()


@dataclasses.dataclass(frozen=True, kw_only=True)
class CameraOptions:
    """Options of a command that reads folders of stereo pairs."""

    calibration: Path | None = None
    """Calibration of all folders: a file of OpenCV, RealSense, Middlebury or KITTI, or a folder with left.yaml and right.yaml
    of ROS. If not given, the one that lies in each folder: calibration.yaml, extrinsics.yml, calib.txt, left.yaml and
    right.yaml. Without one there are no metric lengths."""
    calibration_unit: str | None = None
    """Unit of the calibration's baseline, where the file does not say it: m, cm or mm, or the side of a square of the
    chessboard, as 24mm, where it was counted in squares."""
    speed: float | None = None
    """Speed of the robot in m/s, for an odometry.csv that holds times only."""

    left: str | None = None
    """Pattern of the left images within each plot's folder, as 'image_02/*.png', with --right; what the stars stand for is the
    same for both images of a pair, or the times that are nearest. If not given, names say left and right, L and R, cam0 and
    cam1, ... Of a recording of ROS (.bag, .mcap, .db3): its topic."""
    right: str | None = None
    """Pattern of the right images, with --left."""

    def patterns(self) -> Patterns | None:
        """Return the patterns of the images' names; None where names say it themselves.

        Raises:
            RequestError: Only one side is given.
        """
        from jaxrl_vis.stalks.phenotyping.io.folders import Patterns

        if (self.left is None) != (self.right is None):
            raise RequestError("--left and --right go together: give a pattern for each side")
        return None if self.left is None or self.right is None else Patterns(self.left, self.right)

    def find_plots(self, folder: Path, out: Path) -> list[PlotFolder]:
        """Return the plots of a folder, or of a recording, which is taken apart into the folder ``recording`` in ``out``.

        Raises:
            RequestError: There are none.
        """
        from jaxrl_vis.stalks.phenotyping.io.folders import find_plots
        from jaxrl_vis.stalks.phenotyping.io.recording import Topics, is_recording, take_apart

        patterns = self.patterns()
        if not is_recording(folder):
            return find_plots(folder, patterns)
        topics = None if patterns is None else Topics(patterns.left, patterns.right)
        return find_plots(take_apart(folder, out / "recording", topics))

    def read_calibration(self, plot: PlotFolder) -> Calibration | None:
        """Return the calibration of one folder of pairs; None where there is none.

        Raises:
            RequestError: The file cannot be read.
        """
        from jaxrl_vis.stalks.phenotyping.io.calibration import find_calibration, read_calibration

        path = self.calibration or find_calibration(plot.folder)
        image = next((pair.left for pair in plot.pairs if pair.left is not None), None)
        return None if path is None else read_calibration(path, self.calibration_unit, image)
