"""A stretch of a row around a robot's arm: the few stalks that it can touch, each as two straight pieces. NumPy only.

Frame of a stand: that of its plot, moved along the ground so that the arm's mast stands at (0, -`MAST_DISTANCE`).
How the stalks bend is in `bending`.
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from jaxrl_vis_envs.plants.field import Plot, Stalk

KNEE = 0.3
"""Height at which the two pieces of a stalk meet, m. The arm works above it."""
TOP = 1.4
"""Height at which the upper piece ends, m: above what the arm reaches."""
MAST_DISTANCE = 0.55
"""Distance of the arm's first joint from the middle line of the row, m."""
STALKS = 6
"""Stalks of a stand unless another number is asked for."""
_AWAY = 4.0  # m, how far behind the row absent stalks stand
_FIT = 0.1  # m, the upper piece is the secant of the stalk over so much below and above the arm's height


@dataclasses.dataclass(frozen=True)
class Stands:
    """B stands of N stalks each.

    Attributes:
        stalk: [B, N] int32, index of each in `Plot.stalks`; -1 for absent ones, which stand out of the way.
        foot: [B, N, 3] float32, where each starts on the ground, m, in the frame of the stand.
        knee: [B, N, 3] float32, where its two pieces meet.
        top: [B, N, 3] float32, where its upper piece ends. Its line passes exactly through the stalk at the arm's height.
        radius: [B, N, 2] float32, radius of the lower piece at half its height and of the upper one at the arm's height, m.
        bending_radius: [B, N, 2] float32, radius of pieces without taper that give way as these do to the arm, m.
        origin: [B, 3] float32, what has to be subtracted from the plot's coordinates to get those of the stand, m.
    """

    stalk: np.ndarray
    foot: np.ndarray
    knee: np.ndarray
    top: np.ndarray
    radius: np.ndarray
    bending_radius: np.ndarray
    origin: np.ndarray

    @property
    def present(self) -> np.ndarray:
        """[B, N] bool: which stalks there are."""
        return self.stalk >= 0

    def __len__(self) -> int:
        return len(self.stalk)


def origin_of(x: float, row: float = 0.0) -> np.ndarray:
    """`Stands.origin` [3] of an arm whose mast is ``x`` m along the row, `MAST_DISTANCE` before its line y = ``row`` m."""
    return np.array([x, row, 0.0])


def stands_at(plots: Plot | Sequence[Plot], x: np.ndarray, targets: np.ndarray, stalks: int = STALKS) -> Stands:
    """One stand for each reach: the stalks nearest to the line from the arm's first joint to where it is going.

    Args:
        plots: The plot of each reach, or one for all.
        x: [B], how far along the row the mast stands, m.
        targets: [B, 3], where the gripper is sent, m in the plot's frame.
        stalks: How many stalks of the near row a stand has.

    Raises:
        ValueError: Shapes differ, there are fewer than one stalk, or a target is not finite.
    """
    x, targets = np.asarray(x, float), np.asarray(targets, float)
    if targets.ndim != 2 or targets.shape != (*x.shape, 3):
        raise ValueError(f"a stand needs x [B] and targets [B, 3], got {list(x.shape)} and {list(targets.shape)}")
    if stalks < 1:
        raise ValueError(f"a stand needs at least 1 stalk, got {stalks}")
    if not (np.isfinite(targets).all() and np.isfinite(x).all()):
        raise ValueError("places of masts and targets must be finite")
    each = [plots] * len(x) if isinstance(plots, Plot) else list(plots)
    if len(each) != len(x):
        raise ValueError(f"there are {len(x)} reaches and {len(each)} plots: give one plot, or one for each reach")
    rows = [_stand(plot, at, target, stalks) for plot, at, target in zip(each, x, targets)]
    arrays = [np.stack(parts) for parts in zip(*rows)] if rows else _empty(stalks)
    return Stands(arrays[0].astype(np.int32), *(part.astype(np.float32) for part in arrays[1:]))


