"""Views of single pairs, and faults that make their widths wrong: swapped, upside down, unrectified, or in a wrong unit."""

import dataclasses
import functools
import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from jaxrl_vis.stalks.phenotyping.detector.finder import Detection
from jaxrl_vis.stalks.phenotyping.measure.borders import Frame, find_frame
from jaxrl_vis.stalks.phenotyping.measure.ground import Ground, band_rows, find_ground
from jaxrl_vis.stalks.phenotyping.measure.stalk import DEPTHS, Method, measure_stalk, stalk_disparity
from jaxrl_vis.stalks.phenotyping.measure.width import fit_strip
from jaxrl_vis.stalks.phenotyping.track.near_row import MIN_STALKS, near_row_depth
from jaxrl_vis.stalks.phenotyping.track.sightings import (
    USUAL_DISTANCE,
    Find,
    Sighting,
    measure_pair,
    row_distance,
    to_grey_bytes,
)
from jaxrl_vis_envs.plants import Calibration

_OTHER_DISTANCES = (0.55, 1.15)  # m: tried if there is no row at the usual one
_SAME_DISTANCE = 0.12  # relative: tolerance of the networks to sizes
_STEP = 1.06  # between distances for which images are scaled
_MIN_STALKS = 4
_MIN_MEASURED = 0.7  # minimum fraction of detections measured in a good pair
_SAME_DEPTH = 0.15  # maximum relative difference of depths of one row
_MIN_DEPTH_RATIO = 3.0  # minimum depth in baselines: below, the fields of view hardly overlap
_MIN_DISPARITY = 2.0  # pixels
_SMALL_FRACTION, _LARGE_FRACTION = 0.25, 0.6
_ROW_OFFSETS = (6, 12, 24, 48)  # vertical offsets that are tried, pixels at a focal length of 2168


