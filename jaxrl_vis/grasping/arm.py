"""The arm's way to a stalk and its controllers: a straight line out of the first joint, PID and PI, springs in the joints.

A reach takes two seconds. While the slide goes to the height of the target, the folded arm turns towards it. Then the grip
moves along the straight line that the first joint and the target define, until the stalk is between the jaws. Both solutions
of the inverse kinematics move the grip along the same line; they differ in where the forearm comes from.

Source: section 4.2.2 of the thesis. It tuned its gains by hand and does not state them; ours are tuned by hand, too.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs.tasks import stalk_arm

RATE = 250.0
"""Frequency of the controllers, Hz."""
FOLDED = 0.34
"""Distance of the grip from the first joint before it moves outwards, m."""
_ROOM_POINTS, _TURN_POINTS = 40, 16
_FOLDED_ROOM = 0.02  # m, of the tips of the folded jaws from the middle of the nearest stalk that they reach for
HOME = (0.0, stalk_arm.SHOULDER[1] + FOLDED, 0.85)
"""Where the grip waits, m in the frame of a stand."""


@dataclasses.dataclass(frozen=True)
class Timing:
    """How long the parts of a reach take, s."""

    turn: float = 0.8
    """The slide moves and the folded arm turns."""
    extend: float = 1.0
    """The grip moves outwards along the line."""
    settle: float = 0.2
    """The grip waits for what the controllers still lack."""
    close: float = 0.4
    """The jaws close."""

    @property
    def reach(self) -> float:
        """Until the jaws close."""
        return self.turn + self.extend + self.settle


class Gains(NamedTuple):
    """What drives the joints; [2] for shoulder and elbow. SI units."""

    proportional: Any = (260.0, 130.0)  # N m/rad
    integral: Any = (600.0, 300.0)  # N m/(rad s)
    derivative: Any = (18.0, 7.0)  # N m s/rad
    spring: Any = (180.0, 90.0)  # N m/rad, the elastic part of a joint
    torque: Any = (30.0, 15.0)  # N m, the most
    motor: float = 120.0  # 1/s, how fast a motor follows what it is told
    slide_proportional: float = 25.0  # 1/s
    slide_integral: float = 4.0  # 1/s^2
    slide_speed: float = 1.0  # m/s, the most
    slide_drive: float = 400.0  # N s/m
    jaw_force: float = 10.0  # N


class Drive(NamedTuple):
    """What the controllers remember.

    Attributes:
        integral: [3] float32, the integrated errors of slide, shoulder and elbow, m s and rad s.
        motor: [2] float32, where the motors before the springs of shoulder and elbow are, rad.
        error: [2] float32, the last errors of shoulder and elbow, rad.
    """

    integral: jax.Array
    motor: jax.Array
    error: jax.Array


def smooth(share: Any) -> Any:
    """Minimum jerk: how far, of 1, a movement has come after a ``share`` of its time; at rest at both ends."""
    share = jnp.clip(share, 0.0, 1.0)
    return share**3 * (10.0 - 15.0 * share + 6.0 * share**2)


def better_side(target: Any, numeric: Any = jnp) -> Any:
    """The solution, 1 or -1, whose forearm points more squarely at the row, for ``target`` [..., 3] (m, frame of a stand)."""
    return numeric.where(target[..., 0] > stalk_arm.SHOULDER[0], 1.0, -1.0)


def planned(target: jax.Array, start: jax.Array, time: Any, timing: Timing) -> jax.Array:
    """Where the grip should be at a time, on its way from `HOME` to ``target``: [3] m.

    Args:
        target: [3], m in the frame of a stand.
        start: [3], where the grip was at time 0, m.
        time: [] since the start, s.
        timing: Of the reach.
    """
    shoulder = jnp.asarray(stalk_arm.SHOULDER, jnp.float32)
    turned = smooth(time / timing.turn)
    extended = smooth((time - timing.turn) / timing.extend)
    bearings = [jnp.arctan2(-(place - shoulder)[0], (place - shoulder)[1]) for place in (start[:2], target[:2])]
    radii = [jnp.linalg.norm(place - shoulder) for place in (start[:2], target[:2])]
    bearing = bearings[0] + turned * (bearings[1] - bearings[0])
    folded = radii[0] + turned * (FOLDED - radii[0])
    radius = folded + extended * (radii[1] - FOLDED)
    height = start[2] + turned * (target[2] - start[2])
    return jnp.stack([shoulder[0] - radius * jnp.sin(bearing), shoulder[1] + radius * jnp.cos(bearing), height])


def start_drive(joints: jax.Array) -> Drive:
    """Controllers of an arm at rest at ``joints`` [3]."""
    return Drive(jnp.zeros(3, jnp.float32), joints[1:3], jnp.zeros(2, jnp.float32))


def drive(state: Drive, joints: jax.Array, velocity: jax.Array, wanted: jax.Array, gains: Gains) -> tuple[Drive, jax.Array]:
    """One period of the controllers.

    Args:
        state: What they remember.
        joints: [3], slide, shoulder and elbow, m and rad.
        velocity: [3], of these, m/s and rad/s.
        wanted: [3], where they should be.
        gains: Of the controllers.

    Returns:
        What they remember now; and what acts on the joints [3], N and N m.
    """
    period = 1.0 / RATE
    error = wanted - joints
    integral = jnp.clip(state.integral + period * error, -0.05, 0.05)
    parts = [jnp.asarray(part, jnp.float32) for part in gains[:5]]
    proportional, integrating, derivative, spring, most = parts
    slope = (error[1:] - state.error) / period
    wish = jnp.clip(proportional * error[1:] + integrating * integral[1:] + derivative * slope, -most, most)
    # A motor gives a torque by how far it winds up the spring between itself and its joint.
    motor = state.motor + period * gains.motor * (joints[1:] + wish / spring - state.motor)
    torque = jnp.clip(spring * (motor - joints[1:]), -most, most)
    speed = gains.slide_proportional * error[0] + gains.slide_integral * integral[0]
    force = gains.slide_drive * (jnp.clip(speed, -gains.slide_speed, gains.slide_speed) - velocity[0])
    return Drive(integral, motor, error[1:]), jnp.concatenate([force[None], torque])


def reachable(rail_pose: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Whether the arm's lengths and joint limits let its grip be at a target: [...] bool. Nothing else counts.

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
    """How much room other stalks leave the open gripper on its way, with the elbow to either side.

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
    found = []
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
        found.append(gap.min(axis=(1, 2), initial=np.inf))
    return np.stack(found, axis=-1)


