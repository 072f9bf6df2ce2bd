"""Search, along hierarchies, for the triangles that rays of the camera (on a GPU) and rays to the lights meet.

Only the search is done by kernels. Depths, normals and colours are computed by the plain renderer from the triangles found.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxrl_vis_envs.compiling.compilation import use_gpu_kernels
from jaxrl_vis_envs.render import camera
from jaxrl_vis_envs.render.camera import Rays
from jaxrl_vis_envs.render.gpu import kernel, light_grid
from jaxrl_vis_envs.render.gpu.tiles import pack_bits
from jaxrl_vis_envs.render.gpu.walk import LANES, TILE, Refs, traverse_in_plain_jax, traverse_on_gpu
from jaxrl_vis_envs.render.model import hierarchies, reading
from jaxrl_vis_envs.render.pixel import blocks, lights, raycast, shapes
from jaxrl_vis_envs.render.pixel.arithmetic import Vector
from jaxrl_vis_envs.render.pixel.prepare import prepare
from jaxrl_vis_envs.render.pixel.triangles import Segments
from jaxrl_vis_envs.render.scene import Scene

Walk = Callable[..., list[jax.Array]]

_PROBE = """
<mujoco>
  <asset><mesh name="m" vertex="0 0 0  .1 0 0  0 .1 0  0 0 .1"/></asset>
  <worldbody><geom type="mesh" mesh="m"/><camera pos="0 0 1"/></worldbody>
</mujoco>
"""


def can_search(scene: Scene) -> bool:
    """Return True if the kernel searches the scene's triangles on the platform being traced for."""
    return scene.hierarchies is not None and use_gpu_kernels(probe)


def layout(scene: Scene) -> blocks.Layout:
    """Return the layout of all pixels in one block, tile by tile."""
    tiles = blocks.tiles(scene, *TILE)
    return tiles._replace(rows=tiles.rows.reshape(1, -1), columns=tiles.columns.reshape(1, -1))


def nearest(scene: Scene, unit: shapes.UnitShapes, rays: Rays, interpret: bool = False) -> blocks.Nearest:
    """Return the nearest opaque objects of all pixels, as `blocks.nearest` does. Not differentiable.

    Args:
        scene: Scene with triangles.
        unit: Rendered objects.
        rays: [1, P], those of all pixels, in the order of `layout`.
        interpret: Run without a GPU, slowly.
    """
    scene, unit = jax.lax.stop_gradient((scene, unit))
    rays, row = Rays(rays.u[0], rays.v[0]), None
    if kernel.can_search(scene):
        key, row = jax.tree.map(lambda plane: _cut(scene, plane), kernel.nearest_primitives(scene, unit, interpret))
    elif raycast.has_separate_rows(scene):
        key, row = raycast.nearest_row(scene, unit, rays)
    else:
        key = raycast.nearest_key(scene, unit, rays)
    nearest = nearest_triangle(scene, unit, rays, raycast.decode(scene, key, row)[0], interpret)
    return jax.tree.map(lambda plane: plane[None], blocks.add_triangles(scene, key, row, nearest))


