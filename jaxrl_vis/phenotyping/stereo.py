"""Disparity inside detections: how far to the left the right camera sees the same stalk, to a fraction of a pixel.

Only what lies in a detection is matched: matching all of a 9-megapixel pair takes 20 s on two cores, and one row of pixels in
twenty of a stalk says as much about its distance. Three ways:

    match_rows     one-dimensional: windows of a few lines of the stalk, compared at every whole disparity by normalised
                   cross-correlation; then a parabola through the best and its neighbours. The default.
    match_sgbm     OpenCV's semi-global matching of the detection's strip; what the thesis used, on the whole image.
    sample_rows    takes them from an image of disparities that somebody else computed.

The first two see a window as a whole at one depth, as a stalk nearly is, and leave windows out that look alike elsewhere or
nowhere.
"""

import dataclasses
import math

import cv2
import numpy as np

_LEAST_SCORE = 0.5
_AGREEING = 0.4
_SCATTER = 1.0  # pixels: windows that scatter by more do not see one stalk
_UNIQUE = 0.97  # a second peak of so much of the first one's height makes a window ambiguous


@dataclasses.dataclass(frozen=True)
class StalkDisparity:
    """Disparities of one stalk.

    Attributes:
        lines: [N] float64, middle line of each window that was matched.
        values: [N] float64, disparity there, pixels.
        scores: [N] float64, how alike both sides are, up to 1.
        tried: How many windows there were.
    """

    lines: np.ndarray
    values: np.ndarray
    scores: np.ndarray
    tried: int

    def at(self, line: float) -> tuple[float, float] | None:
        """Disparity in a line and its standard error, by a straight line through the windows that most agree with.

        Returns:
            Pixels; None where fewer than three windows agree, or less than 0.4 of those that were tried.
        """
        least = max(3, math.ceil(_AGREEING * self.tried))
        if self.lines.size < least:
            return None
        offset = self.lines - line
        first, second = np.triu_indices(self.lines.size, k=1)
        slope = float(np.median((self.values[second] - self.values[first]) / (self.lines[second] - self.lines[first])))
        rest = self.values - slope * offset
        middle = float(np.median(rest))
        spread = max(1.4826 * float(np.median(np.abs(rest - middle))), 0.05)
        good = np.abs(rest - middle) < 3.5 * min(spread, _SCATTER)
        if good.sum() < least:
            return None
        if good.sum() > 3:
            slope, _ = map(float, np.polyfit(offset[good], self.values[good], 1))
        remaining = self.values[good] - slope * offset[good]
        scatter = max(float(np.std(remaining)), 0.02)
        return float(np.mean(remaining)), scatter / math.sqrt(int(good.sum()))


def grey(image: np.ndarray) -> np.ndarray:
    """An image [H, W] or [H, W, 3] of any depth as [H, W] float32."""
    return (
        image.astype(np.float32) if image.ndim == 2 else image.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)
    )


def match_rows(
    left: np.ndarray,
    right: np.ndarray,
    lines: np.ndarray,
    edges: tuple[np.ndarray, np.ndarray],
    bounds: tuple[float, float],
    half_height: int = 8,
    core: float = 0.7,
    spread: int = 2,
) -> StalkDisparity:
    """Disparities of a stalk whose edges are known, window by window.

    Args:
        left, right: [H, W] grey float32, rectified; only the lines around ``lines`` are looked at.
        lines: [N] middle line of each window, whole numbers.
        edges: Columns [N] of the stalk's left and right edge in each of them.
        bounds: Least and greatest disparity, pixels.
        half_height: A window has twice as many lines and one.
        core: Share of the stalk's width that a window spans, in its middle: towards its edges a stalk is further away.
        spread: How many lines the right image may lie too low or too high.
    """
    found: list[tuple[float, float, float]] = []
    low, high = int(np.floor(bounds[0])), int(np.ceil(bounds[1]))
    for line, begin, end in zip(np.asarray(lines, int), *edges):
        margin = 0.5 * (1.0 - core) * (end - begin)
        first, last = int(np.ceil(begin + margin)), int(np.floor(end - margin)) + 1
        top, bottom = line - half_height, line + half_height + 1
        if last - first < 6 or top - spread < 0 or bottom + spread > left.shape[0] or first < 0 or last > left.shape[1]:
            continue
        begin_right, end_right = max(first - high - 1, 0), min(last - low + 1, right.shape[1])
        if end_right - begin_right < last - first + 2:
            continue
        window = np.ascontiguousarray(left[top:bottom, first:last])
        searched = np.ascontiguousarray(right[top - spread : bottom + spread, begin_right:end_right])
        score = cv2.matchTemplate(searched, window, cv2.TM_CCOEFF_NORMED)
        best = _peak(score)
        if best is None:
            continue
        column, height = best
        found.append((float(line), first - (begin_right + column), height))
    values = np.array(found, float).reshape(-1, 3)
    return StalkDisparity(values[:, 0], values[:, 1], values[:, 2], len(lines))


