"""Families of fields: parameters of plots and their variation. Imports neither JAX nor MuJoCo.

A range (low, high) is sampled uniformly, a mean with an sd normally. Lengths are in metres and angles in degrees unless stated
otherwise. Sources: the thesis, section 3.3 (33 stalks on 2.134 m, 0.8 m away, 8 mm lens, 9 megapixels, 14.354 mm at 12 inches,
0.405 mm of taper per inch), and published traits of grain sorghum for what the thesis does not state (leaves, tillers, spread).
"""

import dataclasses
import math
import numbers
from typing import Any

from jaxrl_vis_envs.plants.scene import BOUNDS as SCENEBOUNDS
from jaxrl_vis_envs.plants.scene import Range, Scene

INCH = 0.0254


@dataclasses.dataclass(frozen=True)
class Layout:
    """Positions of plants."""

    plot_length: float = 2.134
    """Length of a plot along the row, m; plots are separated by bare alleys."""
    stalks_mean: float = 33.0
    """Mean number of stalks in a plot's near row, including tillers."""
    stalks_sd: float = 6.0
    """Standard deviation of the number of stalks."""
    spacing_minimum: float = 0.028
    """Minimum distance between plants, m."""
    spacing_shape: float = 1.6
    """Shape parameter of the gamma distribution of distances beyond the minimum."""
    offset_sd: float = 0.025
    """Standard deviation of the distance from the row's centre line, m."""
    tillers: float = 0.2
    """Fraction of stalks that are tillers, within `clump_radius` of their mother plant."""
    clump_radius: float = 0.03
    """Maximum distance of a tiller from its mother plant, m."""
    gaps: float = 0.04
    """Fraction of distances that are a gap in the row."""
    gap_length: float = 0.25
    """Length of a gap, m."""
    row_spacing: float = 0.762
    """Distance between rows, m."""
    rows_behind: int = 2
    """Number of rows behind the near one."""


@dataclasses.dataclass(frozen=True)
class Stalks:
    """Shape of stalks."""

    height: Range = (2.1, 2.6)
    """Length of a stalk, m."""
    diameter_mean: float = 0.014354
    """Mean diameter 12 inches above the ground, m."""
    diameter_sd: float = 0.0032
    """Standard deviation of that diameter over stalks, m."""
    diameter_least: float = 0.006
    """Minimum diameter at that height, m."""
    taper: float = 0.405e-3 / INCH
    """Taper between 12 and 24 inches for a stalk of mean diameter, m per m."""
    taper_spread: float = 0.25
    """Coefficient of variation of the taper."""
    lean_sd: Range = (4.0, 4.0)
    """Standard deviation within a plot of the lean at the ground, in both directions, degrees."""
    lean_most: float = 20.0
    """Maximum lean, degrees."""
    curvature_sd: float = 0.06
    """Standard deviation of the curvature, 1/m."""
    zigzag: float = 0.8
    """Standard deviation of the change of direction at a node, degrees."""
    node_spacing: Range = (0.08, 0.20)
    """Distance between nodes, m."""
    node_swelling: Range = (0.05, 0.15)
    """Thickening at a node, relative to the stalk's diameter."""
    ovality: Range = (1.0, 1.2)
    """Ratio of maximum to minimum diameter of a cross section."""
    sheaths: float = 0.6
    """Fraction of nodes whose leaf sheath remains, wrapped around the stalk above it."""
    sheath_length: Range = (0.06, 0.16)
    """Length of a sheath, m."""
    sheath_thickness: Range = (0.2e-3, 0.6e-3)
    """Thickness of a sheath, m; it adds twice as much to the diameter."""


@dataclasses.dataclass(frozen=True)
class Leaves:
    """Shape and number of leaves, including dry ones."""

    density: float = 1.0
    """Factor of the expected number of leaves."""
    lower: float = 0.22
    """Leaves per node below 0.3 m."""
    middle: float = 0.34
    """Leaves per node from 0.3 to 0.8 m."""
    upper: float = 0.8
    """Leaves per node above 0.8 m."""
    dry: float = 0.75
    """Fraction of leaves below 0.8 m that are dry; a third of it above."""
    length_mean: float = 0.636
    """Mean length of a green leaf, m."""
    length_sd: float = 0.098
    """Standard deviation of the length, m."""
    width_mean: float = 0.07
    """Mean width of a green leaf, m."""
    width_sd: float = 0.012
    """Standard deviation of the width, m."""
    angle_mean: float = 45.0
    """Mean angle between leaf and stalk, degrees."""
    angle_sd: float = 10.7
    """Standard deviation of the angle, degrees."""
    droop: Range = (50.0, 130.0)
    """Total bend of a green leaf towards the ground along its length, degrees."""
    litter: float = 60.0
    """Number of pieces of dry leaf on the ground per m of row."""


