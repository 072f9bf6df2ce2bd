"""Width of a stalk's mask in pixels, across its axis: by its two edges (`strip_width`), or by ellipses as in the thesis.

    mask -> left and right edge in each line, to a fraction of a pixel      `line_edges`
         -> one straight line through each, deaf to outliers                `strip_width`, near one line `strip_near`
         -> their distance across the axis, at any line                     `Strip.width`

An ellipse is no strip: its minor axis misses the width of one by -19 to +16 %, depending on how it is fitted, see
benchmarks/stalks/strip_widths.py. Columns and lines are pixels, with (0, 0) in the middle of the first one.
"""

import dataclasses
import functools
import math
from typing import Literal

import cv2
import numpy as np

EllipseFit = Literal["pixels", "pixels_direct", "contour", "contour_direct", "contour_ams", "moments"]
ELLIPSE_FITS: tuple[EllipseFit, ...] = ("pixels", "pixels_direct", "contour", "contour_direct", "contour_ams", "moments")
"""Ways to fit an ellipse to a blob. ``pixels``, least squares over all its pixels, is what the thesis describes."""

_LEAST_LINES = 8
_SETTLED = 1e-3  # weights that change by less are those that they would become
_SWELLING = 0.12  # of the width: by how much an edge may lie beside that of the rest of a stalk
_STEP = 1.5  # pixels: an edge that lies further beside the others of its neighbourhood belongs to something else
_NOISE = (
    0.35  # pixels: how far an edge of a perfect mask lies from the line through it (0.29, the error of rounding, and some more)
)


@dataclasses.dataclass(frozen=True)
class Strip:
    """A stalk as the two straight edges of its mask: column = offset + slope * (line - reference).

    Attributes:
        reference: Middle line of those that were used.
        left, right: Offset and slope of each edge.
        first, last: First and last line that was used.
        used: Share of the mask's lines whose two edges both lie on the fitted ones; what is missing is hidden, or a node.
        residual: Root mean square distance of used edges from the fitted ones, pixels.
        deviation: Standard error of the width at the reference line, pixels.
        points: Lines [N] and columns of the left and right edge in each [N], which all of it was made of.
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
        """Angle between the axis and the image's vertical, rad; positive where the stalk leans to the right."""
        return -math.atan(0.5 * (self.left[1] + self.right[1]))

    def edges(self, line: float | None = None) -> tuple[float, float]:
        """Columns of both edges in a line; in the reference line if none is given."""
        offset = 0.0 if line is None else line - self.reference
        return self.left[0] + self.left[1] * offset, self.right[0] + self.right[1] * offset

    def width(self, line: float | None = None) -> float:
        """Width across the axis where the axis crosses a line, pixels; at the reference line if none is given."""
        left, right = self.edges(line)
        return (right - left) * math.cos(self.lean)

    @property
    def confidence(self) -> float:
        """0 to 1: the share of lines that agree, less where they are few or scatter."""
        lines = self.last - self.first + 1
        enough = min(lines / (2.0 * max(self.width(), 1.0)), 1.0)
        return self.used * enough / (1.0 + (self.residual / 1.5) ** 2)


