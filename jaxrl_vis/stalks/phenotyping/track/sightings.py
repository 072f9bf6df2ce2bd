"""Sightings: the stalks that one pair shows, measured where the pair allows it."""

import dataclasses
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, get_args, get_origin

import cv2
import numpy as np

from jaxrl_vis.config import fields
from jaxrl_vis.stalks.phenotyping.detector.finder import Detection
from jaxrl_vis.stalks.phenotyping.measure.borders import Frame, find_frame
from jaxrl_vis.stalks.phenotyping.measure.ground import Ground, find_ground
from jaxrl_vis.stalks.phenotyping.measure.stalk import Measurement, Method, measure
from jaxrl_vis.stalks.phenotyping.measure.width import strip_width
from jaxrl_vis_envs.plants import Calibration
from jaxrl_vis_envs.plants.truth import HEIGHTS

NO_CALIBRATION = "no calibration"
Find = Callable[[np.ndarray, float | None], list[Detection]]
"""Finds the stalks in a left image [H, W, 3] uint8 with so many pixels per metre at the row; None if nobody knows."""
USUAL_DISTANCE = 0.8
"""Distance from the cameras to the row, m, where nothing says otherwise."""
_OTHER_DISTANCES = (0.55, 1.15)  # m: at which a row is looked for that is not seen at the usual one
_SAME_DISTANCE = 0.12  # of 1: networks find stalks that are by so much larger or smaller than those of the usual distance
_AT_DISTANCE = 3  # stalks that say how far away the row is
_FAR_FROM_ROW = 0.2  # m: what stands there is not of the row
_HIDDEN = 0.1  # of its confidence that a sighting keeps if one of its edges may be hidden
_BEHIND = 0.003  # m: what stands so much further away hides nothing
_TOUCHING = 0.1  # of half a stalk's width: edges so near are one
_SAME_DEPTH = 0.06  # m, within 12 inches of a stalk that leans by 10 degrees


@dataclasses.dataclass(frozen=True)
class Sighting:
    """One stalk in one pair. Lengths that are not known are None.

    Attributes:
        box: Left, top, right, bottom of its part in the band, pixels of the left image; (0, 0) is the middle of the first one.
        axis: Columns of its middle at the box's top and bottom.
        score: Score of the detector, 0 to 1.
        line, column: Place of the measurement: line, and column of its middle, pixels.
        width_px: Across its axis there, pixels.
        lean_deg: Against the image's vertical, degrees, positive to the right.
        diameter_mm: Across its axis.
        deviation_mm: Its standard error.
        depth_m: Planar depth of its front.
        along_m: Position along the row, from the middle between the cameras.
        height_m: Height of the measurement above the ground; None if the pair shows no ground.
        upper_mm, upper_deviation_mm, upper_height_m, upper_confidence: Diameter, its standard error, height and confidence
            around 24 inches above the ground.
        upper_place: Column, line and width in pixels of that.
        confidence: 0 to 1.
        hidden, upper_hidden: One of its edges may be hidden, so that it is at least so thick: another stalk stands
            there, or, of the lower one, the edges were not seen around the height itself. All of the upper piece is near its
            height.
        ray_deg: Angle between the left camera's axis and the ray to it, degrees, positive to the right.
        reason: Why it was not measured; empty where it was.
    """

    box: tuple[float, float, float, float]
    axis: tuple[float, float]
    score: float
    line: float
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
    hidden: bool = False
    upper_hidden: bool = False
    ray_deg: float | None = None
    reason: str = ""

    @classmethod
    def read(cls, values: dict[str, Any]) -> "Sighting":
        """From what JSON kept of `dataclasses.asdict`.

        Raises:
            ValueError: Something is missing, unknown, or of another kind.
        """
        parts: dict[str, Any] = {}
        for name, (kind, optional, length) in _KINDS.items():
            if name not in values:
                continue
            value = parts[name] = tuple(values[name]) if isinstance(values[name], list) else values[name]
            if value is None and optional:
                continue
            several = value if isinstance(value, tuple) else (value,)
            if len(several) != length or not all(isinstance(value, kind) for value in several):
                raise ValueError(f"{name} is not of its kind")
        if len(parts) != len(values) or not {"box", "axis", "score", "line", "column"} <= parts.keys():
            raise ValueError("something is missing or too many")
        return cls(**parts)


def _field_kind(hint: Any) -> tuple[type | tuple[type, ...], bool, int]:
    """Type of a field's values, whether it may be None, and the number of values."""
    one, optional, several = fields.unwrap(hint)
    length = next((len(get_args(part)) for part in (hint, *get_args(hint)) if get_origin(part) is tuple), 1)
    return (int, float) if one is float else one, optional, length if several else 1


_KINDS = {name: _field_kind(hint) for name, hint in fields.hints(Sighting).items()}


