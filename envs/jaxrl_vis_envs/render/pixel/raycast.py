"""Nearest object of each pixel, by analytic intersection of rays with unit shapes.

An intersection counts if the ray enters the object in front of the near plane: from inside, an object is see-through, as with
OpenGL's back-face culling. A plane is visible from both sides.

The result is one integer per pixel, a key: the bits of the depth (which sort like the depths), with the lowest bits replaced by
the row of the object. The nearest object is then the minimum key, at one operation per object. This also suits XLA on a CPU,
which recomputes a loop for each of its outputs. `surface` makes the depth exact again, and differentiable.

With many objects, the row would take so many bits that thin layers could no longer be distinguished: 0.24 mm at 3 m with 600
objects. Then (`has_separate_rows`) a key is just the bits of the depth, and the row is a second integer.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs.render import camera
from jaxrl_vis_envs.render.camera import Rays
from jaxrl_vis_envs.render.model.reading import CLEAR, CLEAR_FROM_BEHIND, SOLID
from jaxrl_vis_envs.render.pixel import shapes
from jaxrl_vis_envs.render.pixel.arithmetic import maximum, minimum
from jaxrl_vis_envs.render.scene import Scene

# Added to divisors so that division by a ray component of exactly 0 is finite; too small to affect other values.
_TINY = 1e-20

# Maximum number of primitives in unrolled code. Beyond it, only types with at most _MAX_UNROLLED_PER_TYPE are unrolled.
MAX_UNROLLED = 48
_MAX_UNROLLED_PER_TYPE = 3


# Maximum number of objects with rows in the key: 6 bits, 0.015 mm at 3 m.
_MAX_ROWS_IN_KEY = 63


def has_separate_rows(scene: Scene) -> bool:
    """Return True if there are too many objects for their indices (rows of the object table) to be part of the keys."""
    return len(scene.object_ids) > _MAX_ROWS_IN_KEY


def code_mask(scene: Scene) -> int:
    """Return the mask of the lowest bits of a key, which hold the object's row (all ones: sky); 0 if rows are separate."""
    return 0 if has_separate_rows(scene) else (1 << int(len(scene.object_ids)).bit_length()) - 1


def primitive_rows(scene: Scene, transparent: bool) -> list[int]:
    """Return the indices of the rendered primitives that can be transparent or, unless ``transparent``, that can be opaque."""
    fine = (shapes.MESH, shapes.HFIELD)
    wanted = (CLEAR, CLEAR_FROM_BEHIND) if transparent else (SOLID, CLEAR_FROM_BEHIND)
    return [
        row
        for row, (kind, clear) in enumerate(zip(scene.object_types, scene.transparent, strict=True))
        if kind not in fine and clear in wanted
    ]


def is_behind(unit: shapes.UnitShapes, row: int) -> jax.Array:
    """Return True if the camera is behind the plane with index ``row``, [] bool."""
    return unit.origin[row, 2] < 0.0


def _solid_entry(scene: Scene, unit: shapes.UnitShapes, row: int, rays: Rays) -> tuple[jax.Array, jax.Array]:
    """Compute `row_entry`, with hits only where the object is opaque from this side and beyond the near plane."""
    t, meets = row_entry(scene, unit, row, rays)
    meets = meets & (t > scene.znear)
    if scene.transparent[row] == CLEAR_FROM_BEHIND:
        meets = meets & ~is_behind(unit, row)
    return t, meets


def decode(scene: Scene, key: jax.Array, row: jax.Array | None) -> tuple[jax.Array, jax.Array]:
    """Decode keys to depths and rows. Not differentiable.

    Args:
        scene: The scene.
        key: [P] int32.
        row: [P] int32 if the scene `has_separate_rows`, otherwise None.

    Returns:
        Depth [P] float32 (m), too small by a relative error of up to a few 1e-6, and row [P] int32, -1 for the sky.
    """
    if row is not None:
        return jax.lax.bitcast_convert_type(key, jnp.float32), row
    mask = code_mask(scene)
    row = key & mask
    return jax.lax.bitcast_convert_type(key & ~mask, jnp.float32), jnp.where(row == mask, -1, row)


