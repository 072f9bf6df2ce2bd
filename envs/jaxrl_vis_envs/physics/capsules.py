"""Contacts of two capsules, or of a plane and a sphere, number by number (`folding`): where they touch, and what moves them."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from jaxrl_vis_envs.physics import links
from jaxrl_vis_envs.physics.folding import (
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
from jaxrl_vis_envs.physics.links import WORLD, Frame, Link
from jaxrl_vis_envs.physics.places import Places

_TINY = 1e-30  # of squared lengths: what is divided by is not 0


class Pair(NamedTuple):
    """Two capsules that may touch, or a plane and a sphere.

    Attributes:
        is_on_plane: Whether the first is a plane, along whose third axis the second, a sphere, is above it.
        frames: Their poses relative to the links they are fixed to.
        radii: m; that of a plane is not used.
        halves: Of their segments' lengths, m; not used with a plane.
        carriers: The joints that move the first and not the second, and those that move the second and not the first.
    """

    is_on_plane: bool
    frames: tuple[Frame, Frame]
    radii: tuple[float, float]
    halves: tuple[float, float]
    carriers: tuple[tuple[int, ...], tuple[int, ...]]

    @property
    def joints(self) -> tuple[int, ...]:
        """The joints that the distance depends on."""
        return tuple(sorted(self.carriers[0] + self.carriers[1]))


class Touch(NamedTuple):
    """Where two geoms are closest.

    Attributes:
        distance: Between them, m; negative where they overlap.
        position: In the middle between their surfaces.
        normal: Of length 1, from the first to the second; 0 where their segments meet.
    """

    distance: Any
    position: Vector
    normal: Vector


def pair_of(model: mjx.Model, tree: list[Link], frames: list[Frame], geoms: tuple[int, int]) -> Pair:
    """What is known of two geoms of a model."""
    placed = [links.geom_frame(model, frames, geom) for geom in geoms]
    (radius_1, half_1), (radius_2, half_2) = (floats(np.asarray(model.geom_size)[geom, :2]) for geom in geoms)
    moving = [links.carriers(tree, frame.link) for frame in placed]
    own = [tuple(joint for joint in these if joint not in others) for these, others in (moving, moving[::-1])]
    is_on_plane = bool(model.geom_type[geoms[0]] == mujoco.mjtGeom.mjGEOM_PLANE)
    return Pair(is_on_plane, (placed[0], placed[1]), (radius_1, radius_2), (half_1, half_2), (own[0], own[1]))


def common_link(tree: list[Link], pairs: list[Pair]) -> int:
    """The last link that all geoms of some pairs hang on, or the world: relative to it, joints before it move nothing."""
    chains = [links.carriers(tree, frame.link) for pair in pairs for frame in pair.frames]
    last = WORLD
    for together in zip(*chains, strict=False):
        if len(set(together)) > 1:
            break
        last = together[0]
    return last


def touch(pair: Pair, places: Places) -> Touch:
    """The closest points of two capsules (Ericson, "Real-Time Collision Detection", 5.1.9), as `mjx_model.step` has them."""
    if pair.is_on_plane:
        return _touch_of_plane(pair, places)
    (middle_1, axis_1), (middle_2, axis_2) = (
        (places.point(frame.link, frame.shift), places.direction(frame.link, frame.turn[:, 2])) for frame in pair.frames
    )
    (half_1, half_2), (radius_1, radius_2) = pair.halves, pair.radii
    between = subtract(middle_1, middle_2)
    cosine, along_1, along_2 = dot(axis_1, axis_2), dot(axis_1, between), dot(axis_2, between)
    normal_to_both = cross(axis_1, axis_2)
    squared_sine = dot(normal_to_both, normal_to_both)
    # Of lines without end, then with the ends of one, of the other, and of the first again. The middle for parallel ones.
    at_1: Any = 0.0
    if not isinstance(squared_sine, float):
        above = minus(times(cosine, along_2), along_1)
        at_1 = jnp.where(squared_sine > 0, above / jnp.where(squared_sine > 0, squared_sine, 1.0), 0.0)
        at_1 = _within(at_1, half_1)
    at_2 = _within(plus(times(cosine, at_1), along_2), half_2)
    at_1 = _within(minus(times(cosine, at_2), along_1), half_1)
    point = add(middle_1, scale(axis_1, at_1))
    gap = subtract(add(middle_2, scale(axis_2, at_2)), point)
    square = dot(gap, gap)
    inverse = inverse_root(square, _TINY)
    normal = scale(gap, inverse)
    distance = square * inverse - (radius_1 + radius_2)
    return Touch(distance, add(point, scale(normal, radius_1 + 0.5 * distance)), normal)


def _touch_of_plane(pair: Pair, places: Places) -> Touch:
    """A plane has no ends here, as in MuJoCo."""
    plane, sphere = pair.frames
    normal, middle = places.direction(plane.link, plane.turn[:, 2]), places.point(sphere.link, sphere.shift)
    radius = pair.radii[1]
    distance = minus(dot(normal, subtract(middle, places.point(plane.link, plane.shift))), radius)
    return Touch(distance, subtract(middle, scale(normal, plus(radius, times(0.5, distance)))), normal)


def frame_about(normal: Vector) -> tuple[Vector, Vector, Vector]:
    """A normal and two directions across it, in the world: those that MJX takes for friction."""
    _, y, z = normal
    is_level: Any = (y > -0.5) & (y < 0.5)
    # Of the axis y or z, whichever is farther from the normal, what lies across it.
    x, y, z = scale(normal, minus(0.0, choose(is_level, y, z)))
    across = (x, choose(is_level, plus(1.0, y), y), choose(is_level, z, plus(1.0, z)))
    first = scale(across, inverse_root(dot(across, across), _TINY))
    return normal, first, cross(normal, first)


def levers(pair: Pair, places: Places, direction: Vector, position: Vector) -> dict[int, Any]:
    """How fast the second geom moves away from the first along a direction at a point, per velocity of each joint."""
    moment = cross(position, direction)
    back = (scale(direction, -1.0), scale(moment, -1.0))
    entries = {joint: places.lever(joint, *back) for joint in pair.carriers[0]}
    entries |= {joint: places.lever(joint, direction, moment) for joint in pair.carriers[1]}
    return entries


def spins(pair: Pair, places: Places, direction: Vector) -> dict[int, Any]:
    """How fast the second geom turns about a direction relative to the first, per velocity of each joint."""
    back = scale(direction, -1.0)
    entries = {joint: dot(places.spin(joint), back) for joint in pair.carriers[0]}
    return entries | {joint: dot(places.spin(joint), direction) for joint in pair.carriers[1]}


def _within(number: Any, most: float) -> Any:
    return jnp.minimum(jnp.maximum(number, -most), most)
