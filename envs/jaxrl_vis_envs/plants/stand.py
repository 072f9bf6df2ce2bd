"""Stands: the few stalks that a robot's arm can touch, each as two straight segments. NumPy only.

The frame of a stand is that of its plot, translated along the ground such that the arm's mast is at (0, -`MAST_DISTANCE`).
`bending` models how the stalks bend.
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from jaxrl_vis_envs.plants.field import Plot, Stalk

KNEE = 0.3
"""Height at which the two segments of a stalk meet, m. The arm works above it."""
TOP = 1.4
"""Height at which the upper segment ends, m: beyond the arm's reach."""
MAST_DISTANCE = 0.55
"""Distance of the arm's first joint from the row's centre line, m."""
STALKS = 6
"""Default number of stalks in a stand."""
_PARKING_DISTANCE = 4.0  # m, distance of absent stalks behind the row
_SECANT_HALF_LENGTH = 0.1  # m, the upper segment is the secant of the stalk over this distance below and above the arm's height


@dataclasses.dataclass(frozen=True)
class Stands:
    """B stands of N stalks each.

    Attributes:
        stalk: [B, N] int32, index in `Plot.stalks`; -1 for absent ones, which are parked out of the way.
        foot: [B, N, 3] float32, foot of the stalk on the ground, m, in the frame of the stand.
        knee: [B, N, 3] float32, joint of its two segments, m, in the same frame.
        top: [B, N, 3] float32, end of its upper segment, whose line passes exactly through the stalk at the arm's height, m.
        radius: [B, N, 2] float32, radius of the lower segment at half its height and of the upper one at the arm's height, m.
        bending_radius: [B, N, 2] float32, radius of untapered segments with the same compliance at the arm, m.
        origin: [B, 3] float32, origin of the stand in the plot's frame, m.
    """

    stalk: np.ndarray
    foot: np.ndarray
    knee: np.ndarray
    top: np.ndarray
    radius: np.ndarray
    bending_radius: np.ndarray
    origin: np.ndarray

    @property
    def is_present(self) -> np.ndarray:
        """[B, N] bool, True for existing stalks."""
        return self.stalk >= 0

    def __len__(self) -> int:
        return len(self.stalk)


def stand_origin(x: float, row: float = 0.0) -> np.ndarray:
    """Return `Stands.origin` [3] for a mast at ``x`` m along the row, `MAST_DISTANCE` in front of its line y = ``row`` m."""
    return np.array([x, row, 0.0])


def stands_at(plots: Plot | Sequence[Plot], x: np.ndarray, targets: np.ndarray, stalks: int = STALKS) -> Stands:
    """Build one stand per reach, from the stalks nearest to the line between the arm's first joint and the target.

    Args:
        plots: Plot of each reach, or one for all.
        x: [B], position of the mast along the row, m.
        targets: [B, 3], target of the gripper, m in the plot's frame.
        stalks: Number of stalks of the near row in a stand.

    Raises:
        ValueError: Shapes differ, ``stalks`` is less than 1, or a position is not finite.
    """
    x, targets = np.asarray(x, float), np.asarray(targets, float)
    if targets.ndim != 2 or targets.shape != (*x.shape, 3):
        raise ValueError(f"a stand needs x [B] and targets [B, 3], got {list(x.shape)} and {list(targets.shape)}")
    if stalks < 1:
        raise ValueError(f"a stand needs at least 1 stalk, got {stalks}")
    if not (np.isfinite(targets).all() and np.isfinite(x).all()):
        raise ValueError("positions of masts and targets must be finite")
    reach_plots = [plots] * len(x) if isinstance(plots, Plot) else list(plots)
    if len(reach_plots) != len(x):
        raise ValueError(f"there are {len(x)} reaches and {len(reach_plots)} plots: give one plot, or one for each reach")
    rows = [_stand(plot, at, target, stalks) for plot, at, target in zip(reach_plots, x, targets)]
    arrays = [np.stack(parts) for parts in zip(*rows)] if rows else _empty(stalks)
    return Stands(arrays[0].astype(np.int32), *(part.astype(np.float32) for part in arrays[1:]))