def row_entry(scene: Scene, unit: shapes.UnitShapes, row: int, rays: Rays) -> tuple[jax.Array, jax.Array]:
    """Compute where each pixel's ray enters the object ``row`` (t, planar depth in metres), and a hit mask; [P] each."""
    start, direction, inverse_square = camera.ray_parts(scene, rays)
    kind = scene.object_types[row]
    bare_ball = kind == shapes.SPHERE and scene.atlas.mappings[row] == 0
    t, meets = entry(kind, _row_values(unit, row, bare_ball), start, direction, inverse_square)
    if can_be_culled(scene, kind):
        meets = meets & is_plane_visible(unit.origin[row, 2], unit.axes[row, 2, 2])
    return t, meets


def can_be_culled(scene: Scene, kind: int) -> bool:
    """Return True if objects of a type may be hidden although a ray intersects them, see `is_plane_visible`."""
    return kind == shapes.PLANE and scene.projection == "orthographic"


def is_plane_visible(height: jax.Array, facing: jax.Array) -> jax.Array:
    """Return True if a plane is visible to an orthographic camera, [] bool.

    MuJoCo selects the side by the camera's position (``height`` above the plane), and OpenGL culls by the camera's direction
    (``facing`` is above 0 if it looks down on the plane): where the two disagree, nothing is rendered.
    """
    return (height > 0.0) == (facing > 0.0)


def _row_values(unit: shapes.UnitShapes, row: int | jax.Array, bare_ball: bool) -> tuple:
    """Return origin (3), axes (3 x 3), extra and extra_square of an object as scalars; axes are None for a plain ball."""
    origin = [unit.origin[row, axis] for axis in range(3)]
    axes = None if bare_ball else [[unit.axes[row, i, j] for j in range(3)] for i in range(3)]
    return origin, axes, unit.extra[row], unit.extra_square[row]


def entry(kind: int, values: tuple, start: tuple, direction: tuple, inverse_square) -> tuple[jax.Array, jax.Array]:
    """Compute the entry points of rays into a shape.

    Args:
        kind: Type, a `mujoco.mjtGeom`.
        values: Origin (3), axes (3 x 3, None for a ball without rotation), extra and extra_square, as in `UnitShapes`.
        start: Three values, metres, camera's frame.
        direction: Three values, in the camera's frame.
        inverse_square: Inverse squared length of the direction.

    Returns:
        t [P] float32 (the ray parameter, finite everywhere, smooth where the ray enters), and a hit mask [P] bool.
    """
    origin, axes, extra, extra_square = values
    if axes is None:
        inverse = 1.0 / extra
        ray = direction
        begin = tuple(o if isinstance(s, float) else o + s * inverse for o, s in zip(origin, start, strict=True))
        return _sphere(begin, ray, extra, inverse_square)
    ray = camera.multiply(axes, direction)
    begin = tuple(o + s for o, s in zip(origin, camera.multiply(axes, start), strict=True))
    return _INTERSECTIONS[kind](begin, ray, extra, inverse_square * extra_square)


def sky_key(scene: Scene, mask: int) -> jax.Array:
    """Return the key of a ray without intersection, [] int32; ``mask`` is that of `code_mask`, or 0 for keys without rows."""
    return (jax.lax.bitcast_convert_type(scene.zfar, jnp.int32) & ~mask) | mask


def object_key(scene: Scene, unit: shapes.UnitShapes, row: int, rays: Rays, missed: jax.Array, mask: int) -> jax.Array:
    """Return the keys of one opaque object, [P] int32, or ``missed`` where a ray misses it; ``mask`` as in `sky_key`."""
    t, meets = _solid_entry(scene, unit, row, rays)
    return jnp.where(meets, (jax.lax.bitcast_convert_type(t, jnp.int32) & ~mask) | (row & mask), missed)


