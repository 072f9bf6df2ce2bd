"""The order in which pixels are processed: in blocks, one after the other.

On a CPU, because XLA drops optimization barriers before it fuses for a CPU, and then computes the nearest hit anew for every
use of it (60 times slower with colour). The boundary of a loop is the one that it respects, so there are at least two blocks
wherever the number of pixels can be divided; what lies between two operations then also stays in the cache.

Anywhere, in scenes with much in them: a block is then a tile, and most things are not in it.
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

# Pixels of one environment that a CPU works on at a time where much is stored for each.
_CPU_BLOCK = 512
# Height and width of a tile, if the image can be cut so. Small ones see fewer objects, but each costs a round of a loop.
_CPU_TILE, _TILE = 8, 16


class Layout(NamedTuple):
    """The pixels in blocks: rows and columns [blocks, P], NumPy; and the height and width of a tile, None for strips.

    The tiles of an image that cannot be cut evenly hang over its right and lower border.
    """

    rows: np.ndarray
    columns: np.ndarray
    tile: tuple[int, int] | None


def layout(scene: Scene) -> Layout:
    """Cuts the image of a scene into blocks: tiles if there is much in it, otherwise strips."""
    if not tiled(scene):
        pixels = np.arange(scene.height * scene.width).reshape(_half_count(scene.height * scene.width), -1)
        return Layout(pixels // scene.width, pixels % scene.width, None)
    wish = _CPU_TILE if targets_cpu() else _TILE
    return tiles(scene, near_divisor(scene.height, wish), near_divisor(scene.width, wish))


def tiles(scene: Scene, high: int, wide: int) -> Layout:
    """Cuts the image of a scene into tiles of this height and width."""
    down, across = -(-scene.height // high), -(-scene.width // wide)
    rows, columns = np.indices((down * high, across * wide))

    def cut(grid: np.ndarray) -> np.ndarray:
        return grid.reshape(down, high, across, wide).swapaxes(1, 2).reshape(down * across, high * wide)

    return Layout(cut(rows), cut(columns), (high, wide))


def restore(scene: Scene, layout: Layout, plane: jax.Array) -> jax.Array:
    """Blocks of pixels in a layout (joined or not) -> [H, W]."""
    if layout.tile is None:
        return plane.reshape(scene.height, scene.width)
    high, wide = layout.tile
    down, across = -(-scene.height // high), -(-scene.width // wide)
    whole = plane.reshape(down, across, high, wide).swapaxes(1, 2).reshape(down * high, across * wide)
    return whole[: scene.height, : scene.width]


def near_divisor(pixels: int, wish: int) -> int:
    """Near the wished length of a tile, and a divisor of ``pixels`` if there is one that is near enough."""
    lengths = [length for length in range(wish // 2 + 2, 2 * wish - 4) if pixels % length == 0]
    return min(lengths, key=lambda length: abs(length - wish), default=min(wish, pixels))


def _block_count(pixels: int) -> int:
    """Into how many equal blocks the pixels are cut: 1 on an accelerator, on a CPU so that a block is about `_CPU_BLOCK`."""
    if not targets_cpu():
        return 1
    counts = [count for count in range(2, max(3, pixels // 64)) if pixels % count == 0]
    return min(counts, key=lambda count: abs(np.log(pixels / count / _CPU_BLOCK)), default=1)


def _half_count(pixels: int) -> int:
    """Two blocks on a CPU, if that is possible: the fewest that make a loop."""
    return 2 if targets_cpu() and pixels % 2 == 0 else _block_count(pixels)


def scan(function: Callable, *pixels: Any) -> Any:
    """Applies ``function``, which takes and gives trees of arrays [P], to trees of arrays [blocks, P], block by block."""
    if _shape(pixels)[0] == 1:
        first = jax.tree.map(lambda plane: plane[0], pixels)
        return jax.tree.map(lambda plane: plane[None], function(*first))
    return jax.lax.scan(lambda carry, block: (carry, function(*block)), None, pixels)[1]


def scan_one(function: Callable, *pixels: Any) -> jax.Array:
    """`scan` for a function with one result, int32, on all cores of a CPU.

    What goes straight into the stacked results of a loop, XLA computes on one thread. What is carried, on all of them: so
    results are carried a round before they are stacked.
    """
    count = _shape(pixels)[0]
    if count == 1 or not targets_cpu():
        return scan(function, *pixels)
    empty = jnp.zeros(jax.eval_shape(function, *jax.tree.map(lambda plane: plane[0], pixels)).shape, jnp.int32)
    if count == 2:
        halves, _ = jax.lax.scan(lambda halves, block: ((halves[1], function(*block)), None), (empty, empty), pixels)
        return jnp.stack(halves)
    last, before = jax.lax.scan(lambda done, block: (function(*block), done), empty, pixels)
    return jnp.concatenate([before[1:], last[None]])


def _shape(pixels: Any) -> tuple[int, ...]:
    """Of the arrays of a tree, which all have the same."""
    return jax.tree.leaves(pixels)[0].shape


def joined(pixels: Any) -> Any:
    """Arrays [blocks, P] in fewer and longer blocks, for what does not depend on which pixels are in a block."""
    count = _block_count(math.prod(_shape(pixels)))
    return jax.tree.map(lambda plane: plane.reshape(count, -1), pixels)


def tiled(scene: Scene) -> bool:
    """Whether there is enough in the scene that it pays to find out what each tile shows."""
    return scene.clusters.shape[-2] > 0 or len(raycast.primitive_rows(scene, transparent=False)) > raycast.UNROLLED


class Nearest(NamedTuple):
    """Nearest object along rays, [blocks, P] int32 each.

    Attributes:
        key: See `raycast`.
        row: Of the object, -1 for the sky; None where it is part of the key.
        triangle: Row of the triangle, -1 where a primitive is nearest; None in a scene without triangles.
    """

    key: jax.Array
    row: jax.Array | None
    triangle: jax.Array | None


def nearest(scene: Scene, unit: shapes.UnitShapes, rays: Rays) -> Nearest:
    """The nearest opaque objects along rays [blocks, P]."""
    row = None
    if raycast.keeps_rows(scene):
        both = scan_one(lambda rays: raycast.nearest_row(scene, unit, rays), rays)
        key, row = both[:, 0], both[:, 1]
    else:
        key = scan_one(lambda rays: raycast.nearest_key(scene, unit, rays), rays)
    if not scene.clusters.shape[-2]:
        return Nearest(key, row, None)

    def add_triangles(rays: Rays, key: jax.Array, row: jax.Array | None) -> Nearest:
        depth, triangle, owner = triangles.nearest_triangle(scene, unit, rays, raycast.decode(scene, key, row)[0])
        mask = raycast.code_mask(scene)
        met = (jax.lax.bitcast_convert_type(depth, jnp.int32) & ~mask) | (owner & mask)
        seen = triangle >= 0
        return Nearest(jnp.where(seen, met, key), None if row is None else jnp.where(seen, owner, row), triangle)

    # Nothing here is differentiated: `surface.meet` is.
    unit = jax.lax.stop_gradient(unit)
    return scan(add_triangles, rays, key, row)