def stand_of_lines(
    points: np.ndarray, directions: np.ndarray, radii: np.ndarray, x: float, target: np.ndarray, stalks: int
) -> Stands:
    """Build one stand from detected straight stalks.

    Args:
        points: [K, 3], a point on each stalk, m in the plot's frame.
        directions: [K, 3], along the stalks; not horizontal.
        radii: [K], m.
        x: Position of the mast along the row, m.
        target: [3], target of the gripper, m in the plot's frame.
        stalks: Number of stalks in the stand: those nearest to the line from the arm's first joint to the target.

    Returns:
        One stand, whose `Stands.stalk` are indices of the K stalks.
    """
    origin = stand_origin(x)
    slopes = directions / directions[:, 2:]
    positions = points - origin

    def at(height: float) -> np.ndarray:
        return positions + (height - positions[:, 2:]) * slopes

    order = np.argsort(_distance_to_line(at(target[2])[:, :2], (target - origin)[:2]), kind="stable")[:stalks]
    stalk = np.full(stalks, -1)
    stalk[: len(order)] = order
    parked = np.stack([0.2 * np.arange(stalks), np.full(stalks, _PARKING_DISTANCE), np.zeros(stalks)], axis=1)
    ends = [parked + [0.0, 0.0, height] for height in (0.0, KNEE, TOP)]
    for end, height in zip(ends, (0.0, KNEE, TOP)):
        end[: len(order)] = at(height)[order]
    radius = np.full((stalks, 2), 0.007)
    radius[: len(order)] = radii[order, None]
    arrays = [np.asarray(value, np.float32)[None] for value in (*ends, radius, radius, origin)]
    return Stands(stalk.astype(np.int32)[None], *arrays)


def concatenate_stands(batches: Sequence[Stands]) -> Stands:
    """Concatenate one or more batches of stands with the same number of stalks each."""
    names = [field.name for field in dataclasses.fields(Stands)]
    return Stands(*(np.concatenate([getattr(batch, name) for batch in batches]) for name in names))


def _empty(stalks: int) -> list[np.ndarray]:
    vectors = np.zeros((0, stalks, 3))
    return [np.zeros((0, stalks)), vectors, vectors, vectors, *[np.zeros((0, stalks, 2))] * 2, np.zeros((0, 3))]


def _stand(plot: Plot, x: float, target: np.ndarray, stalks: int) -> tuple[np.ndarray, ...]:
    origin = stand_origin(x)
    height = float(np.clip(target[2], KNEE + _SECANT_HALF_LENGTH, TOP - _SECANT_HALF_LENGTH))
    positions = np.array([stalk.at_height(height)[0] for stalk in plot.measured]).reshape(-1, 3) - origin
    order = np.argsort(_distance_to_line(positions[:, :2], (target - origin)[:2]), kind="stable")[:stalks]
    stalk = np.full(stalks, -1)
    stalk[: len(order)] = order
    parked = np.stack([0.2 * np.arange(stalks), np.full(stalks, _PARKING_DISTANCE), np.zeros(stalks)], axis=1)
    foot, knee, top = parked.copy(), parked + [0.0, 0.0, KNEE], parked + [0.0, 0.0, TOP]
    radius, bending_radius = np.full((stalks, 2), 0.007), np.full((stalks, 2), 0.007)
    for slot, index in enumerate(order):
        measured = plot.measured[index]
        middle, below, above = (
            measured.at_height(height + step)[0] - origin for step in (0.0, -_SECANT_HALF_LENGTH, _SECANT_HALF_LENGTH)
        )
        slope = (above - below) / (above - below)[2]
        foot[slot] = measured.points[0] - origin
        knee[slot], top[slot] = middle + (KNEE - height) * slope, middle + (TOP - height) * slope
        radius[slot] = measured.diameter(KNEE / 2) / 2, measured.diameter(height) / 2
        bending_radius[slot] = radius[slot, 0], _bending_radius(measured, height)
    return stalk, foot, knee, top, radius, bending_radius, origin


def _bending_radius(stalk: Stalk, height: float) -> float:
    """Return the radius (m) of an untapered beam as compliant as the stalk above the knee, for a force at a height in m."""
    # The deflection of a beam's end per unit force is the integral of (height - z)^2 / (E I(z)), and I scales with radius^4.
    heights = np.linspace(KNEE, height, 21)
    bare = np.array([stalk.diameter(z, bare=True) / 2 for z in heights])
    arms = (height - heights) ** 2
    return float((arms.sum() / (arms / bare**4).sum()) ** 0.25)


def _distance_to_line(points: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return horizontal distances [K] (m) of points [K, 2] from the segment between the first joint and ``end`` [2]."""
    start = np.array([0.0, -MAST_DISTANCE])
    along = end - start
    length = max(math.hypot(*along), 1e-9)
    fraction = np.clip((points - start) @ along / length**2, 0.0, 1.0)
    return np.linalg.norm(points - start - fraction[:, None] * along, axis=1)