def nearest_triangle(
    scene: Scene, unit: shapes.UnitShapes, rays: Rays, depth: jax.Array, interpret: bool = False
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Find the nearest triangle of an opaque object in front of ``depth``. Not differentiable.

    Args:
        scene: Scene with triangles.
        unit: Rendered objects.
        rays: [P], those of all pixels, in the order of `layout`.
        depth: [P] float32, metres, maximum depth.
        interpret: Run without a GPU, slowly.

    Returns:
        Depth [P] float32 of the triangle, or ``depth`` if there is none; its row in `Scene.triangles` and the row of its
        object, [P] int32 each, -1 if there is none.
    """
    trees = scene.hierarchies
    assert trees is not None
    middle, radius = _balls(trees, unit)
    near = jnp.maximum(-middle[:, 2] - radius, scene.znear)
    is_solid = jnp.asarray(np.array(scene.transparent) == reading.SOLID)[trees.objects]
    order = jnp.argsort(near)
    meets = _seen_from_tiles(scene, jnp.where(is_solid, radius, np.nan)[order], middle[order])
    start, direction, _ = camera.ray_parts(scene, rays)
    axis = -unit.axes[trees.objects, :, 2] if scene.projection == "orthographic" else _apply(unit.axes[trees.objects], middle)
    tile = jnp.arange(depth.shape[0], dtype=jnp.int32) // LANES
    refs = _shared_refs(trees, unit, order, axis, pack_bits(meets))._replace(
        rows=tile[None],
        near=near[order],
        ball=jnp.concatenate([middle, radius[:, None]], axis=1)[order],
        start=_stack(start, depth.shape),
        direction=_stack(direction, depth.shape),
        nearest=jnp.broadcast_to(scene.znear, depth.shape),
        farthest=depth,
    )
    best, hit, row = traverse_on_gpu(refs, any_hit=False, interpret=interpret)
    is_hit = hit >= 0
    row = trees.rows.at[jnp.maximum(row, 0)].get(mode="promise_in_bounds")
    owner = trees.objects.at[jnp.maximum(hit, 0)].get(mode="promise_in_bounds")
    return best, jnp.where(is_hit, row, -1), jnp.where(is_hit, owner, -1)


def blocked(
    scene: Scene, unit: shapes.UnitShapes, segments: Segments, light: lights.Light, walk: Walk = traverse_in_plain_jax
) -> jax.Array:
    """Return True where a segment enters a mesh or a height field, of any transparency: [P] bool. Not differentiable.

    Args:
        scene: Scene with triangles.
        unit: Rendered objects.
        segments: [P], towards the light, and not beyond it.
        light: The light.
        walk: `walk.traverse_on_gpu` or `walk.traverse_in_plain_jax`.
    """
    scene, unit, segments = jax.lax.stop_gradient((scene, unit, segments))
    trees = scene.hierarchies
    assert trees is not None
    middle, radius = _balls(trees, unit)
    start, direction = jnp.stack(segments.start), jnp.stack(segments.direction)
    valid = segments.farthest > segments.nearest
    order, words, rows = light_grid.shadow_cells(light, segments, middle, radius)
    common = jnp.sum(jnp.where(valid, direction, 0.0), axis=1)
    refs = _shared_refs(trees, unit, order, _apply(unit.axes[trees.objects], common[None]), words)._replace(
        rows=rows,
        near=jnp.zeros_like(radius),
        ball=jnp.concatenate([middle, radius[:, None]], axis=1)[order],
        start=start,
        direction=direction,
        nearest=segments.nearest,
        farthest=segments.farthest,
    )
    return _padded(walk, refs)[: len(valid)] >= 0


def _padded(walk: Walk, refs: Refs) -> jax.Array:
    """Walk with the number of rays rounded up to whole tiles; the added ones meet nothing."""
    missing = -refs.nearest.shape[0] % LANES
    if missing:
        rays = {name: getattr(refs, name) for name in ("rows", "start", "direction", "nearest", "farthest")}
        rays = {name: jnp.pad(plane, [(0, 0)] * (plane.ndim - 1) + [(0, missing)]) for name, plane in rays.items()}
        refs = refs._replace(**rays)
    return walk(refs, any_hit=True)[0]


def _cut(scene: Scene, plane: jax.Array) -> jax.Array:
    """Bring a plane [H * W] into the order of `layout`, with zeros beyond the image."""
    (high, wide), (down, across) = TILE, (-(-scene.height // TILE[0]), -(-scene.width // TILE[1]))
    plane = plane.reshape(scene.height, scene.width)
    plane = jnp.pad(plane, ((0, down * high - scene.height), (0, across * wide - scene.width)))
    return plane.reshape(down, high, across, wide).swapaxes(1, 2).reshape(-1)


def _balls(trees: hierarchies.Hierarchies, unit: shapes.UnitShapes) -> tuple[jax.Array, jax.Array]:
    """Return centres [N, 3] in the camera's frame and radii [N] of the objects' bounding spheres, m, rounded up."""
    axes = unit.axes[trees.objects]  # rotations
    middle = jnp.sum(axes * (trees.ball[:, :3] - unit.origin[trees.objects])[:, :, None], axis=1)
    distance = jnp.sqrt(jnp.sum(jnp.square(middle), axis=1))
    return middle, trees.ball[:, 3] * (1.0 + 1e-4) + 1e-6 * (1.0 + distance)


def _apply(axes: jax.Array, vector: jax.Array) -> jax.Array:
    """Multiply matrices [N, 3, 3] and vectors [N, 3]. Not a matrix product, which a GPU may compute at low precision."""
    return jnp.sum(axes * vector[:, None, :], axis=2)


def _stack(vector: Vector, shape: tuple[int, ...]) -> jax.Array:
    """Return three values, numbers or arrays, as one array [3, *shape]."""
    return jnp.stack([jnp.broadcast_to(jnp.asarray(value, jnp.float32), shape) for value in vector])


def _seen_from_tiles(scene: Scene, radius: jax.Array, middle: jax.Array) -> jax.Array:
    """Return the mask [tiles, N] of spheres that the rays of a tile's pixels may meet beyond the near plane.

    Args:
        scene: The scene.
        radius: [N] float32, m; not a number for objects to leave out.
        middle: [N, 3] float32, m, camera's frame.
    """
    sides = camera.sphere_sides(scene, middle, radius)
    middles, pitches = camera.lens(scene)[:2], camera.pixel_pitch(scene)
    ranges = []
    for axis, (count, length) in enumerate(((scene.width, TILE[1]), (scene.height, TILE[0]))):
        first = np.arange(0, count, length)
        if axis:
            first = count - length - first  # rows are counted from the top, v from the bottom
        low, high = (first - 0.5 * (count - 1) - 0.01, first + length - 1 - 0.5 * (count - 1) + 0.01)
        low, high = (middles[axis] + jnp.asarray(side, jnp.float32) * pitches[axis] for side in (low, high))
        ranges.append((sides[:, 2 * axis] <= high[:, None]) & (sides[:, 2 * axis + 1] >= low[:, None]))
    across, down = ranges
    in_front = radius - middle[:, 2] > scene.znear
    return (down[:, None] & across[None] & in_front).reshape(down.shape[0] * across.shape[0], -1)


def _shared_refs(
    trees: hierarchies.Hierarchies, unit: shapes.UnitShapes, order: jax.Array, axis: jax.Array, words: jax.Array
) -> Refs:
    """Return the memory blocks that all searches need, the others None.

    Args:
        trees: Hierarchies of the scene.
        unit: Rendered objects.
        order: [N] int32, order of the objects.
        axis: [N, 3] float32, direction of most rays in the object's frame.
        words: [R, words] int32, rows of bits.
    """
    octant = jnp.sum(jnp.where(axis < 0.0, np.array([1, 2, 4], np.int32), 0), axis=1, dtype=jnp.int32)
    pose = jnp.concatenate([unit.axes[trees.objects].reshape(-1, 9), unit.origin[trees.objects]], axis=1)
    blocks = dict.fromkeys(Refs._fields)
    is_set = words != 0
    number = np.arange(1, words.shape[1] + 1, dtype=np.int32)
    last = jnp.max(jnp.where(is_set, number, 0), axis=1)
    before = jnp.min(jnp.where(is_set, number - 1, words.shape[1]), axis=1)
    blocks |= dict(words=words, span=jnp.stack([jnp.minimum(before, last), last], axis=1))
    blocks |= dict(order=order.astype(jnp.int32), pose=pose, first=trees.first + octant * trees.steps)
    blocks |= dict(steps=trees.steps, frame=trees.frame, nodes=trees.nodes, maps=trees.maps)
    return Refs(**blocks)


def probe() -> jax.stages.Traced:
    """Trace small instances of both kernels."""
    mj_model = mujoco.MjModel.from_xml_string(_PROBE)
    mj_data = mujoco.MjData(mj_model)
    mujoco.mj_forward(mj_model, mj_data)
    scene = Scene.from_mjmodel(mj_model, 0, 8, 8)
    unit = jax.eval_shape(lambda scene: prepare(scene, mj_data), scene).unit  # avoids compilation
    pixels = jax.ShapeDtypeStruct((64,), jnp.float32)

    def search(scene: Scene, unit: shapes.UnitShapes, one: jax.Array) -> Any:
        segments = Segments((one,) * 3, (one,) * 3, one, one)
        three = one[:3]
        light = lights.Light(True, False, True, None, three, three, three, three, None, None, None)
        return nearest_triangle(scene, unit, Rays(one, one), one), blocked(scene, unit, segments, light, traverse_on_gpu)

    return jax.jit(search).trace(scene, unit, pixels)