def nearest_key(scene: Scene, unit: shapes.UnitShapes, rays: Rays, labelled: bool = True) -> jax.Array:
    """Return the key of the nearest opaque primitive along every ray, [P] int32.

    Unless ``labelled``, or if the scene `has_separate_rows` (see `nearest_row`), a key consists of the bits of the depth only.

    Small numbers of objects are unrolled into one pass. Otherwise, objects whose bounding spheres intersect the pyramid of the
    rays are selected by type, and a loop runs over them; the rays should then be close together.
    """
    mask = code_mask(scene) if labelled else 0
    unit, rays = jax.lax.stop_gradient((unit, rays))
    best = jnp.broadcast_to(sky_key(scene, mask), rays.u.shape)
    rows = primitive_rows(scene, transparent=False)
    looped = {} if len(rows) <= MAX_UNROLLED else _rows_by_type(scene, rows)
    for row in rows:
        if scene.object_types[row] not in looped:
            best = jnp.minimum(best, object_key(scene, unit, row, rays, best, mask))
    for kind, rows in looped.items():
        best = _nearest_looped(scene, unit, kind, rows, rays, best, mask)
    return best


def _rows_by_type(scene: Scene, rows: list[int]) -> dict[int, np.ndarray]:
    """Group objects by type; return the groups large enough for a loop. Planes are excluded: they fill the image."""
    kinds = np.array(scene.object_types)[rows]
    counted = {int(kind): np.array(rows)[kinds == kind] for kind in np.unique(kinds) if kind != shapes.PLANE}
    return {kind: type_rows for kind, type_rows in counted.items() if len(type_rows) > _MAX_UNROLLED_PER_TYPE}


def nearest_row(scene: Scene, unit: shapes.UnitShapes, rays: Rays) -> jax.Array:
    """Return the depth bits of the nearest opaque primitive along every ray, and its row (-1 for the sky): [2, P] int32."""
    unit, rays = jax.lax.stop_gradient((unit, rays))
    best = jnp.broadcast_to(sky_key(scene, 0), rays.u.shape)
    row = jnp.full(rays.u.shape, len(scene.object_ids), jnp.int32)
    rows = np.array(primitive_rows(scene, transparent=False), int)
    kinds = np.array(scene.object_types)[rows]
    for kind in np.unique(kinds).tolist():
        best, row = _nearest_row_looped(scene, unit, kind, rows[kinds == kind], rays, best, row)
    return jnp.stack([best, jnp.where(row == len(scene.object_ids), -1, row)])


class _Selection(NamedTuple):
    """Objects of one type that rays may intersect.

    Attributes:
        table: [objects, 15] float32, candidates first: origin, axes, extra, extra_square, row.
        count: [] int32, number of candidates.
        bare_ball: True if the objects are balls without texture.
    """

    table: jax.Array
    count: jax.Array
    bare_ball: bool


def _select(scene: Scene, unit: shapes.UnitShapes, kind: int, rows: np.ndarray, rays: Rays) -> _Selection:
    """Select the objects among ``rows``, all of one type, that the rays may intersect."""
    ball = unit.ball[rows]
    bare_ball = kind == shapes.SPHERE and not any(scene.atlas.mappings[row] for row in rows)
    # Index of the k-th candidate = number of cumulative counts that are at most k. All candidates are moved to the front of the
    # table at once: any non-pixel work inside the loop would cost more.
    visible = camera.in_view(scene, ball[:, :3], ball[:, 3], rays, None)
    if kind == shapes.PLANE:
        if can_be_culled(scene, kind):
            visible = visible & is_plane_visible(unit.origin[rows, 2], unit.axes[rows, 2, 2])
        from_behind = np.array(scene.transparent)[rows] == CLEAR_FROM_BEHIND
        visible = visible & ~(from_behind & (unit.origin[rows, 2] < 0.0))
    counts = jnp.cumsum(visible.astype(jnp.int32), dtype=jnp.int32)
    order = jnp.sum(counts[None, :] <= np.arange(len(rows), dtype=np.int32)[:, None], axis=1, dtype=jnp.int32)
    columns = [unit.origin[rows], unit.axes[rows].reshape(-1, 9), unit.extra[rows, None], unit.extra_square[rows, None]]
    table = jnp.concatenate([*columns, jnp.asarray(rows, jnp.float32)[:, None]], axis=1)
    return _Selection(table.at[jnp.minimum(order, len(rows) - 1)].get(mode="promise_in_bounds"), counts[-1], bare_ball)


