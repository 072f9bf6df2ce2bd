"""Registration of the clouds of successive pairs by iterative closest points (ICP).

The thesis starts from the identity, with correspondences up to 0.15 m, on a grid of 3 cm. Vertical stalks a few centimetres
apart look alike, so that this converges one or two stalks off. The default starts from the odometry, on a grid of 5 mm, and
narrows correspondences from 0.15 to 0.05, 0.02 and 0.01 m; results that differ more from the odometry than its error allows are
refused.
"""

import dataclasses
import functools
import math

import numpy as np
from scipy.spatial import cKDTree

from jaxrl_vis.stalks.grasping.perception.cloud import Cloud, subsample


@dataclasses.dataclass(frozen=True)
class Motion:
    """Rigid motion p -> ``rotation`` @ p + ``shift``.

    Attributes:
        rotation: [3, 3] float64.
        shift: [3] float64, m.
    """

    rotation: np.ndarray
    shift: np.ndarray

    @classmethod
    def along(cls, distance: float) -> "Motion":
        """Return a translation along the row by ``distance``, m."""
        return cls(np.eye(3), np.array([distance, 0.0, 0.0]))

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Apply the motion to points [..., 3], m."""
        return points @ self.rotation.T + self.shift

    def after(self, first: "Motion") -> "Motion":
        """Return the composition: ``first``, then this motion."""
        return Motion(self.rotation @ first.rotation, self.rotation @ first.shift + self.shift)

    def inverse(self) -> "Motion":
        """Return the inverse motion."""
        return Motion(self.rotation.T, -self.rotation.T @ self.shift)

    @property
    def angle(self) -> float:
        """Angle of the rotation, rad."""
        return math.acos(min(max(0.5 * (float(np.trace(self.rotation)) - 1.0), -1.0), 1.0))


@dataclasses.dataclass(frozen=True)
class Method:
    """Method of stitching clouds.

    Attributes:
        voxel: Edge of a voxel of the grid, m.
        gates: Maximum distances of corresponding points, m, applied in this order.
        steps: Maximum number of iterations with each gate.
        max_points: Approximate number of points of the source cloud with each gate, evenly subsampled.
        from_odometry: If true, start from the odometry, refuse results that differ too much from it, and weight
            correspondences robustly; if not, start from the identity.
        pixels: Approximate number of pixels of an image to use, evenly subsampled.
    """

    voxel: float
    gates: tuple[float, ...]
    steps: int
    max_points: tuple[int, ...]
    from_odometry: bool
    pixels: int = 1_000_000_000

    def without_first_gate(self) -> "Method":
        """Return the method without its first, widest gate."""
        return dataclasses.replace(self, gates=self.gates[1:], max_points=self.max_points[1:])


THESIS = Method(voxel=0.03, gates=(0.15,), steps=50, max_points=(1_000_000,), from_odometry=False)
# Wide gates only bring the clouds near enough for the next one, for which few points suffice.
DEFAULT = Method(
    voxel=0.005,
    gates=(0.15, 0.05, 0.02, 0.01),
    steps=30,
    max_points=(1000, 1500, 3000, 5000),
    from_odometry=True,
    pixels=512 * 512,
)

_ODOMETRY_FRACTION = 0.05
_MAX_WOBBLE = 0.03  # m
_MAX_TURN = math.radians(3.0)
_MIN_OVERLAP = 0.2
_CONVERGENCE = 0.01  # tolerance of convergence relative to the gate, for translation in m and rotation in rad


@dataclasses.dataclass(frozen=True)
class Stitch:
    """Result of stitching one cloud to the next.

    Attributes:
        motion: From the robot frame of one pair to that of the next one.
        residual: Root mean square distance of corresponding points, m; NaN if there are too few.
        overlap: Fraction of points with a correspondence within the last gate.
        refused: Reason why the result was refused and `motion` is that of the odometry; empty if it was not.
    """

    motion: Motion
    residual: float
    overlap: float
    refused: str = ""


class DownsampledCloud:
    """Cloud downsampled on the grid of a method.

    Attributes:
        points: [N, 3] float64, m.
    """

    def __init__(self, points: np.ndarray, method: Method = DEFAULT) -> None:
        """Downsample points.

        Args:
            points: [N, 3], m.
            method: Method of stitching, which determines the grid.
        """
        self.points = subsample(points, method.voxel)

    @classmethod
    def of(cls, cloud: Cloud, method: Method = DEFAULT) -> "DownsampledCloud":
        """Downsample an organised cloud, from about ``method.pixels`` of its pixels."""
        part = slice(None, None, max(math.isqrt(cloud.depth.size // method.pixels), 1))
        return cls(cloud.points[part, part][np.isfinite(cloud.depth[part, part])], method)

    @functools.cached_property
    def tree(self) -> cKDTree:
        """Search tree for nearest neighbours; not balanced, because on a grid that takes longer than it saves."""
        return cKDTree(self.points, balanced_tree=False, compact_nodes=False)


def stitch(source: DownsampledCloud, target: DownsampledCloud, distance: float, method: Method = DEFAULT) -> Stitch:
    """Register the cloud of one pair with that of the next.

    Args:
        source, target: Clouds of the pair and the next one, each in its own robot frame.
        distance: Distance that the robot drove along the row between the pairs by its odometry, m.
        method: Method of stitching.

    Returns:
        The motion between the pairs' robot frames; that of the odometry if the result is refused or a cloud has fewer than 10
        points.
    """
    prior = Motion.along(-distance)
    start = prior if method.from_odometry else Motion.along(0.0)
    if len(source.points) < 10 or len(target.points) < 10:
        return Stitch(prior, math.nan, 0.0, "a cloud is empty")
    motion, residual, overlap = icp(source.points, target, start, method)
    refused = _rejection_reason(motion, prior, distance, overlap) if method.from_odometry else ""
    if refused and len(method.gates) > 1:
        # With little overlap, points of one pair alone bias the widest gate; the odometry may be good enough for the next one.
        motion, residual, overlap = icp(source.points, target, start, method.without_first_gate())
        refused = _rejection_reason(motion, prior, distance, overlap)
    return Stitch(prior if refused else motion, residual, overlap, refused)


def _rejection_reason(motion: Motion, prior: Motion, distance: float, overlap: float) -> str:
    """Return the reason to refuse a result, by overlap and odometry; empty to accept it."""
    # Compare displacements at a point of the row, so that rotations count as well.
    place = np.array([0.0, 0.6, 0.8])
    moved = float(np.linalg.norm(motion(place) - prior(place)))
    allowed = _ODOMETRY_FRACTION * abs(distance) + _MAX_WOBBLE
    if overlap < _MIN_OVERLAP:
        return f"only {100 * overlap:.0f} % of the points overlap"
    if moved > allowed:
        return f"it moved {1e3 * moved:.0f} mm from the odometry, which allows {1e3 * allowed:.0f} mm"
    if motion.angle > _MAX_TURN:
        return f"it turned by {math.degrees(motion.angle):.1f} degrees"
    return ""


def icp(source: np.ndarray, target: DownsampledCloud, start: Motion, method: Method) -> tuple[Motion, float, float]:
    """Register points with a cloud by iterative closest points.

    Args:
        source: [N, 3], points to move, m.
        target: Cloud to register with.
        start: Initial motion.
        method: Gates and steps.

    Returns:
        The motion, the root mean square distance of corresponding points (m; NaN for fewer than 6), and the fraction of points
        with a correspondence within the last gate that was applied.
    """
    motion, residual, overlap = start, math.nan, 0.0
    for gate, max_points in zip(method.gates, method.max_points):
        chosen = source[:: max(len(source) // max_points, 1)]
        still = _CONVERGENCE * gate if method.from_odometry else 1e-5
        for _ in range(method.steps):
            moved = motion(chosen)
            distance, place = target.tree.query(moved, distance_upper_bound=gate)
            close = np.isfinite(distance)
            overlap = float(close.mean())
            if close.sum() < 6:
                return motion, math.nan, overlap
            residual = math.sqrt(float(np.mean(distance[close] ** 2)))
            # Distant correspondences weigh less: their points are probably visible in one of the two pairs only.
            weight = 1.0 / (1.0 + (distance[close] / (0.3 * gate)) ** 2) if method.from_odometry else np.ones(close.sum())
            step = fit_rigid_motion(moved[close], target.points[place[close]], weight)
            motion = step.after(motion)
            if max(float(np.linalg.norm(step.shift)), step.angle) < still:
                break
    return motion, residual, overlap


def fit_rigid_motion(source: np.ndarray, target: np.ndarray, weight: np.ndarray) -> Motion:
    """Fit the rigid motion from points [N, 3] to corresponding ones [N, 3], by least squares with weights [N].

    Source: Kabsch (1976).
    """
    weights = weight / weight.sum()
    here, there = weights @ source, weights @ target
    left, _, right = np.linalg.svd(((source - here) * weights[:, None]).T @ (target - there))
    turn = np.diag([1.0, 1.0, np.sign(np.linalg.det(right.T @ left.T))])
    rotation = right.T @ turn @ left.T
    return Motion(rotation, there - rotation @ here)
