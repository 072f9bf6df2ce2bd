"""Choice of an approach to a stalk: the stop, the solution of the arm's kinematics and the height, or none at all.

Stalks lean, so that what is in the way at one height is not at another one. Of all stops, both solutions and the heights around
the grasp point, the way is chosen on which the other stalks leave most room, as far as is known of them. Where that is too
little, the arm is not sent: it would push other stalks, or hold two of them. Refused targets are counted as such.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxrl_vis.stalks.grasping.arm import approach
from jaxrl_vis.stalks.grasping.perception.lines import HEIGHTS, GraspPoint

MIN_ROOM = 0.0045
"""Room in m beside the open gripper, on its whole way, with less of which the arm is not sent."""
_ENOUGH_ROOM = 0.02  # m: more room is no better
_STEPS = tuple(sign * step for step in np.arange(0.0, 0.31, 0.05) for sign in (-1.0, 1.0))
# m, from the height of the grasp point: further away the line is not believed
_UNSURE = 0.005  # m per m: how much less is known of a stalk away from the height of its grasp point
_USUAL_RADIUS = 0.007  # m: radius of a stalk whose thickness is not known


class Choice(NamedTuple):
    """An approach to a stalk.

    Attributes:
        stop: Index of the stop; -1 where the arm's geometry does not let it be reached from any.
        side: Solution of the kinematics: 1 or -1.
        room: Room that other stalks leave the open gripper on its path, m; -inf if there is no path.
        point: [3] float64, where the jaws are to close, m.
    """

    stop: int
    side: int
    room: float
    point: np.ndarray

    @property
    def is_blocked(self) -> bool:
        """True if it could be reached, but other stalks are in the way."""
        return self.stop >= 0 and self.room < MIN_ROOM


def choose(points: Sequence[GraspPoint], stops: np.ndarray, heights: tuple[float, float] = HEIGHTS) -> list[Choice]:
    """Choose a way to each of the stalks that were found.

    Args:
        points: Grasp points, in one robot frame.
        stops: [S, 3], `Stands.origin` of each place where the robot may stop, in the same frame, m.
        heights: Lowest and highest grasp, m above the ground.
    """
    chosen = []
    for point in points:
        best, worth = Choice(-1, 1, -np.inf, point.point), -np.inf
        for step in _STEPS:
            height = float(np.clip(point.point[2] + step, *heights))
            path = _approach_at(point, points, stops, height)
            if path.stop < 0:
                continue
            value = min(path.room, _ENOUGH_ROOM) - _UNSURE * abs(height - point.point[2])
            if value > worth:
                best, worth = Choice(path.stop, path.side, path.room, point.at_height(height)), value
        chosen.append(best)
    return chosen


def choose_nearest(points: Sequence[GraspPoint], stops: np.ndarray, heights: tuple[float, float]) -> list[Choice]:
    """The stop that is nearest along the row for each stalk, and the height between two that is nearest to its grasp point.

    Args:
        points, stops, heights: See `choose`.
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
    """The best way to one of the points at a height, among all others as they are there."""
    others = [other for other in points if other is not point]
    beside = np.array([other.at_height(height) for other in others]).reshape(-1, 3)
    return approach.best_approach(stops, point.at_height(height), beside[:, :2], stalk_radii(others, height), _ENOUGH_ROOM)


def stalk_radii(points: Sequence[GraspPoint], height: float | None = None) -> np.ndarray:
    """Radii [B] of stalks at a height, or at their grasp points, m: a usual one where a thickness is not known."""
    thickness = [point.thickness if height is None else point.thickness_at(height) for point in points]
    radii = 0.5 * np.array(thickness, float)
    return np.where(np.isfinite(radii), radii, _USUAL_RADIUS)
