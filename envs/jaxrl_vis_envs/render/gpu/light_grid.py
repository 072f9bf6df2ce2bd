"""Grid of cells in a light's view, by which a segment towards the light finds the few objects that may block it.

A cell is an interval of each of three coordinates. Objects are bits of words, and each interval has the words of the objects
that reach into it, so that the objects of a cell are the bits set in all three. For a directional light the coordinates are two
across its direction and one along it, for any other one two angles about its position and the distance from it.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs.render.gpu.tiles import pack_bits
from jaxrl_vis_envs.render.pixel.arithmetic import Vector, dot, normalized
from jaxrl_vis_envs.render.pixel.lights import Light
from jaxrl_vis_envs.render.pixel.triangles import Segments

_ACROSS, _ALONG = 64, 32
"""Number of intervals of the first two coordinates, and of the third."""
# Part of the largest coordinate (m, or radians) by which objects are enlarged, more than its rounding error.
_ROUNDING = 1e-5


class Cells(NamedTuple):
    """Objects of the segments' cells; N objects.

    Attributes:
        order: [N] int32, object of each bit, along the first coordinate.
        words: [R, words] int32, rows of bits.
        rows: [3, P] int32, the three rows of each segment.
    """

    order: jax.Array
    words: jax.Array
    rows: jax.Array


def shadow_cells(light: Light, segments: Segments, middle: jax.Array, radius: jax.Array) -> Cells:
    """Sort segments and spheres into cells.

    Args:
        light: The light.
        segments: [P], towards the light, and not beyond it.
        middle: [N, 3] float32, m, centres of the spheres in the camera's frame.
        radius: [N] float32, m, their radii.
    """
    centre = tuple(middle[:, axis] for axis in range(3))
    if light.is_directional:
        frame = _frame(tuple(-light.direction[axis] for axis in range(3)))
        place = [dot(segments.start, axis) for axis in frame]
        bounds = [(at - radius, at + radius) for at in (dot(centre, axis) for axis in frame)]
    else:
        place, bounds = _around(light, segments, centre, radius)
    order = jnp.argsort(bounds[0][0]).astype(jnp.int32)
    is_valid = segments.farthest > segments.nearest
    words, rows, first = [], [], 0
    for number, (at, sides, count) in enumerate(zip(place, bounds, (_ACROSS, _ACROSS, _ALONG), strict=True)):
        low, high = (side[order] for side in sides)
        least, most = (jnp.where(jnp.isnan(side), fill, side) for side, fill in ((low, np.inf), (high, -np.inf)))
        least, most = jnp.min(least), jnp.max(most)
        margin = _ROUNDING * (1.0 + jnp.maximum(jnp.abs(least), jnp.abs(most)))
        least, most = least - margin, most + margin
        pitch = jnp.maximum(most - least, margin) / count
        edge = least + pitch * np.arange(count + 1, dtype=np.float32)
        mask = high + margin >= edge[:-1, None]
        if number < 2:
            mask &= low - margin <= edge[1:, None]
        words.append(pack_bits(mask))
        # No object is beyond the last cell, and before the first one in the first two coordinates.
        is_valid &= (at <= most) if number == 2 else (at >= least) & (at <= most)
        cell = jnp.clip((at - least) / pitch, 0.0, count - 1.0)
        rows.append(first + cell.astype(jnp.int32))
        first += count
    words.append(jnp.zeros_like(words[0][:1]))
    return Cells(order, jnp.concatenate(words), jnp.stack([jnp.where(is_valid, row, first) for row in rows]))


def _frame(axis: Vector) -> tuple[Vector, Vector, Vector]:
    """Return three orthogonal unit vectors, the last one along ``axis``, a unit vector of scalars."""
    x, y, z = axis
    # The axis of the camera's frame that is farthest from it.
    is_x = (jnp.abs(x) <= jnp.abs(y)) & (jnp.abs(x) <= jnp.abs(z))
    is_y = ~is_x & (jnp.abs(y) <= jnp.abs(z))
    other = tuple(mask.astype(jnp.float32) for mask in (is_x, is_y, ~is_x & ~is_y))
    first = normalized(_cross(axis, other))
    return first, _cross(axis, first), axis


def _cross(a: Vector, b: Vector) -> Vector:
    """Return the vector product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _around(
    light: Light, segments: Segments, centre: Vector, radius: jax.Array
) -> tuple[list[jax.Array], list[tuple[jax.Array, jax.Array]]]:
    """Return azimuth, elevation and negative distance about a light's position: of the segments' starts [P], and the bounds of
    the spheres [N]. The azimuth is measured from the direction to most spheres.
    """
    assert light.position is not None
    offset = tuple(c - light.position[axis] for axis, c in enumerate(centre))
    ahead = tuple(jnp.sum(jnp.where(jnp.isnan(component), 0.0, component)) for component in offset)
    side, up, ahead = _frame(normalized(ahead))

    def angles(vector: Vector) -> tuple[jax.Array, jax.Array, jax.Array]:
        distance = jnp.sqrt(dot(vector, vector))
        beside, above, along = (dot(vector, axis) for axis in (side, up, ahead))
        return jnp.arctan2(beside, along), jnp.arctan2(above, jnp.sqrt(beside * beside + along * along)), distance

    azimuth, elevation, distance = angles(offset)
    # The derivative of the arcsine, and so its rounding error, is unbounded at 1.
    ratio = radius / jnp.maximum(distance, 1e-20)
    width = jnp.where(ratio < 0.99, jnp.arcsin(jnp.minimum(ratio, 1.0)), np.pi)
    # A sphere around a pole of the angles, or around the direction opposite to most spheres, has all azimuths.
    rest = 0.5 * np.pi - jnp.abs(elevation)
    ratio = jnp.sin(jnp.minimum(width, 0.5 * np.pi)) / jnp.maximum(jnp.sin(rest), 1e-20)
    turn = jnp.where((ratio < 0.99) & (width < rest), jnp.arcsin(jnp.minimum(ratio, 1.0)), np.pi)
    turn = jnp.where(jnp.abs(azimuth) + turn < 0.999 * np.pi, turn, 2.0 * np.pi)
    ends = angles(tuple(s - light.position[axis] for axis, s in enumerate(segments.start)))
    bounds = [(azimuth - turn, azimuth + turn), (elevation - width, elevation + width), (-distance - radius, radius - distance)]
    return [*ends[:2], -ends[2]], bounds