@dataclasses.dataclass(frozen=True)
class PairView:
    """Detections and measurements of one stereo pair.

    Attributes:
        detections: Detections in the left image.
        sightings: Sighting of each detection that counts.
        ground: Ground plane, the reference for heights; None if not found.
        frame: Part of the left image without black borders.
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
    min_score: float = 0.0,
) -> PairView:
    """Detect and measure the stalks of a pair, whose row of plants may be nearer or further away than usual.

    The networks detect stalks of about one size in pixels. If stereo shows that the row is at another distance, or few stalks
    are detected, detection is repeated with images scaled for other distances.

    Args:
        find: Stalk detector.
        left, right: Rectified images [H, W, 3] uint8.
        calibration: Calibration of the cameras; None if unknown.
        method: Method of measuring widths.
        disparity: Known disparities; see `measure_pair`.
        min_score: Minimum score of a detection that counts.

    Returns:
        View at the distance that stereo confirms, or else at the usual one.
    """

    def measure(detections: list[Detection]) -> PairView:
        likely = [detection for detection in detections if detection.score >= min_score]
        sightings = measure_pair(likely, left, right, calibration, method, ground, disparity)
        return PairView(detections, sightings, ground, frame)

    detections, ground = _detect_with_ground(find, left, right, calibration, disparity)
    frame = find_frame(left)
    usual = measure(detections)
    there = row_distance(usual.sightings)
    if calibration is None or (there is not None and abs(there / USUAL_DISTANCE - 1.0) <= _SAME_DISTANCE):
        return usual
    if there is None and len(usual.sightings) >= MIN_STALKS:
        return usual
    for distance in _OTHER_DISTANCES if there is None else (there,):
        band = functools.partial(band_rows, ground, calibration, distance)
        view = measure(find(left, calibration.focal / _rounded(distance), band))
        there = row_distance(view.sightings)
        if there is not None and abs(there / distance - 1.0) <= _SAME_DISTANCE:
            return view
    return usual


def _detect_with_ground(
    find: Find, left: np.ndarray, right: np.ndarray, calibration: Calibration | None, disparity: np.ndarray | None
) -> tuple[list[Detection], Ground | None]:
    """Detect the stalks of a row at the usual distance, and find the ground plane meanwhile, in a thread on the host."""
    if calibration is None:
        return find(left, None, None), None
    with ThreadPoolExecutor(1) as aside:
        ground = aside.submit(lambda: find_ground(to_grey_bytes(left), to_grey_bytes(right), calibration, disparity))

        def band(column: float) -> tuple[float, float, bool]:  # waits for the ground, but not before a detector asks
            return band_rows(ground.result(), calibration, USUAL_DISTANCE, column)

        return find(left, calibration.focal / USUAL_DISTANCE, band), ground.result()


def _rounded(distance: float) -> float:
    """Round a distance by 3 % at most: networks are compiled for each size of an image."""
    return USUAL_DISTANCE * _STEP ** round(math.log(distance / USUAL_DISTANCE, _STEP))


def pair_fault(
    detections: list[Detection],
    sightings: list[Sighting],
    left: np.ndarray,
    right: np.ndarray,
    calibration: Calibration,
    ground: Ground | None = None,
) -> str | None:
    """Return a message on what is wrong with a pair; None if nothing is, or there are too few detections to tell.

    Args:
        detections: Detections in the left image.
        sightings: Sighting of each detection.
        left, right: Images [H, W, 3] uint8.
        calibration: Calibration of the cameras.
        ground: Ground plane found in the pair; None if none.
    """
    grey_left, grey_right = to_grey_bytes(left), to_grey_bytes(right)
    measured = sum(sighting.diameter_mm is not None for sighting in sightings)
    fault = _orientation_fault(grey_left, grey_right, calibration) if ground is None else None
    if fault is None and (ground is None or measured < _MIN_MEASURED * len(detections)):
        fault = _distance_fault(detections, grey_left, grey_right, calibration)
    if fault is not None:
        return fault
    if len(detections) < _MIN_STALKS or measured > _SMALL_FRACTION * len(detections):
        return None
    # The mirror image of a swapped pair is a correct pair.
    mirror = dataclasses.replace(calibration, centre=(calibration.width - 1 - calibration.centre[0], calibration.centre[1]))
    turned = [
        dataclasses.replace(
            detection,
            mask=detection.mask[:, ::-1],
            corner=(detection.corner[0], left.shape[1] - detection.corner[1] - detection.mask.shape[1]),
            strip=None,
        )
        for detection in detections
    ]
    if _measured_fraction(turned, grey_left[:, ::-1], grey_right[:, ::-1], mirror) >= _LARGE_FRACTION:
        return "left and right are swapped: exchange their names"
    for rows in sorted({max(round(offset * calibration.focal / 2168), 3) for offset in _ROW_OFFSETS}):
        for shift in (rows, -rows):
            if _measured_fraction(detections, grey_left, np.roll(grey_right, shift, axis=0), calibration) >= _LARGE_FRACTION:
                return f"the right image lies about {rows} rows too {'high' if shift > 0 else 'low'}: rectify the pair"
    return None


def _orientation_fault(left: np.ndarray, right: np.ndarray, calibration: Calibration) -> str | None:
    """Return a message if a greyscale pair [H, W] is upside down; None if not."""
    column, row = calibration.centre
    turned = dataclasses.replace(calibration, centre=(column, calibration.height - 1 - row))
    if find_ground(left[::-1], right[::-1], turned) is not None:
        return "the images are upside down, left and right exchanged: turn both by 180 degrees, and exchange their names back"
    turned = dataclasses.replace(turned, centre=(calibration.width - 1 - column, turned.centre[1]))
    if find_ground(left[::-1, ::-1], right[::-1, ::-1], turned) is not None:
        return "the images are upside down: turn both by 180 degrees"
    return None


def _distance_fault(detections: list[Detection], left: np.ndarray, right: np.ndarray, calibration: Calibration) -> str | None:
    """Return a message if the stalks of a greyscale pair [H, W] have an implausible depth by its calibration; None if not."""
    depths = [
        depth for depth in (_unconstrained_depth(find, left, right, calibration) for find in _subsample(detections)) if depth
    ]
    if len(depths) < _MIN_STALKS:
        return None
    depth = near_row_depth(depths)
    agree = np.mean(np.abs(np.array(depths) / depth - 1.0) < _SAME_DEPTH)
    if DEPTHS[0] <= depth <= DEPTHS[1] or agree < _LARGE_FRACTION:
        return None
    # By day, most of the stalks may be those of a row behind; in a wrong unit, those of the row would be as far off.
    if depth > DEPTHS[1] and any(DEPTHS[0] <= other <= DEPTHS[1] for other in depths):
        return None
    baseline = calibration.baseline * USUAL_DISTANCE / depth
    return (
        f"its stalks stand {depth:.2g} m away by the calibration, not {DEPTHS[0]} to {DEPTHS[1]} m: say in which unit its "
        f"baseline is with --calibration-unit (a baseline of about {baseline:.2g} m would put the row at {USUAL_DISTANCE} m)"
    )


def _unconstrained_depth(detection: Detection, left: np.ndarray, right: np.ndarray, calibration: Calibration) -> float | None:
    """Return the depth of a detection without the usual limits, m; None if it has no clear match in the right image."""
    strip = detection.strip or fit_strip(detection.mask)
    if strip is None:
        return None
    nearest = float(calibration.disparity(np.array(_MIN_DEPTH_RATIO * calibration.baseline)))
    matched = stalk_disparity(strip, detection.corner, left, right, calibration, (calibration.offset + _MIN_DISPARITY, nearest))
    at = matched.at(strip.reference + detection.corner[0])
    return None if at is None else float(calibration.depth(np.array(at[0])))


def _subsample(detections: list[Detection]) -> list[Detection]:
    """Return at most ten of the detections, evenly spaced."""
    return detections[:: -(-len(detections) // 10)] if detections else []


def _measured_fraction(detections: list[Detection], left: np.ndarray, right: np.ndarray, calibration: Calibration) -> float:
    """Return the fraction of the detections, of which at most ten are tried, that can be measured with the right image."""
    some = _subsample(detections)
    left, right = np.ascontiguousarray(left), np.ascontiguousarray(right)
    measured = [
        measure_stalk(detection.mask, detection.corner, left, right, calibration).diameter_mm is not None for detection in some
    ]
    return sum(measured) / len(measured)
