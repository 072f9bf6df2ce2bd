"""Width of a stalk's mask in pixels, perpendicular to its axis: by its two edges (`fit_strip`) or by ellipses (thesis).

    mask -> left and right edge in each row, with subpixel precision        `row_edges`
         -> robust straight line fit to each edge                           `fit_strip`, locally `fit_strip_near`
         -> distance of the edges perpendicular to the axis, at any row     `Strip.width`

An ellipse is a poor model of a strip: its minor axis deviates from the width by -19 to +16 %, depending on the fit, see
benchmarks/stalks/strip_widths.py. Coordinates are in pixels, with (0, 0) at the centre of the first one.
"""

import dataclasses
import functools
import math

import cv2
import numpy as np

_MIN_ROWS = 8
_MIN_INSIDE = 0.5  # minimum value of a stalk's pixels in its mask
_CONVERGED = 1e-3  # change of weights below which the robust fit has converged
_MAX_EDGE_OFFSET = 0.12  # of the width: maximum distance of a local edge from the edge fitted to the whole stalk
_OUTLIER_DISTANCE = 1.5  # pixels: maximum distance of an edge from the mode of its neighbours
_NOISE = (
    0.35  # pixels: standard deviation of the edge of a perfect mask about its line (0.29, the rounding error, plus a margin)
)


@dataclasses.dataclass(frozen=True)
class Strip:
    """Straight edges fitted to the mask of a stalk: column = offset + slope * (row - reference).

    Attributes:
        reference: Mean row of the fit.
        left, right: Offset and slope of each edge.
        first, last: First and last inlier row.
        used: Fraction of the mask's rows in which both edges are inliers; the others are occluded, or show a node.
        residual: Root mean square distance of the inlier edge points from the fitted edges, pixels.
        deviation: Standard error of the width at the reference row, pixels.
        points: Rows [N] and columns of the left and right edge in each [N], outliers included.
    """

    reference: float
    left: tuple[float, float]
    right: tuple[float, float]
    first: int
    last: int
    used: float
    residual: float
    deviation: float
    points: tuple[np.ndarray, np.ndarray, np.ndarray] = dataclasses.field(repr=False, compare=False)

    @property
    def lean(self) -> float:
        """Angle between the axis and the vertical of the image, rad; positive if the stalk leans to the right."""
        return -math.atan(0.5 * (self.left[1] + self.right[1]))

    def edges(self, row: float | None = None) -> tuple[float, float]:
        """Return the columns of the left and right edges in a row; in the reference row if None."""
        offset = 0.0 if row is None else row - self.reference
        return self.left[0] + self.left[1] * offset, self.right[0] + self.right[1] * offset

    def width(self, row: float | None = None) -> float:
        """Return the width in pixels, perpendicular to the axis where it crosses a row; at the reference row if None."""
        left, right = self.edges(row)
        return (right - left) * math.cos(self.lean)

    @property
    def confidence(self) -> float:
        """Confidence from 0 to 1: the fraction of inlier rows, reduced if these are few or scattered."""
        rows = self.last - self.first + 1
        enough = min(rows / (2.0 * max(self.width(), 1.0)), 1.0)
        return self.used * enough / (1.0 + (self.residual / 1.5) ** 2)


