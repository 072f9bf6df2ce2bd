"""One stalk of one pair: from its mask and both images to its diameter in millimetres, with what speaks for and against it."""

import dataclasses
import math
from typing import Literal

import numpy as np

from jaxrl_vis.stalks.phenotyping.measure.diameter import diameter_mm, edge_tilt
from jaxrl_vis.stalks.phenotyping.measure.edges import refine_edges
from jaxrl_vis.stalks.phenotyping.measure.ground import Ground
from jaxrl_vis.stalks.phenotyping.measure.stereo import StalkDisparity, match_rows, sample_rows
from jaxrl_vis.stalks.phenotyping.measure.width import Strip, ellipse_width, index_pairs, median, strip_near, strip_width
from jaxrl_vis_envs.plants import Calibration

Method = Literal["strip", "ellipse"]
DEPTHS = (0.5, 1.3)
"""Least and greatest depth at which the stalks of a row stand, m."""
_WINDOWS = 16
_REACH = 0.025  # m along a stalk: sheaths and nodes further away do not matter


@dataclasses.dataclass(frozen=True)
class Measurement:
    """Measurement of one stalk in one pair.

    Attributes:
        diameter_mm: Across its axis; None where it could not be measured, and `reason` says why.
        deviation_mm: Its standard error, as far as edges and disparity tell; hidden parts and sheaths are not in it.
        line: Line of the left image where the stalk was measured, pixels.
        column: Column of its middle there, pixels.
        width: Across its axis, pixels.
        disparity: There, pixels.
        depth: Planar depth of its front, m.
        height: Height of the place above the ground, m; not a number where no ground is known.
        lean, tilt: Against the image's vertical and away from the camera, rad.
        confidence: 0 to 1.
        here: Both edges are visible around that line; if not, they are those of the rest of the stalk, which
            is mostly partly hidden then.
        reason: Empty where the stalk was measured.
    """

    diameter_mm: float | None = None
    deviation_mm: float = math.nan
    line: float = math.nan
    column: float = math.nan
    width: float = math.nan
    disparity: float = math.nan
    depth: float = math.nan
    height: float = math.nan
    lean: float = math.nan
    tilt: float = 0.0
    confidence: float = 0.0
    here: bool = True
    reason: str = ""


def measure(
    mask: np.ndarray,
    corner: tuple[int, int],
    left: np.ndarray,
    right: np.ndarray,
    calibration: Calibration,
    line: float | None = None,
    depths: tuple[float, float] = DEPTHS,
    method: Method = "strip",
    ground: Ground | None = None,
    height: float | None = None,
    disparity: np.ndarray | None = None,
    strip: Strip | None = None,
) -> Measurement:
    """Measure a stalk.

    Args:
        mask: [h, w] bool, or float32 from 0 to 1: of the stalk, in a part of the left image.
        corner: Line and column of the mask's first pixel in the image.
        left, right: [H, W] grey, uint8 or float32, rectified.
        calibration: Calibration of the cameras, for images of this size.
        line: Line of the image at which to measure; the middle of the visible part if not given.
        depths: Least and greatest depth at which a stalk may stand, m.
        method: ``strip``, or ``ellipse`` as in the thesis, which measures the mask as a whole and not at a line.
        ground: Origin of heights.
        height: Height at which to measure, m above the ground, if it is known: there, or as near to it as both edges are
            visible; ``line`` does not matter then.
        disparity: [H, W] float32, disparities that are known, in place of those that are matched; pixels, not a number where
            there is none.
        strip: The mask's edges, if they are known.
    """
    strip = strip_width(mask) if strip is None else strip
    if strip is None:
        return Measurement(reason="too few lines show both edges")
    confidence = strip.confidence
    place = strip.reference if line is None else line - corner[0]
    matched = _disparity(strip, corner, left, right, calibration, depths, disparity)
    if ground is not None and height is not None:
        place = _place_at(height, strip, corner, matched, calibration, ground)
    disparity_here = matched.at(place + corner[0])
    if disparity_here is None:
        return Measurement(line=place + corner[0], lean=strip.lean, reason="the right image does not show it clearly")
    beside, error = disparity_here
    depth = float(calibration.depth(np.array(beside)))
    if not depths[0] <= depth <= depths[1]:
        return Measurement(line=place + corner[0], depth=depth, lean=strip.lean, reason=f"it stands {depth:.2f} m away")
    reach = _REACH * calibration.focal / depth
    near = strip_near(strip, place, reach, mask.shape[0])
    strip = refine_edges(near or strip, left, corner, place, reach)
    middle = 0.5 * sum(strip.edges(place))
    pixels = strip.width(place) if method == "strip" else ellipse_width(mask)
    if pixels is None:
        return Measurement(line=place + corner[0], lean=strip.lean, reason="no ellipse fits the mask")
    half = 0.5 * pixels / math.cos(strip.lean)
    edges = tuple((middle + corner[1] + side * half, place + corner[0]) for side in (-1.0, 1.0))
    tilt = _tilt(matched, beside, calibration)
    diameter = diameter_mm(calibration, edges[0], edges[1], depth, strip.lean, tilt)
    # Towards the ends of what was seen, and beyond, slopes add to the error of the edges.
    span = max(strip.last - strip.first, 1)
    lever = math.sqrt(1.0 + 12.0 * ((place - strip.reference) / span) ** 2)
    relative = math.hypot(strip.deviation * lever / pixels, error / max(beside - calibration.offset, 1e-6))
    return Measurement(
        diameter_mm=diameter,
        deviation_mm=diameter * relative,
        line=place + corner[0],
        column=middle + corner[1],
        width=pixels,
        disparity=beside,
        depth=depth,
        height=math.nan if ground is None else ground.height(middle + corner[1], place + corner[0], depth, calibration),
        lean=strip.lean,
        tilt=tilt,
        confidence=confidence * min(matched.values.size / max(matched.tried, 1), 1.0),
        here=near is not None or method == "ellipse",
    )


