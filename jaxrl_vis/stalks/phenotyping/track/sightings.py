"""Sightings: the stalks detected in one stereo pair, with their measurements where possible."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, get_args, get_origin

import cv2
import numpy as np

from jaxrl_vis.config import fields
from jaxrl_vis.stalks.phenotyping.detector.band import Band
from jaxrl_vis.stalks.phenotyping.detector.finder import Detection
from jaxrl_vis.stalks.phenotyping.measure.behind import depths_behind
from jaxrl_vis.stalks.phenotyping.measure.borders import find_frame
from jaxrl_vis.stalks.phenotyping.measure.ground import Ground
from jaxrl_vis.stalks.phenotyping.measure.stalk import Measurement, Method, measure_stalk
from jaxrl_vis.stalks.phenotyping.measure.width import fit_strip
from jaxrl_vis.stalks.phenotyping.track.near_row import MIN_STALKS, near_row_depth
from jaxrl_vis_envs.plants import Calibration
from jaxrl_vis_envs.plants.truth import HEIGHTS

NO_CALIBRATION = "no calibration"
Find = Callable[[np.ndarray, float | None, Band | None], list[Detection]]
"""Detector of the stalks in a left image [H, W, 3] uint8, given its pixels per metre at the row of plants and the image rows of
the band, both None if unknown."""
USUAL_DISTANCE = 0.8
"""Default distance from the cameras to the row of plants, m."""
_FAR_FROM_ROW = 0.2  # m: distance from the row beyond which a match is suspicious
# Factor of the confidence of a measurement with an edge that may be occluded; at 24 inches, fewer of these are lower bounds.
_OCCLUSION_FACTOR, _UPPER_OCCLUSION_FACTOR = 0.1, 0.025
_BEHIND = 0.003  # m: a stalk further behind occludes nothing
_TOUCHING = 0.1  # of half a stalk's width: distance within which edges touch
_SAME_DEPTH = 0.06  # m: change of depth over 12 inches of a stalk that leans by 10 degrees


@dataclasses.dataclass(frozen=True)
class Sighting:
    """One stalk in one pair. Unknown lengths are None.

    Attributes:
        box: Left, top, right and bottom of its part in the band, pixels of the left image; (0, 0) is the centre of the first
            pixel.
        axis: x coordinates of its centre line at the top and bottom of the box, pixels.
        score: Score of the detector, 0 to 1.
        row, column: Image row of the measurement, and column of the stalk's centre line in it, pixels.
        width_px: Width perpendicular to the axis, pixels.
        lean_deg: Angle against the vertical of the image, degrees, positive to the right.
        diameter_mm: Diameter perpendicular to the axis, mm.
        deviation_mm: Standard error of the diameter, mm.
        depth_m: Planar depth of the front surface, m.
        along_m: Position along the row, relative to the midpoint of the cameras, m.
        height_m: Height of the measurement above the ground, m; None if no ground was found in the pair.
        upper_mm, upper_deviation_mm, upper_height_m, upper_confidence: Diameter, its standard error, height and confidence
            of the measurement around 24 inches above the ground.
        upper_place: Column, row and width of that measurement, pixels.
        confidence: Confidence of the measurement, 0 to 1.
        occluded, upper_occluded: True if an edge may be occluded, so that the diameter is a lower bound: another stalk touches
            it, or, for the lower measurement, the edges are not visible around that image row.
        ray_deg: Horizontal angle between the left camera's axis and the ray to the stalk, degrees, positive to the right.
        reason: Reason why the stalk was not measured; empty if it was.
    """

    box: tuple[float, float, float, float]
    axis: tuple[float, float]
    score: float
    row: float
    column: float
    width_px: float | None = None
    lean_deg: float | None = None
    diameter_mm: float | None = None
    deviation_mm: float | None = None
    depth_m: float | None = None
    along_m: float | None = None
    height_m: float | None = None
    upper_mm: float | None = None
    upper_deviation_mm: float | None = None
    upper_height_m: float | None = None
    upper_confidence: float = 0.0
    upper_place: tuple[float, float, float] | None = None
    confidence: float = 0.0
    occluded: bool = False
    upper_occluded: bool = False
    ray_deg: float | None = None
    reason: str = ""

    @classmethod
    def read(cls, values: dict[str, Any]) -> "Sighting":
        """Build a sighting from its `json_values`.

        Raises:
            ValueError: A field is missing, unknown, or of the wrong type or length.
        """
        parts: dict[str, Any] = {}
        for name, (kind, optional, length) in _KINDS.items():
            key = _KEYS.get(name, name)
            if key not in values:
                continue
            value = parts[name] = tuple(values[key]) if isinstance(values[key], list) else values[key]
            if value is None and optional:
                continue
            several = value if isinstance(value, tuple) else (value,)
            if len(several) != length or not all(isinstance(value, kind) for value in several):
                raise ValueError(f"{name} is not of its kind")
        if len(parts) != len(values) or not {"box", "axis", "score", "row", "column"} <= parts.keys():
            raise ValueError("something is missing or too many")
        return cls(**parts)

    def json_values(self) -> dict[str, Any]:
        """Return the fields as JSON values by their keys in files."""
        return {_KEYS.get(name, name): value for name, value in dataclasses.asdict(self).items()}


# Keys in files of the fields that have another name there.
_KEYS = {"row": "line", "occluded": "hidden", "upper_occluded": "upper_hidden"}


def _field_kind(hint: Any) -> tuple[type | tuple[type, ...], bool, int]:
    """Return the type of a field's values, True if it is optional, and its number of values."""
    one, optional, several = fields.unwrap(hint)
    length = next((len(get_args(part)) for part in (hint, *get_args(hint)) if get_origin(part) is tuple), 1)
    return (int, float) if one is float else one, optional, length if several else 1


