"""Geometry of a reach: reachability of targets, clearance of the gripper to other stalks, and the best approach to a stalk.

Source: section 4.2.2 of the thesis.
"""

from typing import NamedTuple

import numpy as np

from jaxrl_vis.stalks.grasping.arm.control import FOLDED, better_side
from jaxrl_vis_envs.tasks import stalk_arm

_ROOM_POINTS, _TURN_POINTS = 40, 16
_FOLDED_CLEARANCE = 0.02  # m, minimum distance between the tips of the folded arm's jaws and the centre of the target


def is_within_reach(origin: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return True where the arm can reach a target in front of it, with obstacles ignored.

    The target and the point on the way to it at which the arm is folded must be within the arm's lengths and joint limits, with
    one solution of the inverse kinematics, and the jaws of the folded arm must not yet reach the target.

    Args:
        origin: [..., 3], `Stands.origin`: point of the row's line that the arm faces, m in the plot's frame.
        target: [..., 3], target of the grip, m in the plot's frame; broadcast with ``origin``.

    Returns:
        [...] bool.
    """
    local = np.asarray(target, float) - np.asarray(origin, float)
    place = local[..., :2] - np.array(stalk_arm.SHOULDER)
    distance = np.linalg.norm(place, axis=-1)
    # With the arm folded, the open jaws must be in front of the stalk.
    far_enough = distance >= FOLDED + stalk_arm.TIPS + _FOLDED_CLEARANCE
    start = local.copy()
    start[..., :2] = stalk_arm.SHOULDER + place * (FOLDED / np.maximum(distance, 1e-9))[..., None]
    both = stalk_arm.is_reachable(local) & stalk_arm.is_reachable(start)
    return both.any(axis=-1) & far_enough & (place[..., 1] > 0)


def clearance(target: np.ndarray, others: np.ndarray, radii: np.ndarray, whole_path: bool = True) -> np.ndarray:
    """Return the clearance between other stalks and the open gripper on its path, with the elbow to either side.

    Args:
        target: [B, 3], m in the frame of the stand.
        others: [B, M, 2], centres of other stalks at the target's height, m in the frame of the stand; NaN for absent ones.
        radii: [B, M], radii of these stalks, m.
        whole_path: If true, include the forearm and the whole path, on which the folded arm turns and then extends; if not,
            only the open gripper at the target. Stalks are assumed vertical, although the arm turns at other heights.

    Returns:
        [B, 2] float64, for the solutions 1 and -1: minimum distance between a stalk and the gripper, m. Negative if they
        overlap, infinite if there are no others.
    """
    target, others = np.asarray(target, float), np.asarray(others, float)
    from_shoulder = target[:, :2] - np.array(stalk_arm.SHOULDER)
    distance = np.linalg.norm(from_shoulder, axis=-1)
    bearing = np.arctan2(-from_shoulder[:, 0], from_shoulder[:, 1])[:, None]
    outwards = np.linspace(0.0, 1.0, _ROOM_POINTS) if whole_path else np.ones(1)
    radius = np.minimum(FOLDED, distance)[:, None] * (1 - outwards) + distance[:, None] * outwards
    if whole_path:
        turned = np.linspace(0.0, 1.0, _TURN_POINTS, endpoint=False)
        radius = np.concatenate([np.full((len(target), _TURN_POINTS), FOLDED), radius], axis=1)
        bearing = bearing * np.concatenate([turned, np.ones(_ROOM_POINTS)])
    place = np.stack([-np.sin(bearing), np.cos(bearing)], axis=-1) * radius[..., None]
    gaps = []
    for side in (1.0, -1.0):
        angles = stalk_arm.angles_at(place, np.full(radius.shape, side), np)
        turn = angles.sum(axis=-1)
        along = np.stack([-np.sin(turn), np.cos(turn)], axis=-1)[:, :, None]
        away = (others[:, None] - np.array(stalk_arm.SHOULDER)) - place[:, :, None]  # [B, K, M, 2]
        ahead = (away * along).sum(axis=-1)
        aside = np.abs(away[..., 0] * along[..., 1] - away[..., 1] * along[..., 0])
        gap = _distance_to_box(aside, ahead, stalk_arm.OUTER_HALF_WIDTH, stalk_arm.PALM_BACK, stalk_arm.TIPS)
        if whole_path:
            gap = np.minimum(gap, _distance_to_box(aside, ahead, stalk_arm.FOREARM_RADIUS, -stalk_arm.FOREARM, 0.0))
        gap = np.where(np.isnan(gap), np.inf, gap - np.asarray(radii)[:, None])
        gaps.append(gap.min(axis=(1, 2), initial=np.inf))
    return np.stack(gaps, axis=-1)


class Approach(NamedTuple):
    """Stop and kinematic solution for reaching a stalk.

    Attributes:
        stop: Index of the stop; -1 if the stalk is out of reach from all stops.
        side: Solution of the inverse kinematics, 1 or -1.
        room: Clearance between the open gripper and other stalks on its path, m; -inf if there is no path.
    """

    stop: int
    side: int
    room: float


def best_approach(
    origins: np.ndarray, target: np.ndarray, others: np.ndarray, radii: np.ndarray, enough: float = 0.02
) -> Approach:
    """Return the approach with maximum room over all stops and solutions; among those with ``enough`` room, the shortest.

    Args:
        origins: [S, 3], `Stands.origin` of each stop, m in the plot's frame.
        target: [3], m in the plot's frame.
        others: [M, 2], centres of the other known stalks at the target's height, m in the plot's frame.
        radii: [M], radii of these stalks, m.
        enough: Room above which more is no better, m.

    Returns:
        The approach; its stop is -1 and its room -inf if the target is out of reach from all stops.
    """
    origins, target = np.asarray(origins, float).reshape(-1, 3), np.asarray(target, float)
    local = target - origins
    around = np.asarray(others, float).reshape(1, -1, 2) - origins[:, None, :2]
    rooms = clearance(local, around, np.broadcast_to(radii, around.shape[:2]))
    can = is_within_reach(origins, np.broadcast_to(target, origins.shape))
    if not can.any():
        return Approach(-1, int(better_side(target, np)), -np.inf)
    distance = np.linalg.norm(local[:, :2] - np.array(stalk_arm.SHOULDER), axis=-1)
    # A millimetre of room outweighs a metre of path length, which thus only breaks ties.
    worth = np.where(can[:, None], np.minimum(rooms, enough) - 1e-3 * distance[:, None], -np.inf)
    stop, column = np.unravel_index(np.argmax(worth), worth.shape)
    return Approach(int(stop), (1, -1)[int(column)], float(rooms[stop, column]))


def _distance_to_box(offset: np.ndarray, ahead: np.ndarray, half_width: float, back: float, front: float) -> np.ndarray:
    """Return signed distances (m) of points from a rectangle, negative inside.

    Points lie at a distance ``offset`` from the rectangle's centre line and at ``ahead`` along it; the rectangle extends along
    it from ``back`` to ``front``. All are in m, and arrays have the same shape.
    """
    outside = np.stack([offset - half_width, np.maximum(back - ahead, ahead - front)])
    return np.linalg.norm(np.maximum(outside, 0.0), axis=0) + np.minimum(outside.max(axis=0), 0.0)