def line_edges(mask: np.ndarray, threshold: float = 0.5) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Left and right edge of the longest run in each line of a mask.

    Args:
        mask: [H, W] bool, or float32 from 0 to 1, whose edges are found to a fraction of a pixel.
        threshold: What belongs to the stalk.

    Returns:
        Lines [N] int64, and the columns of their left and right edges [N] float64. Lines in which a run touches the image's
        left or right side are left out: the stalk goes on there.
    """
    soft = np.asarray(mask, np.float32)
    inside = soft >= threshold
    padded = np.zeros((inside.shape[0], inside.shape[1] + 2), np.int8)
    padded[:, 1:-1] = inside
    change = np.diff(padded, axis=1)
    line, start = np.nonzero(change == 1)
    _, end = np.nonzero(change == -1)  # one past the last column of the run
    if not line.size:
        return np.zeros(0, np.int64), np.zeros(0), np.zeros(0)
    # The longest run of each line, and of equally long ones the first.
    order = np.lexsort((start, start - end, line))
    first = np.concatenate([[True], np.diff(line[order]) > 0])
    line, start, end = (each[order][first] for each in (line, start, end))
    whole = (start > 0) & (end < soft.shape[1])
    line, start, end = line[whole], start[whole], end[whole]

    def crossing(outer: np.ndarray, inner: np.ndarray) -> np.ndarray:
        """How far from the inner pixel towards the outer one the mask passes the threshold, 0 to 1."""
        out, within = soft[line, outer], soft[line, inner]
        return np.where(within > out, (within - threshold) / np.maximum(within - out, 1e-6), 0.5)

    return line, start - crossing(start - 1, start), end - 1 + crossing(end, end - 1)


def strip_width(mask: np.ndarray, threshold: float = 0.5) -> Strip | None:
    """The edges of a stalk's mask as two straight lines.

    Lines in which the stalk is partly hidden, swollen by a node, or cut off by the end of the strip do not count. Unbiased for
    stalks that lean by up to 30 degrees: the width is taken across the axis, not along the image's lines.

    Args:
        mask: [H, W] bool, or float32 from 0 to 1: of one stalk, or a piece of it, standing more upright than lying.
        threshold: What belongs to the stalk.

    Returns:
        The strip; None where fewer than eight lines agree.
    """
    return fit_edges(*line_edges(mask, threshold))


def strip_near(strip: Strip, line: float, reach: float, lines: int) -> Strip | None:
    """The edges of a stalk near a line: what it is like there, and not where a sheath covers it.

    Slopes are those of the whole strip, which many more lines tell.

    Args:
        strip: Of a whole mask.
        line: Of the mask.
        reach: How far above and below the line edges are looked at, pixels.
        lines: How many the mask has.

    Returns:
        The strip; None where less than half of the lines there agree, or they do not go with the rest of the stalk.
    """
    first, last = max(math.floor(line - reach), 0), min(math.ceil(line + reach) + 1, lines)
    if last - first < _LEAST_LINES:
        return None
    begin, end = np.searchsorted(strip.points[0], (first, last))
    place, left, right = (each[begin:end] for each in strip.points)
    offset = place - strip.reference
    beside = [edge - fit[0] - fit[1] * offset for edge, fit in zip((left, right), (strip.left, strip.right))]
    tolerance = max(3.0, _SWELLING * strip.width(line))
    good = np.logical_and(*(np.abs(each) < tolerance for each in beside))
    for each in beside:
        good &= np.abs(each - _mode(each[good])) < _STEP if good.any() else False
    count = int(good.sum())
    if count < max(_LEAST_LINES, 0.5 * (last - first)) or not place[good].min() <= line <= place[good].max():
        return None
    moved = [float(each[good].mean()) for each in beside]
    rms = float(np.sqrt(np.mean([np.var(each[good]) for each in beside])))
    edges = [(edge + shift, fit[1]) for edge, shift, fit in zip(strip.edges(line), moved, (strip.left, strip.right))]
    return Strip(
        reference=line,
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
    """Standard deviation of a width, pixels: of two edges that so many lines agree on, each no better than a twentieth."""
    return math.sqrt(2.0) * max(rms, 0.05) / math.sqrt(count)


def fit_edges(line: np.ndarray, left: np.ndarray, right: np.ndarray) -> Strip | None:
    """Straight lines through edges that were found line by line.

    Args:
        line: [N] lines.
        left, right: [N] float64 columns of the edges.

    Returns:
        The strip; None where fewer than eight lines agree.
    """
    if line.size < _LEAST_LINES:
        return None
    points, total = (line, left, right), line.size
    slope = _common_slope(line, left, right)
    # A strip that ends across its axis has lines at both ends in which one edge is that of the end. They lie within a width's
    # projection of the first and last line.
    wide = median(right - left)
    cut = math.ceil(wide * abs(slope) / (1.0 + slope**2)) if abs(slope) > 0.01 else 0
    kept = (line >= line[0] + cut) & (line <= line[-1] - cut)
    if kept.sum() >= _LEAST_LINES:
        line, left, right = line[kept], left[kept], right[kept]
        total = line.size
    reference = float(line.mean())
    offset = line - reference
    good = np.ones(line.size, bool)
    lines: list[tuple[float, float]] = []
    scale = _NOISE
    for edge in (left, right):
        start = _mode(edge - slope * offset)
        weight = (np.abs(edge - slope * offset - start) < max(3.0, 0.08 * wide)).astype(float)
        for _ in range(12):
            heavy = weight > 0
            if np.count_nonzero(heavy) < _LEAST_LINES:
                return None
            fitted = _line(offset, edge, weight)
            residual = edge - fitted[0] - fitted[1] * offset
            spread = 1.4826 * median(np.abs(residual[heavy]))
            reach = 4.7 * max(spread, _NOISE / 2)
            before, weight = weight, np.maximum(1.0 - (residual / reach) ** 2, 0.0) ** 2
            if np.abs(weight - before).max() < _SETTLED:
                break
        good &= weight > 0
        lines.append(fitted)
        scale = max(scale, spread)
    if good.sum() < _LEAST_LINES:
        return None
    # Both edges of the same lines, so that what hides one of them tilts neither.
    fits = [_line(offset, edge, good.astype(float)) for edge in (left, right)]
    residuals = np.concatenate([edge - fit[0] - fit[1] * offset for edge, fit in zip((left, right), fits)])[np.tile(good, 2)]
    rms = float(np.sqrt(np.mean(residuals**2)))
    return Strip(
        reference=reference,
        left=fits[0],
        right=fits[1],
        first=int(line[good].min()),
        last=int(line[good].max()),
        used=float(good.sum()) / total,
        residual=rms,
        deviation=_deviation(rms, int(good.sum())),
        points=points,
    )


def _common_slope(line: np.ndarray, left: np.ndarray, right: np.ndarray) -> float:
    """Slope that most pairs of edge points agree on, left or right: columns a line."""
    step = max(line.size // 60, 1)
    places = np.arange(0, line.size, step)
    first, second = pairs_of(places.size, max(places.size // 4, 1))
    first, second = places[first], places[second]
    gap = (line[second] - line[first]).astype(float)
    slopes = np.concatenate([(edge[second] - edge[first]) / gap for edge in (left, right)])
    return _mode(slopes, 0.02)


@functools.lru_cache(maxsize=512)
def pairs_of(count: int, apart: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """All pairs of indices below ``count`` that are so far ``apart`` or further, the lower one first."""
    return np.triu_indices(count, k=apart)


def median(values: np.ndarray) -> float:
    """Of a few values [N], at least one: many times quicker than NumPy's, which looks after much else."""
    ordered = np.sort(values)
    half = len(ordered) // 2
    return float(ordered[half]) if len(ordered) % 2 else 0.5 * float(ordered[half - 1] + ordered[half])


