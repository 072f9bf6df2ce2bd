"""Stalks of the rows behind, which the sun lights, too, told from those of the row by dense stereo.

Windows of a stalk behind are narrow and show leaves before it: few match, and some by chance at depths within the row.
Semi-global matching (Hirschmüller, 2008) of small images takes a hundredth of a second, and says how far off most of it is.
"""

from collections.abc import Sequence

import cv2
import numpy as np

from jaxrl_vis.stalks.phenotyping.detector.finder import Detection
from jaxrl_vis.stalks.phenotyping.measure.stalk import DEPTHS
from jaxrl_vis.stalks.phenotyping.measure.stereo import match_sgbm
from jaxrl_vis.stalks.phenotyping.measure.width import fit_strip
from jaxrl_vis_envs.plants import Calibration

_WIDTH = 844  # pixels, of the small images
_BLOCK = 5  # pixels, of the small images
_FARTHEST = 8.0  # m
_BEHIND = 0.4  # m behind the row: nearer stalks may be of the row
_COLUMNS = np.linspace(0.25, 0.75, 7)  # fractions of a stalk's width: background shows through at its edges
_MIN_MATCHED = 0.15  # fraction of these points


def depths_behind(
    detections: Sequence[Detection],
    left: np.ndarray,
    right: np.ndarray,
    calibration: Calibration,
    row_depth: float | None,
    first_column: int = 0,
    disparity: np.ndarray | None = None,
) -> np.ndarray:
    """Measure the depths of stalks that stand behind the row.

    Args:
        detections: Detections in the left image, N.
        left, right: Rectified greyscale images [H, W] uint8.
        calibration: Calibration of the cameras.
        row_depth: Depth of the row, m; None if unknown.
        first_column: First column of the right image without a black border.
        disparity: Known disparities [H, W] float32 to use instead of matching, pixels; NaN where unknown. None to match.

    Returns:
        Median depth [N] float64, m, of each stalk of which more than half is behind the row; NaN for all others, and for those
        that would be outside the right image if they stood in the row.
    """
    depths = np.full(len(detections), np.nan)
    row_depth = DEPTHS[1] - _BEHIND if row_depth is None else row_depth
    bounds = calibration.disparity(np.array([_FARTHEST, row_depth + _BEHIND, row_depth, DEPTHS[0]]))
    if not detections or bounds[3] >= left.shape[1]:  # a baseline in centimetres: nothing near would be in both images
        return depths
    scale, dense = 1.0, disparity
    if dense is None:
        scale = min(_WIDTH / left.shape[1], 1.0)
        small_left, small_right = (
            cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) for image in (left, right)
        )
        box = (0, 0, small_left.shape[1], small_left.shape[0])
        dense = match_sgbm(small_left, small_right, box, (scale * bounds[0], scale * bounds[3]), _BLOCK) / scale
    for place, detection in enumerate(detections):
        strip = detection.strip or fit_strip(detection.mask)
        if strip is None or detection.box[0] - bounds[2] < first_column:
            continue
        rows = np.arange(strip.first, strip.last + 1.0, 1.0 / scale)
        begin, end = np.array([strip.edges(row) for row in rows]).T[..., None]
        columns = begin + (end - begin) * _COLUMNS + detection.corner[1]
        y, x = (scale * (rows[:, None] + detection.corner[0])).astype(int), (scale * columns).astype(int)
        values = dense[y.clip(0, dense.shape[0] - 1), x.clip(0, dense.shape[1] - 1)]
        matched = values[np.isfinite(values)]
        if matched.size >= _MIN_MATCHED * values.size and 2 * np.count_nonzero(matched < bounds[1]) > matched.size:
            depths[place] = calibration.depth(np.median(matched))
    return depths
