"""Geometry of a reach: what the arm can reach, how much room other stalks leave it, and from where it approaches a stalk best.

Source: section 4.2.2 of the thesis.
"""

from typing import NamedTuple

import numpy as np

from jaxrl_vis.stalks.grasping.arm.control import FOLDED, better_side
from jaxrl_vis_envs.tasks import stalk_arm

_ROOM_POINTS, _TURN_POINTS = 40, 16
_FOLDED_ROOM = 0.02  # m, of the tips of the folded jaws from the middle of the nearest stalk that they reach for


def reachable(rail_pose: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return True where the arm's lengths and joint limits let its grip be at a target: [...] bool. Nothing else counts.

    Args:
        rail_pose: [..., 3], `Stands.origin`: the place on the row's line that the arm faces, m in the plot's frame.
        target: [..., 3], m in the plot's frame.
    """
    local = np.asarray(target, float) - np.asarray(rail_pose, float)
    place = local[..., :2] - np.array(stalk_arm.SHOULDER)
    distance = np.linalg.norm(place, axis=-1)
    # Folded, the open jaws have to be this side of the stalk.
    far_enough = distance >= FOLDED + stalk_arm.TIPS + _FOLDED_ROOM
    start = local.copy()
    start[..., :2] = stalk_arm.SHOULDER + place * (FOLDED / np.maximum(distance, 1e-9))[..., None]
    both = stalk_arm.is_within(local) & stalk_arm.is_within(start)
    return both.any(axis=-1) & far_enough & (place[..., 1] > 0)


def room(target: np.ndarray, others: np.ndarray, radii: np.ndarray, whole_way: bool = True) -> np.ndarray:
    """Return the room that other stalks leave the open gripper on its path, with the elbow to either side.

    Args:
        target: [B, 3], m in the frame of the stand.
        others: [B, M, 2], where the middles of other stalks are at the target's height, m; nan for none.
        radii: [B, M], of these, m.
        whole_way: As the folded arm turns, and from there outwards, forearm included; if not, beside the open jaws at the
            target alone. While it turns, the arm comes from another height: stalks are taken to stand upright.

    Returns:
        [B, 2] float64, for the elbow at 1 and -1: the least distance between a stalk and the gripper, m. Negative where they
        would overlap, infinite where there are no others.
    """
    target, others = np.asarray(target, float), np.asarray(others, float)
    from_shoulder = target[:, :2] - np.array(stalk_arm.SHOULDER)
    distance = np.linalg.norm(from_shoulder, axis=-1)
    bearing = np.arctan2(-from_shoulder[:, 0], from_shoulder[:, 1])[:, None]
    outwards = np.linspace(0.0, 1.0, _ROOM_POINTS) if whole_way else np.ones(1)
    radius = np.minimum(FOLDED, distance)[:, None] * (1 - outwards) + distance[:, None] * outwards
    if whole_way:
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
        gap = _to_box(aside, ahead, stalk_arm.OUTER_HALF_WIDTH, stalk_arm.PALM_BACK, stalk_arm.TIPS)
        if whole_way:
            gap = np.minimum(gap, _to_box(aside, ahead, stalk_arm.FOREARM_RADIUS, -stalk_arm.FOREARM, 0.0))
        gap = np.where(np.isnan(gap), np.inf, gap - np.asarray(radii)[:, None])
        gaps.append(gap.min(axis=(1, 2), initial=np.inf))
    return np.stack(gaps, axis=-1)


class Approach(NamedTuple):
    """From where, and with which solution, a stalk is reached.

    Attributes:
        stop: Index of the place of the mast; -1 where none will do.
        side: Solution of the kinematics: 1 or -1.
        room: Room that other stalks leave the open gripper on its path, m; -inf if there is no path.
    """

    stop: int
    side: int
    room: float


def best_approach(
    origins: np.ndarray, target: np.ndarray, others: np.ndarray, radii: np.ndarray, enough: float = 0.02
) -> Approach:
    """The way with most room from any of the places where the robot stops, the shortest of those with ``enough`` of it.

    Args:
        origins: [S, 3], `Stands.origin` of each stop, m in the plot's frame.
        target: [3], m in the plot's frame.
        others: [M, 2], where other stalks are at the target's height, as far as is known, m in the plot's frame.
        radii: [M], of these, m.
        enough: More room than this is no better, m.
    """
    origins, target = np.asarray(origins, float).reshape(-1, 3), np.asarray(target, float)
    local = target - origins
    around = np.asarray(others, float).reshape(1, -1, 2) - origins[:, None, :2]
    rooms = room(local, around, np.broadcast_to(radii, around.shape[:2]))
    can = reachable(origins, np.broadcast_to(target, origins.shape))
    if not can.any():
        return Approach(-1, int(better_side(target, np)), -np.inf)
    distance = np.linalg.norm(local[:, :2] - np.array(stalk_arm.SHOULDER), axis=-1)
    # A millimetre of room is worth a metre of way: it only decides between equals.
    worth = np.where(can[:, None], np.minimum(rooms, enough) - 1e-3 * distance[:, None], -np.inf)
    stop, column = np.unravel_index(np.argmax(worth), worth.shape)
    return Approach(int(stop), (1, -1)[int(column)], float(rooms[stop, column]))


def _to_box(aside: np.ndarray, ahead: np.ndarray, half_width: float, back: float, front: float) -> np.ndarray:
    """Distance in m of points from a rectangle: ``aside`` of its middle line, and ``ahead`` along it; negative inside."""
    outside = np.stack([aside - half_width, np.maximum(back - ahead, ahead - front)])
    return np.linalg.norm(np.maximum(outside, 0.0), axis=0) + np.minimum(outside.max(axis=0), 0.0)