_KINDS = {name: _field_kind(hint) for name, hint in fields.hints(Sighting).items()}


def to_grey_bytes(image: np.ndarray) -> np.ndarray:
    """Convert an RGB image [H, W, 3] uint8 to greyscale [H, W] uint8."""
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def row_distance(sightings: list[Sighting]) -> float | None:
    """Return the depth of the row of plants in one or several pairs, m; None if fewer than three stalks were measured."""
    depths = [sighting.depth_m for sighting in sightings if sighting.diameter_mm is not None and sighting.depth_m is not None]
    return near_row_depth(depths) if len(depths) >= MIN_STALKS else None


def measure_pair(
    detections: list[Detection],
    left: np.ndarray,
    right: np.ndarray,
    calibration: Calibration | None,
    method: Method = "strip",
    ground: Ground | None = None,
    disparity: np.ndarray | None = None,
) -> list[Sighting]:
    """Measure the detections of a pair.

    Args:
        detections: Detections in the left image.
        left, right: Rectified images [H, W, 3] uint8.
        calibration: Calibration of the cameras; None for measurements in pixels only.
        method: Method of measuring widths.
        ground: Ground plane, the reference for heights; None to measure stalks only in the middle of their boxes.
        disparity: Known disparities [H, W] float32 to use instead of matching, pixels; NaN where unknown. None to match.

    Returns:
        One sighting per detection.
    """
    if calibration is None:
        return [_unscaled_sighting(detection) for detection in detections]
    grey_left, grey_right = to_grey_bytes(left), to_grey_bytes(right)
    measured: list[tuple[Measurement, Measurement | None]] = []
    for detection in detections:
        row = 0.5 * (detection.box[1] + detection.box[3])
        images = (grey_left, grey_right, calibration)
        how = {"method": method, "ground": ground, "disparity": disparity}
        measurement = measure_stalk(
            detection.mask, detection.corner, *images, row=row, height=HEIGHTS[0], strip=detection.strip, **how
        )
        upper = None
        if ground is not None and detection.upper is not None:
            upper = measure_stalk(*detection.upper, *images, height=HEIGHTS[1], **how)
        measured.append((measurement, upper))
    first_column = find_frame(grey_right).columns[0]
    depths = depths_behind(detections, grey_left, grey_right, calibration, _row_depth(measured), first_column, disparity)
    measured = _without_mismatches(_place_behind(measured, depths), calibration, first_column)
    occluded = _occluded_edges([measurement for measurement, _ in measured])
    above = _occluded_edges([upper or Measurement() for _, upper in measured])
    occluded = [behind or not measurement.both_edges_visible for behind, (measurement, _) in zip(occluded, measured)]
    sightings = []
    for detection, (measurement, upper), hidden, upper_hidden in zip(detections, measured, occluded, above):
        lower = dataclasses.replace(measurement, confidence=measurement.confidence * (_OCCLUSION_FACTOR if hidden else 1.0))
        if upper is not None and upper_hidden:
            upper = dataclasses.replace(upper, confidence=upper.confidence * _UPPER_OCCLUSION_FACTOR)
        sighting = _make_sighting(detection, lower, upper, calibration)
        sightings.append(dataclasses.replace(sighting, occluded=hidden, upper_occluded=upper_hidden))
    return sightings


def _place_behind(
    measured: list[tuple[Measurement, Measurement | None]], depths: np.ndarray
) -> list[tuple[Measurement, Measurement | None]]:
    """Replace measurements by the depths [N] of stalks behind the row, NaN for others, unless they are at the row's depth.

    Windows that match by chance do so at any depth.
    """
    is_behind = np.isfinite(depths)
    row_depth = _row_depth([pair for pair, behind in zip(measured, is_behind) if not behind])
    placed = []
    for (lower, upper), behind, depth in zip(measured, is_behind, map(float, depths)):
        if behind and (lower.diameter_mm is None or row_depth is None or abs(lower.depth - row_depth) > _SAME_DEPTH):
            lower = Measurement(row=lower.row, depth=depth, lean=lower.lean, reason=f"it stands {depth:.2f} m away")
            upper = None
        placed.append((lower, upper))
    return placed


def _row_depth(measured: list[tuple[Measurement, Measurement | None]]) -> float | None:
    """Return the depth of the row in a pair, m; None if fewer than three stalks were measured."""
    depths = [measurement.depth for measurement, _ in measured if measurement.diameter_mm is not None]
    return near_row_depth(depths) if len(depths) >= MIN_STALKS else None


