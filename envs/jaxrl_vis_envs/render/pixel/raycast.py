"""Visible object of each pixel: analytic intersections of rays with unit shapes.

An object counts where a ray enters it in front of the near plane: from inside an object one looks through it, as with OpenGL's
culled back faces. A plane is seen from both sides.

The answer is one integer per pixel, a key: the bits of the depth (which order as the depths do), with the lowest bits replaced
by the row of the object. The nearest object is then the least key, one operation per object, and XLA on a CPU, which computes a
loop anew for each of its outputs, computes it once. `surface` makes the depth exact again, and differentiable.

With many objects the row would take so many bits that thin layers could not be told apart any more: 0.24 mm at 3 m with 600 of
them. Then (`keeps_rows`) a key is nothing but the bits of the depth, and the row is a second integer.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs.render import camera
from jaxrl_vis_envs.render.camera import Rays
from jaxrl_vis_envs.render.model.reading import CLEAR, CLEAR_FROM_BEHIND, SOLID
from jaxrl_vis_envs.render.pixel import shapes
from jaxrl_vis_envs.render.pixel.arithmetic import larger, smaller
from jaxrl_vis_envs.render.scene import Scene

# Keeps a division by a ray component that is exactly 0 finite; far too small to change any other number.
_TINY = 1e-20

# Up to this many primitives are unrolled; of more than these, only those of a type with at most _FEW objects.
UNROLLED = 48
_FEW = 3


# Up to so many objects have their row in the key: 6 bits, 0.015 mm at 3 m.
_MOST_IN_KEY = 63


def keeps_rows(scene: Scene) -> bool:
    """Returns whether rows are kept beside keys, because there are too many of them to be part of one."""
    return len(scene.object_ids) > _MOST_IN_KEY


def code_mask(scene: Scene) -> int:
    """The lowest bits of a key, that hold the row of the object (all ones is the sky); 0 where rows are kept beside keys."""
    return 0 if keeps_rows(scene) else (1 << int(len(scene.object_ids)).bit_length()) - 1


def primitive_rows(scene: Scene, transparent: bool) -> list[int]:
    """Rows of the drawn objects that are primitives, and transparent or not."""
    fine = (shapes.MESH, shapes.HFIELD)
    wanted = (CLEAR, CLEAR_FROM_BEHIND) if transparent else (SOLID, CLEAR_FROM_BEHIND)
    return [
        row
        for row, (kind, clear) in enumerate(zip(scene.object_types, scene.transparent, strict=True))
        if kind not in fine and clear in wanted
    ]


def behind(unit: shapes.UnitShapes, row: int) -> jax.Array:
    """Whether the camera is behind the plane of a row, [] bool."""
    return unit.origin[row, 2] < 0.0


def _solid_entry(scene: Scene, unit: shapes.UnitShapes, row: int, rays: Rays) -> tuple[jax.Array, jax.Array]:
    """`row_entry` for objects that are opaque from this side, and not before the near plane."""
    t, meets = row_entry(scene, unit, row, rays)
    meets = meets & (t > scene.znear)
    if scene.transparent[row] == CLEAR_FROM_BEHIND:
        meets = meets & ~behind(unit, row)
    return t, meets


def decode(scene: Scene, key: jax.Array, row: jax.Array | None) -> tuple[jax.Array, jax.Array]:
    """Depth (m, float32, a few millionths too small, not differentiable) and row (-1 for the sky, int32) of keys.

    Args:
        scene: The scene.
        key: [P] int32.
        row: [P] int32 where the scene `keeps_rows`, otherwise None.
    """
    if row is not None:
        return jax.lax.bitcast_convert_type(key, jnp.float32), row
    mask = code_mask(scene)
    row = key & mask
    return jax.lax.bitcast_convert_type(key & ~mask, jnp.float32), jnp.where(row == mask, -1, row)


def row_entry(scene: Scene, unit: shapes.UnitShapes, row: int, rays: Rays) -> tuple[jax.Array, jax.Array]:
    """Where the ray of each pixel enters the object of one row (t, metres of planar depth), and whether it does; [P] each."""
    start, direction, inverse_square = camera.ray_parts(scene, rays)
    kind = scene.object_types[row]
    bare_ball = kind == shapes.SPHERE and scene.atlas.mappings[row] == 0
    t, meets = entry(kind, _row_values(unit, row, bare_ball), start, direction, inverse_square)
    if culls(scene, kind):
        meets = meets & one_sided(unit.origin[row, 2], unit.axes[row, 2, 2])
    return t, meets


def culls(scene: Scene, kind: int) -> bool:
    """Whether objects of a type may be hidden although a ray meets them, see `one_sided`."""
    return kind == shapes.PLANE and scene.projection == "orthographic"


def one_sided(height: jax.Array, facing: jax.Array) -> jax.Array:
    """Whether a plane is seen by an orthographic camera, [] bool.

    MuJoCo takes the side that is seen from the camera's place (``height`` above the plane), and OpenGL culls by the camera's
    direction (``facing`` is above 0 if it looks down on the plane): where the two differ, nothing is drawn.
    """
    return (height > 0.0) == (facing > 0.0)


def _row_values(unit: shapes.UnitShapes, row: int | jax.Array, bare_ball: bool) -> tuple:
    """Origin (3), axes (3 x 3), extra and extra_square of one object, in scalars; the axes of a plain ball are None."""
    origin = [unit.origin[row, axis] for axis in range(3)]
    axes = None if bare_ball else [[unit.axes[row, i, j] for j in range(3)] for i in range(3)]
    return origin, axes, unit.extra[row], unit.extra_square[row]


def entry(kind: int, values: tuple, start: tuple, direction: tuple, inverse_square) -> tuple[jax.Array, jax.Array]:
    """Where rays enter a shape, and whether they do.

    Args:
        kind: The type, a `mujoco.mjtGeom`.
        values: Origin (3), axes (3 x 3, None for a ball that is not turned), extra and extra_square, as in `UnitShapes`.
        start: Three values, metres, camera's frame.
        direction: Three values, in the camera's frame.
        inverse_square: The inverse square of the direction's length.

    Returns:
        t [P] float32 (the ray parameter, finite everywhere, smooth wherever the ray does enter) and [P] bool.
    """
    origin, axes, extra, extra_square = values
    if axes is None:
        inverse = 1.0 / extra
        ray = direction
        begin = tuple(o if isinstance(s, float) else o + s * inverse for o, s in zip(origin, start, strict=True))
        return _sphere(begin, ray, extra, inverse_square)
    ray = camera.mapped(axes, direction)
    begin = tuple(o + s for o, s in zip(origin, camera.mapped(axes, start), strict=True))
    return _INTERSECTIONS[kind](begin, ray, extra, inverse_square * extra_square)


def sky_key(scene: Scene, mask: int) -> jax.Array:
    """The key of a ray that meets nothing, [] int32; ``mask`` is `code_mask`, or 0 for depths alone."""
    return (jax.lax.bitcast_convert_type(scene.zfar, jnp.int32) & ~mask) | mask


def object_key(scene: Scene, unit: shapes.UnitShapes, row: int, rays: Rays, missed: jax.Array, mask: int) -> jax.Array:
    """The keys of one opaque object, [P] int32, and ``missed`` where a ray does not meet it; ``mask`` as in `sky_key`."""
    t, meets = _solid_entry(scene, unit, row, rays)
    return jnp.where(meets, (jax.lax.bitcast_convert_type(t, jnp.int32) & ~mask) | (row & mask), missed)


def nearest_key(scene: Scene, unit: shapes.UnitShapes, rays: Rays, labelled: bool = True) -> jax.Array:
    """The key of the nearest opaque primitive along every ray, [P] int32; not ``labelled``, only the bits of its depth.

    Where the scene `keeps_rows` it is the latter in any case, and `nearest_row` finds both.

    Few objects are unrolled into one pass. Of many, those of a type whose balls touch the pyramid of the rays are counted
    through, and a loop runs up to their count; the rays should then lie close together.
    """
    mask = code_mask(scene) if labelled else 0
    unit, rays = jax.lax.stop_gradient((unit, rays))
    best = jnp.broadcast_to(sky_key(scene, mask), rays.u.shape)
    rows = primitive_rows(scene, transparent=False)
    listed = {} if len(rows) <= UNROLLED else _rows_by_type(scene, rows)
    for row in rows:
        if scene.object_types[row] not in listed:
            best = jnp.minimum(best, object_key(scene, unit, row, rays, best, mask))
    for kind, rows in listed.items():
        best = _nearest_listed(scene, unit, kind, rows, rays, best, mask)
    return best


def _rows_by_type(scene: Scene, rows: list[int]) -> dict[int, np.ndarray]:
    """The rows of each type that has enough of them for a loop. Planes fill the image: a loop would save nothing."""
    kinds = np.array(scene.object_types)[rows]
    counted = {int(kind): np.array(rows)[kinds == kind] for kind in np.unique(kinds) if kind != shapes.PLANE}
    return {kind: found for kind, found in counted.items() if len(found) > _FEW}


def nearest_row(scene: Scene, unit: shapes.UnitShapes, rays: Rays) -> jax.Array:
    """Bits of the depth of the nearest opaque primitive along every ray, and its row (-1 for the sky): [2, P] int32."""
    unit, rays = jax.lax.stop_gradient((unit, rays))
    best = jnp.broadcast_to(sky_key(scene, 0), rays.u.shape)
    row = jnp.full(rays.u.shape, len(scene.object_ids), jnp.int32)
    rows = np.array(primitive_rows(scene, transparent=False), int)
    kinds = np.array(scene.object_types)[rows]
    for kind in np.unique(kinds).tolist():
        best, row = _nearest_row_listed(scene, unit, kind, rows[kinds == kind], rays, best, row)
    return jnp.stack([best, jnp.where(row == len(scene.object_ids), -1, row)])


class _Listed(NamedTuple):
    """Objects of one type that rays may meet.

    Attributes:
        table: [objects, 15] float32, those that may be met first: origin, axes, extra, extra_square, row.
        count: [] int32, how many of them may be.
        bare_ball: Whether the type is a ball without a texture.
    """

    table: jax.Array
    count: jax.Array
    bare_ball: bool


def _listed(scene: Scene, unit: shapes.UnitShapes, kind: int, rows: np.ndarray, rays: Rays) -> _Listed:
    """Those objects among ``rows``, all of one type, that the rays may meet."""
    ball = unit.ball[rows]
    bare_ball = kind == shapes.SPHERE and not any(scene.atlas.mappings[row] for row in rows)
    # The k-th object that touches is the number of these counts that are at most k. All of them are brought to the front of a
    # table at once: whatever is done in the loop, but for the pixels, costs more than it does.
    seen = camera.in_view(scene, ball[:, :3], ball[:, 3], rays, None)
    if kind == shapes.PLANE:
        if culls(scene, kind):
            seen = seen & one_sided(unit.origin[rows, 2], unit.axes[rows, 2, 2])
        from_behind = np.array(scene.transparent)[rows] == CLEAR_FROM_BEHIND
        seen = seen & ~(from_behind & (unit.origin[rows, 2] < 0.0))
    counts = jnp.cumsum(seen.astype(jnp.int32), dtype=jnp.int32)
    order = jnp.sum(counts[None, :] <= np.arange(len(rows), dtype=np.int32)[:, None], axis=1, dtype=jnp.int32)
    columns = [unit.origin[rows], unit.axes[rows].reshape(-1, 9), unit.extra[rows, None], unit.extra_square[rows, None]]
    table = jnp.concatenate([*columns, jnp.asarray(rows, jnp.float32)[:, None]], axis=1)
    return _Listed(table.at[jnp.minimum(order, len(rows) - 1)].get(mode="promise_in_bounds"), counts[-1], bare_ball)


def _meet_listed(scene: Scene, kind: int, listed: _Listed, step: jax.Array, rays: Rays) -> tuple:
    """t and whether it counts, [P] each, of the object at one place of the table; and its row, [] int32."""
    start, direction, inverse_square = camera.ray_parts(scene, rays)
    values = jax.lax.dynamic_slice(listed.table, (step, np.int32(0)), (1, listed.table.shape[1]))[0]
    origin, axes = [values[i] for i in range(3)], [[values[3 + 3 * i + j] for j in range(3)] for i in range(3)]
    form = (origin, None if listed.bare_ball else axes, values[12], values[13])
    t, meets = entry(kind, form, start, direction, inverse_square)
    return t, meets & (t > scene.znear) & (step < listed.count), values[14].astype(jnp.int32)


def _nearest_listed(
    scene: Scene, unit: shapes.UnitShapes, kind: int, rows: np.ndarray, rays: Rays, best: jax.Array, mask: int
) -> jax.Array:
    """The least of ``best`` [P] and the keys of those objects among ``rows``, all of one type, that the rays may meet."""
    listed = _listed(scene, unit, kind, rows, rays)

    def advance(state: tuple) -> tuple:
        step, best = state
        t, meets, row = _meet_listed(scene, kind, listed, step, rays)
        key = (jax.lax.bitcast_convert_type(t, jnp.int32) & ~mask) | (row & mask)
        return step + 1, jnp.minimum(best, jnp.where(meets, key, best))

    return jax.lax.while_loop(lambda state: state[0] < listed.count, advance, (jnp.zeros((), jnp.int32), best))[1]


def _nearest_row_listed(
    scene: Scene, unit: shapes.UnitShapes, kind: int, rows: np.ndarray, rays: Rays, best: jax.Array, row: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Bits of the least depth [P] and its row [P], of those so far and of those objects among ``rows``, all of one type.

    Of objects at the same depth it is the one with the lesser row.
    """
    listed = _listed(scene, unit, kind, rows, rays)
    none = jnp.full(rays.u.shape, np.iinfo(np.int32).max, jnp.int32)

    def advance(state: tuple) -> tuple:
        step, best, row, met, own = state
        # What the last round met is weighed only now: a CPU would otherwise meet it again for each of these two.
        nearer = (met < best) | ((met == best) & (own < row))
        best, row = jnp.where(nearer, met, best), jnp.where(nearer, own, row)
        t, meets, own = _meet_listed(scene, kind, listed, jnp.minimum(step, len(rows) - 1), rays)
        met = jnp.where(meets & (step < listed.count), jax.lax.bitcast_convert_type(t, jnp.int32), none)
        return step + 1, best, row, met, own

    zero = jnp.zeros((), jnp.int32)
    # One round more than there are objects, to weigh what the last one met.
    state = jax.lax.while_loop(lambda state: state[0] <= listed.count, advance, (zero, best, row, none, zero))
    return state[1], state[2]


