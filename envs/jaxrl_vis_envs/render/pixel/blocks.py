"""Processing order of pixels: in blocks, one after the other.

On a CPU, XLA drops optimization barriers before fusion, and would recompute the nearest hit for every use of it (60 times
slower with colour). It does respect loop boundaries, so there are at least two blocks whenever the number of pixels can be
divided; intermediate values then also stay in the cache.

On any platform, blocks are tiles if the scene has many objects, most of which are outside a given tile.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs.compiling.compilation import targets_cpu
from jaxrl_vis_envs.render.camera import Rays
from jaxrl_vis_envs.render.pixel import raycast, shapes, triangles
from jaxrl_vis_envs.render.scene import Scene

# Pixels per block on a CPU in stages that store much per pixel.
_CPU_BLOCK = 512
# Preferred height and width of a tile. Smaller tiles see fewer objects, but each costs a loop iteration.
_CPU_TILE, _TILE = 8, 16


class Layout(NamedTuple):
    """Image coordinates of the pixels by block, rows and columns [blocks, P], NumPy; and height and width of a tile, None for
    strips.

    If an image is not divisible into tiles, they extend beyond its right and lower border.
    """

    rows: np.ndarray
    columns: np.ndarray
    tile: tuple[int, int] | None


def layout(scene: Scene) -> Layout:
    """Split the image of a scene into blocks: tiles if it has many objects, otherwise strips."""
    if not is_tiled(scene):
        pixels = np.arange(scene.height * scene.width).reshape(_half_count(scene.height * scene.width), -1)
        return Layout(pixels // scene.width, pixels % scene.width, None)
    preferred = _CPU_TILE if targets_cpu() else _TILE
    return tiles(scene, near_divisor(scene.height, preferred), near_divisor(scene.width, preferred))


def tiles(scene: Scene, high: int, wide: int) -> Layout:
    """Split the image of a scene into tiles of height ``high`` and width ``wide``."""
    down, across = -(-scene.height // high), -(-scene.width // wide)
    rows, columns = np.indices((down * high, across * wide))

    def cut(grid: np.ndarray) -> np.ndarray:
        return grid.reshape(down, high, across, wide).swapaxes(1, 2).reshape(down * across, high * wide)

    return Layout(cut(rows), cut(columns), (high, wide))


def restore(scene: Scene, layout: Layout, plane: jax.Array) -> jax.Array:
    """Reassemble blocks of pixels in a layout (merged or not) to [H, W]."""
    if layout.tile is None:
        return plane.reshape(scene.height, scene.width)
    high, wide = layout.tile
    down, across = -(-scene.height // high), -(-scene.width // wide)
    whole = plane.reshape(down, across, high, wide).swapaxes(1, 2).reshape(down * high, across * wide)
    return whole[: scene.height, : scene.width]


def near_divisor(pixels: int, preferred: int) -> int:
    """Return a tile length near the ``preferred`` one that divides ``pixels``, if there is one nearby."""
    lengths = [length for length in range(preferred // 2 + 2, 2 * preferred - 4) if pixels % length == 0]
    return min(lengths, key=lambda length: abs(length - preferred), default=min(preferred, pixels))


def _block_count(pixels: int) -> int:
    """Return the number of equal blocks: 1 on an accelerator; on a CPU, such that a block has about `_CPU_BLOCK` pixels."""
    if not targets_cpu():
        return 1
    counts = [count for count in range(2, max(3, pixels // 64)) if pixels % count == 0]
    return min(counts, key=lambda count: abs(np.log(pixels / count / _CPU_BLOCK)), default=1)


def _half_count(pixels: int) -> int:
    """Return 2 on a CPU if ``pixels`` is even, the minimum number of blocks for a loop, else `_block_count`."""
    return 2 if targets_cpu() and pixels % 2 == 0 else _block_count(pixels)


def scan(function: Callable, *pixels: Any) -> Any:
    """Apply ``function`` to each block of pytrees [blocks, P], one after another, and stack the results.

    Args:
        function: Takes and returns pytrees of arrays [P].
        *pixels: Pytrees of arrays [blocks, P].
    """
    if _shape(pixels)[0] == 1:
        first = jax.tree.map(lambda plane: plane[0], pixels)
        return jax.tree.map(lambda plane: plane[None], function(*first))
    return jax.lax.scan(lambda carry, block: (carry, function(*block)), None, pixels)[1]


def scan_one(function: Callable, *pixels: Any) -> jax.Array:
    """Apply `scan` to a function with one int32 result, on all cores of a CPU.

    XLA computes values that go directly into the stacked results of a loop on one thread, but carried values on all of them:
    results are therefore carried for one iteration before they are stacked.
    """
    count = _shape(pixels)[0]
    if count == 1 or not targets_cpu():
        return scan(function, *pixels)
    empty = jnp.zeros(jax.eval_shape(function, *jax.tree.map(lambda plane: plane[0], pixels)).shape, jnp.int32)
    if count == 2:
        halves, _ = jax.lax.scan(lambda halves, block: ((halves[1], function(*block)), None), (empty, empty), pixels)
        return jnp.stack(halves)
    last, earlier = jax.lax.scan(lambda previous, block: (function(*block), previous), empty, pixels)
    return jnp.concatenate([earlier[1:], last[None]])


def _shape(pixels: Any) -> tuple[int, ...]:
    """Return the common shape of a pytree's arrays."""
    return jax.tree.leaves(pixels)[0].shape


