"""Contacts between boxes in scalars (`partial_arithmetic`), one contact per lane: the arithmetic of `physics.box_contacts`.

Each lane computes all candidates of its pair, and keeps the one that reaches farthest towards its own corner.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp

from jaxrl_vis_envs.physics.scalar.boxes.box_model import CONTACTS_PER_PAIR, CORNERS, LaneContacts, Side
from jaxrl_vis_envs.physics.scalar.boxes.own_block import in_own_block
from jaxrl_vis_envs.physics.scalar.contacts import ContactPoint
from jaxrl_vis_envs.physics.scalar.link_frames import LinkFrames
from jaxrl_vis_envs.physics.scalar.links import FixedFrame
from jaxrl_vis_envs.physics.scalar.partial_arithmetic import (
    Vector,
    add,
    choose,
    combine,
    dot,
    minus,
    plus,
    scale,
    subtract,
    times,
)

_FAR = 1.0  # distance that represents no contact, m
_NONE = -1e30  # reach of a candidate outside of the overlap


class _Box(NamedTuple):
    """Position (m), axes (three unit vectors) and half-size (m) of a box in the world."""

    position: Vector
    axes: tuple[Vector, Vector, Vector]
    half_size: Vector


class _Candidate(NamedTuple):
    """Point of the incident face, in units of its half edges, and True if it lies in the overlap of the faces."""

    x: Any
    y: Any
    is_inside: Any


class BoxPose(NamedTuple):
    """Position (m) and axes (three unit vectors) of a box in the world."""

    position: Vector
    axes: tuple[Vector, Vector, Vector]


def moving_poses(contacts: LaneContacts, frames: LinkFrames) -> list[list[BoxPose]]:
    """Return the poses in the world (m) of the boxes that move, for each of the two sides."""
    return [[_pose(frame, frames) for _, frame in side.moving] for side in contacts.sides]


def _pose(frame: FixedFrame, frames: LinkFrames) -> BoxPose:
    x, y, z = (frames.direction(frame.link, frame.rotation[:, axis]) for axis in range(3))
    return BoxPose(frames.point(frame.link, frame.position), (x, y, z))


def contact_points(contacts: LaneContacts, poses: list[list[BoxPose]]) -> ContactPoint:
    """Return the contacts of all lanes, m in the world.

    Args:
        contacts: Constants of the contacts.
        poses: Result of `moving_poses`.

    Returns:
        Contacts, with normals from the first box to the second; the distance of one that does not exist is `_FAR`.
    """
    first, second = (_box(side, moving) for side, moving in zip(contacts.sides, poses, strict=True))
    reference, incident, is_first = _order_boxes(first, second)
    offset = _to_frame(reference.axes, subtract(incident.position, reference.position))
    incident = _align_nearest_face(reference, incident)
    columns = [_to_frame(reference.axes, axis) for axis in incident.axes]
    side = jnp.where(offset[2] >= 0, 1.0, -1.0)
    towards = jnp.where(columns[2][2] >= 0, 1.0, -1.0)
    centre = subtract(offset, scale(columns[2], side * towards * incident.half_size[2]))
    edges = scale(columns[0], incident.half_size[0]), scale(columns[1], incident.half_size[1])
    zero = 0.0 * centre[0]
    x, y, exists = in_own_block(
        lambda face: _select_candidate(contacts, _candidates(*face)), (centre, edges, reference.half_size), (zero, zero, zero)
    )
    point = add(centre, scale(edges[0], x), scale(edges[1], y))
    distance = minus(side * point[2], reference.half_size[2])
    point = point[0], point[1], point[2] - 0.5 * side * distance
    normal = scale(reference.axes[2], jnp.where(is_first, side, -side))
    position = add(reference.position, combine(reference.axes, point))
    return ContactPoint(jnp.where(exists > 0.5, distance, _FAR), position, normal)


def _box(side: Side, moving: list[BoxPose]) -> _Box:
    """Return the box of a side in each lane."""
    pose = BoxPose(side.position, side.axes)  # type: ignore[arg-type] - of three
    for (is_here, _), moving_pose in zip(side.moving, moving, strict=True):
        condition = is_here == 1.0 if isinstance(is_here, float) else is_here > 0.5
        pose = _choose_tree(condition, moving_pose, pose)
    return _Box(*pose, side.half_size)  # type: ignore[arg-type] - of three


def _to_frame(axes: tuple[Vector, Vector, Vector], vector: Vector) -> Vector:
    """Express a vector in the frame with these axes."""
    return dot(axes[0], vector), dot(axes[1], vector), dot(axes[2], vector)


def _order_boxes(first: _Box, second: _Box) -> tuple[_Box, _Box, Any]:
    """Order two boxes, and permute the axes of the first so that its face farthest from the second is normal to the last axis.

    Returns:
        The boxes in order, and True in lanes where that is the order of the arguments.
    """
    offset = subtract(second.position, first.position)
    cosines = [[_abs(dot(axis, across)) for across in second.axes] for axis in first.axes]
    gaps = []
    for box, opposite, rows in ((first, second, cosines), (second, first, list(zip(*cosines, strict=True)))):
        for axis, extent, row in zip(box.axes, box.half_size, rows, strict=True):
            reach = plus(*(times(*pair) for pair in zip(row, opposite.half_size, strict=True)))
            gaps.append(minus(minus(_abs(dot(axis, offset)), extent), reach))
    face = _argmax(gaps)
    is_first = face < 3.0
    axis = jnp.where(is_first, face, face - 3.0)
    return _permute_axes(_choose_tree(is_first, first, second), axis), _choose_tree(is_first, second, first), is_first


def _align_nearest_face(reference: _Box, incident: _Box) -> _Box:
    """Permute the axes of the incident box so that its face nearest to the reference is normal to the last axis."""
    return _permute_axes(incident, _argmax([_abs(dot(reference.axes[2], axis)) for axis in incident.axes]))


def _argmax(values: list[Any]) -> Any:
    """Return the index of the maximum of ``values`` in each lane, as float32; the first index in a tie."""
    best, index = values[0], 0.0 * values[0]
    for position, value in enumerate(values[1:], start=1):
        is_greater = value > best
        best, index = jnp.where(is_greater, value, best), jnp.where(is_greater, float(position), index)
    return index


def _choose_tree(condition: Any, if_true: Any, if_false: Any) -> Any:
    """Select between two nested tuples of the same structure, leaf by leaf."""
    if isinstance(if_true, tuple):
        parts = [_choose_tree(condition, *pair) for pair in zip(if_true, if_false, strict=True)]
        return type(if_true)(*parts) if hasattr(if_true, "_fields") else tuple(parts)
    is_same = isinstance(if_true, float) and isinstance(if_false, float) and if_true == if_false
    return if_true if is_same else choose(condition, if_true, if_false)


def _permute_axes(box: _Box, axis: Any) -> _Box:
    """Permute the axes of a box cyclically, so that ``axis`` is the last."""
    is_zero, is_one = axis < 0.5, (axis > 0.5) & (axis < 1.5)

    def pick(values: tuple[Any, ...], index: int) -> Any:
        return jnp.where(is_zero, values[(index + 1) % 3], jnp.where(is_one, values[(index + 2) % 3], values[index]))

    axes = [tuple(pick(tuple(old[part] for old in box.axes), index) for part in range(3)) for index in range(3)]
    return _Box(box.position, tuple(axes), tuple(pick(box.half_size, index) for index in range(3)))  # type: ignore[arg-type]


def _candidates(centre: Vector, edges: tuple[Vector, Vector], half_size: Vector) -> list[_Candidate]:
    """Return 24 points of the incident face: its corners, those of the reference face, and the intersections of their edges.

    Args:
        centre: Centre of the incident face in the frame of the reference box, m.
        edges: Half edges of the incident face in that frame, m.
        half_size: Half-size of the reference box, m.
    """
    (a, c, _), (b, d, _) = edges
    inverse = 1.0 / (a * d - b * c)
    places: list[tuple[Any, Any]] = list(CORNERS)
    for x, y in CORNERS:
        gap = minus(times(x, half_size[0]), centre[0]), minus(times(y, half_size[1]), centre[1])
        places.append(((d * gap[0] - b * gap[1]) * inverse, (a * gap[1] - c * gap[0]) * inverse))
    for edge in range(2):
        for axis in range(2):
            slope = edges[edge][axis]
            is_along = slope == 0
            inverse = 1.0 / jnp.where(is_along, 1.0, slope)
            for end, sign in CORNERS:
                rest = sign * half_size[axis] - centre[axis] - end * edges[1 - edge][axis]
                place = jnp.where(is_along, 2.0, rest * inverse)
                places.append((place, end) if edge == 0 else (end, place))
    candidates = []
    for x, y in places:
        # Crossings and corners lie on the edges up to rounding.
        inside = [_abs(part) <= 1.0 + 1e-5 for part in (x, y) if not isinstance(part, float)]
        for axis in range(2):
            point = plus(centre[axis], times(edges[0][axis], x), times(edges[1][axis], y))
            inside.append(_abs(point) <= half_size[axis] + 1e-7)
        is_inside = inside[0]
        for more in inside[1:]:
            is_inside = is_inside & more
        candidates.append(_Candidate(x, y, is_inside))
    return candidates


def _select_candidate(contacts: LaneContacts, candidates: list[_Candidate]) -> tuple[Any, Any, Any]:
    """Return coordinates x and y of the candidate in the overlap that reaches farthest towards each lane's corner.

    The third result is 1.0 if there is one and no earlier corner of the pair selects it, else 0.0.
    """
    like = 0.0 * (candidates[4].x + contacts.number)
    own, place_x, place_y, index = like + _NONE, like, like, like
    reaches, chosen = [like + _NONE] * (CONTACTS_PER_PAIR - 1), [like] * (CONTACTS_PER_PAIR - 1)
    for number, (x, y, is_inside) in enumerate(candidates):
        reach = jnp.where(is_inside, plus(times(contacts.corner[0], x), times(contacts.corner[1], y)), _NONE)
        is_farther = reach > own
        own, index = jnp.where(is_farther, reach, own), jnp.where(is_farther, float(number), index)
        place_x, place_y = jnp.where(is_farther, x, place_x), jnp.where(is_farther, y, place_y)
        for corner, (along, across) in enumerate(CORNERS[: CONTACTS_PER_PAIR - 1]):
            reach = jnp.where(is_inside, plus(times(along, x), times(across, y)), _NONE)
            is_farther = reach > reaches[corner]
            reaches[corner] = jnp.where(is_farther, reach, reaches[corner])
            chosen[corner] = jnp.where(is_farther, float(number), chosen[corner])
    exists = own > _NONE
    for corner, other in enumerate(chosen):
        exists = exists & ((other != index) | (contacts.number <= corner))
    return place_x, place_y, jnp.where(exists, 1.0, 0.0)


def _abs(number: Any) -> Any:
    return abs(number) if isinstance(number, float) else jnp.abs(number)
