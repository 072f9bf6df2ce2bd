"""Subpixel stereo disparity of detected stalks.

Only detections are matched: matching a whole 9-megapixel pair takes 20 s on two cores, and every twentieth row of a stalk is as
informative about its distance. Three methods:

    match_rows     one-dimensional: windows of a few rows of the stalk are compared at every integer disparity by normalised
                   cross-correlation, and refined by a parabola through the maximum and its neighbours. The default.
    match_sgbm     OpenCV's semi-global matching of a part of the images; the thesis applied it to whole images.
    sample_rows    samples a disparity image from another source.

`match_rows` assumes one depth per window, which nearly holds on a stalk, and rejects windows with an ambiguous match or none.
"""

import dataclasses
import math

import cv2
import numpy as np

from jaxrl_vis.stalks.phenotyping.measure.width import index_pairs, median

_MIN_SCORE = 0.5
_AGREEING = 0.4
_SCATTER = 1.0  # pixels: maximum scatter of the disparities of one stalk
_CORE = 0.7  # central fraction of a stalk's width that is matched: towards its edges a stalk is further away
_SPREAD = 2  # rows: tolerance for vertical misalignment of the right image, up or down
_COARSE_WINDOWS = 6  # windows of a stalk that are searched over all disparities
_BESIDE = 12  # pixels: search range of the other windows around the disparity expected from the first ones
_MAX_PEAK_RATIO = 0.97  # maximum ratio of the second to the first peak; above, a window is ambiguous


@dataclasses.dataclass(frozen=True)
class StalkDisparity:
    """Disparities of one stalk.

    Attributes:
        rows: [N] float64, centre row of each matched window.
        values: [N] float64, disparity of each, pixels.
        scores: [N] float64, normalised cross-correlation of each, up to 1; 1 for sampled disparities.
        window_count: Number of windows, including unmatched ones.
    """

    rows: np.ndarray
    values: np.ndarray
    scores: np.ndarray
    window_count: int

    def at(self, row: float) -> tuple[float, float] | None:
        """Estimate the disparity in an image row by a robust straight-line fit to the windows.

        Returns:
            Disparity and its standard error, pixels; None if there are fewer than three inliers, or fewer than 0.4 of the
            windows tried.
        """
        minimum = max(3, math.ceil(_AGREEING * self.window_count))
        if self.rows.size < minimum:
            return None
        offset = self.rows - row
        first, second = index_pairs(self.rows.size)
        slope = median((self.values[second] - self.values[first]) / (self.rows[second] - self.rows[first]))
        rest = self.values - slope * offset
        middle = median(rest)
        spread = max(1.4826 * median(np.abs(rest - middle)), 0.05)
        good = np.abs(rest - middle) < 3.5 * min(spread, _SCATTER)
        count = np.count_nonzero(good)
        if count < minimum:
            return None
        where, value = offset[good], self.values[good]
        if count > 3:
            centred = where - where.sum() / count
            slope = float(centred @ value) / float(centred @ centred)
        remaining = value - slope * where
        mean = float(remaining.sum()) / count
        scatter = max(math.sqrt(float(((remaining - mean) ** 2).sum()) / count), 0.02)
        return mean, scatter / math.sqrt(count)


def match_rows(
    left: np.ndarray,
    right: np.ndarray,
    rows: np.ndarray,
    edges: tuple[np.ndarray, np.ndarray],
    bounds: tuple[float, float],
    half_height: int = 8,
) -> StalkDisparity:
    """Match windows along a stalk with known edges.

    Args:
        left, right: Rectified greyscale images [H, W], uint8 or float32; only rows around ``rows`` are used.
        rows: Integer centre row [N] of each window.
        edges: Columns [N] of the stalk's left and right edge in each of these rows.
        bounds: Minimum and maximum disparity, pixels.
        half_height: Rows of a window above and below its centre row.

    Returns:
        Disparities of the windows with a unique match, in the order of ``rows``. Windows outside the image or narrower than
        six pixels are not matched.
    """
    wanted = [
        _Window(
            row,
            int(np.ceil(begin + 0.5 * (1.0 - _CORE) * (end - begin))),
            int(np.floor(end - 0.5 * (1.0 - _CORE) * (end - begin))) + 1,
        )
        for row, begin, end in zip(np.asarray(rows, int), *edges)
    ]
    wanted = [strip for strip in wanted if strip.is_inside(left.shape, half_height)]
    # A few windows are searched over all disparities. If these agree, the others are searched near the expected disparity.
    first = sorted(set(np.linspace(0, len(wanted) - 1, min(_COARSE_WINDOWS, len(wanted))).round().astype(int)))
    limits = int(np.floor(bounds[0])), int(np.ceil(bounds[1]))
    matches = {place: _match_window(left, right, wanted[place], limits, half_height) for place in first}
    expected = _robust_line([(wanted[place].row, result[0]) for place, result in matches.items() if result is not None])
    for place, window in enumerate(wanted):
        if place in matches:
            continue
        within = limits
        if expected is not None:
            middle = expected[0] + expected[1] * window.row
            within = max(math.floor(middle) - _BESIDE, limits[0]), min(math.ceil(middle) + _BESIDE, limits[1])
        matches[place] = _match_window(left, right, window, within, half_height) if within[0] < within[1] else None
    values = [(float(wanted[place].row), *result) for place, result in sorted(matches.items()) if result is not None]
    matched = np.array(values, float).reshape(-1, 3)
    return StalkDisparity(matched[:, 0], matched[:, 1], matched[:, 2], len(rows))