@dataclasses.dataclass(frozen=True)
class Textures:
    """Appearance of surfaces; values are sampled per plant."""

    stalk_hue: Range = (0.085, 0.19)
    """Hue of stalks, as a fraction of the colour circle: 0.08 is straw, 0.25 is green."""
    leaf_hue: Range = (0.20, 0.27)
    """Hue of green leaves."""
    dry_hue: Range = (0.07, 0.11)
    """Hue of dry leaves and sheaths."""
    soil_hue: Range = (0.05, 0.08)
    """Hue of the ground."""
    fibre_pitch: Range = (0.7e-3, 1.4e-3)
    """Distance between fibres, m."""
    fibre_contrast: Range = (0.10, 0.25)
    """Darkening of gaps between fibres, 0 to 1."""
    blotch_size: Range = (0.006, 0.02)
    """Size of blotches, m."""
    blotch_contrast: Range = (0.15, 0.45)
    """Darkening of blotches, 0 to 1."""
    speckles: Range = (0.0, 0.3)
    """Fraction of the surface with small dark speckles."""
    speckle_size: Range = (0.8e-3, 1.6e-3)
    """Size of speckles, m."""
    bands: Range = (0.0, 0.15)
    """Contrast of bands across stalks and leaves, 0 to 1."""
    band_pitch: Range = (0.02, 0.05)
    """Distance between bands, m."""
    bloom: Range = (0.1, 0.5)
    """Fraction of a stalk with a bright waxy bloom."""
    gloss: Range = (0.03, 0.12)
    """Intensity of the highlight."""


@dataclasses.dataclass(frozen=True)
class Rig:
    """Stereo camera pair and its trajectory past the plants."""

    width: int = 3376
    """Width of an image, pixels."""
    height: int = 2704
    """Height of an image, pixels."""
    focal: float = 2168.0
    """Nominal focal length, pixels."""
    baseline: float = 0.1
    """Nominal distance between the cameras, m."""
    stated_spread: float = 0.0
    """Maximum relative deviation of focal length and baseline from their nominal values; the calibration includes it."""
    calibration_error: float = 0.0
    """Relative error of focal length and baseline in the calibration; its sign is random."""
    rectification_error: float = 0.2
    """Standard deviation of the vertical offset between rectified images, pixels at full width."""
    distance: float = 0.8
    """Mean distance from the cameras to the row, m."""
    distance_sd: float = 0.015
    """Standard deviation of the distance over plots, m."""
    camera_height: float = 0.42
    """Mean height of the cameras, m."""
    camera_height_sd: float = 0.015
    """Standard deviation of the height over plots, m."""
    wobble: float = 0.004
    """Standard deviation of height and distance from image to image, m."""
    pitch: float = 0.0
    """Downward pitch of the cameras, degrees."""
    pitch_sd: float = 0.7
    """Standard deviation of the pitch over plots, degrees."""
    frames: int = 34
    """Number of stereo pairs per plot."""
    stretch: float = 0.0
    """Length of the drive, centred in the plot, m; 0 for the whole plot."""
    speed: float = 0.05
    """Speed of the robot, m/s."""
    odometry_noise: Range = (0.01, 0.03)
    """Relative error of the odometry's scale; its sign is random."""


@dataclasses.dataclass(frozen=True)
class Imaging:
    """Flash, lens and sensor."""

    flash: Range = (0.92, 1.08)
    """Intensity of the flash."""
    exposure_spread: float = 0.04
    """Relative standard deviation of the brightness from image to image."""
    ambient: float = 0.004
    """Ambient light, relative to the flash on a white surface at the row's distance."""
    vignetting: float = 0.35
    """Relative loss of light in the corners."""
    blur: Range = (0.5, 1.0)
    """Standard deviation of the point spread function, pixels at full width."""
    full_well: float = 9000.0
    """Electrons in a white pixel."""
    read_noise: float = 12.0
    """Standard deviation of the sensor's read noise, electrons."""
    noise: float = 1.0
    """Factor of the standard deviation of all noise."""
    samples: int = 4
    """Rays per pixel: 1 or 4."""


def is_number(value: Any) -> bool:
    """Return True if a value is a finite number; bools are not."""
    try:
        return isinstance(value, numbers.Real) and not isinstance(value, bool) and math.isfinite(value)
    except OverflowError:  # an integer too large for a float
        return False


def _check_value(label: str, example: Any, value: Any) -> None:
    """Check that a value is of the kind of the example: a range, an integer or a number."""
    if isinstance(example, tuple) and not (isinstance(value, tuple) and len(value) == 2):
        raise ValueError(f"{label} must be a range, (low, high), got {value!r}")
    ends: tuple[Any, Any] = value if isinstance(example, tuple) else (value, value)
    low, high = ends
    if not (is_number(low) and is_number(high)) or (low < 0 <= BOUNDS.get(label, (0.0,))[0]):
        raise ValueError(f"{label} must be finite and at least 0, got {value}")
    if isinstance(example, int) and not isinstance(value, numbers.Integral):
        raise ValueError(f"{label} must be a whole number, got {value}")
    if low > high:
        raise ValueError(f"{label} must run from low to high, got {value}")


