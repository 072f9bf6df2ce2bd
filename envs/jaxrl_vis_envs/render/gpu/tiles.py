"""Tiles of an image that programs of a GPU kernel render, and the objects that may be visible in them, as bits."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs.render import camera
from jaxrl_vis_envs.render.pixel import shapes
from jaxrl_vis_envs.render.scene import Scene

PIXELS_PER_TILE = 128
"""Pixels per tile: a power of two, some of which may be idle. Tuned on an H200."""


def tile_shape(height: int, width: int) -> tuple[int, int]:
    """Return the rows and columns of a tile: about twice as wide as high, with little overhang beyond the image's border."""

    def cost(shape: tuple[int, int]) -> float:
        high, wide = shape
        return -(-height // high) * -(-width // wide) * (1.0 + 0.1 * abs(np.log2(wide / high) - 1.0))

    return min(((PIXELS_PER_TILE // wide, wide) for wide in range(8, PIXELS_PER_TILE + 1)), key=cost)


def rectangles(scene: Scene, unit: shapes.UnitShapes) -> jax.Array:
    """Return bounds [G, 4] float32 (min u, max u, min v, max v) of each object's bounding sphere; infinite for planes."""
    is_infinite = np.array(scene.object_types) == shapes.PLANE
    endless = np.array([-camera.INFINITE, camera.INFINITE] * 2, np.float32)
    return jnp.where(is_infinite[:, None], endless, camera.sphere_sides(scene, unit.ball[:, :3], unit.ball[:, 3]))


def tile_words(scene: Scene, sides: jax.Array, tile: tuple[int, int], rows: list[int]) -> tuple[jax.Array, np.ndarray]:
    """Determine which objects may be visible in which tiles.

    Args:
        scene: The scene.
        sides: [G, 4] from `rectangles`.
        tile: Rows and columns of a tile.
        rows: The objects.

    Returns:
        Bits [tiles, words] int32, in which bit b of word w stands for object ``order[32 w + b]``; and the order of ``rows``,
        sorted by type.
    """
    order = np.array(rows, np.int32)[np.argsort(np.array(scene.object_types)[rows], kind="stable")]
    high, wide = tile
    tops, lefts = np.arange(0, scene.height, high), np.arange(0, scene.width, wide)
    middle_u, middle_v, half_u, half_v = camera.lens(scene)

    def u_at(column: np.ndarray) -> jax.Array:
        return middle_u + jnp.asarray((2.0 * column + 1.0 - scene.width) / scene.width, jnp.float32) * half_u

    def v_at(row: np.ndarray) -> jax.Array:
        return middle_v + jnp.asarray((scene.height - 1.0 - 2.0 * row) / scene.height, jnp.float32) * half_v

    sides = sides[order]
    across = (sides[:, 0] <= u_at(lefts + wide)[:, None]) & (sides[:, 1] >= u_at(lefts - 1)[:, None])
    down = (sides[:, 2] <= v_at(tops - 1)[:, None]) & (sides[:, 3] >= v_at(tops + high)[:, None])
    meets = (down[:, None] & across[None, :]).reshape(len(tops) * len(lefts), -1)
    return pack_bits(meets), order


def pack_bits(mask: jax.Array) -> jax.Array:
    """Pack a mask [tiles, N] into bits [tiles, words] int32: bit b of word w is element 32 w + b."""
    count = mask.shape[1]
    words = -(-count // 32)
    mask = jnp.pad(mask, ((0, 0), (0, 32 * words - count))).reshape(-1, words, 32)
    bits = jnp.asarray(np.left_shift(np.uint32(1), np.arange(32, dtype=np.uint32)))
    return jax.lax.bitcast_convert_type(jnp.sum(jnp.where(mask, bits, 0), axis=-1, dtype=jnp.uint32), jnp.int32)