def sample_rows(
    disparity: np.ndarray,
    lines: np.ndarray,
    edges: tuple[np.ndarray, np.ndarray],
    bounds: tuple[float, float],
    core: float = 0.7,
) -> StalkDisparity:
    """Disparities of a stalk whose edges are known, out of an image of disparities.

    Args:
        disparity: [H, W] float32, pixels; not a number where there is none.
        lines: [N] whole numbers.
        edges: Columns [N] of the stalk's left and right edge in each of them.
        bounds: Least and greatest disparity, pixels.
        core: Share of the stalk's width that is looked at, in its middle.
    """
    found = []
    for line, begin, end in zip(np.asarray(lines, int), *edges):
        margin = 0.5 * (1.0 - core) * (end - begin)
        first, last = max(int(np.ceil(begin + margin)), 0), int(np.floor(end - margin)) + 1
        if not 0 <= line < disparity.shape[0] or last <= first:
            continue
        values = disparity[line, first:last]
        values = values[(values >= bounds[0]) & (values <= bounds[1])]  # not a number is neither
        if 2 * values.size >= last - first:
            found.append((float(line), float(np.median(values))))
    columns = np.array(found, float).reshape(-1, 2)
    return StalkDisparity(columns[:, 0], columns[:, 1], np.ones(len(columns)), len(lines))


def _peak(score: np.ndarray) -> tuple[float, float] | None:
    """Column to a fraction of a pixel, and height of the one clear peak of a correlation; None where there is none."""
    row, column = np.unravel_index(int(np.nanargmax(score)), score.shape)
    height = float(score[row, column])
    if not height >= _LEAST_SCORE or column in (0, score.shape[1] - 1):
        return None
    best = score.max(axis=0)
    away = np.abs(np.arange(best.size) - column) > 4
    if away.any() and float(best[away].max()) > _UNIQUE * height:
        return None
    before, after = float(score[row, column - 1]), float(score[row, column + 1])
    bend = before - 2.0 * height + after
    fraction = 0.0 if bend >= 0.0 else 0.5 * (before - after) / bend
    return float(column + np.clip(fraction, -0.5, 0.5)), height


def match_sgbm(left: np.ndarray, right: np.ndarray, box: tuple[int, int, int, int], bounds: tuple[float, float]) -> np.ndarray:
    """Disparities of all pixels of a box, by semi-global matching of the strip that the box spans.

    Args:
        left, right: [H, W] or [H, W, 3] uint8, rectified.
        box: First column and line, and one past the last ones.
        bounds: Least and greatest disparity, pixels.

    Returns:
        [h, w] float32, pixels; not a number where nothing matches.
    """
    first, top, last, bottom = box
    low = int(np.floor(bounds[0]))
    count = max(-(-(int(np.ceil(bounds[1])) - low + 1) // 16) * 16, 16)
    # SGBM looks to the left by up to its greatest disparity, so the strip begins so much further left.
    begin = max(first - low - count, 0)
    strips = [np.ascontiguousarray(image[top:bottom, begin:last]) for image in (left, right)]
    if strips[0].shape[1] <= low + count:
        pad = low + count + 1 - strips[0].shape[1]
        padding = [(0, 0), (pad, 0), (0, 0)][: strips[0].ndim]
        strips = [np.pad(strip, padding) for strip in strips]
    channels = 1 if strips[0].ndim == 2 else 3
    matcher = cv2.StereoSGBM_create(
        minDisparity=low,
        numDisparities=count,
        blockSize=7,
        P1=8 * channels * 49,
        P2=32 * channels * 49,
        disp12MaxDiff=1,
        uniquenessRatio=10,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    found = matcher.compute(*strips)[:, -(last - first) :].astype(np.float32) / 16.0
    return np.where(found >= low, found, np.nan)
