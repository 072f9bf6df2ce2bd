"""The dynamics of a tree of links number by number (`folding`): poses, mass matrix and the forces that motion takes.

All is computed in the frames of the links (`links`), where the axes of joints and the masses of bodies are constants, and
little is left to compute. It is also where float32 loses least: nothing is a small difference of large numbers.

Source: Featherstone, "Rigid Body Dynamics Algorithms": recursive Newton-Euler, 5.3, and composite rigid bodies, 6.2.
"""

from collections.abc import Collection, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from jaxrl_vis_envs.physics.folding import (
    NOTHING,
    Symmetric,
    Vector,
    add,
    combine,
    cross,
    dot,
    floats,
    minus,
    place,
    plus,
    scale,
    sine_and_cosine,
    symmetric_times,
    times,
)
from jaxrl_vis_envs.physics.links import WORLD, Link


class Joint(NamedTuple):
    """How far a joint has moved from where it is at rest.

    Attributes:
        sine: Of the angle it has turned by; a known 0 where it slides.
        cosine: A known 1 where it slides.
        slide: The way it has slid, m; a known 0 where it turns.
        half_turn: Sine and cosine of half the angle, for joints of which quaternions are asked for.
    """

    sine: Any
    cosine: Any
    slide: Any
    half_turn: tuple[Any, Any] = (0.0, 1.0)


class Pose(NamedTuple):
    """Where a link is in a frame that many share.

    Attributes:
        origin: Of the link's frame.
        axes: Of the link's frame, three vectors.
    """

    origin: Vector
    axes: tuple[Vector, Vector, Vector]


class _Body(NamedTuple):
    """The masses of a link, and of all that hangs on it, about the origin of its frame; see `Link`."""

    mass: float
    moment: Vector
    inertia: Symmetric


def joints_at(links: list[Link], displacement: list[Any], with_half_turns: Collection[int] = ()) -> list[Joint]:
    """The joints, moved by ``displacement`` (rad or m) from where they are at rest, some of them with `Joint.half_turn`."""
    joints = []
    for index, (link, moved) in enumerate(zip(links, displacement, strict=True)):
        if link.slides:
            joints.append(Joint(0.0, 1.0, moved))
        elif index in with_half_turns:
            sine, cosine = sine_and_cosine(0.5 * moved)
            twice = 2.0 * sine
            joints.append(Joint(twice * cosine, 1.0 - twice * sine, 0.0, (sine, cosine)))
        else:
            joints.append(Joint(*sine_and_cosine(moved), 0.0))
    return joints


def pose_after(link: Link, joint: Joint, before: Pose) -> Pose:
    """The pose of a link whose parent has the pose ``before``."""
    origin = add(before.origin, combine(before.axes, _shift(link, joint)))
    axes = [combine(before.axes, floats(column)) for column in link.turn.T]
    one, other = (link.axis + 1) % 3, (link.axis + 2) % 3
    ahead = add(scale(axes[one], joint.cosine), scale(axes[other], joint.sine))
    axes[other] = add(scale(axes[other], joint.cosine), scale(axes[one], minus(0.0, joint.sine)))
    axes[one] = ahead
    return Pose(origin, (axes[0], axes[1], axes[2]))


def mass_matrix(links: list[Link], joints: list[Joint]) -> dict[tuple[int, int], Any]:
    """The mass matrix (kg m^2 and the like) between each joint and those it hangs on: (joint, ancestor) -> number."""
    whole = [_Body(link.mass, _vector(link.moment), _table(link.inertia)) for link in links]
    matrix: dict[tuple[int, int], Any] = {}
    for index in reversed(range(len(links))):
        link = links[index]
        # What it takes to move the link and all that hangs on it at unit speed along the joint.
        axis = _unit(link.axis)
        if link.slides:
            impulse, spin = scale(axis, whole[index].mass), cross(whole[index].moment, axis)
        else:
            impulse, spin = cross(axis, whole[index].moment), symmetric_times(whole[index].inertia, axis)
        here = index
        while True:
            matrix[index, here] = (impulse if links[here].slides else spin)[links[here].axis]
            if links[here].parent < 0:
                break
            impulse, spin = _wrench_to_parent(links[here], joints[here], impulse, spin)
            here = links[here].parent
        if link.parent >= 0:
            whole[link.parent] = _together(whole[link.parent], _to_parent(link, joints[index], whole[index]))
    return matrix


