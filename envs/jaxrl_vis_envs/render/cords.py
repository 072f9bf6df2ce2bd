"""Poses of the capsules of tendons, and colours of tendons at a limit, computed from the poses of sites and geoms alone.

`mjx.kinematics` does not compute tendons, and slack cords exist only in MuJoCo's visualiser.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs.render.model import tendons
from jaxrl_vis_envs.render.model.tendons import Path, Piece

# Fractions of the horizontal extent at which MuJoCo places the points of a hanging cord.
_SHARES = np.append(np.arange(tendons.CHAIN) / (tendons.CHAIN + 1), 1.0).astype(np.float32)
_SOLVER_STEPS = 8  # Newton's method converges quadratically
_BISECTIONS = 24
_STEEPEST = 40.0  # above it, hyperbolic functions overflow in float32
_TINY = 1e-9


class Capsules(NamedTuple):
    """Capsules in the world.

    Attributes:
        position: [K, 3] float32, m.
        rotation: [K, 3, 3] float32, with the axis in the last column.
        half: [K] float32, half-length, m; 0 for capsules that are not rendered.
    """

    position: jax.Array
    rotation: jax.Array
    half: jax.Array


def capsules(scene: Any, data: Any, drawn: tuple[int, ...]) -> Capsules:
    """Compute the capsules of the tendons with indices ``drawn``, tendon by tendon, each in the order of its path."""
    ends = [_ends(scene, data, tendon) for tendon in drawn]
    start, end = (jnp.concatenate(parts) for parts in zip(*ends, strict=True))
    along = end - start
    length = _norm(along)
    axis = along / jnp.where(length > 0.0, length, 1.0)[:, None]
    return Capsules(0.5 * (start + end), _towards(axis), 0.5 * length)


def coloured(scene: Any, data: Any) -> Any:
    """Return ``scene`` with blended colours for tendons that are at a limit, as in MuJoCo's visualiser."""
    first = len(scene.size) - len(scene.tendon_paths)
    rgba = scene.rgba
    for tendon in sorted({index - first for index in scene.object_ids if index >= first}):
        path, values = scene.tendon_paths[tendon], scene.cords[tendon]
        if path.shows_limits:
            share = _impedance(_length(scene, data, path), values)
            colour = rgba[first + tendon, :3]
            rgba = rgba.at[first + tendon, :3].set(colour + share * (values[tendons.LIMIT_COLOUR] - colour))
    return scene.replace(rgba=rgba)


def _impedance(length: jax.Array, values: jax.Array) -> jax.Array:
    """Compute the impedance of the limit that a tendon of this ``length`` violates, 0 if none: [] float32."""
    low, high = values[tendons.RANGE]
    distance = jnp.minimum(length - low, high - length)
    least, most, width, middle, power = values[tendons.SOLIMP]
    ratio = jnp.clip(jnp.abs(distance - values[tendons.MARGIN]) / jnp.maximum(width, _TINY), 0.0, 1.0)
    rise = jnp.where(
        ratio <= middle,
        ratio**power / jnp.maximum(middle, _TINY) ** (power - 1.0),
        1.0 - (1.0 - ratio) ** power / jnp.maximum(1.0 - middle, _TINY) ** (power - 1.0),
    )
    return jnp.where(distance < values[tendons.MARGIN], least + rise * (most - least), 0.0)


def _length(scene: Any, data: Any, path: Path) -> jax.Array:
    """Compute the length of a tendon, [] float32 (m)."""
    total = jnp.zeros((), jnp.float32)
    for piece in path.pieces:
        first, last = _site(data, piece.first), _site(data, piece.last)
        own = _norm(last - first)
        if piece.geom >= 0:
            wrap = _wrap(scene, data, piece)
            around = _norm(wrap.points[0] - first) + wrap.length + _norm(last - wrap.points[-1])
            own = jnp.where(wrap.meets, around, own)
        total += own / piece.divisor
    return total


def _ends(scene: Any, data: Any, tendon: int) -> tuple[jax.Array, jax.Array]:
    """Return start and end points [K, 3] (m, world) of a tendon's capsules."""
    path = scene.tendon_paths[tendon]
    if path.hangs:
        points = _catenary(_site(data, path.pieces[0].first), _site(data, path.pieces[0].last), scene.cords[tendon])
        return points[:-1], points[1:]
    starts, ends = [], []
    for piece in path.pieces:
        first, last = _site(data, piece.first), _site(data, piece.last)
        if piece.geom < 0:
            points = [first, last]
        else:
            wrap = _wrap(scene, data, piece)
            # Without contact, the first capsule is the whole piece, and the others have no length.
            points = [first, *jnp.where(wrap.meets, wrap.points, last), last]
        starts += points[:-1]
        ends += points[1:]
    return jnp.stack(starts), jnp.stack(ends)