class Way(NamedTuple):
    """From where, and with which solution, a stalk is reached.

    Attributes:
        stop: Index of the place of the mast; -1 where none will do.
        side: Which solution: 1 or -1.
        room: What other stalks leave the open gripper on the way, m; -inf where there is no way.
    """

    stop: int
    side: int
    room: float


def best_way(origins: np.ndarray, target: np.ndarray, others: np.ndarray, radii: np.ndarray, enough: float = 0.02) -> Way:
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
        return Way(-1, int(better_side(target, np)), -np.inf)
    distance = np.linalg.norm(local[:, :2] - np.array(stalk_arm.SHOULDER), axis=-1)
    # A millimetre of room is worth a metre of way: it only decides between equals.
    worth = np.where(can[:, None], np.minimum(rooms, enough) - 1e-3 * distance[:, None], -np.inf)
    stop, column = np.unravel_index(np.argmax(worth), worth.shape)
    return Way(int(stop), (1, -1)[int(column)], float(rooms[stop, column]))


def _to_box(aside: np.ndarray, ahead: np.ndarray, half_width: float, back: float, front: float) -> np.ndarray:
    """Distance in m of points from a rectangle: ``aside`` of its middle line, and ``ahead`` along it; negative inside."""
    outside = np.stack([aside - half_width, np.maximum(back - ahead, ahead - front)])
    return np.linalg.norm(np.maximum(outside, 0.0), axis=0) + np.minimum(outside.max(axis=0), 0.0)