def bias(
    links: list[Link],
    joints: list[Joint],
    velocity: list[Any],
    gravity: np.ndarray,
    roots: Mapping[int, Pose] = MappingProxyType({}),
) -> list[Any]:
    """The forces on the joints (N m or N) that their ``velocity`` (rad/s or m/s) takes if nothing accelerates, under gravity.

    Args:
        links: Of the model.
        joints: Where they are.
        velocity: Of the joints.
        gravity: [3], m/s^2, in the world.
        roots: Where the mocap bodies are in the world that links hang on.
    """
    starts = {WORLD: _Motion(NOTHING, NOTHING, _vector(-gravity))}
    for root, pose in roots.items():
        x, y, z = (dot(axis, _vector(-gravity)) for axis in pose.axes)
        starts[root] = _Motion(NOTHING, NOTHING, (x, y, z))
    motions: list[_Motion] = []
    for link, joint, rate in zip(links, joints, velocity, strict=True):
        motions.append((motions[link.parent] if link.parent >= 0 else starts[link.parent]).carried(link, joint, rate))
    wrenches = [motion.wrench(link) for motion, link in zip(motions, links, strict=True)]
    forces: list[Any] = [0.0] * len(links)
    for index in reversed(range(len(links))):
        link, (force, torque) = links[index], wrenches[index]
        forces[index] = (force if link.slides else torque)[link.axis]
        if link.parent >= 0:
            force, torque = _wrench_to_parent(link, joints[index], force, torque)
            own_force, own_torque = wrenches[link.parent]
            wrenches[link.parent] = add(own_force, force), add(own_torque, torque)
    return forces


class _Motion:
    """How a link moves, in its own frame: angular velocity and acceleration, and the acceleration of the frame's origin."""

    def __init__(self, spin: Vector, change: Vector, lift: Vector) -> None:
        self._spin, self._change, self._lift = spin, change, lift
        (x, y, z), (a, b, c) = spin, change
        xx, yy, zz = times(x, x), times(y, y), times(z, z)
        xy, yz, xz = times(x, y), times(y, z), times(x, z)
        # The acceleration of points that ride along, by how far from the origin they are.
        self._by_distance = (
            (minus(0.0, plus(yy, zz)), plus(xy, c), minus(xz, b)),
            (minus(xy, c), minus(0.0, plus(xx, zz)), plus(yz, a)),
            (plus(xz, b), minus(yz, a), minus(0.0, plus(xx, yy))),
        )

    def carried(self, link: Link, joint: Joint, rate: Any) -> "_Motion":
        """The motion of a link that hangs on this one by a joint which moves at ``rate`` without accelerating."""
        lift = _to_link(link, joint, add(self._lift, combine(self._by_distance, _shift(link, joint))))
        spin, change = _to_link(link, joint, self._spin), _to_link(link, joint, self._change)
        own = scale(_unit(link.axis), rate)
        if link.slides:
            return _Motion(spin, change, add(lift, scale(cross(spin, own), 2.0)))
        return _Motion(add(spin, own), add(change, cross(spin, own)), lift)

    def wrench(self, link: Link) -> tuple[Vector, Vector]:
        """The force and the torque about the frame's origin that this motion of the link takes."""
        moment, inertia = _vector(link.moment), _table(link.inertia)
        force = add(scale(self._lift, link.mass), combine(self._by_distance, moment))
        turning = add(symmetric_times(inertia, self._change), cross(self._spin, symmetric_times(inertia, self._spin)))
        return force, add(turning, cross(moment, self._lift))


def _unit(axis: int) -> Vector:
    return floats(np.eye(3)[axis])  # type: ignore[return-value] - of three