def _catenary(first: jax.Array, last: jax.Array, values: jax.Array) -> jax.Array:
    """Compute the points [CHAIN + 1, 3] (m) of a cord between two points; on a straight line if it is taut."""
    length, gravity = values[tendons.LENGTH], values[tendons.GRAVITY]
    up = -gravity / _norm(gravity)
    straight = last - first
    rise = jnp.sum(straight * up)
    level = straight - rise * up
    extent = jnp.maximum(_norm(level), _TINY)
    taut = _norm(straight) >= length
    # sinh(q) / q = ratio, where q is half the extent over the catenary's parameter; in logarithms, which are nearly linear.
    ratio = jnp.sqrt(jnp.maximum(jnp.square(length) - jnp.square(rise), _TINY)) / extent
    target = jnp.log(jnp.maximum(ratio, 1.0))
    half = jnp.where(target < 1.0, jnp.sqrt(6.0 * target), target + jnp.log(2.0 * target + 2.0))
    half = jnp.clip(half, 1e-2, _STEEPEST)
    for _ in range(_SOLVER_STEPS):
        error = half + jnp.log1p(-jnp.exp(-2.0 * half)) - jnp.log(2.0 * half) - target
        half = jnp.clip(half - error / (1.0 / jnp.tanh(half) - 1.0 / half), 1e-2, _STEEPEST)
    lean = jnp.arctanh(jnp.clip(rise / jnp.maximum(length, _TINY), -1.0 + 1e-6, 1.0 - 1e-6))
    turns = half * (2.0 * _SHARES - 1.0) + lean
    heights = extent / (2.0 * half) * (jnp.cosh(turns) - jnp.cosh(turns[0]))
    shares = jnp.asarray(_SHARES)[:, None]
    hanging = first + shares * level + heights[:, None] * up
    points = jnp.where(taut, first + shares * straight, hanging)
    return points.at[-1].set(last)


class _Wrap(NamedTuple):
    """Path of a tendon around a geom: points [ARC + 1, 3] of the arc (m, world), its length (m), and a flag for contact."""

    points: jax.Array
    length: jax.Array
    meets: jax.Array


def _wrap(scene: Any, data: Any, piece: Piece) -> _Wrap:
    """Compute the path of a piece around its sphere or cylinder, as in the physics."""
    centre = jnp.asarray(data.geom_xpos, jnp.float32)[piece.geom]
    rotation = jnp.asarray(data.geom_xmat, jnp.float32).reshape(-1, 3, 3)[piece.geom]
    radius = scene.size[piece.geom, 0]

    def local(site: int) -> jax.Array:
        return jnp.sum(rotation * (_site(data, site) - centre)[:, None], axis=0)

    begin, end = local(piece.first), local(piece.last)
    side = local(piece.side) if piece.side >= 0 else None
    across, up = (jnp.eye(3, dtype=jnp.float32)[axis] for axis in (0, 1))
    if piece.is_ball:
        # The plane of both ends and the centre.
        across = begin / jnp.maximum(_norm(begin), _TINY)
        normal = jnp.cross(begin, end)
        other = jnp.cross(across, jnp.ones(3).at[jnp.argmax(across)].set(0.0))
        normal = jnp.where(_norm(normal) < _TINY, other, normal)
        up = jnp.cross(normal / jnp.maximum(_norm(normal), _TINY), across)
    flat = [jnp.stack([jnp.sum(point * across), jnp.sum(point * up)]) for point in (begin, end)]
    toward = None
    if side is not None:
        toward = jnp.stack([jnp.sum(side * across), jnp.sum(side * up)])
    start, turn, meets = _around_circle(flat[0], flat[1], toward, radius)
    if side is not None:
        touch, touches = _inside_circle(flat[0], flat[1], radius)
        inside = _norm(side) < radius
        start, turn = jnp.where(inside, touch, start), jnp.where(inside, 0.0, turn)
        meets = jnp.where(inside, touches, meets)
    angles = (start + turn * jnp.linspace(0.0, 1.0, tendons.ARC + 1))[:, None]
    points, length = radius * (jnp.cos(angles) * across + jnp.sin(angles) * up), radius * jnp.abs(turn)
    if not piece.is_ball:
        # Position along the cylinder's axis, proportional to the path length in the plane.
        before, after = _norm(begin[:2] - points[0, :2]), _norm(end[:2] - points[-1, :2])
        path = jnp.maximum(before + length + after, _TINY)
        low, high = (begin[2] + (end[2] - begin[2]) * part / path for part in (before, before + length))
        length = jnp.sqrt(jnp.square(length) + jnp.square(high - low))
        points = points.at[:, 2].set(jnp.linspace(low, high, tendons.ARC + 1))
    meets = meets & (_norm(begin) > _TINY) & (_norm(end) > _TINY)
    return _Wrap(centre + jnp.sum(rotation * points[:, None, :], axis=2), length, meets)


