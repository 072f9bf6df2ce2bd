"""Dynamics of a tree of links in scalars (`partial_arithmetic`): poses, mass matrix and bias forces.

All quantities are expressed in the links' own frames (`links`), where joint axes and inertias are constants and most operations
fold away. This also minimizes the loss of precision in float32: no quantity is a small difference of large numbers.

Source: Featherstone, "Rigid Body Dynamics Algorithms": recursive Newton-Euler, 5.3, and composite rigid bodies, 6.2.
"""

from collections.abc import Collection, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from jaxrl_vis_envs.physics.scalar.links import WORLD, Link
from jaxrl_vis_envs.physics.scalar.partial_arithmetic import (
    ZERO,
    Symmetric,
    Vector,
    add,
    combine,
    cross,
    dot,
    floats,
    minus,
    plus,
    scale,
    sine_and_cosine,
    symmetric_times,
    times,
    upper_key,
)


class JointTransform(NamedTuple):
    """Displacement of a joint from ``qpos0``.

    Attributes:
        sine: Sine of a hinge's angle; a known 0 for slides.
        cosine: Cosine of a hinge's angle; a known 1 for slides.
        slide: Displacement of a slide, m; a known 0 for hinges.
        half_turn: Sine and cosine of half the angle, for joints whose quaternions are needed.
    """

    sine: Any
    cosine: Any
    slide: Any
    half_turn: tuple[Any, Any] = (0.0, 1.0)


class Pose(NamedTuple):
    """Pose of a link's frame in a common frame.

    Attributes:
        origin: Origin of the link's frame, m.
        axes: Axes of the link's frame, three vectors.
    """

    origin: Vector
    axes: tuple[Vector, Vector, Vector]


class _CompositeInertia(NamedTuple):
    """Inertia of a link and its descendants about the origin of the link's frame; fields as in `Link`."""

    mass: float
    moment: Vector
    inertia: Symmetric


def joint_transforms(links: list[Link], displacement: list[Any], with_half_turns: Collection[int] = ()) -> list[JointTransform]:
    """Return the transforms of joints displaced from ``qpos0``.

    Args:
        links: Links of the model.
        displacement: Displacement of each joint, rad or m.
        with_half_turns: Joints that get a `JointTransform.half_turn`.
    """
    joints = []
    for index, (link, moved) in enumerate(zip(links, displacement, strict=True)):
        if link.slides:
            joints.append(JointTransform(0.0, 1.0, moved))
        elif index in with_half_turns:
            sine, cosine = sine_and_cosine(0.5 * moved)
            twice = 2.0 * sine
            joints.append(JointTransform(twice * cosine, 1.0 - twice * sine, 0.0, (sine, cosine)))
        else:
            joints.append(JointTransform(*sine_and_cosine(moved), 0.0))
    return joints


def child_pose(link: Link, joint: JointTransform, parent: Pose) -> Pose:
    """Return the pose of a link from its parent's pose."""
    origin = add(parent.origin, combine(parent.axes, _origin_in_parent(link, joint)))
    axes = [combine(parent.axes, floats(column)) for column in link.rotation.T]
    one, other = (link.axis + 1) % 3, (link.axis + 2) % 3
    ahead = add(scale(axes[one], joint.cosine), scale(axes[other], joint.sine))
    axes[other] = add(scale(axes[other], joint.cosine), scale(axes[one], minus(0.0, joint.sine)))
    axes[one] = ahead
    return Pose(origin, (axes[0], axes[1], axes[2]))


