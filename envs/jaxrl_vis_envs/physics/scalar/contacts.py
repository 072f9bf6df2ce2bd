"""Contacts of two capsules, or of a plane and a sphere, in scalars (`partial_arithmetic`), and their Jacobians."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from jaxrl_vis_envs.physics.scalar import links
from jaxrl_vis_envs.physics.scalar.link_frames import LinkFrames
from jaxrl_vis_envs.physics.scalar.links import WORLD, FixedFrame, Link
from jaxrl_vis_envs.physics.scalar.partial_arithmetic import (
    Vector,
    add,
    choose,
    cross,
    dot,
    floats,
    inverse_root,
    minus,
    plus,
    scale,
    subtract,
    times,
)

_TINY = 1e-30  # lower bound of squared lengths, so that no divisor is 0


class GeomPair(NamedTuple):
    """Two capsules that may touch, or a plane and a sphere.

    Attributes:
        is_on_plane: True if the first geom is a plane, with its third axis towards the second, a sphere.
        frames: Frames of the geoms relative to their links.
        radii: Radii, m; unused for a plane.
        half_lengths: Half lengths of the capsules' segments, m; unused with a plane.
        joints_of_one: Joints that move only the first geom, and joints that move only the second.
    """

    is_on_plane: bool
    frames: tuple[FixedFrame, FixedFrame]
    radii: tuple[float, float]
    half_lengths: tuple[float, float]
    joints_of_one: tuple[tuple[int, ...], tuple[int, ...]]

    @property
    def joints(self) -> tuple[int, ...]:
        """Joints that the distance depends on."""
        return tuple(sorted(self.joints_of_one[0] + self.joints_of_one[1]))


class ContactPoint(NamedTuple):
    """Closest approach of two geoms.

    Attributes:
        distance: Distance between the surfaces, m; negative if they overlap.
        position: Midpoint between the surfaces, m.
        normal: Unit normal from the first geom to the second; 0 if the capsules' segments intersect.
    """

    distance: Any
    position: Vector
    normal: Vector


def build_pair(model: mjx.Model, tree: list[Link], frames: list[FixedFrame], geoms: tuple[int, int]) -> GeomPair:
    """Return the constants of a pair of geoms.

    Args:
        model: The model.
        tree: Links of the model.
        frames: Frames of its bodies.
        geoms: Indices of the two geoms.
    """
    placed = [links.geom_frame(model, frames, geom) for geom in geoms]
    (radius_1, half_1), (radius_2, half_2) = (floats(np.asarray(model.geom_size)[geom, :2]) for geom in geoms)
    chains = [links.ancestor_joints(tree, frame.link) for frame in placed]
    own = [tuple(joint for joint in chain if joint not in other) for chain, other in (chains, chains[::-1])]
    is_on_plane = bool(model.geom_type[geoms[0]] == mujoco.mjtGeom.mjGEOM_PLANE)
    return GeomPair(is_on_plane, (placed[0], placed[1]), (radius_1, radius_2), (half_1, half_2), (own[0], own[1]))


def common_ancestor(tree: list[Link], pairs: list[GeomPair]) -> int:
    """Return the last common ancestor link of all geoms of ``pairs``, or the world; joints up to it do not affect distances."""
    chains = [links.ancestor_joints(tree, frame.link) for pair in pairs for frame in pair.frames]
    last = WORLD
    for level in zip(*chains, strict=False):
        if len(set(level)) > 1:
            break
        last = level[0]
    return last


def contact_point(pair: GeomPair, frames: LinkFrames) -> ContactPoint:
    """Compute the contact of two geoms (distance, midpoint and normal) from their closest points.

    The arithmetic is that of `mjx_model.step`. Source: Ericson, "Real-Time Collision Detection", 5.1.9.
    """
    if pair.is_on_plane:
        return _plane_contact_point(pair, frames)
    (middle_1, axis_1), (middle_2, axis_2) = (
        (frames.point(frame.link, frame.position), frames.direction(frame.link, frame.rotation[:, 2])) for frame in pair.frames
    )
    (half_1, half_2), (radius_1, radius_2) = pair.half_lengths, pair.radii
    between = subtract(middle_1, middle_2)
    cosine, along_1, along_2 = dot(axis_1, axis_2), dot(axis_1, between), dot(axis_2, between)
    normal_to_both = cross(axis_1, axis_2)
    squared_sine = dot(normal_to_both, normal_to_both)
    # Closest points of infinite lines, clipped to the first segment, to the second, and to the first again. For parallel
    # segments the search starts at the middle.
    at_1: Any = 0.0
    if not isinstance(squared_sine, float):
        above = minus(times(cosine, along_2), along_1)
        at_1 = jnp.where(squared_sine > 0, above / jnp.where(squared_sine > 0, squared_sine, 1.0), 0.0)
        at_1 = _clip(at_1, half_1)
    at_2 = _clip(plus(times(cosine, at_1), along_2), half_2)
    at_1 = _clip(minus(times(cosine, at_2), along_1), half_1)
    point = add(middle_1, scale(axis_1, at_1))
    gap = subtract(add(middle_2, scale(axis_2, at_2)), point)
    square = dot(gap, gap)
    inverse = inverse_root(square, _TINY)
    normal = scale(gap, inverse)
    distance = square * inverse - (radius_1 + radius_2)
    return ContactPoint(distance, add(point, scale(normal, radius_1 + 0.5 * distance)), normal)


def _plane_contact_point(pair: GeomPair, frames: LinkFrames) -> ContactPoint:
    """Compute the contact of an infinite plane and a sphere (distance, midpoint and normal)."""
    plane, sphere = pair.frames
    normal, middle = frames.direction(plane.link, plane.rotation[:, 2]), frames.point(sphere.link, sphere.position)
    radius = pair.radii[1]
    distance = minus(dot(normal, subtract(middle, frames.point(plane.link, plane.position))), radius)
    return ContactPoint(distance, subtract(middle, scale(normal, plus(radius, times(0.5, distance)))), normal)


def contact_axes(normal: Vector) -> tuple[Vector, Vector, Vector]:
    """Return the normal and the two tangents that MJX uses for friction, in the world."""
    _, y, z = normal
    is_level: Any = (y > -0.5) & (y < 0.5)
    # Projection across the normal of the world's axis y or z, whichever is farther from it.
    x, y, z = scale(normal, minus(0.0, choose(is_level, y, z)))
    across = (x, choose(is_level, plus(1.0, y), y), choose(is_level, z, plus(1.0, z)))
    first = scale(across, inverse_root(dot(across, across), _TINY))
    return normal, first, cross(normal, first)


def translation_jacobian(pair: GeomPair, frames: LinkFrames, direction: Vector, position: Vector) -> dict[int, Any]:
    """Return derivatives by joint of the displacement, second geom minus first, along ``direction`` at ``position`` (m).

    Both are in the base frame of ``frames``.
    """
    moment = cross(position, direction)
    back = (scale(direction, -1.0), scale(moment, -1.0))
    entries = {joint: frames.derivative_along(joint, *back) for joint in pair.joints_of_one[0]}
    entries |= {joint: frames.derivative_along(joint, direction, moment) for joint in pair.joints_of_one[1]}
    return entries


def rotation_jacobian(pair: GeomPair, frames: LinkFrames, direction: Vector) -> dict[int, Any]:
    """Return derivatives by joint of the rotation, second geom minus first, about ``direction``."""
    back = scale(direction, -1.0)
    entries = {joint: dot(frames.rotation_derivative(joint), back) for joint in pair.joints_of_one[0]}
    return entries | {joint: dot(frames.rotation_derivative(joint), direction) for joint in pair.joints_of_one[1]}


def _clip(number: Any, bound: float) -> Any:
    return jnp.minimum(jnp.maximum(number, -bound), bound)
