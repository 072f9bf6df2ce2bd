"""The thesis's methods on the same detections, to show what each of ours is worth.

width     the largest minor axis of the ellipses fitted to a mask, and the disparity of the pixels in it by semi-global
          matching; where the mask is, as the ground is not looked for; the mean over the pairs that show a stalk
count     stalks per metre of image, by stereo, times the length of the plot: no stalk is followed from pair to pair
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
    """Measure what was found in a pair [H, W, 3] uint8, by ellipses and semi-global matching."""
    disparity = np.full(left.shape[:2], np.nan, np.float32)
    far, near = (float(calibration.disparity(np.array(depth))) for depth in reversed(_DEPTHS))
    for detection in detections:
        (top, first), (tall, wide) = detection.corner, detection.mask.shape
        box = (first, top, first + wide, top + tall)
        disparity[top : top + tall, first : first + wide] = match_sgbm(left, right, box, (far, near))
    return measure_pair(detections, left, right, calibration, "ellipse", disparity=disparity)


def count_by_length(frames: list[list[Sighting]], calibration: Calibration, length: float) -> float:
    """Stalks of a plot by those that its images show on each metre.

    Args:
        frames: Sightings of each pair.
        calibration: Calibration of the cameras.
        length: Length of the plot, m.
    """
    shares = []
    for sightings in frames:
        depths = [sighting.depth_m for sighting in sightings if sighting.depth_m is not None]
        if depths:
            extent = calibration.width / calibration.focal * float(np.median(depths))
            shares.append(len(sightings) / extent)
        else:
            shares.append(0.0)
    return length * float(np.mean(shares)) if shares else 0.0


def mean_widths(frames: list[list[Sighting]], owners: list[list[int | None]]) -> dict[int, float]:
    """Mean diameter in mm of each stalk, by its index, over the pairs in which it was identified and measured."""
    widths: dict[int, list[float]] = {}
    for sightings, names in zip(frames, owners):
        for sighting, name in zip(sightings, names):
            if name is not None and sighting.diameter_mm is not None:
                widths.setdefault(name, []).append(sighting.diameter_mm)
    return {name: float(np.mean(values)) for name, values in widths.items()}