def mass_matrix(links: list[Link], joints: list[JointTransform]) -> dict[tuple[int, int], Any]:
    """Return the mass matrix (kg m^2, kg m, kg): (joint, ancestor) -> entry, for each joint with its ancestors and itself."""
    composite = [_CompositeInertia(link.mass, _vector(link.moment), _symmetric(link.inertia)) for link in links]
    matrix: dict[tuple[int, int], Any] = {}
    for index in reversed(range(len(links))):
        link = links[index]
        # Momentum of the link and its descendants at unit velocity of the joint.
        axis = _unit(link.axis)
        if link.slides:
            linear, angular = scale(axis, composite[index].mass), cross(composite[index].moment, axis)
        else:
            linear, angular = cross(axis, composite[index].moment), symmetric_times(composite[index].inertia, axis)
        ancestor = index
        while True:
            matrix[index, ancestor] = (linear if links[ancestor].slides else angular)[links[ancestor].axis]
            if links[ancestor].parent < 0:
                break
            linear, angular = _wrench_to_parent(links[ancestor], joints[ancestor], linear, angular)
            ancestor = links[ancestor].parent
        if link.parent >= 0:
            composite[link.parent] = _sum_inertias(
                composite[link.parent], _inertia_to_parent(link, joints[index], composite[index])
            )
    return matrix


def bias_forces(
    links: list[Link],
    joints: list[JointTransform],
    velocity: list[Any],
    gravity: np.ndarray,
    roots: Mapping[int, Pose] = MappingProxyType({}),
) -> list[Any]:
    """Return the joint forces (N m or N) that balance gravity, Coriolis and centrifugal forces.

    Args:
        links: Links of the model.
        joints: Displacements of the joints.
        velocity: Velocities of the joints, rad/s or m/s.
        gravity: [3], m/s^2, in the world.
        roots: Poses in the world of mocap bodies that are parents of links.
    """
    starts = {WORLD: _LinkMotion(ZERO, ZERO, _vector(-gravity))}
    for root, pose in roots.items():
        x, y, z = (dot(axis, _vector(-gravity)) for axis in pose.axes)
        starts[root] = _LinkMotion(ZERO, ZERO, (x, y, z))
    motions: list[_LinkMotion] = []
    for link, joint, rate in zip(links, joints, velocity, strict=True):
        motions.append((motions[link.parent] if link.parent >= 0 else starts[link.parent]).child(link, joint, rate))
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


class _LinkMotion:
    """Motion of a link in its own frame: angular velocity omega and acceleration alpha, acceleration of the frame's origin.

    Gravity is included as an upward acceleration of the world.
    """

    def __init__(self, omega: Vector, alpha: Vector, acceleration: Vector) -> None:
        self._omega, self._alpha, self._acceleration = omega, alpha, acceleration
        (x, y, z), (a, b, c) = omega, alpha
        xx, yy, zz = times(x, x), times(y, y), times(z, z)
        xy, yz, xz = times(x, y), times(y, z), times(x, z)
        # Columns of the matrix from a point's position to its acceleration relative to the origin.
        self._acceleration_columns = (
            (minus(0.0, plus(yy, zz)), plus(xy, c), minus(xz, b)),
            (minus(xy, c), minus(0.0, plus(xx, zz)), plus(yz, a)),
            (plus(xz, b), minus(yz, a), minus(0.0, plus(xx, yy))),
        )

    def child(self, link: Link, joint: JointTransform, rate: Any) -> "_LinkMotion":
        """Return the motion of a child link whose joint moves at ``rate`` without acceleration."""
        relative = combine(self._acceleration_columns, _origin_in_parent(link, joint))
        acceleration = _to_link(link, joint, add(self._acceleration, relative))
        omega, alpha = _to_link(link, joint, self._omega), _to_link(link, joint, self._alpha)
        own = scale(_unit(link.axis), rate)
        if link.slides:
            return _LinkMotion(omega, alpha, add(acceleration, scale(cross(omega, own), 2.0)))
        return _LinkMotion(add(omega, own), add(alpha, cross(omega, own)), acceleration)

    def wrench(self, link: Link) -> tuple[Vector, Vector]:
        """Return the force, and the torque about the frame's origin, that produce this motion of the link."""
        moment, inertia = _vector(link.moment), _symmetric(link.inertia)
        force = add(scale(self._acceleration, link.mass), combine(self._acceleration_columns, moment))
        torque = add(symmetric_times(inertia, self._alpha), cross(self._omega, symmetric_times(inertia, self._omega)))
        return force, add(torque, cross(moment, self._acceleration))


