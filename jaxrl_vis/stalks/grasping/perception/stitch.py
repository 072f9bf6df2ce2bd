"""Clouds of several pairs put together by iterative closest points (ICP).

The thesis: from where the cloud lies, correspondences up to 0.15 m, on a grid of 3 cm. Vertical stalks some centimetres apart
look alike, so that this settles a stalk or two aside. The default starts where odometry says, on a grid of 5 mm, and narrows
correspondences from 0.15 to 0.05, 0.02 and 0.01 m; a result further from the odometry than its error allows is refused.
"""

import dataclasses
import functools
import math

import numpy as np
from scipy.spatial import cKDTree

from jaxrl_vis.stalks.grasping.perception.cloud import Cloud, thinned


@dataclasses.dataclass(frozen=True)
class Motion:
    """A rigid motion: p -> rotation p + shift.

    Attributes:
        rotation: [3, 3] float64.
        shift: [3] float64, m.
    """

    rotation: np.ndarray
    shift: np.ndarray

    @classmethod
    def along(cls, distance: float) -> "Motion":
        """A shift along the row, m."""
        return cls(np.eye(3), np.array([distance, 0.0, 0.0]))

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Points [..., 3], moved."""
        return points @ self.rotation.T + self.shift

    def after(self, first: "Motion") -> "Motion":
        """First ``first``, then this."""
        return Motion(self.rotation @ first.rotation, self.rotation @ first.shift + self.shift)

    def inverse(self) -> "Motion":
        """Return the inverse motion."""
        return Motion(self.rotation.T, -self.rotation.T @ self.shift)

    @property
    def angle(self) -> float:
        """By how much it turns, rad."""
        return math.acos(min(max(0.5 * (float(np.trace(self.rotation)) - 1.0), -1.0), 1.0))


@dataclasses.dataclass(frozen=True)
class Method:
    """Method of stitching clouds.

    Attributes:
        voxel: Edge of the cubes of the grid, m.
        gates: Greatest distance of corresponding points, m: one after the other.
        steps: Most iterations with each gate.
        most: About how many points of the moved cloud are used with each gate: evenly chosen.
        from_odometry: Start where odometry says, and refuse what moves too far from there; else start where the cloud lies.
        pixels: About how many pixels of a larger image are looked at: evenly chosen.
    """

    voxel: float
    gates: tuple[float, ...]
    steps: int
    most: tuple[int, ...]
    from_odometry: bool
    pixels: int = 1_000_000_000

    def after_first_gate(self) -> "Method":
        """The same without its widest gate."""
        return dataclasses.replace(self, gates=self.gates[1:], most=self.most[1:])


THESIS = Method(voxel=0.03, gates=(0.15,), steps=50, most=(1_000_000,), from_odometry=False)
# Wide gates only bring the clouds near enough for the next one: few points do.
DEFAULT = Method(
    voxel=0.005,
    gates=(0.15, 0.05, 0.02, 0.01),
    steps=30,
    most=(1000, 1500, 3000, 5000),
    from_odometry=True,
    pixels=512 * 512,
)

_ODOMETRY_SHARE = 0.05
_WOBBLE = 0.03  # m
_TURN = math.radians(3.0)
_MIN_OVERLAP = 0.2
_STILL = 0.01  # of the gate, m, and the same in rad: what moves less has arrived


@dataclasses.dataclass(frozen=True)
class Stitch:
    """Result of stitching one cloud to the next.

    Attributes:
        motion: From the robot frame of one pair to that of the next one.
        residual: Root mean square distance of corresponding points, m; not a number where there are none.
        overlap: Share of points that have a correspondence within the last gate.
        refused: Why the result was not used; empty where it was. The motion is then what odometry says.
    """

    motion: Motion
    residual: float
    overlap: float
    refused: str = ""


class Thinned:
    """A cloud on the grid of a method.

    Attributes:
        points: [N, 3], m.
    """

    def __init__(self, points: np.ndarray, method: Method = DEFAULT) -> None:
        """Args: points [N, 3], m, and how they are to be stitched."""
        self.points = thinned(points, method.voxel)

    @classmethod
    def of(cls, cloud: Cloud, method: Method = DEFAULT) -> "Thinned":
        """That of an organised cloud."""
        part = slice(None, None, max(math.isqrt(cloud.depth.size // method.pixels), 1))
        return cls(cloud.points[part, part][np.isfinite(cloud.depth[part, part])], method)

    @functools.cached_property
    def tree(self) -> cKDTree:
        """For the nearest neighbours. Points on a grid need no balance, which takes longer than it saves."""
        return cKDTree(self.points, balanced_tree=False, compact_nodes=False)


def stitch(source: Thinned, target: Thinned, driven: float, method: Method = DEFAULT) -> Stitch:
    """Lays the cloud of one pair on the cloud of the next.

    Args:
        source, target: Points in the robot frame of their own pair.
        driven: Distance that the robot moved along the row in between, m, by its odometry.
        method: Method of stitching.
    """
    prior = Motion.along(-driven)
    start = prior if method.from_odometry else Motion.along(0.0)
    if len(source.points) < 10 or len(target.points) < 10:
        return Stitch(prior, math.nan, 0.0, "a cloud is empty")
    motion, residual, overlap = closest_points(source.points, target, start, method)
    refused = _why_refused(motion, prior, driven, overlap) if method.from_odometry else ""
    if refused and len(method.gates) > 1:
        # Where little overlaps, what one pair alone sees drags a wide gate aside; odometry may be near enough for the next one.
        motion, residual, overlap = closest_points(source.points, target, start, method.after_first_gate())
        refused = _why_refused(motion, prior, driven, overlap)
    return Stitch(prior if refused else motion, residual, overlap, refused)


def _why_refused(motion: Motion, prior: Motion, driven: float, overlap: float) -> str:
    """Why odometry rules the result out; empty where it does not."""
    # At the row, which is about as far from the cameras as they are high: turning moves what is there.
    place = np.array([0.0, 0.6, 0.8])
    moved = float(np.linalg.norm(motion(place) - prior(place)))
    allowed = _ODOMETRY_SHARE * abs(driven) + _WOBBLE
    if overlap < _MIN_OVERLAP:
        return f"only {100 * overlap:.0f} % of the points overlap"
    if moved > allowed:
        return f"it moved {1e3 * moved:.0f} mm from the odometry, which allows {1e3 * allowed:.0f} mm"
    if motion.angle > _TURN:
        return f"it turned by {math.degrees(motion.angle):.1f} degrees"
    return ""


def closest_points(source: np.ndarray, target: Thinned, start: Motion, method: Method) -> tuple[Motion, float, float]:
    """Iterative closest points.

    Args:
        source: [N, 3], m.
        target: Cloud that they are laid on.
        start: Motion to begin with.
        method: Gates and steps.

    Returns:
        The motion, the root mean square distance of corresponding points in m, and the share of points that have one.
    """
    motion, residual, overlap = start, math.nan, 0.0
    for gate, most in zip(method.gates, method.most):
        chosen = source[:: max(len(source) // most, 1)]
        still = _STILL * gate if method.from_odometry else 1e-5
        for _ in range(method.steps):
            moved = motion(chosen)
            distance, place = target.tree.query(moved, distance_upper_bound=gate)
            close = np.isfinite(distance)
            overlap = float(close.mean())
            if close.sum() < 6:
                return motion, math.nan, overlap
            residual = math.sqrt(float(np.mean(distance[close] ** 2)))
            # What lies farther away than most weighs less: it is seen in one of the two pairs only.
            weight = 1.0 / (1.0 + (distance[close] / (0.3 * gate)) ** 2) if method.from_odometry else np.ones(close.sum())
            step = rigid(moved[close], target.points[place[close]], weight)
            motion = step.after(motion)
            if max(float(np.linalg.norm(step.shift)), step.angle) < still:
                break
    return motion, residual, overlap


def rigid(source: np.ndarray, target: np.ndarray, weight: np.ndarray) -> Motion:
    """The rigid motion that brings points [N, 3] nearest to others [N, 3], by weighted least squares."""
    share = weight / weight.sum()
    here, there = share @ source, share @ target
    left, _, right = np.linalg.svd(((source - here) * share[:, None]).T @ (target - there))
    turn = np.diag([1.0, 1.0, np.sign(np.linalg.det(right.T @ left.T))])
    rotation = right.T @ turn @ left.T
    return Motion(rotation, there - rotation @ here)
