"""Grasp points from lines that are fitted to the stalk segments of several pairs.

Lines are seeded by connected pieces of segments ("chords") and grown with the chords of all pairs that lie along them, above
and below occlusions; a line is accepted as a stalk if enough chords of enough pairs support it. Its grasp point lies where most
of it is visible, at a height at which the gripper works. Lines may be curved: half a metre below the grasp point, straight ones
are 12 mm off the stalk, curved ones 2 mm.
"""

import dataclasses
from typing import NamedTuple

import numpy as np

from jaxrl_vis.stalks.grasping.perception.stalk_segments import StalkSegments
from jaxrl_vis.stalks.grasping.perception.visibility import Visibility

HEIGHTS = (0.45, 1.05)
"""Minimum and maximum height of a grasp, m above the ground."""
PREFERRED = 0.75
"""Preferred height of a grasp, m above the ground."""


@dataclasses.dataclass(frozen=True)
class GraspPoint:
    """Grasp point on a detected stalk, with the line of the stalk.

    Attributes:
        point: [3] float64, centre of the stalk at the grasp, in the robot frame of the last pair, m; if detected by slice, the
            mean of the points on its front.
        direction: [3] float64, unit vector along the stalk at the grasp, upwards.
        thickness: Diameter at the grasp, m; NaN if not measured.
        frames: Number of pairs that show the stalk; 0 if unknown.
        spread: RMS horizontal distance of the chords around the grasp from the line, m; NaN if unknown.
        bend: Quadratic coefficients of x and y in the height above the grasp, 1/m: half the curvature.
        taper: Change of the diameter per m of height, positive if it grows upwards.
    """

    point: np.ndarray
    direction: np.ndarray
    thickness: float
    frames: int
    spread: float
    bend: tuple[float, float] = (0.0, 0.0)
    taper: float = 0.0

    def at_height(self, height: float | np.ndarray) -> np.ndarray:
        """Return the points [..., 3] of the stalk's line at heights [...] above the ground, m."""
        up = np.asarray(height - self.point[2])[..., None]
        return self.point + self.direction * (up / self.direction[2]) + np.array([*self.bend, 0.0]) * up**2

    def thickness_at(self, height: float) -> float:
        """Return the diameter at a height, m; at least half of that at the grasp point, NaN if not measured."""
        return max(self.thickness + self.taper * (height - self.point[2]), 0.5 * self.thickness)


_LINE_RADIUS = 0.009  # m: maximum distance of a chord from its line
_BENT_LENGTH = 0.3  # m: minimum height range of chords for fitting curvature or taper
_USUAL_TAPER = -0.01  # m per m: taper of stalks with a smaller height range
_RADIUS_GROWTH = 0.03  # growth of the maximum distance per m beyond the known part of a line
_MIN_PIECE = 0.03  # m: minimum height range of a seed
_MAX_SLOPE = 0.6  # m per m: maximum slope of a line against the vertical
_BIN = 0.02  # m: bin width of heights
_MIN_SUPPORT = 0.12  # m: minimum visible length, summed over pairs
_WINDOW = 0.10  # m: half height of the window around the grasp point for the local fit
_AROUND = 0.2  # m: half height of the range around the grasp point in which visibility is queried
_MIN_SHOWN = 4  # minimum number of places at which a pair must show a stalk
_MIN_FRACTION = 0.4  # minimum fraction of places that show the stalk among those that show it or see through it
_APART = 0.012  # m: lines nearer than this are the same stalk
_SEPARATION_GROWTH = 0.04  # growth of that distance per m between the heights of their grasp points
_REST_WITHIN, _REST_SPREAD = 0.025, 0.003  # m: nearer lines with a greater spread are leftovers of the other stalk
_LEVEL = 0.002  # m: chords of one pair that differ less in height are in the same image row
_MIN_BESIDE, _FRACTION_BESIDE = 20, 0.2  # minimum number, and fraction, of chords of two distinct stalks that are side by side
_APART_BESIDE = 0.008  # m: minimum median distance of such chords


class _Line(NamedTuple):
    """Line that is accepted as a stalk.

    Attributes:
        point: Grasp point.
        members: [K] int, indices of its chords.
        shown: Number of places along the line at which pairs show it, summed over pairs.
    """

    point: GraspPoint
    members: np.ndarray
    shown: int