def _unit(axis: int) -> Vector:
    return floats(np.eye(3)[axis])  # type: ignore[return-value] - of three


def _vector(array: np.ndarray) -> Vector:
    return floats(array)  # type: ignore[return-value] - of three


def _symmetric(matrix: np.ndarray) -> Symmetric:
    return {(row, column): float(matrix[row, column]) for row in range(3) for column in range(row, 3)}


def _origin_in_parent(link: Link, joint: JointTransform) -> Vector:
    """Return the origin of a link's frame in the parent's frame."""
    return add(_vector(link.position), scale(_vector(link.rotation[:, link.axis]), joint.slide))


def _rotate(link: Link, sine: Any, cosine: Any, vector: Vector) -> Vector:
    """Rotate a vector about a joint's axis."""
    one, other = (link.axis + 1) % 3, (link.axis + 2) % 3
    parts = list(vector)
    parts[one] = minus(times(cosine, vector[one]), times(sine, vector[other]))
    parts[other] = plus(times(sine, vector[one]), times(cosine, vector[other]))
    return parts[0], parts[1], parts[2]


def _to_link(link: Link, joint: JointTransform, vector: Vector) -> Vector:
    """Transform a vector from the parent's frame to the link's."""
    x, y, z = (dot(_vector(column), vector) for column in link.rotation.T)
    return _rotate(link, minus(0.0, joint.sine), joint.cosine, (x, y, z))


def _wrench_to_parent(link: Link, joint: JointTransform, force: Vector, torque: Vector) -> tuple[Vector, Vector]:
    """Transform a force, and a torque about the frame's origin, from a link's frame to its parent's."""
    columns = [_vector(column) for column in link.rotation.T]
    force = combine(columns, _rotate(link, joint.sine, joint.cosine, force))
    torque = combine(columns, _rotate(link, joint.sine, joint.cosine, torque))
    return force, add(torque, cross(_origin_in_parent(link, joint), force))


def _sum_inertias(first: _CompositeInertia, other: _CompositeInertia) -> _CompositeInertia:
    inertia = {key: plus(first.inertia[key], other.inertia[key]) for key in first.inertia}
    return _CompositeInertia(first.mass + other.mass, add(first.moment, other.moment), inertia)


def _inertia_to_parent(link: Link, joint: JointTransform, body: _CompositeInertia) -> _CompositeInertia:
    """Transform an inertia from a link's frame to its parent's."""
    columns = [_vector(column) for column in link.rotation.T]
    moment = combine(columns, _rotate(link, joint.sine, joint.cosine, body.moment))
    turned = _rotate_inertia(link.axis, joint, body.inertia)
    rows = [_vector(row) for row in link.rotation]
    inertia: Symmetric = {}
    shift, mass = _origin_in_parent(link, joint), body.mass
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
    return _CompositeInertia(mass, add(moment, scale(shift, mass)), inertia)


def _rotate_inertia(axis: int, joint: JointTransform, inertia: Symmetric) -> Symmetric:
    """Rotate a symmetric matrix by a joint's angle."""
    one, other = (axis + 1) % 3, (axis + 2) % 3
    sine, cosine = joint.sine, joint.cosine
    first, second, mixed = inertia[one, one], inertia[other, other], inertia[upper_key(one, other)]
    left, right = inertia[upper_key(axis, one)], inertia[upper_key(axis, other)]
    tilt = plus(times(sine, minus(first, second)), times(2.0, cosine, mixed))
    return {
        (axis, axis): inertia[axis, axis],
        (one, one): minus(first, times(sine, tilt)),
        (other, other): plus(second, times(sine, tilt)),
        upper_key(one, other): minus(times(cosine, tilt), mixed),
        upper_key(axis, one): minus(times(cosine, left), times(sine, right)),
        upper_key(axis, other): plus(times(sine, left), times(cosine, right)),
    }