def row_edges(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the left and right edge of the longest run in each row of a mask.

    Args:
        mask: [H, W] bool, or float32 from 0 to 1 for subpixel precision.

    Returns:
        Rows [N] int64, and the columns of their left and right edges [N] float64. Rows in which the longest run touches the
        left or right side of the mask are omitted: the stalk may extend beyond it.
    """
    soft = np.asarray(mask, np.float32)
    inside = soft >= _MIN_INSIDE
    padded = np.zeros((inside.shape[0], inside.shape[1] + 2), np.int8)
    padded[:, 1:-1] = inside
    change = np.diff(padded, axis=1)
    row, start = np.nonzero(change == 1)
    _, end = np.nonzero(change == -1)  # one past the last column of the run
    if not row.size:
        return np.zeros(0, np.int64), np.zeros(0), np.zeros(0)
    # The longest run of each row; the first one in case of ties.
    order = np.lexsort((start, start - end, row))
    first = np.concatenate([[True], np.diff(row[order]) > 0])
    row, start, end = (array[order][first] for array in (row, start, end))
    complete = (start > 0) & (end < soft.shape[1])
    row, start, end = row[complete], start[complete], end[complete]

    def crossing(outer: np.ndarray, inner: np.ndarray) -> np.ndarray:
        """Return the position between the inner and the outer pixel at which the mask crosses the threshold, 0 to 1."""
        out, within = soft[row, outer], soft[row, inner]
        return np.where(within > out, (within - _MIN_INSIDE) / np.maximum(within - out, 1e-6), 0.5)

    return row, start - crossing(start - 1, start), end - 1 + crossing(end, end - 1)


def fit_strip(mask: np.ndarray) -> Strip | None:
    """Fit two straight lines to the edges of a stalk's mask.

    Rows in which the stalk is partially occluded, swollen by a node, or cut off by the end of the strip are rejected as
    outliers. Unbiased for stalks that lean by up to 30 degrees, as the width is perpendicular to the axis instead of along the
    rows.

    Args:
        mask: Mask [H, W] of one stalk or a segment of it, more upright than horizontal; bool, or float32 from 0 to 1.

    Returns:
        Fitted strip; None if there are fewer than eight inlier rows.
    """
    return fit_edges(*row_edges(mask))


def fit_strip_near(strip: Strip, row: float, reach: float, height: int) -> Strip | None:
    """Fit the edges of a stalk locally around a row, so that sheaths elsewhere have no effect.

    Slopes are those of the whole strip, which are determined by many more rows.

    Args:
        strip: Strip of the whole mask.
        row: Row of the mask.
        reach: Distance above and below the row within which edges are used, pixels.
        height: Height of the mask.

    Returns:
        Local strip; None if fewer than half of the rows (or eight) are inliers, these do not enclose ``row``, or they are
        inconsistent with the rest of the stalk.
    """
    first, last = max(math.floor(row - reach), 0), min(math.ceil(row + reach) + 1, height)
    if last - first < _MIN_ROWS:
        return None
    begin, end = np.searchsorted(strip.points[0], (first, last))
    place, left, right = (array[begin:end] for array in strip.points)
    offset = place - strip.reference
    residuals = [edge - fit[0] - fit[1] * offset for edge, fit in zip((left, right), (strip.left, strip.right))]
    tolerance = max(3.0, _MAX_EDGE_OFFSET * strip.width(row))
    good = np.logical_and(*(np.abs(offsets) < tolerance for offsets in residuals))
    for offsets in residuals:
        good &= np.abs(offsets - _mode(offsets[good])) < _OUTLIER_DISTANCE if good.any() else False
    count = int(good.sum())
    if count < max(_MIN_ROWS, 0.5 * (last - first)) or not place[good].min() <= row <= place[good].max():
        return None
    moved = [float(offsets[good].mean()) for offsets in residuals]
    rms = float(np.sqrt(np.mean([np.var(offsets[good]) for offsets in residuals])))
    edges = [(edge + shift, fit[1]) for edge, shift, fit in zip(strip.edges(row), moved, (strip.left, strip.right))]
    return Strip(
        reference=row,
        left=edges[0],
        right=edges[1],
        first=int(place[good].min()),
        last=int(place[good].max()),
        used=count / (last - first),
        residual=rms,
        deviation=_deviation(rms, count),
        points=(place, left, right),
    )


def _deviation(rms: float, count: int) -> float:
    """Return the standard error of a width from ``count`` rows with edge residuals ``rms`` (0.05 or more), pixels."""
    return math.sqrt(2.0) * max(rms, 0.05) / math.sqrt(count)


def fit_edges(rows: np.ndarray, left: np.ndarray, right: np.ndarray) -> Strip | None:
    """Fit robust straight lines to edges found row by row.

    Args:
        rows: Rows [N], in ascending order.
        left, right: Columns [N] float64 of the edges.

    Returns:
        Fitted strip; None if there are fewer than eight inlier rows.
    """
    if rows.size < _MIN_ROWS:
        return None
    points, total = (rows, left, right), rows.size
    slope = _common_slope(rows, left, right)
    # Near the ends of a strip that is cut perpendicular to its axis, one of the edges in a row belongs to the cut. These rows
    # lie within the projected width of the first and last row.
    wide = median(right - left)
    cut = math.ceil(wide * abs(slope) / (1.0 + slope**2)) if abs(slope) > 0.01 else 0
    inner = (rows >= rows[0] + cut) & (rows <= rows[-1] - cut)
    if inner.sum() >= _MIN_ROWS:
        rows, left, right = rows[inner], left[inner], right[inner]
        total = rows.size
    reference = float(rows.mean())
    offset = rows - reference
    good = np.ones(rows.size, bool)
    lines: list[tuple[float, float]] = []
    scale = _NOISE
    for edge in (left, right):
        start = _mode(edge - slope * offset)
        weight = (np.abs(edge - slope * offset - start) < max(3.0, 0.08 * wide)).astype(float)
        for _ in range(12):
            heavy = weight > 0
            if np.count_nonzero(heavy) < _MIN_ROWS:
                return None
            fitted = _fit_line(offset, edge, weight)
            residual = edge - fitted[0] - fitted[1] * offset
            spread = 1.4826 * median(np.abs(residual[heavy]))
            reach = 4.7 * max(spread, _NOISE / 2)
            before, weight = weight, np.maximum(1.0 - (residual / reach) ** 2, 0.0) ** 2
            if np.abs(weight - before).max() < _CONVERGED:
                break
        good &= weight > 0
        lines.append(fitted)
        scale = max(scale, spread)
    if good.sum() < _MIN_ROWS:
        return None
    # Use the same rows for both edges, so that an occlusion of one edge tilts neither.
    fits = [_fit_line(offset, edge, good.astype(float)) for edge in (left, right)]
    residuals = np.concatenate([edge - fit[0] - fit[1] * offset for edge, fit in zip((left, right), fits)])[np.tile(good, 2)]
    rms = float(np.sqrt(np.mean(residuals**2)))
    return Strip(
        reference=reference,
        left=fits[0],
        right=fits[1],
        first=int(rows[good].min()),
        last=int(rows[good].max()),
        used=float(good.sum()) / total,
        residual=rms,
        deviation=_deviation(rms, int(good.sum())),
        points=points,
    )


def _common_slope(rows: np.ndarray, left: np.ndarray, right: np.ndarray) -> float:
    """Estimate the common slope of both edges, columns per row: the mode over pairs of edge points.

    Args:
        rows: Rows [N], in ascending order.
        left, right: Columns [N] of the edges in these rows, pixels.
    """
    step = max(rows.size // 60, 1)
    places = np.arange(0, rows.size, step)
    first, second = index_pairs(places.size, max(places.size // 4, 1))
    first, second = places[first], places[second]
    gap = (rows[second] - rows[first]).astype(float)
    slopes = np.concatenate([(edge[second] - edge[first]) / gap for edge in (left, right)])
    return _mode(slopes, 0.02)


@functools.lru_cache(maxsize=512)
def index_pairs(count: int, min_difference: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Return all pairs of indices below ``count`` that differ by ``min_difference`` or more: lower and upper ones, [P] each."""
    return np.triu_indices(count, k=min_difference)


def median(values: np.ndarray) -> float:
    """Return the median of a few values [N], N >= 1; many times faster than `np.median` for small arrays."""
    ordered = np.sort(values)
    half = len(ordered) // 2
    return float(ordered[half]) if len(ordered) % 2 else 0.5 * float(ordered[half - 1] + ordered[half])


def _mode(values: np.ndarray, width: float = 1.0) -> float:
    """Estimate the mode: the median of the interval of length ``width`` with the most values, even if these are a minority."""
    ordered = np.sort(values)
    upper = np.searchsorted(ordered, ordered + width, side="right")
    best = int(np.argmax(upper - np.arange(ordered.size)))
    return median(ordered[best : upper[best]])


def _fit_line(x: np.ndarray, y: np.ndarray, weight: np.ndarray) -> tuple[float, float]:
    """Fit y = offset + slope * x to points [N] by least squares with weights [N]; the slope is 0 if all x are equal."""
    total = weight.sum()
    mean_x, mean_y = (weight * x).sum() / total, (weight * y).sum() / total
    spread = (weight * (x - mean_x) ** 2).sum()
    slope = (weight * (x - mean_x) * (y - mean_y)).sum() / spread if spread > 0 else 0.0
    return float(mean_y - slope * mean_x), float(slope)


def ellipse_width(mask: np.ndarray) -> float | None:
    """Compute the width as in the thesis: the largest minor axis of ellipses fitted to the blobs of the mask by least squares.

    Args:
        mask: [H, W] bool, or float32 from 0 to 1.

    Returns:
        Width in pixels; None if no blob of 20 pixels or more has a valid ellipse. Ellipses wider than a blob of that area and
        length can be, as OpenCV returns for some nearly collinear points, are rejected.
    """
    inside = (np.asarray(mask, np.float32) >= 0.5).astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(inside, connectivity=8)
    widths = []
    for label in range(1, count):
        area = int(stats[label, cv2.CC_STAT_AREA])
        if area < 20:
            continue
        row, column = np.nonzero(labels == label)
        width = float(min(cv2.fitEllipse(np.stack([column, row], axis=1).astype(np.float32))[1]))
        length = math.hypot(stats[label, cv2.CC_STAT_WIDTH], stats[label, cv2.CC_STAT_HEIGHT])
        if math.isfinite(width) and 1.0 < width < 3.0 * area / max(length / math.sqrt(2.0), 1.0):
            widths.append(width)
    return max(widths, default=None)
