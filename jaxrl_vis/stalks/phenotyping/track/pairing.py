"""Why a right image shows hardly any stalk of its left one: the two may be swapped, or not rectified."""

import dataclasses

import numpy as np

from jaxrl_vis.stalks.phenotyping.detector.finder import Detection
from jaxrl_vis.stalks.phenotyping.measure.stalk import measure
from jaxrl_vis.stalks.phenotyping.track.sightings import Sighting, grey_at
from jaxrl_vis_envs.plants import Calibration

_MIN_STALKS = 4
_SMALL_SHARE, _LARGE_SHARE = 0.25, 0.6
_LINES = (6, 12, 24, 48)  # how far two images lie apart that are not rectified, pixels at a focal length of 2168


def pair_fault(
    detections: list[Detection], sightings: list[Sighting], left: np.ndarray, right: np.ndarray, calibration: Calibration
) -> str | None:
    """Say in words what is wrong with a pair; None if nothing is, or too few stalks were detected to tell.

    Args:
        detections: In the left image.
        sightings: Their sightings.
        left, right: [H, W, 3] uint8.
        calibration: Calibration of the cameras.
    """
    measured = sum(sighting.diameter_mm is not None for sighting in sightings)
    if len(detections) < _MIN_STALKS or measured > _SMALL_SHARE * len(detections):
        return None
    grey_left, grey_right = grey_at(left), grey_at(right)
    # Seen in a mirror, a pair that is swapped is one that is not.
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
    if _share(turned, grey_left[:, ::-1], grey_right[:, ::-1], mirror) >= _LARGE_SHARE:
        return "left and right are swapped: exchange their names"
    for lines in sorted({max(round(line * calibration.focal / 2168), 3) for line in _LINES}):
        for shift in (lines, -lines):
            if _share(detections, grey_left, np.roll(grey_right, shift, axis=0), calibration) >= _LARGE_SHARE:
                return f"the right image lies about {lines} lines too {'high' if shift > 0 else 'low'}: rectify the pair"
    return None


def _share(detections: list[Detection], left: np.ndarray, right: np.ndarray, calibration: Calibration) -> float:
    """Return the share of detections, ten at most, that the right image shows."""
    some = detections[:: -(-len(detections) // 10)]
    left, right = np.ascontiguousarray(left), np.ascontiguousarray(right)
    measured = [
        measure(detection.mask, detection.corner, left, right, calibration).diameter_mm is not None for detection in some
    ]
    return sum(measured) / len(measured)
