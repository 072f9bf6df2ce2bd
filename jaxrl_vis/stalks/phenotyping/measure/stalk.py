"""Measurement of one stalk in one stereo pair: from its mask and both images to its diameter, with error and confidence."""

import dataclasses
import math
from typing import Literal

import numpy as np

from jaxrl_vis.stalks.phenotyping.measure.diameter import diameter_mm, tilt_from_disparity
from jaxrl_vis.stalks.phenotyping.measure.edges import refine_edges
from jaxrl_vis.stalks.phenotyping.measure.ground import Ground
from jaxrl_vis.stalks.phenotyping.measure.stereo import StalkDisparity, match_rows, sample_rows
from jaxrl_vis.stalks.phenotyping.measure.width import Strip, ellipse_width, fit_strip, fit_strip_near, index_pairs, median
from jaxrl_vis_envs.plants import Calibration

Method = Literal["strip", "ellipse"]
DEPTHS = (0.5, 1.3)
"""Minimum and maximum depth of the stalks of a row, m."""
_WINDOWS = 16
_REACH = 0.025  # m along a stalk, within which edges are measured: sheaths and nodes beyond have no effect


@dataclasses.dataclass(frozen=True)
class Measurement:
    """Measurement of one stalk in one pair. Unknown numbers are NaN.

    Attributes:
        diameter_mm: Diameter perpendicular to the axis; None if it could not be measured, see ``reason``.
        deviation_mm: Standard error of the diameter from edges and disparity, mm, without effects of occlusion and sheaths.
        row: Row of the left image at which the stalk was measured, pixels.
        column: Column of the stalk's centre line in that row, pixels.
        width: Width perpendicular to the axis, pixels.
        disparity: Disparity in that row, pixels.
        depth: Planar depth of the front surface, m.
        height: Height of the measurement above the ground, m; NaN if no ground is known.
        lean, tilt: Angles of the stalk against the vertical of the image (positive to the right) and away from the camera, rad;
            the tilt is 0 if unknown or implausible.
        confidence: Confidence of the measurement, 0 to 1.
        both_edges_visible: True if both edges are visible around that image row. If False, the edges are extrapolated from the
            rest of the stalk, which is usually partially occluded.
        reason: Reason why the stalk could not be measured; empty if it was.
    """

    diameter_mm: float | None = None
    deviation_mm: float = math.nan
    row: float = math.nan
    column: float = math.nan
    width: float = math.nan
    disparity: float = math.nan
    depth: float = math.nan
    height: float = math.nan
    lean: float = math.nan
    tilt: float = 0.0
    confidence: float = 0.0
    both_edges_visible: bool = True
    reason: str = ""


def measure_stalk(
    mask: np.ndarray,
    corner: tuple[int, int],
    left: np.ndarray,
    right: np.ndarray,
    calibration: Calibration,
    row: float | None = None,
    depths: tuple[float, float] = DEPTHS,
    method: Method = "strip",
    ground: Ground | None = None,
    height: float | None = None,
    disparity: np.ndarray | None = None,
    strip: Strip | None = None,
) -> Measurement:
    """Measure a stalk; failures are returned as a `Measurement` with a ``reason``.

    Args:
        mask: Mask [h, w] of the stalk in a part of the left image, bool, or float32 from 0 to 1.
        corner: Image row and column of the first pixel of the mask.
        left, right: Rectified greyscale images [H, W], uint8 or float32.
        calibration: Calibration of the cameras, for images of this size.
        row: Image row at which to measure; None for the middle of the visible part.
        depths: Minimum and maximum depth of a stalk, m.
        method: ``strip``, or ``ellipse`` as in the thesis, which measures the width of the mask as a whole instead of at a row.
        ground: Ground plane, the reference for heights; None if unknown.
        height: Height above the ground at which to measure, m, or as near to it as both edges are visible. With both ``ground``
            and ``height``, ``row`` is ignored.
        disparity: Known disparities [H, W] float32 to use instead of matching, pixels; NaN where unknown. None to match.
        strip: Edges of the mask; None to fit them.
    """
    strip = fit_strip(mask) if strip is None else strip
    if strip is None:
        return Measurement(reason="too few lines show both edges")
    confidence = strip.confidence
    place = strip.reference if row is None else row - corner[0]
    far, near = (float(calibration.disparity(np.array(depth))) for depth in depths[::-1])
    matched = stalk_disparity(strip, corner, left, right, calibration, (far, near), disparity)
    if ground is not None and height is not None:
        place = _row_at_height(height, strip, corner, matched, calibration, ground)
    disparity_here = matched.at(place + corner[0])
    if disparity_here is None:
        return Measurement(row=place + corner[0], lean=strip.lean, reason="the right image does not show it clearly")
    shift, error = disparity_here
    depth = float(calibration.depth(np.array(shift)))
    if not depths[0] <= depth <= depths[1]:
        return Measurement(row=place + corner[0], depth=depth, lean=strip.lean, reason=f"it stands {depth:.2f} m away")
    reach = _REACH * calibration.focal / depth
    near = fit_strip_near(strip, place, reach, mask.shape[0])
    strip = refine_edges(near or strip, left, corner, place, reach)
    middle = 0.5 * sum(strip.edges(place))
    pixels = strip.width(place) if method == "strip" else ellipse_width(mask)
    if pixels is None:
        return Measurement(row=place + corner[0], lean=strip.lean, reason="no ellipse fits the mask")
    half = 0.5 * pixels / math.cos(strip.lean)
    edges = tuple((middle + corner[1] + side * half, place + corner[0]) for side in (-1.0, 1.0))
    tilt = _tilt(matched, shift, calibration)
    diameter = diameter_mm(calibration, edges[0], edges[1], depth, strip.lean, tilt)
    # Away from the middle of the visible part, the error of the slopes adds to that of the edges.
    span = max(strip.last - strip.first, 1)
    lever = math.sqrt(1.0 + 12.0 * ((place - strip.reference) / span) ** 2)
    relative = math.hypot(strip.deviation * lever / pixels, error / max(shift - calibration.offset, 1e-6))
    return Measurement(
        diameter_mm=diameter,
        deviation_mm=diameter * relative,
        row=place + corner[0],
        column=middle + corner[1],
        width=pixels,
        disparity=shift,
        depth=depth,
        height=math.nan if ground is None else ground.height(middle + corner[1], place + corner[0], depth, calibration),
        lean=strip.lean,
        tilt=tilt,
        confidence=confidence * min(matched.values.size / max(matched.window_count, 1), 1.0),
        both_edges_visible=near is not None or method == "ellipse",
    )