# Limits of plausible values, and of memory. Fields without an entry must only be finite and at least 0.
BOUNDS: dict[str, tuple[float, float]] = {
    "layout.plot_length": (0.1, 50.0),
    "layout.stalks_mean": (0, 1000),
    "layout.stalks_sd": (0, 500),
    "layout.spacing_minimum": (0.005, 2.0),
    "layout.spacing_shape": (0.1, 100.0),
    "layout.tillers": (0, 0.9),
    "layout.gaps": (0, 0.9),
    "layout.row_spacing": (0.2, 5.0),
    "layout.rows_behind": (0, 5),
    "stalks.height": (0.3, 5.0),
    "stalks.diameter_mean": (0.001, 0.1),
    "stalks.diameter_least": (0.001, 0.1),
    "stalks.lean_sd": (0, 45),
    "stalks.lean_most": (0, 45),
    "stalks.node_spacing": (0.04, 1.0),
    "stalks.node_swelling": (0, 1.0),
    "stalks.ovality": (1.0, 3.0),
    "stalks.sheaths": (0, 1),
    "leaves.density": (0, 20),
    "leaves.dry": (0, 1),
    "leaves.length_mean": (0.05, 3.0),
    "leaves.width_mean": (0.002, 0.3),
    "leaves.litter": (0, 2000),
    "textures.fibre_pitch": (1e-4, 1.0),
    "textures.fibre_contrast": (0, 1),
    "textures.blotch_size": (1e-3, 1.0),
    "textures.blotch_contrast": (0, 1),
    "textures.speckles": (0, 1),
    "textures.speckle_size": (2e-4, 1.0),
    "textures.bands": (0, 1),
    "textures.band_pitch": (1e-3, 1.0),
    "textures.bloom": (0, 1),
    "rig.width": (32, 20000),
    "rig.height": (16, 20000),
    "rig.focal": (8, 1e5),
    "rig.baseline": (0.008, 2.0),
    "rig.stated_spread": (0, 0.5),
    "rig.calibration_error": (0, 0.2),
    "rig.distance": (0.3, 5.0),
    "rig.camera_height": (0.05, 3.0),
    "rig.pitch": (-30, 60),
    "rig.pitch_sd": (0, 20),
    "rig.frames": (1, 10000),
    "rig.stretch": (0, 50),
    "rig.speed": (1e-3, 10.0),
    "rig.odometry_noise": (0, 0.5),
    "imaging.flash": (0.01, 100.0),
    "imaging.exposure_spread": (0, 2),
    "imaging.vignetting": (0, 1),
    "imaging.blur": (0, 3.0),
    "imaging.full_well": (10.0, 1e7),
    **SCENEBOUNDS,
}


@dataclasses.dataclass(frozen=True)
class Family:
    """Distribution of plots. Equal families with equal seeds give equal plots.

    Raises:
        ValueError: A value is of the wrong kind or out of range; the message names the field.
    """

    name: str = "training"
    """Name of the family."""
    stream: int = 1
    """Number of the random stream; families with different streams use independent random numbers for all seeds."""
    layout: Layout = Layout()
    """Positions of plants."""
    stalks: Stalks = Stalks()
    """Shape of stalks."""
    leaves: Leaves = Leaves()
    """Shape and number of leaves."""
    textures: Textures = Textures()
    """Appearance of surfaces."""
    rig: Rig = Rig()
    """Camera pair."""
    imaging: Imaging = Imaging()
    """Light and sensor."""
    scene: Scene = Scene()
    """Daylight, surroundings and cameras of daytime plots."""

    def __post_init__(self) -> None:
        _check_value("stream", 1, self.stream)
        for field in dataclasses.fields(self):
            part, example = getattr(self, field.name), field.default
            if type(part) is not type(example) and dataclasses.is_dataclass(example):
                raise ValueError(f"{field.name} must be a {type(example).__name__}, got {part!r}")
            if dataclasses.is_dataclass(part):
                for part_field in dataclasses.fields(part):
                    _check_value(f"{field.name}.{part_field.name}", part_field.default, getattr(part, part_field.name))
        for label, (low, high) in BOUNDS.items():
            part, name = label.split(".")
            value = getattr(getattr(self, part), name)
            minimum, maximum = value if isinstance(value, tuple) else (value, value)
            if minimum < low or maximum > high:
                raise ValueError(f"{label} must be from {low:g} to {high:g}, got {value}")
        if self.imaging.samples not in (1, 4):
            raise ValueError(f"imaging.samples must be 1 or 4, got {self.imaging.samples}")

    def at_width(self, width: int) -> "Family":
        """Return a family with the same cameras at another resolution: images ``width`` pixels wide with the same view."""
        scale = width / self.rig.width
        height = max(round(self.rig.height * scale), 1)
        rig = dataclasses.replace(self.rig, width=width, height=height, focal=self.rig.focal * scale)
        return dataclasses.replace(self, rig=rig)


TRAINING = Family()