@dataclasses.dataclass(frozen=True)
class _Window:
    """Window of a stalk in the left image.

    Attributes:
        row: Centre row.
        first, last: First column, and end of the columns (exclusive).
    """

    row: int
    first: int
    last: int

    def is_inside(self, shape: tuple[int, ...], half_height: int) -> bool:
        """Return True if the window is at least 6 pixels wide and, with the margin for vertical misalignment, in the image.

        Args:
            shape: Height and width of the image.
            half_height: Rows of the window above and below its centre.
        """
        reach = half_height + _SPREAD
        tall = reach <= self.row and self.row + reach + 1 <= shape[0]
        return tall and self.last - self.first >= 6 and self.first >= 0 and self.last <= shape[1]


def _match_window(
    left: np.ndarray, right: np.ndarray, window: _Window, bounds: tuple[int, int], half_height: int
) -> tuple[float, float] | None:
    """Return the disparity (pixels) and correlation of a window; None without a match in the bounds, or if it is ambiguous.

    Args:
        left, right: Rectified greyscale images [H, W], uint8 or float32.
        window: Window of the left image.
        bounds: Minimum and maximum disparity, pixels.
        half_height: Rows of the window above and below its centre.
    """
    top, bottom = window.row - half_height, window.row + half_height + 1
    begin, end = max(window.first - bounds[1] - 1, 0), min(window.last - bounds[0] + 1, right.shape[1])
    if end - begin < window.last - window.first + 2:
        return None
    piece = np.ascontiguousarray(left[top:bottom, window.first : window.last])
    searched = np.ascontiguousarray(right[top - _SPREAD : bottom + _SPREAD, begin:end])
    best = _subpixel_peak(cv2.matchTemplate(searched, piece, cv2.TM_CCOEFF_NORMED))
    return None if best is None else (window.first - (begin + best[0]), best[1])


def _robust_line(matches: list[tuple[int, float]]) -> tuple[float, float] | None:
    """Fit a robust line to pairs (row, disparity) and return its offset, pixels, and slope, pixels per row.

    Return None unless at least three, and all but one, are inliers.
    """
    if len(matches) < 3:
        return None
    row, value = np.array(matches, float).T
    first, second = index_pairs(len(row))
    slope = median((value[second] - value[first]) / (row[second] - row[first]))
    rest = value - slope * row
    offset = median(rest)
    return (offset, slope) if (np.abs(rest - offset) < _SCATTER).sum() >= max(3, len(row) - 1) else None


def sample_rows(
    disparity: np.ndarray,
    rows: np.ndarray,
    edges: tuple[np.ndarray, np.ndarray],
    bounds: tuple[float, float],
) -> StalkDisparity:
    """Sample the disparities of a stalk with known edges from a disparity image: the median across the stalk in each row.

    Rows in which less than half of the used width has a disparity within the bounds are left out.

    Args:
        disparity: [H, W] float32, pixels; NaN where unknown.
        rows: Integer image rows [N].
        edges: Columns [N] of the stalk's left and right edge in each of these rows.
        bounds: Minimum and maximum disparity, pixels.
    """
    samples = []
    for row, begin, end in zip(np.asarray(rows, int), *edges):
        margin = 0.5 * (1.0 - _CORE) * (end - begin)
        first, last = max(int(np.ceil(begin + margin)), 0), int(np.floor(end - margin)) + 1
        if not 0 <= row < disparity.shape[0] or last <= first:
            continue
        values = disparity[row, first:last]
        values = values[(values >= bounds[0]) & (values <= bounds[1])]  # false for NaN
        if 2 * values.size >= last - first:
            samples.append((float(row), float(np.median(values))))
    columns = np.array(samples, float).reshape(-1, 2)
    return StalkDisparity(columns[:, 0], columns[:, 1], np.ones(len(columns)), len(rows))


def _subpixel_peak(score: np.ndarray) -> tuple[float, float] | None:
    """Return the subpixel column and the height of the unique peak of a correlation; None if there is none."""
    row, column = divmod(int(score.argmax()), score.shape[1])
    height = float(score[row, column])
    if not height >= _MIN_SCORE or column in (0, score.shape[1] - 1):
        return None
    best = score.max(axis=0)
    elsewhere = max(best[: max(column - 4, 0)].max(initial=-1.0), best[column + 5 :].max(initial=-1.0))
    if elsewhere > _MAX_PEAK_RATIO * height:
        return None
    before, after = float(score[row, column - 1]), float(score[row, column + 1])
    bend = before - 2.0 * height + after
    fraction = 0.0 if bend >= 0.0 else 0.5 * (before - after) / bend
    return column + min(max(fraction, -0.5), 0.5), height


def match_sgbm(
    left: np.ndarray, right: np.ndarray, box: tuple[int, int, int, int], bounds: tuple[float, float], block: int = 7
) -> np.ndarray:
    """Compute the disparities of all pixels of a box by semi-global matching.

    Args:
        left, right: Rectified images [H, W] or [H, W, 3] uint8.
        box: Left, top, right and bottom, pixels; right and bottom are exclusive.
        bounds: Minimum and maximum disparity, pixels.
        block: Height and width of the compared blocks, pixels.

    Returns:
        Disparities [h, w] float32, pixels; NaN where unmatched.
    """
    first, top, last, bottom = box
    low = int(np.floor(bounds[0]))
    count = max(-(-(int(np.ceil(bounds[1])) - low + 1) // 16) * 16, 16)
    # SGBM searches to the left up to the maximum disparity, so the strip is extended to the left by as much.
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
        blockSize=block,
        P1=8 * channels * block**2,
        P2=32 * channels * block**2,
        disp12MaxDiff=1,
        uniquenessRatio=10,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    disparity = matcher.compute(*strips)[:, -(last - first) :].astype(np.float32) / 16.0
    return np.where(disparity >= low, disparity, np.nan)