def _mode(values: np.ndarray, width: float = 1.0) -> float:
    """Middle of the densest stretch of ``width``: what most values agree on, even where that is less than half of them."""
    ordered = np.sort(values)
    upper = np.searchsorted(ordered, ordered + width, side="right")
    best = int(np.argmax(upper - np.arange(ordered.size)))
    return median(ordered[best : upper[best]])


def _line(x: np.ndarray, y: np.ndarray, weight: np.ndarray) -> tuple[float, float]:
    """Offset and slope of the weighted least-squares line."""
    total = weight.sum()
    mean_x, mean_y = (weight * x).sum() / total, (weight * y).sum() / total
    spread = (weight * (x - mean_x) ** 2).sum()
    slope = (weight * (x - mean_x) * (y - mean_y)).sum() / spread if spread > 0 else 0.0
    return float(mean_y - slope * mean_x), float(slope)


def ellipse_width(mask: np.ndarray, fit: EllipseFit = "pixels") -> float | None:
    """Width as the thesis takes it: the largest minor axis of the ellipses that are fitted to the mask's blobs.

    Args:
        mask: [H, W] bool, or float32 from 0 to 1.
        fit: How an ellipse is fitted; see `ELLIPSE_FITS`.

    Returns:
        Pixels; None where no blob has an ellipse that makes sense. Fits that come out wider than a blob of that area and length
        can be, which OpenCV's do for some near-straight sets of points, are left out.
    """
    inside = (np.asarray(mask, np.float32) >= 0.5).astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(inside, connectivity=8)
    widths = []
    for label in range(1, count):
        area = int(stats[label, cv2.CC_STAT_AREA])
        if area < 20:
            continue
        width = _minor_axis((labels == label).astype(np.uint8), fit)
        length = math.hypot(stats[label, cv2.CC_STAT_WIDTH], stats[label, cv2.CC_STAT_HEIGHT])
        if width is not None and math.isfinite(width) and 1.0 < width < 3.0 * area / max(length / math.sqrt(2.0), 1.0):
            widths.append(width)
    return max(widths, default=None)


def _minor_axis(blob: np.ndarray, fit: EllipseFit) -> float | None:
    line, column = np.nonzero(blob)
    pixels = np.stack([column, line], axis=1).astype(np.float32)
    if fit == "moments":
        return 4.0 * math.sqrt(max(float(np.linalg.eigvalsh(np.cov(pixels.T))[0]), 0.0))
    if fit.startswith("contour"):
        contours, _ = cv2.findContours(blob, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        pixels = max(contours, key=len).reshape(-1, 2).astype(np.float32)
    if len(pixels) < 5:
        return None
    fitter = {"direct": cv2.fitEllipseDirect, "ams": cv2.fitEllipseAMS}.get(fit.partition("_")[2], cv2.fitEllipse)
    (_, axes, _) = fitter(pixels)
    return float(min(axes))
