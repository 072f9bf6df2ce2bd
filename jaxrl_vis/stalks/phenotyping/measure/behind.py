"""Stalks of the rows behind, which the sun lights, too, told from those of the row by dense stereo.

Windows of a stalk behind are narrow and show leaves before it: few match, and some by chance at depths within the row.
Semi-global matching (Hirschmüller, 2008) of small images takes a hundredth of a second, and says how far off most of it is.
"""

import math
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
_MIN_CORRELATION = 0.65  # of a stalk that the right image would not show if it stood in the row, with what it was matched with


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
        Median depth [N] float64, m, of each stalk of which more than half is behind the row; NaN for all others. What the right
        image would not show if it stood in the row would be matched with something else then, so it must also resemble that.
    """
    depths = np.full(len(detections), np.nan)
    row_depth = DEPTHS[1] - _BEHIND if row_depth is None else row_depth
    bounds = calibration.disparity(np.array([_FARTHEST, row_depth + _BEHIND, row_depth, DEPTHS[0]]))
    if not detections or bounds[3] >= left.shape[1]:  # a baseline in centimetres: nothing near would be in both images
        return depths
    scale = min(_WIDTH / left.shape[1], 1.0) if disparity is None else 1.0
    left, right = (cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) for image in (left, right))
    dense = _match_to_border(left, right, scale * bounds[[0, 3]], scale * first_column) if disparity is None else disparity
    for place, detection in enumerate(detections):
        strip = detection.strip or fit_strip(detection.mask)
        if strip is None:
            continue
        rows = np.arange(strip.first, strip.last + 1.0, 1.0 / scale)
        begin, end = np.array([strip.edges(row) for row in rows]).T[..., None]
        columns = scale * (begin + (end - begin) * _COLUMNS + detection.corner[1])
        rows = np.broadcast_to(scale * (rows[:, None] + detection.corner[0]), columns.shape)
        values = dense[rows.astype(int).clip(0, dense.shape[0] - 1), columns.astype(int).clip(0, dense.shape[1] - 1)]
        matched = values[np.isfinite(values)]
        nearest = scale * bounds[1]
        if matched.size < _MIN_MATCHED * values.size or 2 * np.count_nonzero(matched < nearest) <= matched.size:
            continue
        median = float(np.median(matched))
        is_in_view = detection.box[0] - bounds[2] >= first_column
        if is_in_view or _correlation(left, right, columns, rows, median) >= _MIN_CORRELATION:
            depths[place] = calibration.depth(np.array(median / scale))
    return depths


def _match_to_border(left: np.ndarray, right: np.ndarray, bounds: np.ndarray, first_column: float) -> np.ndarray:
    """Match two images up to the left border.

    Args:
        left, right: Rectified greyscale images [H, W] uint8.
        bounds: Minimum and maximum disparity [2] float64, pixels.
        first_column: First column of the right image without a black border.

    Returns:
        Disparities [H, W] float32, pixels; NaN where unmatched or where the right image does not show it.
    """
    # SGBM leaves out columns from which the maximum disparity, in steps of 16, leads out of the image.
    margin = math.ceil(bounds[1]) + 16
    padded = [cv2.copyMakeBorder(image, 0, 0, margin, 0, cv2.BORDER_CONSTANT) for image in (left, right)]
    box = (margin, 0, padded[0].shape[1], padded[0].shape[0])
    disparities = match_sgbm(padded[0], padded[1], box, (bounds[0], bounds[1]), _BLOCK)
    return np.where(np.arange(left.shape[1]) - disparities >= first_column, disparities, np.nan)


def _correlation(left: np.ndarray, right: np.ndarray, columns: np.ndarray, rows: np.ndarray, disparity: float) -> float:
    """Return the correlation of points [M, N] in the left image with those at a disparity in the right one; NaN if constant."""
    y = rows.astype(np.float32)
    values = [
        cv2.remap(image, x.astype(np.float32), y, cv2.INTER_LINEAR).ravel()
        for image, x in ((left, columns), (right, columns - disparity))
    ]
    with np.errstate(divide="ignore", invalid="ignore"):
        return float(np.corrcoef(values[0], values[1])[0, 1])