def grey_at(image: np.ndarray) -> np.ndarray:
    """An image [H, W, 3] uint8 as [H, W] uint8."""
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def find_with_ground(
    find: Find,
    left: np.ndarray,
    right: np.ndarray,
    calibration: Calibration | None,
    disparity: np.ndarray | None = None,
    distance: float = USUAL_DISTANCE,
) -> tuple[list[Detection], Ground | None]:
    """The stalks and the ground of a pair, looked for at the same time: an accelerator finds the one and the host the other.

    Args:
        find: Detector of the stalks.
        left, right: [H, W, 3] uint8, rectified.
        calibration: Calibration of the cameras; without it, no ground is looked for.
        disparity: See `find_ground`.
        distance: Distance from the cameras to the row, m, which with the focal length gives the size of stalks in pixels.
    """
    if calibration is None:
        return find(left, None), None
    with ThreadPoolExecutor(1) as aside:
        ground = aside.submit(lambda: find_ground(grey_at(left), grey_at(right), calibration, disparity))
        return find(left, calibration.focal / distance), ground.result()


@dataclasses.dataclass(frozen=True)
class PairView:
    """All that a pair shows.

    Attributes:
        detections: In its left image.
        sightings: Of each of them.
        ground: Origin of heights; None where it shows none.
        frame: Part of the left image that shows anything.
    """

    detections: list[Detection]
    sightings: list[Sighting]
    ground: Ground | None
    frame: Frame


def view_pair(
    find: Find,
    left: np.ndarray,
    right: np.ndarray,
    calibration: Calibration | None,
    method: Method = "strip",
    disparity: np.ndarray | None = None,
) -> PairView:
    """Find and measure the stalks of a pair, whose row may be nearer or further away than usual.

    Networks find stalks of about one size in pixels. Where stereo says that the row stands elsewhere, or nothing is found, they
    look again for stalks of the size that they have there.

    Args:
        find: Detector of the stalks.
        left, right: [H, W, 3] uint8, rectified.
        calibration: Calibration of the cameras.
        method: Method of widths.
        disparity: See `measure_pair`.
    """
    detections, ground = find_with_ground(find, left, right, calibration, disparity)
    frame = find_frame(left)
    sightings = measure_pair(detections, left, right, calibration, method, ground, disparity)
    usual = PairView(detections, sightings, ground, frame)
    there = row_distance(usual.sightings)
    if calibration is None or (there is not None and abs(there / USUAL_DISTANCE - 1.0) <= _SAME_DISTANCE):
        return usual
    if there is None and len(detections) >= _AT_DISTANCE:
        return usual
    for distance in _OTHER_DISTANCES if there is None else (there,):
        detections = find(left, calibration.focal / distance)
        sightings = measure_pair(detections, left, right, calibration, method, ground, disparity)
        there = row_distance(sightings)
        if there is not None and abs(there / distance - 1.0) <= _SAME_DISTANCE:
            return PairView(detections, sightings, ground, frame)
    return usual


def row_distance(sightings: list[Sighting]) -> float | None:
    """Return the distance at which most stalks of a pair, or of several, were measured, m; None where too few were."""
    depths = [sighting.depth_m for sighting in sightings if sighting.diameter_mm is not None and sighting.depth_m is not None]
    return float(np.median(depths)) if len(depths) >= _AT_DISTANCE else None


def measure_pair(
    detections: list[Detection],
    left: np.ndarray,
    right: np.ndarray,
    calibration: Calibration | None,
    method: Method = "strip",
    ground: Ground | None = None,
    disparity: np.ndarray | None = None,
) -> list[Sighting]:
    """Measure what was found in a pair.

    Args:
        detections: In the left image.
        left, right: [H, W, 3] uint8, rectified.
        calibration: Calibration of the cameras; without it there are no millimetres and no metres.
        method: Method of widths.
        ground: Origin of heights; without it a stalk is measured in the middle of its box, and only there.
        disparity: [H, W] float32, disparities that are known, pixels.
    """
    if calibration is None:
        return [_in_pixels(detection) for detection in detections]
    grey_left, grey_right = grey_at(left), grey_at(right)
    measured: list[tuple[Measurement, Measurement | None]] = []
    for detection in detections:
        line = 0.5 * (detection.box[1] + detection.box[3])
        images = (grey_left, grey_right, calibration)
        how = {"method": method, "ground": ground, "disparity": disparity}
        got = measure(detection.mask, detection.corner, *images, line=line, height=HEIGHTS[0], strip=detection.strip, **how)
        upper = None
        if ground is not None and detection.upper is not None:
            upper = measure(*detection.upper, *images, height=HEIGHTS[1], **how)
        measured.append((got, upper))
    measured = _without_strangers(measured, calibration, find_frame(grey_right).columns[0])
    hidden = _hidden_edges([got for got, _ in measured])
    above = _hidden_edges([upper or Measurement() for _, upper in measured])
    hidden = [behind or not got.here for behind, (got, _) in zip(hidden, measured)]
    sightings = []
    for detection, (got, upper), *behind in zip(detections, measured, hidden, above):
        less = dataclasses.replace(got, confidence=got.confidence * _HIDDEN) if behind[0] else got
        sighting = _sighting(detection, less, upper, calibration)
        sightings.append(dataclasses.replace(sighting, hidden=behind[0], upper_hidden=behind[1]))
    return sightings