def _place_at(
    height: float, strip: Strip, corner: tuple[int, int], matched: StalkDisparity, calibration: Calibration, ground: Ground
) -> float:
    """Line of the mask at which a stalk is so high above the ground, m, or the nearest one in which its edges are seen."""
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


def _disparity(
    strip: Strip,
    corner: tuple[int, int],
    left: np.ndarray,
    right: np.ndarray,
    calibration: Calibration,
    depths: tuple[float, float],
    disparity: np.ndarray | None,
) -> StalkDisparity:
    """Disparities of a stalk that stands between two depths in m."""
    far, near = (float(calibration.disparity(np.array(depth))) for depth in (depths[1], depths[0]))
    return stalk_disparity(strip, corner, left, right, calibration, (far, near), disparity)


def stalk_disparity(
    strip: Strip,
    corner: tuple[int, int],
    left: np.ndarray,
    right: np.ndarray,
    calibration: Calibration,
    bounds: tuple[float, float],
    disparity: np.ndarray | None = None,
) -> StalkDisparity:
    """Match windows of a stalk that are spread over the lines in which both edges are seen.

    Args:
        strip: Edges of the stalk's mask.
        corner: Line and column of the mask's first pixel in the image.
        left, right: [H, W] grey, uint8 or float32, rectified.
        calibration: Calibration of the cameras.
        bounds: Least and greatest disparity, pixels.
        disparity: [H, W] float32, disparities that are known, in place of those that are matched.
    """
    half = max(round(8 * calibration.focal / 2168), 3)
    lines = np.unique(np.linspace(strip.first + half, max(strip.last - half, strip.first + half), _WINDOWS).round()).astype(int)
    edges = np.array([strip.edges(line) for line in lines]) + corner[1]
    if disparity is not None:
        return sample_rows(disparity, lines + corner[0], (edges[:, 0], edges[:, 1]), bounds)
    return match_rows(left, right, lines + corner[0], (edges[:, 0], edges[:, 1]), bounds, half)


def _tilt(matched: StalkDisparity, disparity: float, calibration: Calibration) -> float:
    """Return the lean of the stalk away from the camera; 0 if too short a piece of it was matched to tell."""
    if matched.lines.size < 6 or np.ptp(matched.lines) < 0.03 * calibration.focal:
        return 0.0
    first, second = index_pairs(matched.lines.size, 3)
    slopes = (matched.values[second] - matched.values[first]) / (matched.lines[second] - matched.lines[first])
    tilt = edge_tilt(median(slopes), disparity, calibration)
    return tilt if abs(tilt) < math.radians(30.0) else 0.0