def _intersect_selected(scene: Scene, kind: int, selection: _Selection, step: jax.Array, rays: Rays) -> tuple:
    """Intersect rays with the object at index ``step`` of the table; return t and hit mask, [P] each, and row, [] int32."""
    start, direction, inverse_square = camera.ray_parts(scene, rays)
    values = jax.lax.dynamic_slice(selection.table, (step, np.int32(0)), (1, selection.table.shape[1]))[0]
    origin, axes = [values[i] for i in range(3)], [[values[3 + 3 * i + j] for j in range(3)] for i in range(3)]
    form = (origin, None if selection.bare_ball else axes, values[12], values[13])
    t, meets = entry(kind, form, start, direction, inverse_square)
    return t, meets & (t > scene.znear) & (step < selection.count), values[14].astype(jnp.int32)


def _nearest_looped(
    scene: Scene, unit: shapes.UnitShapes, kind: int, rows: np.ndarray, rays: Rays, best: jax.Array, mask: int
) -> jax.Array:
    """Return the minimum of ``best`` [P] and the keys of the objects ``rows``, all of one type."""
    selection = _select(scene, unit, kind, rows, rays)

    def advance(state: tuple) -> tuple:
        step, best = state
        t, meets, row = _intersect_selected(scene, kind, selection, step, rays)
        key = (jax.lax.bitcast_convert_type(t, jnp.int32) & ~mask) | (row & mask)
        return step + 1, jnp.minimum(best, jnp.where(meets, key, best))

    return jax.lax.while_loop(lambda state: state[0] < selection.count, advance, (jnp.zeros((), jnp.int32), best))[1]


def _nearest_row_looped(
    scene: Scene, unit: shapes.UnitShapes, kind: int, rows: np.ndarray, rays: Rays, best: jax.Array, row: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Update the minimum depth (as bits, [P]) and its row [P] with the objects ``rows``, all of one type.

    Of objects at the same depth, the one with the lower row is kept.
    """
    selection = _select(scene, unit, kind, rows, rays)
    none = jnp.full(rays.u.shape, np.iinfo(np.int32).max, jnp.int32)

    def advance(state: tuple) -> tuple:
        step, best, row, met, own = state
        # The previous iteration's hit is compared only now: XLA on a CPU would otherwise recompute it for each output.
        nearer = (met < best) | ((met == best) & (own < row))
        best, row = jnp.where(nearer, met, best), jnp.where(nearer, own, row)
        t, meets, own = _intersect_selected(scene, kind, selection, jnp.minimum(step, len(rows) - 1), rays)
        met = jnp.where(meets & (step < selection.count), jax.lax.bitcast_convert_type(t, jnp.int32), none)
        return step + 1, best, row, met, own

    zero = jnp.zeros((), jnp.int32)
    # One extra iteration, to compare the last hit.
    state = jax.lax.while_loop(lambda state: state[0] <= selection.count, advance, (zero, best, row, none, zero))
    return state[1], state[2]


def nearest_distance(scene: Scene, unit: shapes.UnitShapes, rays: Rays) -> jax.Array:
    """Return only the depth of the nearest opaque primitive, [P] float32 (m); differentiable, and cheaper than keys."""
    depth = jnp.broadcast_to(scene.zfar, rays.u.shape)
    for row in primitive_rows(scene, transparent=False):
        t, meets = _solid_entry(scene, unit, row, rays)
        depth = jnp.where(meets & (t < depth), t, depth)
    return depth


# Arguments of the following functions: start and direction of the ray in the unit shape's frame.


def _safe_root(square: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the square root of positive values, 1 for others (to keep gradients finite), and the mask of positive values."""
    positive = square > 0.0
    return jnp.sqrt(jnp.where(positive, square, 1.0)), positive


def _sphere(origin: tuple, ray: tuple, radius: jax.Array, inverse_square) -> tuple:
    """Intersect the unit ball without rotation: the ray's direction is still in metres, so t comes out in radii.

    The point of the ray nearest to the centre is computed first. Subtracting there, instead of between the large terms of the
    usual quadratic formula, keeps small, distant balls accurate in float32.
    """
    middle = -(origin[0] * ray[0] + origin[1] * ray[1] + origin[2] * ray[2]) * inverse_square
    x, y, z = (origin[axis] + middle * ray[axis] for axis in range(3))
    root, meets = _safe_root((1.0 - (x * x + y * y + z * z)) * inverse_square)
    return (middle - root) * radius, meets


def _ellipsoid(origin: tuple, ray: tuple, extra: jax.Array, scaled_inverse) -> tuple:
    del extra, scaled_inverse
    inverse = 1.0 / (ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2])
    middle = -(origin[0] * ray[0] + origin[1] * ray[1] + origin[2] * ray[2]) * inverse
    x, y, z = (origin[axis] + middle * ray[axis] for axis in range(3))
    root, meets = _safe_root((1.0 - (x * x + y * y + z * z)) * inverse)
    return middle - root, meets