def _vector(array: np.ndarray) -> Vector:
    return floats(array)  # type: ignore[return-value] - of three


def _table(matrix: np.ndarray) -> Symmetric:
    return {(row, column): float(matrix[row, column]) for row in range(3) for column in range(row, 3)}


def _shift(link: Link, joint: Joint) -> Vector:
    """The origin of a link's frame in the parent's."""
    return add(_vector(link.shift), scale(_vector(link.turn[:, link.axis]), joint.slide))


def _turned(link: Link, sine: Any, cosine: Any, vector: Vector) -> Vector:
    """A vector turned about a joint's axis."""
    one, other = (link.axis + 1) % 3, (link.axis + 2) % 3
    parts = list(vector)
    parts[one] = minus(times(cosine, vector[one]), times(sine, vector[other]))
    parts[other] = plus(times(sine, vector[one]), times(cosine, vector[other]))
    return parts[0], parts[1], parts[2]


def _to_link(link: Link, joint: Joint, vector: Vector) -> Vector:
    """A vector of the parent's frame in that of the link."""
    x, y, z = (dot(_vector(column), vector) for column in link.turn.T)
    return _turned(link, minus(0.0, joint.sine), joint.cosine, (x, y, z))


def _wrench_to_parent(link: Link, joint: Joint, force: Vector, torque: Vector) -> tuple[Vector, Vector]:
    """Force and torque about the origin of a link's frame, for the frame of its parent."""
    columns = [_vector(column) for column in link.turn.T]
    force = combine(columns, _turned(link, joint.sine, joint.cosine, force))
    torque = combine(columns, _turned(link, joint.sine, joint.cosine, torque))
    return force, add(torque, cross(_shift(link, joint), force))


def _together(one: _Body, other: _Body) -> _Body:
    inertia = {where: plus(one.inertia[where], other.inertia[where]) for where in one.inertia}
    return _Body(one.mass + other.mass, add(one.moment, other.moment), inertia)


def _to_parent(link: Link, joint: Joint, body: _Body) -> _Body:
    """The masses of a link's frame, for the frame of its parent."""
    columns = [_vector(column) for column in link.turn.T]
    moment = combine(columns, _turned(link, joint.sine, joint.cosine, body.moment))
    turned = _turned_inertia(link.axis, joint, body.inertia)
    rows = [_vector(row) for row in link.turn]
    inertia: Symmetric = {}
    shift, mass = _shift(link, joint), body.mass
    for row in range(3):
        half = symmetric_times(turned, rows[row])
        for column in range(row, 3):
            value = dot(rows[column], half)
            if row == column:
                others = [axis for axis in range(3) if axis != row]
                away = plus(
                    *(times(2.0, moment[axis], shift[axis]) for axis in others),
                    *(times(mass, shift[axis], shift[axis]) for axis in others),
                )
            else:
                crosswise = plus(times(moment[row], shift[column]), times(moment[column], shift[row]))
                away = minus(0.0, plus(crosswise, times(mass, shift[row], shift[column])))
            inertia[row, column] = plus(value, away)
    return _Body(mass, add(moment, scale(shift, mass)), inertia)


def _turned_inertia(axis: int, joint: Joint, inertia: Symmetric) -> Symmetric:
    """A symmetric matrix turned with a joint."""
    one, other = (axis + 1) % 3, (axis + 2) % 3
    sine, cosine = joint.sine, joint.cosine
    first, second, mixed = inertia[one, one], inertia[other, other], inertia[place(one, other)]
    left, right = inertia[place(axis, one)], inertia[place(axis, other)]
    tilt = plus(times(sine, minus(first, second)), times(2.0, cosine, mixed))
    return {
        (axis, axis): inertia[axis, axis],
        (one, one): minus(first, times(sine, tilt)),
        (other, other): plus(second, times(sine, tilt)),
        place(one, other): minus(times(cosine, tilt), mixed),
        place(axis, one): minus(times(cosine, left), times(sine, right)),
        place(axis, other): plus(times(sine, left), times(cosine, right)),
    }