def detect_grasp_points(segments: StalkSegments, visibility: Visibility) -> list[GraspPoint]:
    """Detect stalks and return their grasp points, in ascending order of x.

    Args:
        segments: Segments of all pairs, in the robot frame of the last one.
        visibility: Visibility of points in all pairs.
    """
    free = np.ones(len(segments), bool)
    lines: list[_Line] = []
    for seed in _seeds(segments):
        members = seed[free[seed]]
        if np.ptp(segments.middle[members, 2]) < _MIN_PIECE if len(members) else True:
            continue
        members = _grow(segments, members, free)
        if not len(members):
            continue
        free[members] = False
        point = _make_grasp_point(segments, members, min(2, len(visibility.clouds)))
        if point is None:
            continue
        count = _count_support(point, visibility)
        if count:
            lines.append(_Line(point, members, count))
    lines.sort(key=lambda line: -line.shown)
    return sorted((line.point for line in _remove_duplicates(lines, segments)), key=lambda point: float(point.point[0]))


def _seeds(segments: StalkSegments) -> list[np.ndarray]:
    """Return the indices of the chords of each piece with at least 5, tall pieces first."""
    order = np.argsort(segments.component, kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(segments.component[order])) + 1) if len(order) else []
    parts = [part for part in parts if len(part) >= 5]
    return sorted(parts, key=lambda part: -float(np.ptp(segments.middle[part, 2])))


def _fit(points: np.ndarray, weights: np.ndarray, bent: bool) -> tuple[np.ndarray, float]:
    """Fit x and y as polynomials of the height relative to the mean height.

    Args:
        points: [N, 3], m.
        weights: [N].
        bent: If true, fit a quadratic (K = 3) instead of a line (K = 2).

    Returns:
        Coefficients [K, 2], constant term first, and the weighted mean height, m.
    """
    middle = float(weights @ points[:, 2] / weights.sum())
    height = points[:, 2] - middle
    powers = np.stack([np.ones_like(height), height, height**2][: 3 if bent else 2], axis=1)
    # Stalks are nearly straight: regularise slope and curvature, which short pieces determine poorly.
    stiff = np.diag([0.0, 1e-4, 0.02][: powers.shape[1]]) * weights.sum() * 1e-2
    normal = powers.T @ (powers * weights[:, None]) + stiff
    return np.linalg.solve(normal, powers.T @ (points[:, :2] * weights[:, None])), middle


def _offsets(points: np.ndarray, coefficients: np.ndarray, middle: float) -> np.ndarray:
    """Return the horizontal distances [N] of points [N, 3] from a line fitted by `_fit`, m."""
    height = points[:, 2] - middle
    powers = np.stack([np.ones_like(height), height, height**2][: len(coefficients)], axis=1)
    return np.linalg.norm(points[:, :2] - powers @ coefficients, axis=1)


def _fit_robustly(points: np.ndarray, bent: bool) -> tuple[np.ndarray, float]:
    weights = np.ones(len(points))
    coefficients, middle = _fit(points, weights, bent)
    for _ in range(4):
        offset = _offsets(points, coefficients, middle)
        weights = 1.0 / (1.0 + (offset / 0.004) ** 2)
        coefficients, middle = _fit(points, weights, bent)
    return coefficients, middle