def _tube(origin: tuple, ray: tuple) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Intersect the infinite cylinder of radius 1 around z: centre of the chord, half its length, and a hit mask."""
    inverse = 1.0 / (ray[0] * ray[0] + ray[1] * ray[1] + _TINY)
    middle = -(origin[0] * ray[0] + origin[1] * ray[1]) * inverse
    x, y = origin[0] + middle * ray[0], origin[1] + middle * ray[1]
    root, meets = _safe_root((1.0 - (x * x + y * y)) * inverse)
    return middle, root, meets


def _capsule(origin: tuple, ray: tuple, half_length: jax.Array, inverse) -> tuple:
    """Intersect a tube with a ball at each end: if the ray enters the tube beyond an end, the ball of that end is used."""
    middle, root, meets = _tube(origin, ray)
    side = middle - root
    height = origin[2] + side * ray[2]
    centre = minimum(maximum(height, -half_length), half_length)
    on_side = meets & (height == centre)
    below = origin[2] - jnp.where(height > 0.0, half_length, -half_length)
    nearest = -(origin[0] * ray[0] + origin[1] * ray[1] + below * ray[2]) * inverse
    x, y, z = origin[0] + nearest * ray[0], origin[1] + nearest * ray[1], below + nearest * ray[2]
    ball_root, meets_ball = _safe_root((1.0 - (x * x + y * y + z * z)) * inverse)
    return jnp.where(on_side, side, nearest - ball_root), meets & (on_side | meets_ball)


def _cylinder(origin: tuple, ray: tuple, extra: jax.Array, scaled_inverse) -> tuple:
    """Intersect the tube and the slab |z| <= 1: the ray is inside both from the later entry to the earlier exit."""
    del extra, scaled_inverse
    middle, root, meets = _tube(origin, ray)
    inverse = 1.0 / (ray[2] + _TINY)
    slab_middle, slab_half = -origin[2] * inverse, jnp.abs(inverse)
    enter = maximum(middle - root, slab_middle - slab_half)
    leave = minimum(middle + root, slab_middle + slab_half)
    return enter, meets & (enter < leave)


def _box(origin: tuple, ray: tuple, extra: jax.Array, scaled_inverse) -> tuple:
    """Intersect three slabs: the ray is inside all of them from the latest entry to the earliest exit."""
    del extra, scaled_inverse
    enters, leaves = [], []
    for axis in range(3):
        inverse = 1.0 / (ray[axis] + _TINY)
        middle, half = -origin[axis] * inverse, jnp.abs(inverse)
        enters.append(middle - half)
        leaves.append(middle + half)
    enter = maximum(maximum(enters[0], enters[1]), enters[2])
    leave = minimum(minimum(leaves[0], leaves[1]), leaves[2])
    return enter, enter < leave


def _plane(origin: tuple, ray: tuple, extra: jax.Array, scaled_inverse) -> tuple:
    """Intersect the square |x|, |y| <= 1 at z = 0, visible from both sides."""
    del extra, scaled_inverse
    t = -origin[2] / (ray[2] + _TINY)
    x, y = origin[0] + t * ray[0], origin[1] + t * ray[1]
    return t, maximum(jnp.abs(x), jnp.abs(y)) <= 1.0


def _ball(origin: tuple, ray: tuple, extra: jax.Array, scaled_inverse) -> tuple:
    """Intersect a rotated ball (which has a texture)."""
    return _ellipsoid(origin, ray, extra, scaled_inverse)


_INTERSECTIONS = {
    shapes.PLANE: _plane,
    shapes.SPHERE: _ball,
    shapes.CAPSULE: _capsule,
    shapes.ELLIPSOID: _ellipsoid,
    shapes.CYLINDER: _cylinder,
    shapes.BOX: _box,
}