def _without_strangers(
    measured: list[tuple[Measurement, Measurement | None]], calibration: Calibration, begin: int
) -> list[tuple[Measurement, Measurement | None]]:
    """Return measurements without those that matched something else, as the right image does not reach as far as their stalk.

    Args:
        measured: Measurements of the stalks of a pair, lower and upper.
        calibration: Calibration of the cameras.
        begin: First column that the right image shows.
    """
    depths = [got.depth for got, _ in measured if got.diameter_mm is not None]
    if len(depths) < _AT_DISTANCE:
        return measured
    row = float(np.median(depths))
    disparity = float(calibration.disparity(np.array(row)))
    kept = []
    for got, upper in measured:
        beyond = got.column - 0.5 * got.width - disparity < begin
        if got.diameter_mm is not None and beyond and abs(got.depth - row) > _FAR_FROM_ROW:
            got = Measurement(line=got.line, column=got.column, lean=got.lean, reason="the right image does not show it")
            upper = None
        kept.append((got, upper))
    return kept


def _hidden_edges(measurements: list[Measurement]) -> list[bool]:
    """Return True for the stalks with an edge at another one that is not behind them: it may be the other's, and they look too
    thin.
    """
    hidden = []
    for measurement in measurements:
        half = 0.5 * measurement.width / math.cos(measurement.lean) if measurement.diameter_mm is not None else math.nan
        hidden.append(False)
        for other in measurements:
            if (
                measurement.diameter_mm is None
                or other.diameter_mm is None
                or other is measurement
                or other.depth > measurement.depth + _BEHIND
            ):
                continue
            middle = other.column + math.tan(other.lean) * (other.line - measurement.line)
            reach = 0.5 * other.width / math.cos(other.lean) + _TOUCHING * half
            hidden[-1] |= any(abs(measurement.column + side * half - middle) < reach for side in (-1.0, 1.0))
    return hidden


def _in_pixels(detection: Detection) -> Sighting:
    strip = detection.strip or strip_width(detection.mask)
    line = 0.5 * (detection.box[1] + detection.box[3])
    column = 0.5 * sum(detection.axis)
    if strip is None:
        return Sighting(detection.box, detection.axis, detection.score, line, column, reason=NO_CALIBRATION)
    width, lean = strip.width(line - detection.corner[0]), math.degrees(strip.lean)
    return Sighting(
        detection.box,
        detection.axis,
        detection.score,
        line,
        column,
        round(width, 3),
        round(lean, 2),
        confidence=round(strip.confidence, 4),
        reason=NO_CALIBRATION,
    )


def _sighting(detection: Detection, got: Measurement, upper: Measurement | None, calibration: Calibration) -> Sighting:
    """Rounded, so that what JSON keeps is what was measured."""
    line = got.line if math.isfinite(got.line) else 0.5 * (detection.box[1] + detection.box[3])
    column = got.column if math.isfinite(got.column) else 0.5 * sum(detection.axis)

    def known(value: float | None, digits: int) -> float | None:
        return None if value is None or not math.isfinite(value) else round(value, digits)

    # Another stalk may stand where this one's axis was followed to.
    same = upper is not None and abs(upper.depth - got.depth) < _SAME_DEPTH
    higher = upper if upper is not None and upper.diameter_mm is not None and same else Measurement()
    along = None
    if got.diameter_mm is not None:
        # The middle stands behind the front by half a diameter.
        depth = got.depth + 0.5e-3 * got.diameter_mm
        along = (column - calibration.centre[0]) / calibration.focal * depth - 0.5 * calibration.baseline
    return Sighting(
        box=tuple(round(edge, 2) for edge in detection.box),  # pyright: ignore[reportArgumentType]
        axis=tuple(round(column, 2) for column in detection.axis),  # pyright: ignore[reportArgumentType]
        score=round(detection.score, 4),
        line=round(line, 2),
        column=round(column, 2),
        width_px=known(got.width, 3),
        lean_deg=known(math.degrees(got.lean), 2),
        diameter_mm=known(got.diameter_mm, 4),
        deviation_mm=known(got.deviation_mm, 4),
        depth_m=known(got.depth, 5),
        along_m=known(along, 5),
        height_m=known(got.height, 4),
        upper_mm=known(higher.diameter_mm, 4),
        upper_deviation_mm=known(higher.deviation_mm, 4),
        upper_height_m=known(higher.height, 4),
        upper_confidence=round(higher.confidence, 4),
        upper_place=None
        if higher.diameter_mm is None
        else tuple(round(x, 2) for x in (higher.column, higher.line, higher.width)),  # pyright: ignore[reportArgumentType]
        confidence=round(got.confidence, 4),
        ray_deg=round(math.degrees(math.atan((column - calibration.centre[0]) / calibration.focal)), 2),
        reason=got.reason,
    )
