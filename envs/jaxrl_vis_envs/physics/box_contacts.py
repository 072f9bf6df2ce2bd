"""Face-to-face contacts between boxes as in MuJoCo 4: the corners of the overlap of the two faces.

MJX's box contacts omit boxes that are close without touching (``margin``), and repeat a corner on which a tilted box stands up
to four times, which multiplies its stiffness. Here a pair has up to four contacts, all of them different. If the overlap has
more than four corners, as between faces rotated relative to each other, the four that reach farthest towards the corners of one
face are used. Edge-to-edge contacts are not supported: boxes touch with the faces that are farthest apart.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from jaxrl_vis_envs.physics import rotations

_CONTACTS = 4  # of a pair
_SIGNS = np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]], np.float32)
_FAR = 1.0  # distance that represents no contact, m


def supports(model: mjx.Model) -> bool:
    """Return True if all contacts of a model are explicit pairs of boxes."""
    if not model.npair or np.any(np.asarray(model.geom_contype)) or np.any(np.asarray(model.geom_conaffinity)):
        return False
    pairs = np.concatenate([model.pair_geom1, model.pair_geom2])
    return bool(np.all(np.asarray(model.geom_type)[pairs] == mujoco.mjtGeom.mjGEOM_BOX))


def collide(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Return ``data`` with the contacts at its poses, which must be up to date; for a model that `supports` accepts."""
    order = np.repeat(np.argsort(model.pair_dim, kind="stable"), _CONTACTS)  # MJX sorts contacts by their dimensions
    geoms = np.stack([model.pair_geom1, model.pair_geom2], axis=1)[order]
    first, second = geoms[::_CONTACTS].T
    position, rotation, half_size = data.geom_xpos, data.geom_xmat, model.geom_size
    distance, point, normal = jax.vmap(_contact_points)(
        position[first], rotation[first], half_size[first], position[second], rotation[second], half_size[second]
    )
    frame = jnp.repeat(jax.vmap(rotations.make_frame)(normal), _CONTACTS, axis=0)
    contact = data._impl.contact.replace(
        dist=distance.reshape(-1),
        pos=point.reshape(-1, 3),
        frame=frame,
        includemargin=model.pair_margin[order] - model.pair_gap[order],
        friction=model.pair_friction[order],
        solref=model.pair_solref[order],
        solreffriction=model.pair_solreffriction[order],
        solimp=model.pair_solimp[order],
        geom=jnp.asarray(geoms),
        geom1=jnp.asarray(geoms[:, 0]),
        geom2=jnp.asarray(geoms[:, 1]),
    )
    return data.tree_replace({"_impl.contact": contact})  # type: ignore[dict-item] - a Contact is a tree of arrays


def _contact_points(
    position_1: jax.Array,
    rotation_1: jax.Array,
    size_1: jax.Array,
    position_2: jax.Array,
    rotation_2: jax.Array,
    size_2: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return the contacts of two boxes with positions [3], rotation matrices [3, 3] and half-sizes [3], in m.

    Returns:
        Distances [4] and points halfway between the faces [4, 3] (m, world), and the normal [3] from the first box to the
        second. The distance of a contact that does not exist is `_FAR`.
    """
    # The face farthest from the other box is the reference.
    turn, offset = rotation_1.T @ rotation_2, position_2 - position_1
    apart_1 = jnp.abs(rotation_1.T @ offset) - size_1 - jnp.abs(turn) @ size_2
    apart_2 = jnp.abs(rotation_2.T @ offset) - size_2 - jnp.abs(turn.T) @ size_1
    face = jnp.argmax(jnp.concatenate([apart_1, apart_2]))
    is_first = face < 3
    middle, rotation, size = _select(is_first, (position_1, rotation_1, size_1), (position_2, rotation_2, size_2))
    other, other_rotation, other_size = _select(is_first, (position_2, rotation_2, size_2), (position_1, rotation_1, size_1))
    # Axes are permuted: in the frame at the centre of each box, z becomes the normal of the reference or the nearest face.
    rotation, size = _move_axis_last(face % 3, rotation, size)
    offset, turn = rotation.T @ (other - middle), rotation.T @ other_rotation
    turn, other_size = _move_axis_last(jnp.argmax(jnp.abs(turn[2])), turn, other_size)
    side = jnp.where(offset[2] >= 0, 1.0, -1.0)
    centre = offset - side * jnp.sign(turn[2, 2]) * other_size[2] * turn[:, 2]
    along = turn[:, :2] * other_size[:2]  # columns: half edges of the other face
    inverse = _inverse(along[:2])
    # Candidates: points on the other face, in units of its half edges [24, 2].
    corners = jnp.asarray(_SIGNS)
    reference_corners = (corners * size[:2] - centre[:2]) @ inverse.T
    places = jnp.concatenate([corners, reference_corners, _crossings(centre[:2], along[:2], size[:2])])
    points = centre + places @ along.T
    # Crossings and corners lie on the edges up to rounding.
    is_inside = jnp.all(jnp.abs(places) <= 1.0 + 1e-5, axis=1) & jnp.all(jnp.abs(points[:, :2]) <= size[:2] + 1e-7, axis=1)
    chosen = jnp.argmax(jnp.where(is_inside[:, None], places @ corners.T, -jnp.inf), axis=0)
    is_new = jnp.array([jnp.all(chosen[number] != chosen[:number]) for number in range(_CONTACTS)])
    points = points[chosen]
    distance = side * points[:, 2] - size[2]
    points = points.at[:, 2].add(-0.5 * side * distance)
    normal = jnp.where(is_first, side, -side) * rotation[:, 2]
    return jnp.where(is_new & is_inside[chosen], distance, _FAR), middle + points @ rotation.T, normal


def _select(condition: jax.Array, if_true: tuple, if_false: tuple) -> tuple[jax.Array, ...]:
    return tuple(jnp.where(condition, one, other) for one, other in zip(if_true, if_false, strict=True))


def _move_axis_last(axis: jax.Array, rotation: jax.Array, size: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Permute the axes of a box cyclically, so that ``axis`` is the last."""
    order = (axis + jnp.arange(1, 4)) % 3
    return rotation[:, order], size[order]


def _inverse(matrix: jax.Array) -> jax.Array:
    (a, b), (c, d) = matrix
    return jnp.array([[d, -b], [-c, a]]) / (a * d - b * c)


def _crossings(centre: jax.Array, along: jax.Array, size: jax.Array) -> jax.Array:
    """Intersect the edges of a face with the lines through the edges of a rectangle.

    Args:
        centre: [2], centre of the face in the frame of the rectangle, whose centre is 0.
        along: [2, 2], columns are the half edges of the face in that frame.
        size: [2], half edges of the rectangle.

    Returns:
        [16, 2], intersections in units of the face's half edges; a coordinate is beyond +-1 if the edge does not intersect.
    """
    places = []
    for edge, axis in np.ndindex(2, 2):  # edges along `edge`, lines across `axis`
        for end, side in _SIGNS:
            slope = along[axis, edge]
            rest = side * size[axis] - centre[axis] - end * along[axis, 1 - edge]
            place = jnp.where(slope == 0, 2.0, rest / jnp.where(slope == 0, 1.0, slope))
            places.append(jnp.stack([place, jnp.float32(end)] if edge == 0 else [jnp.float32(end), place]))
    return jnp.stack(places)