def merge_blocks(pixels: Any) -> Any:
    """Merge arrays [blocks, P] into fewer, longer blocks, for stages that process pixels independently of their blocks."""
    count = _block_count(math.prod(_shape(pixels)))
    return jax.tree.map(lambda plane: plane.reshape(count, -1), pixels)


def is_tiled(scene: Scene) -> bool:
    """Return True if the scene has enough objects to make culling per tile worthwhile."""
    return scene.clusters.shape[-2] > 0 or len(raycast.primitive_rows(scene, transparent=False)) > raycast.MAX_UNROLLED


class Nearest(NamedTuple):
    """Nearest object along rays, [blocks, P] int32 each.

    Attributes:
        key: Key, see `raycast`.
        row: Row of the object, -1 for the sky; None if it is part of the key.
        triangle: Row of the triangle, -1 where a primitive is nearest; None in a scene without triangles.
    """

    key: jax.Array
    row: jax.Array | None
    triangle: jax.Array | None


def nearest_primitives(scene: Scene, unit: shapes.UnitShapes, rays: Rays) -> tuple[jax.Array, jax.Array | None]:
    """Return the keys of the nearest opaque primitives along rays [blocks, P], and their rows unless part of the keys."""
    if raycast.has_separate_rows(scene):
        bits_and_row = scan_one(lambda rays: raycast.nearest_row(scene, unit, rays), rays)
        return bits_and_row[:, 0], bits_and_row[:, 1]
    return scan_one(lambda rays: raycast.nearest_key(scene, unit, rays), rays), None


def nearest(scene: Scene, unit: shapes.UnitShapes, rays: Rays) -> Nearest:
    """Return the nearest opaque objects along rays [blocks, P]."""
    key, row = nearest_primitives(scene, unit, rays)
    if not scene.clusters.shape[-2]:
        return Nearest(key, row, None)

    # Not differentiated: the derivatives come from `surface.intersect`.
    unit = jax.lax.stop_gradient(unit)
    bounds = jax.lax.optimization_barrier(triangles.opaque_bounds(jax.lax.stop_gradient(scene), unit))

    def with_triangles(rays: Rays, key: jax.Array, row: jax.Array | None) -> Nearest:
        depth = raycast.decode(scene, key, row)[0]
        return add_triangles(scene, key, row, triangles.nearest_triangle(scene, unit, rays, depth, bounds=bounds))

    return scan(with_triangles, rays, key, row)


def add_triangles(scene: Scene, key: jax.Array, row: jax.Array | None, nearest: tuple) -> Nearest:
    """Merge the nearest primitives with the nearest triangles in front of them.

    Args:
        scene: The scene.
        key: [P] int32, keys of the nearest primitives.
        row: [P] int32, their rows if the scene has separate rows, else None.
        nearest: Nearest triangles in front of them, from `triangles.nearest_triangle`.
    """
    depth, triangle, owner = nearest
    mask = raycast.code_mask(scene)
    triangle_key = (jax.lax.bitcast_convert_type(depth, jnp.int32) & ~mask) | (owner & mask)
    is_triangle = triangle >= 0
    return Nearest(
        jnp.where(is_triangle, triangle_key, key), None if row is None else jnp.where(is_triangle, owner, row), triangle
    )