def stand_of_lines(
    points: np.ndarray, directions: np.ndarray, radii: np.ndarray, x: float, target: np.ndarray, stalks: int
) -> Stands:
    """One stand, of straight stalks as somebody has found them.

    Args:
        points: [K, 3] on the stalks, m in the plot's frame.
        directions: [K, 3], along them; not horizontal.
        radii: [K], m.
        x: How far along the row the mast stands, m.
        target: [3], where the gripper is sent, m in the plot's frame.
        stalks: How many of them the stand has: those nearest to the line from the arm's first joint to the target.

    Returns:
        One stand; `Stands.stalk` are indices of the K stalks.
    """
    origin = origin_of(x)
    slopes = directions / directions[:, 2:]
    places = points - origin

    def at(height: float) -> np.ndarray:
        return places + (height - places[:, 2:]) * slopes

    order = np.argsort(_distance_to_line(at(target[2])[:, :2], (target - origin)[:2]), kind="stable")[:stalks]
    stalk = np.full(stalks, -1)
    stalk[: len(order)] = order
    parked = np.stack([0.2 * np.arange(stalks), np.full(stalks, _AWAY), np.zeros(stalks)], axis=1)
    ends = [parked + [0.0, 0.0, height] for height in (0.0, KNEE, TOP)]
    for end, height in zip(ends, (0.0, KNEE, TOP)):
        end[: len(order)] = at(height)[order]
    radius = np.full((stalks, 2), 0.007)
    radius[: len(order)] = radii[order, None]
    arrays = [np.asarray(each, np.float32)[None] for each in (*ends, radius, radius, origin)]
    return Stands(stalk.astype(np.int32)[None], *arrays)


def concatenated(parts: Sequence[Stands]) -> Stands:
    """All stands of several, which have as many stalks each, in their order; at least one."""
    names = [field.name for field in dataclasses.fields(Stands)]
    return Stands(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def _empty(stalks: int) -> list[np.ndarray]:
    vectors = np.zeros((0, stalks, 3))
    return [np.zeros((0, stalks)), vectors, vectors, vectors, *[np.zeros((0, stalks, 2))] * 2, np.zeros((0, 3))]


def _stand(plot: Plot, x: float, target: np.ndarray, stalks: int) -> tuple[np.ndarray, ...]:
    origin = origin_of(x)
    height = float(np.clip(target[2], KNEE + _FIT, TOP - _FIT))
    places = np.array([stalk.at_height(height)[0] for stalk in plot.measured]).reshape(-1, 3) - origin
    order = np.argsort(_distance_to_line(places[:, :2], (target - origin)[:2]), kind="stable")[:stalks]
    stalk = np.full(stalks, -1)
    stalk[: len(order)] = order
    parked = np.stack([0.2 * np.arange(stalks), np.full(stalks, _AWAY), np.zeros(stalks)], axis=1)
    foot, knee, top = parked.copy(), parked + [0.0, 0.0, KNEE], parked + [0.0, 0.0, TOP]
    radius, bending_radius = np.full((stalks, 2), 0.007), np.full((stalks, 2), 0.007)
    for place, index in enumerate(order):
        each = plot.measured[index]
        middle, below, above = (each.at_height(height + step)[0] - origin for step in (0.0, -_FIT, _FIT))
        slope = (above - below) / (above - below)[2]
        foot[place] = each.points[0] - origin
        knee[place], top[place] = middle + (KNEE - height) * slope, middle + (TOP - height) * slope
        radius[place] = each.diameter(KNEE / 2) / 2, each.diameter(height) / 2
        bending_radius[place] = radius[place, 0], _bending_radius(each, height)
    return stalk, foot, knee, top, radius, bending_radius, origin


def _bending_radius(stalk: Stalk, height: float) -> float:
    """Radius in m of a beam without taper that gives way like the stalk above the knee, pushed at a height in m."""
    # The end of a beam moves by the integral of (height - z)^2 / (E I(z)) for a unit of force, and I is as radius^4.
    heights = np.linspace(KNEE, height, 21)
    bare = np.array([stalk.diameter(z, bare=True) / 2 for z in heights])
    arms = (height - heights) ** 2
    return float((arms.sum() / (arms / bare**4).sum()) ** 0.25)


def _distance_to_line(points: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Distances [K] in m of points [K, 2] from the straight line between the first joint and ``end`` [2], in the plane."""
    start = np.array([0.0, -MAST_DISTANCE])
    along = end - start
    length = max(math.hypot(*along), 1e-9)
    share = np.clip((points - start) @ along / length**2, 0.0, 1.0)
    return np.linalg.norm(points - start - share[:, None] * along, axis=1)