def nearest_distance(scene: Scene, unit: shapes.UnitShapes, rays: Rays) -> jax.Array:
    """The depth alone, [P] float32 (m), differentiable as it is: cheaper where nothing else is asked for."""
    depth = jnp.broadcast_to(scene.zfar, rays.u.shape)
    for row in primitive_rows(scene, transparent=False):
        t, meets = _solid_entry(scene, unit, row, rays)
        depth = jnp.where(meets & (t < depth), t, depth)
    return depth


# Each intersection takes the ray's start and direction in the unit shape's frame.


def _safe_root(square: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Square root where positive, and whether it is; 1 elsewhere, so that no gradient is infinite."""
    positive = square > 0.0
    return jnp.sqrt(jnp.where(positive, square, 1.0)), positive


def _sphere(origin: tuple, ray: tuple, radius: jax.Array, inverse_square) -> tuple:
    """The unit ball, not rotated: the ray's direction is still in metres, so t comes out in radii.

    The ray is followed to its point nearest to the centre first. Subtracting there, and not between the large terms of the
    usual quadratic formula, keeps a small ball that is far away sharp in float32.
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
    """The endless cylinder of radius 1 around z: middle of the chord, half its length, and whether there is one."""
    inverse = 1.0 / (ray[0] * ray[0] + ray[1] * ray[1] + _TINY)
    middle = -(origin[0] * ray[0] + origin[1] * ray[1]) * inverse
    x, y = origin[0] + middle * ray[0], origin[1] + middle * ray[1]
    root, meets = _safe_root((1.0 - (x * x + y * y)) * inverse)
    return middle, root, meets


def _capsule(origin: tuple, ray: tuple, half_length: jax.Array, inverse) -> tuple:
    """A tube with a ball at each end: where the ray enters the tube beyond an end, that end's ball decides."""
    middle, root, meets = _tube(origin, ray)
    side = middle - root
    height = origin[2] + side * ray[2]
    centre = smaller(larger(height, -half_length), half_length)
    on_side = meets & (height == centre)
    below = origin[2] - jnp.where(height > 0.0, half_length, -half_length)
    nearest = -(origin[0] * ray[0] + origin[1] * ray[1] + below * ray[2]) * inverse
    x, y, z = origin[0] + nearest * ray[0], origin[1] + nearest * ray[1], below + nearest * ray[2]
    ball_root, meets_ball = _safe_root((1.0 - (x * x + y * y + z * z)) * inverse)
    return jnp.where(on_side, side, nearest - ball_root), meets & (on_side | meets_ball)


def _cylinder(origin: tuple, ray: tuple, extra: jax.Array, scaled_inverse) -> tuple:
    """The tube and the slab |z| <= 1: inside both from the later entry to the earlier exit."""
    del extra, scaled_inverse
    middle, root, meets = _tube(origin, ray)
    inverse = 1.0 / (ray[2] + _TINY)
    slab_middle, slab_half = -origin[2] * inverse, jnp.abs(inverse)
    enter = larger(middle - root, slab_middle - slab_half)
    leave = smaller(middle + root, slab_middle + slab_half)
    return enter, meets & (enter < leave)


def _box(origin: tuple, ray: tuple, extra: jax.Array, scaled_inverse) -> tuple:
    """Three slabs: inside all of them from the latest entry to the earliest exit."""
    del extra, scaled_inverse
    enters, leaves = [], []
    for axis in range(3):
        inverse = 1.0 / (ray[axis] + _TINY)
        middle, half = -origin[axis] * inverse, jnp.abs(inverse)
        enters.append(middle - half)
        leaves.append(middle + half)
    enter = larger(larger(enters[0], enters[1]), enters[2])
    leave = smaller(smaller(leaves[0], leaves[1]), leaves[2])
    return enter, enter < leave


def _plane(origin: tuple, ray: tuple, extra: jax.Array, scaled_inverse) -> tuple:
    """The square |x|, |y| <= 1 at z = 0, seen from both sides."""
    del extra, scaled_inverse
    t = -origin[2] / (ray[2] + _TINY)
    x, y = origin[0] + t * ray[0], origin[1] + t * ray[1]
    return t, larger(jnp.abs(x), jnp.abs(y)) <= 1.0


def _ball(origin: tuple, ray: tuple, extra: jax.Array, scaled_inverse) -> tuple:
    """A ball that is turned, for its texture."""
    return _ellipsoid(origin, ray, extra, scaled_inverse)


_INTERSECTIONS = {
    shapes.PLANE: _plane,
    shapes.SPHERE: _ball,
    shapes.CAPSULE: _capsule,
    shapes.ELLIPSOID: _ellipsoid,
    shapes.CYLINDER: _cylinder,
    shapes.BOX: _box,
}
