"""Baselines: the thesis's methods on the same detections, for comparison with ours.

width     the largest minor axis of ellipses fitted to a mask, with disparities by semi-global matching of the pixels in it;
          at the height of the mask, as the ground is not detected; averaged over the pairs that show a stalk
count     mean number of stalks per metre of image, by stereo, times the length of the plot; stalks are not tracked
"""

import numpy as np

from jaxrl_vis.stalks.phenotyping.detector.finder import Detection
from jaxrl_vis.stalks.phenotyping.measure.stereo import match_sgbm
from jaxrl_vis.stalks.phenotyping.track.sightings import Sighting, measure_pair
from jaxrl_vis_envs.plants import Calibration

_DEPTHS = (0.5, 1.3)  # m


def measure_pair_as_thesis(
    detections: list[Detection], left: np.ndarray, right: np.ndarray, calibration: Calibration
) -> list[Sighting]:
    """Measure the detections in a rectified pair of images [H, W, 3] uint8 by ellipses and semi-global matching.

    Returns:
        One sighting for each detection, in the same order.
    """
    disparity = np.full(left.shape[:2], np.nan, np.float32)
    far, near = (float(calibration.disparity(np.array(depth))) for depth in reversed(_DEPTHS))
    for detection in detections:
        (top, first), (tall, wide) = detection.corner, detection.mask.shape
        box = (first, top, first + wide, top + tall)
        disparity[top : top + tall, first : first + wide] = match_sgbm(left, right, box, (far, near))
    return measure_pair(detections, left, right, calibration, "ellipse", disparity=disparity)


def count_by_length(frames: list[list[Sighting]], calibration: Calibration, length: float) -> float:
    """Estimate the number of stalks in a plot from their mean number per metre of image width at their median depth.

    Args:
        frames: Sightings of each pair; a pair without depths contributes 0.
        calibration: Calibration of the cameras.
        length: Length of the plot, m.
    """
    densities = []
    for sightings in frames:
        depths = [sighting.depth_m for sighting in sightings if sighting.depth_m is not None]
        if depths:
            extent = calibration.width / calibration.focal * float(np.median(depths))
            densities.append(len(sightings) / extent)
        else:
            densities.append(0.0)
    return length * float(np.mean(densities)) if densities else 0.0


def mean_widths(frames: list[list[Sighting]], owners: list[list[int | None]]) -> dict[int, float]:
    """Compute the mean diameter in mm of each stalk, by index, over the pairs in which it was identified and measured.

    Args:
        frames: Sightings of each pair.
        owners: Index of each sighting's stalk; None if unknown.
    """
    widths: dict[int, list[float]] = {}
    for sightings, names in zip(frames, owners):
        for sighting, name in zip(sightings, names):
            if name is not None and sighting.diameter_mm is not None:
                widths.setdefault(name, []).append(sighting.diameter_mm)
    return {name: float(np.mean(values)) for name, values in widths.items()}
