"""Choice of an approach to a stalk: stop, solution of the inverse kinematics, and height; or refusal.

Stalks lean, so that a stalk that blocks the path at one height does not at another. Over all stops, both solutions and heights
around the grasp point, the approach is chosen with maximum room between the gripper and the other detected stalks. If the room
is too small, the arm is not sent, because it would push other stalks, or hold two; such targets are counted as refused.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxrl_vis.stalks.grasping.arm import approach
from jaxrl_vis.stalks.grasping.perception.lines import HEIGHTS, GraspPoint

MIN_CLEARANCE = 0.0045
"""Minimum room beside the open gripper on its whole path, m, below which the arm is not sent."""
_SUFFICIENT_CLEARANCE = 0.02  # m: more room is no better
_STEPS = tuple(sign * step for step in np.arange(0.0, 0.31, 0.05) for sign in (-1.0, 1.0))
# m, candidate heights relative to the grasp point: farther away, the line is not reliable
_HEIGHT_PENALTY = 0.005  # m per m: penalty on the room for the distance from the height of the grasp point
_USUAL_RADIUS = 0.007  # m: radius of stalks of unknown thickness


class Choice(NamedTuple):
    """Chosen approach to a stalk.

    Attributes:
        stop: Index of the stop; -1 if the stalk is out of reach from all stops.
        side: Solution of the inverse kinematics, 1 or -1.
        room: Clearance between the open gripper and other stalks on its path, m; -inf if there is no path.
        point: [3] float64, where the jaws should close, m, in the frame of the grasp points.
    """

    stop: int
    side: int
    room: float
    point: np.ndarray

    @property
    def is_blocked(self) -> bool:
        """True if the stalk is within reach, but other stalks leave less than `MIN_CLEARANCE`."""
        return self.stop >= 0 and self.room < MIN_CLEARANCE


def choose_approaches(points: Sequence[GraspPoint], stops: np.ndarray, heights: tuple[float, float] = HEIGHTS) -> list[Choice]:
    """Choose an approach to each of the detected stalks, by maximum room at heights up to 0.3 m from the grasp point.

    Room beyond 20 mm counts no more, and 5 mm of room are deducted for each metre from the height of the grasp point.

    Args:
        points: Grasp points, in one robot frame.
        stops: [S, 3], `Stands.origin` of each possible stop, in the same frame, m.
        heights: Minimum and maximum height of a grasp, m above the ground.

    Returns:
        One choice for each point, in order; with stop -1 and the grasp point itself for points that are out of reach.
    """
    chosen = []
    for point in points:
        best, worth = Choice(-1, 1, -np.inf, point.point), -np.inf
        for step in _STEPS:
            height = float(np.clip(point.point[2] + step, *heights))
            path = _approach_at(point, points, stops, height)
            if path.stop < 0:
                continue
            value = min(path.room, _SUFFICIENT_CLEARANCE) - _HEIGHT_PENALTY * abs(height - point.point[2])
            if value > worth:
                best, worth = Choice(path.stop, path.side, path.room, point.at_height(height)), value
        chosen.append(best)
    return chosen


def choose_nearest(points: Sequence[GraspPoint], stops: np.ndarray, heights: tuple[float, float]) -> list[Choice]:
    """Choose the stop nearest to each stalk along the row, and the height of its grasp point, clipped to ``heights``.

    Args:
        points, stops, heights: See `choose_approaches`.

    Returns:
        One choice for each point, in order; its stop is -1 if the point is out of reach from the nearest stop.
    """
    chosen = []
    for point in points:
        height = float(np.clip(point.point[2], *heights))
        target = point.at_height(height)
        stop = int(np.argmin(np.abs(stops[:, 0] - target[0])))
        path = _approach_at(point, points, stops[stop : stop + 1], height)
        chosen.append(Choice(stop if path.stop >= 0 else -1, path.side, path.room, target))
    return chosen


def _approach_at(point: GraspPoint, points: Sequence[GraspPoint], stops: np.ndarray, height: float) -> approach.Approach:
    """Return the best approach to one of the points at a height, with all others as obstacles at this height."""
    others = [other for other in points if other is not point]
    other_points = np.array([other.at_height(height) for other in others]).reshape(-1, 3)
    return approach.best_approach(
        stops, point.at_height(height), other_points[:, :2], stalk_radii(others, height), _SUFFICIENT_CLEARANCE
    )


def stalk_radii(points: Sequence[GraspPoint], height: float | None = None) -> np.ndarray:
    """Return the radii [B] of stalks as float64, m; 7 mm for stalks of unknown thickness.

    Args:
        points: Grasp points of B stalks.
        height: Height above the ground, m; None for the height of each grasp point.
    """
    thickness = [point.thickness if height is None else point.thickness_at(height) for point in points]
    radii = 0.5 * np.array(thickness, float)
    return np.where(np.isfinite(radii), radii, _USUAL_RADIUS)
