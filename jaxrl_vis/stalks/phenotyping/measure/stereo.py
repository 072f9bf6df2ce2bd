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

from jaxrl_vis.stalks.phenotyping.measure.width import index_pairs, median

_MIN_SCORE = 0.5
_AGREEING = 0.4
_SCATTER = 1.0  # pixels: windows that scatter by more do not see one stalk
_FIRST = 6  # windows of a stalk that are looked for at every disparity
_BESIDE = 12  # pixels: how far beside what they say the others are looked for
_UNIQUE = 0.97  # a second peak of so much of the first one's height makes a window ambiguous


@dataclasses.dataclass(frozen=True)
class StalkDisparity:
    """Disparities of one stalk.

    Attributes:
        lines: [N] float64, middle line of each window that was matched.
        values: [N] float64, disparity there, pixels.
        scores: [N] float64, how alike both sides are, up to 1.
        tried: Number of windows.
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
        first, second = index_pairs(self.lines.size)
        slope = median((self.values[second] - self.values[first]) / (self.lines[second] - self.lines[first]))
        rest = self.values - slope * offset
        middle = median(rest)
        spread = max(1.4826 * median(np.abs(rest - middle)), 0.05)
        good = np.abs(rest - middle) < 3.5 * min(spread, _SCATTER)
        count = np.count_nonzero(good)
        if count < least:
            return None
        where, value = offset[good], self.values[good]
        if count > 3:
            beside = where - where.sum() / count
            slope = float(beside @ value) / float(beside @ beside)
        remaining = value - slope * where
        mean = float(remaining.sum()) / count
        scatter = max(math.sqrt(float(((remaining - mean) ** 2).sum()) / count), 0.02)
        return mean, scatter / math.sqrt(count)


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
        left, right: [H, W] grey, uint8 or float32, rectified; only the lines around ``lines`` are looked at.
        lines: [N] middle line of each window, whole numbers.
        edges: Columns [N] of the stalk's left and right edge in each of them.
        bounds: Least and greatest disparity, pixels.
        half_height: A window has twice as many lines and one.
        core: Share of the stalk's width that a window spans, in its middle: towards its edges a stalk is further away.
        spread: Number of lines that the right image may lie too low or too high.
    """
    wanted = [
        _Window(
            line,
            int(np.ceil(begin + 0.5 * (1.0 - core) * (end - begin))),
            int(np.floor(end - 0.5 * (1.0 - core) * (end - begin))) + 1,
        )
        for line, begin, end in zip(np.asarray(lines, int), *edges)
    ]
    wanted = [strip for strip in wanted if strip.inside(left.shape, half_height, spread)]
    # A few windows are looked for wherever they may be. Where they agree, the others are looked for near to where that says.
    first = sorted(set(np.linspace(0, len(wanted) - 1, min(_FIRST, len(wanted))).round().astype(int)))
    whole = int(np.floor(bounds[0])), int(np.ceil(bounds[1]))
    matches = {place: _match(left, right, wanted[place], whole, half_height, spread) for place in first}
    expected = _agreed([(wanted[place].line, result[0]) for place, result in matches.items() if result is not None])
    for place, window in enumerate(wanted):
        if place in matches:
            continue
        within = whole
        if expected is not None:
            middle = expected[0] + expected[1] * window.line
            within = max(math.floor(middle) - _BESIDE, whole[0]), min(math.ceil(middle) + _BESIDE, whole[1])
        matches[place] = _match(left, right, window, within, half_height, spread) if within[0] < within[1] else None
    values = [(float(wanted[place].line), *result) for place, result in sorted(matches.items()) if result is not None]
    matched = np.array(values, float).reshape(-1, 3)
    return StalkDisparity(matched[:, 0], matched[:, 1], matched[:, 2], len(lines))


@dataclasses.dataclass(frozen=True)
class _Window:
    """A piece of a stalk: its middle line, its first column and the one past its last."""

    line: int
    first: int
    last: int

    def inside(self, shape: tuple[int, ...], half_height: int, spread: int) -> bool:
        """Return True if it is wide enough, and the image holds it and the lines around it that the right image may need."""
        reach = half_height + spread
        tall = reach <= self.line and self.line + reach + 1 <= shape[0]
        return tall and self.last - self.first >= 6 and self.first >= 0 and self.last <= shape[1]


def _match(
    left: np.ndarray, right: np.ndarray, window: _Window, within: tuple[int, int], half_height: int, spread: int
) -> tuple[float, float] | None:
    """Disparity of a window and how alike both sides are; None where nothing within the bounds is alike, or too much."""
    top, bottom = window.line - half_height, window.line + half_height + 1
    begin, end = max(window.first - within[1] - 1, 0), min(window.last - within[0] + 1, right.shape[1])
    if end - begin < window.last - window.first + 2:
        return None
    piece = np.ascontiguousarray(left[top:bottom, window.first : window.last])
    searched = np.ascontiguousarray(right[top - spread : bottom + spread, begin:end])
    best = _peak(cv2.matchTemplate(searched, piece, cv2.TM_CCOEFF_NORMED))
    return None if best is None else (window.first - (begin + best[0]), best[1])


def _agreed(matches: list[tuple[int, float]]) -> tuple[float, float] | None:
    """Offset and slope of the line through most of some (line, disparity); None unless at least three agree."""
    if len(matches) < 3:
        return None
    line, value = np.array(matches, float).T
    first, second = index_pairs(len(line))
    slope = median((value[second] - value[first]) / (line[second] - line[first]))
    rest = value - slope * line
    offset = median(rest)
    return (offset, slope) if (np.abs(rest - offset) < _SCATTER).sum() >= max(3, len(line) - 1) else None


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
    samples = []
    for line, begin, end in zip(np.asarray(lines, int), *edges):
        margin = 0.5 * (1.0 - core) * (end - begin)
        first, last = max(int(np.ceil(begin + margin)), 0), int(np.floor(end - margin)) + 1
        if not 0 <= line < disparity.shape[0] or last <= first:
            continue
        values = disparity[line, first:last]
        values = values[(values >= bounds[0]) & (values <= bounds[1])]  # not a number is neither
        if 2 * values.size >= last - first:
            samples.append((float(line), float(np.median(values))))
    columns = np.array(samples, float).reshape(-1, 2)
    return StalkDisparity(columns[:, 0], columns[:, 1], np.ones(len(columns)), len(lines))


def _peak(score: np.ndarray) -> tuple[float, float] | None:
    """Column to a fraction of a pixel, and height of the one clear peak of a correlation; None where there is none."""
    row, column = divmod(int(score.argmax()), score.shape[1])
    height = float(score[row, column])
    if not height >= _MIN_SCORE or column in (0, score.shape[1] - 1):
        return None
    best = score.max(axis=0)
    elsewhere = max(best[: max(column - 4, 0)].max(initial=-1.0), best[column + 5 :].max(initial=-1.0))
    if elsewhere > _UNIQUE * height:
        return None
    before, after = float(score[row, column - 1]), float(score[row, column + 1])
    bend = before - 2.0 * height + after
    fraction = 0.0 if bend >= 0.0 else 0.5 * (before - after) / bend
    return column + min(max(fraction, -0.5), 0.5), height


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
    disparity = matcher.compute(*strips)[:, -(last - first) :].astype(np.float32) / 16.0
    return np.where(disparity >= low, disparity, np.nan)
