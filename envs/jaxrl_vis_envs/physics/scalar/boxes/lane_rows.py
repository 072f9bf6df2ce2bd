"""Jacobians, stiffness and reference accelerations of contacts in lanes (`box_model`)."""

from typing import Any, NamedTuple

import jax.numpy as jnp

from jaxrl_vis_envs.physics.scalar import contacts as contact_frames
from jaxrl_vis_envs.physics.scalar.boxes import box_faces
from jaxrl_vis_envs.physics.scalar.boxes.box_model import FREE_DOFS, BoxModel, LaneContacts
from jaxrl_vis_envs.physics.scalar.boxes.own_block import in_own_block
from jaxrl_vis_envs.physics.scalar.contacts import ContactPoint
from jaxrl_vis_envs.physics.scalar.link_frames import LinkFrames
from jaxrl_vis_envs.physics.scalar.partial_arithmetic import (
    Vector,
    cross,
    dot,
    minus,
    plus,
    subtract,
    times,
)
from jaxrl_vis_envs.physics.scalar.sparse_algebra import Column

COMPONENTS = 4
"""Number of components of a contact: normal, two tangents, and rotation about the normal; all but the first times friction."""


class LaneRows(NamedTuple):
    """Rows of the contacts: the normal component plus and minus each of the others, so six per lane.

    Attributes:
        jacobian: For each degree of freedom, the four components' derivatives, per lane; 0.0 where it moves no box.
        offset: [4], residual of each component at zero acceleration.
        stiffness: Stiffness of the rows, 0 where the boxes do not touch.
        torsional_stiffness: Stiffness of the two rows of rotation about the normal, 0 for contacts without torsional friction.
    """

    jacobian: list[tuple[Any, Any, Any, Any]]
    offset: Column
    stiffness: Any
    torsional_stiffness: Any


def contact_rows(model: BoxModel, contacts: LaneContacts, frames: LinkFrames, velocity: Column, free: int) -> LaneRows:
    """Compute the rows of all contacts.

    Args:
        model: The model.
        contacts: Its contacts, with all rows of its table.
        frames: Frames of the links, with that of the free body.
        velocity: Velocities of all degrees of freedom.
        free: Link of the free body.
    """
    zero = 0.0 * velocity[0]
    point = in_own_block(
        lambda poses: box_faces.contact_points(contacts, poses),
        box_faces.moving_poses(contacts, frames),
        ContactPoint(zero, (zero,) * 3, (zero,) * 3),
    )
    directions = contact_frames.contact_axes(point.normal)
    jacobian = _tree_jacobian(model, contacts, frames, point, directions)
    jacobian += _free_jacobian(contacts, frames, point, directions, free)
    friction = (1.0, *contacts.friction)
    jacobian = [
        tuple(times(sign, part, factor) for part, factor in zip(parts, friction, strict=True))
        for sign, parts in zip(contacts.signs, jacobian, strict=True)
    ]
    violation = minus(point.distance, contacts.margin)
    impedance = _impedance(contacts, violation)
    stiffness = impedance / minus(contacts.inverse_weight, times(impedance, contacts.inverse_weight))
    stiffness = jnp.where(violation < 0, stiffness, 0.0)
    spring, damping = contacts.spring
    offset = [times(damping, speed) for speed in components(jacobian, velocity)]
    offset[0] = plus(offset[0], times(spring, impedance, violation))
    return LaneRows(jacobian, offset, stiffness, times(stiffness, contacts.has_torsion))


def components(jacobian: list[tuple[Any, Any, Any, Any]], column: Column) -> Column:
    """Return the four components of a velocity or acceleration of all degrees of freedom, per lane."""
    return [
        plus(*(times(parts[row], value) for parts, value in zip(jacobian, column, strict=True))) for row in range(COMPONENTS)
    ]


def _tree_jacobian(
    model: BoxModel, contacts: LaneContacts, frames: LinkFrames, point: ContactPoint, directions: tuple
) -> list[tuple[Any, Any, Any, Any]]:
    """Return the derivatives of a contact with respect to each joint of the tree: of its point along the three directions, and
    of the rotation about the normal.
    """
    links = model.tree.links
    moving = [frame for side in contacts.sides for _, frame in side.moving if frame.link >= 0]
    if not moving:
        return [(0.0, 0.0, 0.0, 0.0)] * len(links)
    # Lever arms from a point nearby: those from the world's origin would lose digits.
    near = frames.point(moving[0].link, moving[0].position)
    arm = subtract(point.position, near)
    moments = [cross(arm, direction) for direction in directions]
    jacobian = []
    for joint, (link, sign) in enumerate(zip(links, contacts.signs, strict=False)):
        if isinstance(sign, float) and sign == 0.0:
            jacobian.append((0.0, 0.0, 0.0, 0.0))
            continue
        axis, there = frames.joint_axis(joint), frames.point_derivative(joint, near)
        along = [dot(there, direction) for direction in directions]
        if link.slides:
            jacobian.append((*along, 0.0))
        else:
            along = [plus(part, dot(axis, moment)) for part, moment in zip(along, moments, strict=True)]
            jacobian.append((*along, dot(axis, directions[0])))
    return jacobian


def _free_jacobian(
    contacts: LaneContacts, frames: LinkFrames, point: ContactPoint, directions: tuple, free: int
) -> list[tuple[Any, Any, Any, Any]]:
    """Return the same derivatives for the free body's degrees of freedom: along the world's axes, then about its own."""
    origin, axes = frames.origin_and_axes(free)
    arm = subtract(point.position, origin)
    moments: list[Vector] = [cross(arm, direction) for direction in directions]
    jacobian: list[tuple[Any, Any, Any, Any]] = [(*(direction[axis] for direction in directions), 0.0) for axis in range(3)]
    for axis in axes:
        jacobian.append((*(dot(axis, moment) for moment in moments), dot(axis, directions[0])))
    assert len(jacobian) == FREE_DOFS
    return jacobian


def _impedance(contacts: LaneContacts, violation: Any) -> Any:
    """Return the impedance of `constraint_softness.Softness`, with an exponent of 2."""
    low, rise, inverse_width = contacts.impedance
    fraction = jnp.minimum(times(jnp.abs(violation), inverse_width), 1.0)
    midpoint, rest = contacts.midpoint, 1.0 - fraction
    below = fraction * fraction / midpoint
    above = 1.0 - rest * rest / minus(1.0, midpoint)
    return plus(low, times(rise, jnp.where(fraction < midpoint, below, above)))