def _row_at_height(
    height: float, strip: Strip, corner: tuple[int, int], matched: StalkDisparity, calibration: Calibration, ground: Ground
) -> float:
    """Return the row of the mask with visible edges nearest to a height; the reference row if heights are unknown.

    Args:
        height: Height above the ground, m.
        strip: Edges of the stalk's mask.
        corner: Image row and column of the first pixel of the mask.
        matched: Disparities of the stalk.
        calibration: Calibration of the cameras.
        ground: Ground in front of the cameras.
    """
    ends = np.array([strip.first, strip.last], float)
    disparities = [matched.at(place + corner[0]) for place in ends]
    known = [disparity_here[0] for disparity_here in disparities if disparity_here is not None]
    if len(known) < 2 or ends[0] == ends[1]:
        return strip.reference
    depths = calibration.depth(np.array(known))
    heights = [
        ground.height(0.5 * sum(strip.edges(place)) + corner[1], place + corner[0], float(depth), calibration)
        for place, depth in zip(ends, depths)
    ]
    if not heights[0] > heights[1]:
        return strip.reference
    return float(np.interp(-height, [-height_here for height_here in heights], ends))


def stalk_disparity(
    strip: Strip,
    corner: tuple[int, int],
    left: np.ndarray,
    right: np.ndarray,
    calibration: Calibration,
    bounds: tuple[float, float],
    disparity: np.ndarray | None = None,
) -> StalkDisparity:
    """Match windows of a stalk, spread over the rows in which both edges are visible.

    Args:
        strip: Edges of the stalk's mask.
        corner: Image row and column of the first pixel of the mask.
        left, right: Rectified greyscale images [H, W], uint8 or float32.
        calibration: Calibration of the cameras.
        bounds: Minimum and maximum disparity, pixels.
        disparity: Known disparities [H, W] float32 to sample instead of matching, pixels; NaN where unknown. None to match.
    """
    half = max(round(8 * calibration.focal / 2168), 3)
    rows = np.unique(np.linspace(strip.first + half, max(strip.last - half, strip.first + half), _WINDOWS).round()).astype(int)
    edges = np.array([strip.edges(row) for row in rows]) + corner[1]
    if disparity is not None:
        return sample_rows(disparity, rows + corner[0], (edges[:, 0], edges[:, 1]), bounds)
    return match_rows(left, right, rows + corner[0], (edges[:, 0], edges[:, 1]), bounds, half)


def _tilt(matched: StalkDisparity, disparity: float, calibration: Calibration) -> float:
    """Return the tilt of the stalk away from the camera, rad; 0 if the matched segment is too short or the tilt implausible.

    Args:
        matched: Disparities of the stalk.
        disparity: Disparity at the row of the measurement, pixels.
        calibration: Calibration of the cameras.
    """
    if matched.rows.size < 6 or np.ptp(matched.rows) < 0.03 * calibration.focal:
        return 0.0
    first, second = index_pairs(matched.rows.size, 3)
    slopes = (matched.values[second] - matched.values[first]) / (matched.rows[second] - matched.rows[first])
    tilt = tilt_from_disparity(median(slopes), disparity, calibration)
    return tilt if abs(tilt) < math.radians(30.0) else 0.0