def _grow(segments: StalkSegments, members: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Return the indices of all free chords along the line through ``members``; none if the line is too steep."""
    candidates = np.flatnonzero(free)
    points = segments.middle[candidates]
    for _ in range(6):
        known = segments.middle[members]
        low, high = known[:, 2].min(), known[:, 2].max()
        coefficients, middle = _fit_robustly(known, bent=high - low > _BENT_LENGTH)
        if np.abs(coefficients[1]).max() > _MAX_SLOPE:
            return members[:0]
        beyond = np.maximum(np.maximum(low - points[:, 2], points[:, 2] - high), 0.0)
        # Extrapolate by at most the known height range of the line, or 0.15 m.
        near = _offsets(points, coefficients, middle) < _LINE_RADIUS + _RADIUS_GROWTH * beyond
        near &= beyond < max(0.15, 1.0 * (high - low))
        grown = candidates[near]
        if len(grown) < 5 or (len(grown) == len(members) and (grown == members).all()):
            break
        members = grown
    return members


def _support(segments: StalkSegments, members: np.ndarray) -> tuple[float, int]:
    """Return the visible length summed over pairs, m, and the number of pairs with chords in at least two height bins."""
    bins = np.floor(segments.middle[members, 2] / _BIN).astype(int)
    occupied = np.unique(np.stack([segments.frame[members], bins], axis=1), axis=0)
    frames, counts = np.unique(occupied[:, 0], return_counts=True)
    return _BIN * len(occupied), int((counts >= 2).sum())


def _make_grasp_point(segments: StalkSegments, members: np.ndarray, min_frames: int) -> GraspPoint | None:
    """Return the grasp point of a stalk; None if the pairs show too little of it, or fewer than ``min_frames`` show it."""
    length, frames = _support(segments, members)
    if length < _MIN_SUPPORT or frames < min_frames:
        return None
    points = segments.middle[members]
    places = np.arange(HEIGHTS[0], HEIGHTS[1] + 1e-9, _BIN)
    within = np.abs(points[None, :, 2] - places[:, None]) < _WINDOW
    count = within.sum(axis=1) * np.exp(-0.5 * ((places - PREFERRED) / 0.3) ** 2)
    best = int(np.argmax(count))
    if within[best].sum() < 8:
        return None
    near = np.flatnonzero(within[best])
    local, middle = _fit_robustly(points[near], bent=False)
    x, y = local[0] + local[1] * (places[best] - middle)
    spread = float(np.sqrt(np.mean(np.minimum(_offsets(points[near], local, middle), _LINE_RADIUS) ** 2)))
    thickness = float(np.median(segments.thickness[members[near]]))
    # Direction and curvature are fitted to the whole line.
    curve, middle = _fit_robustly(points, bent=np.ptp(points[:, 2]) > _BENT_LENGTH)
    bend = curve[2] if len(curve) > 2 else np.zeros(2)
    direction = np.array([*(curve[1] + 2.0 * bend * (places[best] - middle)), 1.0])
    return GraspPoint(
        np.array([x, y, places[best]]),
        direction / np.linalg.norm(direction),
        thickness,
        frames,
        spread,
        (float(bend[0]), float(bend[1])),
        _fit_taper(points[:, 2], segments.thickness[members]),
    )


def _fit_taper(heights: np.ndarray, thickness: np.ndarray) -> float:
    """Estimate the change of the diameter per m of height, from the medians of the lower and the upper half of the heights.

    Return a default if the heights span less than 0.3 m, which does not suffice.
    """
    if np.ptp(heights) < _BENT_LENGTH:
        return _USUAL_TAPER
    upper = heights > 0.5 * (heights.min() + heights.max())
    parts = [(np.median(heights[half]), np.median(thickness[half])) for half in (upper, ~upper)]
    return float((parts[0][1] - parts[1][1]) / (parts[0][0] - parts[1][0]))


def _count_support(point: GraspPoint, visibility: Visibility) -> int:
    """Count the places along a stalk's line at which pairs show it.

    Return 0 unless at least two pairs (or the only one) show it, and few enough see through it.
    """
    places = point.point[2] + np.arange(-_AROUND, _AROUND, 0.5 * _BIN)
    shown, through = visibility.query(point.at_height(places))
    count = int(shown.sum())
    frames = int((shown.sum(axis=1) >= _MIN_SHOWN).sum())
    agreed = frames >= min(2, len(visibility.clouds)) and count >= _MIN_FRACTION * (count + through.sum())
    return count if agreed else 0


def _remove_duplicates(lines: list[_Line], segments: StalkSegments) -> list[_Line]:
    """Return the lines without those that are the same stalk as an earlier one."""
    distinct: list[_Line] = []
    for line in lines:
        if not any(
            _is_same_stalk(line.point, other.point) and not _are_side_by_side(segments, line, other) for other in distinct
        ):
            distinct.append(line)
    return distinct


def _is_same_stalk(point: GraspPoint, other: GraspPoint) -> bool:
    """Return True if a line is probably the same stalk as ``other``, which pairs show better."""
    up = point.point[2] - other.point[2]
    distance = float(np.linalg.norm((point.point - other.at_height(point.point[2]))[:2]))
    # Chords left over from a stalk form a second line nearby, with a large spread.
    return distance < _APART + _SEPARATION_GROWTH * abs(up) or (distance < _REST_WITHIN and point.spread > _REST_SPREAD)


def _are_side_by_side(segments: StalkSegments, first: _Line, second: _Line) -> bool:
    """Return True if pairs show two lines side by side in the same image rows: these are distinct stalks, however near."""
    apart = [np.zeros(0)]
    for frame in np.intersect1d(segments.frame[first.members], segments.frame[second.members]):
        mine, theirs = (segments.middle[line.members[segments.frame[line.members] == frame]] for line in (first, second))
        theirs = theirs[np.argsort(theirs[:, 2])]
        place = np.searchsorted(0.5 * (theirs[1:, 2] + theirs[:-1, 2]), mine[:, 2])
        level = np.abs(theirs[place, 2] - mine[:, 2]) < _LEVEL
        apart.append(np.linalg.norm((theirs[place] - mine)[level, :2], axis=1))
    distances = np.concatenate(apart)
    enough = max(_MIN_BESIDE, _FRACTION_BESIDE * min(len(first.members), len(second.members)))
    return len(distances) >= enough and float(np.median(distances)) > _APART_BESIDE