def _around_circle(begin: jax.Array, end: jax.Array, toward: jax.Array | None, radius: jax.Array) -> tuple:
    """Compute the path around a circle at the origin: start angle and signed turn (rad), and a flag for contact.

    It is the short path if the circle obstructs the straight line, or the long one around the back of the circle if ``toward``
    points there: into the angle opposite to that between the two ends. (MuJoCo before 4.0, and MJX, use another rule.)
    """
    area = _area(begin, end)
    is_long = jnp.zeros((), bool)
    if toward is not None:
        is_long = (_area(begin, toward) * area <= 0.0) & (_area(toward, end) * area <= 0.0)
    counterclockwise = (area > 0.0) != is_long
    first, last, crosses = _tangents(begin, end, radius, jnp.where(counterclockwise, -1.0, 1.0))
    turn = jnp.arctan2(_area(first, last), jnp.sum(first * last))
    turn = jnp.where(counterclockwise, jnp.mod(turn, 2.0 * jnp.pi), -jnp.mod(-turn, 2.0 * jnp.pi))
    along = end - begin
    square = jnp.sum(along * along)
    nearest = begin + along * jnp.clip(-jnp.sum(begin * along) / jnp.maximum(square, _TINY), 0.0, 1.0)
    free = (_norm(nearest) > radius) & ~is_long
    outside = (_norm(begin) >= radius) & (_norm(end) >= radius)
    return jnp.arctan2(first[1], first[0]), turn, outside & (square > _TINY) & ~free & ~crosses


def _area(one: jax.Array, two: jax.Array) -> jax.Array:
    """Return the signed area between two vectors [2], positive if the second is counterclockwise of the first."""
    return one[0] * two[1] - one[1] * two[0]


def _tangents(begin: jax.Array, end: jax.Array, radius: jax.Array, sign: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return the tangent points [2] of one path around a circle, and True if its two straight parts cross."""

    def tangent(point: jax.Array, sign: jax.Array) -> jax.Array:
        square = jnp.maximum(jnp.sum(point * point), _TINY)
        root = jnp.sqrt(jnp.maximum(square - radius * radius, 0.0))
        beside = jnp.stack([point[1], -point[0]])
        return (radius * radius * point + sign * radius * root * beside) / square

    first, last = tangent(begin, sign), tangent(end, -sign)
    one, two, gap = first - begin, last - end, end - begin
    area = _area(one, two)
    safe = jnp.where(jnp.abs(area) > _TINY, area, 1.0)
    shares = _area(gap, two) / safe, _area(gap, one) / safe
    crosses = jnp.abs(area) > _TINY
    for share in shares:
        crosses = crosses & (share >= 0.0) & (share <= 1.0)
    return first, last, crosses


def _inside_circle(begin: jax.Array, end: jax.Array, radius: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Compute the angle (rad) of the point where a circle constrains a tendon passing inside it, and a flag for contact."""
    start = jnp.arctan2(begin[1], begin[0])
    turn = jnp.arctan2(_area(begin, end), jnp.sum(begin * end))

    def point(share: jax.Array) -> jax.Array:
        angle = start + share * turn
        return radius * jnp.stack([jnp.cos(angle), jnp.sin(angle)])

    def slope(share: jax.Array) -> jax.Array:
        here = point(share)
        ahead = turn * jnp.stack([-here[1], here[0]])
        parts = [jnp.sum(ahead * (here - other)) / jnp.maximum(_norm(here - other), _TINY) for other in (begin, end)]
        return parts[0] + parts[1]

    def halve(_: int, ends: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        middle = 0.5 * (ends[0] + ends[1])
        rises = slope(middle) > 0.0
        return jnp.where(rises, ends[0], middle), jnp.where(rises, middle, ends[1])

    # The path is shortest where the slope of its length is 0.
    low, high = jax.lax.fori_loop(0, _BISECTIONS, halve, (jnp.zeros((), jnp.float32), jnp.ones((), jnp.float32)))
    along = end - begin
    share = -jnp.sum(begin * along) / jnp.maximum(jnp.sum(along * along), _TINY)
    passes = (share > 0.0) & (share < 1.0) & (_norm(begin + share * along) <= radius)
    outside = (_norm(begin) > radius) & (_norm(end) > radius)
    return start + 0.5 * (low + high) * turn, outside & ~passes


def _towards(axis: jax.Array) -> jax.Array:
    """Compute the smallest rotations [K, 3, 3] of the z axis to unit vectors [K, 3]."""
    x, y, z = axis[:, 0], axis[:, 1], axis[:, 2]
    down = z < -1.0 + 1e-6
    scale = 1.0 / jnp.where(down, 1.0, 1.0 + z)
    rows = [
        [jnp.where(down, 1.0, 1.0 - x * x * scale), -x * y * scale, x],
        [-x * y * scale, jnp.where(down, -1.0, 1.0 - y * y * scale), y],
        [-x, -y, z],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def _site(data: Any, index: int) -> jax.Array:
    return jnp.asarray(data.site_xpos, jnp.float32)[index]


def _norm(vector: jax.Array) -> jax.Array:
    """Return norms along the last axis, with finite derivatives everywhere."""
    square = jnp.sum(vector * vector, axis=-1)
    return jnp.where(square > 0.0, jnp.sqrt(jnp.where(square > 0.0, square, 1.0)), 0.0)
