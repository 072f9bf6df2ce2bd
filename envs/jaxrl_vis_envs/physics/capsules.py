"""Contacts between capsules number by number (`folding`): where they touch, and how joints change their distance."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from mujoco import mjx

from jaxrl_vis_envs.physics import dynamics, links
from jaxrl_vis_envs.physics.dynamics import Joint, Pose
from jaxrl_vis_envs.physics.folding import (
    NOTHING,
    Vector,
    add,
    choose,
    combine,
    cross,
    dot,
    floats,
    minus,
    plus,
    scale,
    subtract,
    times,
)
from jaxrl_vis_envs.physics.links import WORLD, Frame, Link

_TINY = 1e-30  # of squared lengths: what is divided by is not 0


class Pair(NamedTuple):
    """Two capsules that may touch.

    Attributes:
        frames: Their poses relative to the links they are fixed to.
        radii: m.
        halves: Of their segments' lengths, m.
        carriers: The joints that move the first and not the second, and those that move the second and not the first.
    """

    frames: tuple[Frame, Frame]
    radii: tuple[float, float]
    halves: tuple[float, float]
    carriers: tuple[tuple[int, ...], tuple[int, ...]]

    @property
    def joints(self) -> tuple[int, ...]:
        """The joints that the distance depends on."""
        return tuple(sorted(self.carriers[0] + self.carriers[1]))


class Touch(NamedTuple):
    """Where two capsules are closest.

    Attributes:
        distance: Between them, m; negative where they overlap.
        position: In the middle between their surfaces.
        normal: Of length 1, from the first to the second; 0 where their segments meet.
    """

    distance: Any
    position: Vector
    normal: Vector


def pair_of(model: mjx.Model, tree: list[Link], frames: list[Frame], geoms: tuple[int, int]) -> Pair:
    """What is known of two capsules of a model."""
    placed = [links.geom_frame(model, frames, geom) for geom in geoms]
    (radius_1, half_1), (radius_2, half_2) = (floats(np.asarray(model.geom_size)[geom, :2]) for geom in geoms)
    moving = [links.carriers(tree, frame.link) for frame in placed]
    own = [tuple(joint for joint in these if joint not in others) for these, others in (moving, moving[::-1])]
    return Pair((placed[0], placed[1]), (radius_1, radius_2), (half_1, half_2), (own[0], own[1]))


def common_link(tree: list[Link], pairs: list[Pair]) -> int:
    """The last link that all capsules of some pairs hang on, or the world: relative to it, joints before it move nothing."""
    chains = [links.carriers(tree, frame.link) for pair in pairs for frame in pair.frames]
    last = WORLD
    for together in zip(*chains, strict=False):
        if len(set(together)) > 1:
            break
        last = together[0]
    return last


class Places:
    """Where capsules and joints are, in the frame of one link."""

    def __init__(self, tree: list[Link], joints: list[Joint], base: int) -> None:
        x, y, z = np.eye(3)
        self._tree = tree
        self._poses = {base: Pose(NOTHING, (floats(x), floats(y), floats(z)))}  # type: ignore[arg-type] - of three
        for index, (link, joint) in enumerate(zip(tree, joints, strict=True)):
            if link.parent in self._poses and index not in self._poses:
                self._poses[index] = dynamics.pose_after(link, joint, self._poses[link.parent])
        self._moments: dict[int, Vector] = {}

    def capsule(self, frame: Frame) -> tuple[Vector, Vector]:
        """Centre and axis of a capsule."""
        pose = self._poses[frame.link]
        return add(pose.origin, combine(pose.axes, floats(frame.shift))), combine(pose.axes, floats(frame.turn[:, 2]))

    def lever(self, joint: int, direction: Vector, moment: Vector) -> Any:
        """How far a point moves along a direction per radian (or m) of a joint.

        Args:
            joint: Which joint.
            direction: Of length 1.
            moment: The vector product of the point and the direction.
        """
        link, pose = self._tree[joint], self._poses[joint]
        axis = pose.axes[link.axis]
        if link.slides:
            return dot(axis, direction)
        if joint not in self._moments:
            self._moments[joint] = cross(pose.origin, axis)
        return plus(dot(axis, moment), dot(self._moments[joint], direction))


def touch(pair: Pair, places: Places) -> Touch:
    """The closest points of two capsules (Ericson, "Real-Time Collision Detection", 5.1.9), as `mjx_model.step` has them."""
    (middle_1, axis_1), (middle_2, axis_2) = (places.capsule(frame) for frame in pair.frames)
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
    inverse = 1.0 / jnp.sqrt(jnp.maximum(square, _TINY))
    normal = scale(gap, inverse)
    distance = square * inverse - (radius_1 + radius_2)
    return Touch(distance, add(point, scale(normal, radius_1 + 0.5 * distance)), normal)


def frame_about(normal: Vector) -> tuple[Vector, Vector, Vector]:
    """A normal and two directions across it, in the world: those that MJX takes for friction."""
    _, y, z = normal
    is_level: Any = (y > -0.5) & (y < 0.5)
    # Of the axis y or z, whichever is farther from the normal, what lies across it.
    x, y, z = scale(normal, minus(0.0, choose(is_level, y, z)))
    across = (x, choose(is_level, plus(1.0, y), y), choose(is_level, z, plus(1.0, z)))
    first = scale(across, 1.0 / jnp.sqrt(jnp.maximum(dot(across, across), _TINY)))
    return normal, first, cross(normal, first)


def levers(pair: Pair, places: Places, direction: Vector, position: Vector) -> dict[int, Any]:
    """How fast the second capsule moves away from the first along a direction at a point, per velocity of each joint."""
    moment = cross(position, direction)
    back = (scale(direction, -1.0), scale(moment, -1.0))
    entries = {joint: places.lever(joint, *back) for joint in pair.carriers[0]}
    entries |= {joint: places.lever(joint, direction, moment) for joint in pair.carriers[1]}
    return entries


def _within(number: Any, most: float) -> Any:
    return jnp.minimum(jnp.maximum(number, -most), most)