def _without_mismatches(
    measured: list[tuple[Measurement, Measurement | None]], calibration: Calibration, first_column: int
) -> list[tuple[Measurement, Measurement | None]]:
    """Invalidate measurements of stalks outside the right image, which were matched with something else.

    Args:
        measured: Lower and upper measurement of each stalk of a pair.
        calibration: Calibration of the cameras.
        first_column: First column of the right image without a black border.
    """
    row_depth = _row_depth(measured)
    if row_depth is None:
        return measured
    disparity = float(calibration.disparity(np.array(row_depth)))
    valid = []
    for measurement, upper in measured:
        beyond = measurement.column - 0.5 * measurement.width - disparity < first_column
        if measurement.diameter_mm is not None and beyond and abs(measurement.depth - row_depth) > _FAR_FROM_ROW:
            measurement = Measurement(
                row=measurement.row,
                column=measurement.column,
                lean=measurement.lean,
                reason="the right image does not show it",
            )
            upper = None
        valid.append((measurement, upper))
    return valid


def _occluded_edges(measurements: list[Measurement]) -> list[bool]:
    """Return True for stalks with an edge at another stalk that is not behind them.

    Such an edge may be that of the other stalk, and the width too small.
    """
    occluded = []
    for measurement in measurements:
        half = 0.5 * measurement.width / math.cos(measurement.lean) if measurement.diameter_mm is not None else math.nan
        occluded.append(False)
        for other in measurements:
            if (
                measurement.diameter_mm is None
                or other.diameter_mm is None
                or other is measurement
                or other.depth > measurement.depth + _BEHIND
            ):
                continue
            middle = other.column + math.tan(other.lean) * (other.row - measurement.row)
            reach = 0.5 * other.width / math.cos(other.lean) + _TOUCHING * half
            occluded[-1] |= any(abs(measurement.column + side * half - middle) < reach for side in (-1.0, 1.0))
    return occluded


def _unscaled_sighting(detection: Detection) -> Sighting:
    strip = detection.strip or fit_strip(detection.mask)
    row = 0.5 * (detection.box[1] + detection.box[3])
    column = 0.5 * sum(detection.axis)
    if strip is None:
        return Sighting(detection.box, detection.axis, detection.score, row, column, reason=NO_CALIBRATION)
    width, lean = strip.width(row - detection.corner[0]), math.degrees(strip.lean)
    return Sighting(
        detection.box,
        detection.axis,
        detection.score,
        row,
        column,
        round(width, 3),
        round(lean, 2),
        confidence=round(strip.confidence, 4),
        reason=NO_CALIBRATION,
    )


def _make_sighting(
    detection: Detection, measurement: Measurement, upper: Measurement | None, calibration: Calibration
) -> Sighting:
    """Build a sighting from measurements, rounded so that it is unchanged by a round trip through JSON."""
    row = measurement.row if math.isfinite(measurement.row) else 0.5 * (detection.box[1] + detection.box[3])
    column = measurement.column if math.isfinite(measurement.column) else 0.5 * sum(detection.axis)

    def round_or_none(value: float | None, digits: int) -> float | None:
        return None if value is None or not math.isfinite(value) else round(value, digits)

    # Another stalk may stand where this one's axis was extrapolated to.
    same = upper is not None and abs(upper.depth - measurement.depth) < _SAME_DEPTH
    higher = upper if upper is not None and upper.diameter_mm is not None and same else Measurement()
    along = None
    if measurement.diameter_mm is not None:
        # The axis is half a diameter behind the front surface.
        depth = measurement.depth + 0.5e-3 * measurement.diameter_mm
        along = (column - calibration.centre[0]) / calibration.focal * depth - 0.5 * calibration.baseline
    return Sighting(
        box=tuple(round(edge, 2) for edge in detection.box),  # pyright: ignore[reportArgumentType]
        axis=tuple(round(column, 2) for column in detection.axis),  # pyright: ignore[reportArgumentType]
        score=round(detection.score, 4),
        row=round(row, 2),
        column=round(column, 2),
        width_px=round_or_none(measurement.width, 3),
        lean_deg=round_or_none(math.degrees(measurement.lean), 2),
        diameter_mm=round_or_none(measurement.diameter_mm, 4),
        deviation_mm=round_or_none(measurement.deviation_mm, 4),
        depth_m=round_or_none(measurement.depth, 5),
        along_m=round_or_none(along, 5),
        height_m=round_or_none(measurement.height, 4),
        upper_mm=round_or_none(higher.diameter_mm, 4),
        upper_deviation_mm=round_or_none(higher.deviation_mm, 4),
        upper_height_m=round_or_none(higher.height, 4),
        upper_confidence=round(higher.confidence, 4),
        upper_place=None
        if higher.diameter_mm is None
        else tuple(round(x, 2) for x in (higher.column, higher.row, higher.width)),  # pyright: ignore[reportArgumentType]
        confidence=round(measurement.confidence, 4),
        ray_deg=round(math.degrees(math.atan((column - calibration.centre[0]) / calibration.focal)), 2),
        reason=measurement.reason,
    )
