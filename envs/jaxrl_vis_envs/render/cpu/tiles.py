"""Nearest object of every pixel on a CPU, tile by tile, testing only objects that may be visible in the tile.

A batched program cannot skip work for a single image. But most cameras are static and most robots stay in place, so most tiles
show the same few objects in all images of a batch. Work that depends on a tile is therefore a loop of zero or one iterations
(`once`), which all images of the batch execute or skip together.

XLA requires three measures for this. A condition that differs between images would become a select after the work, so it is
reduced to one condition for the batch (`_anywhere`). A branch of ``cond`` runs on one core, the body of a ``while`` on all. And
a loop that reads what it overwrites is not vectorised, so every object has its own keys, which are compared afterwards.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs.render import camera
from jaxrl_vis_envs.render.camera import Rays
from jaxrl_vis_envs.render.pixel import blocks, raycast, shapes
from jaxrl_vis_envs.render.scene import Scene

# Number of tiles along each axis. Each costs some microseconds per object, which does not pay off for smaller images.
_TILES = 4
_MIN_PIXELS = 48 * 48


def _culls_per_tile(scene: Scene) -> bool:
    """Return True if objects are culled per tile; otherwise `raycast.nearest_key` tests them all."""
    has_few = len(raycast.primitive_rows(scene, transparent=False)) <= raycast.MAX_UNROLLED
    return has_few and not raycast.has_separate_rows(scene) and scene.height * scene.width >= _MIN_PIXELS


def layout(scene: Scene) -> blocks.Layout:
    """Return the tiles of the image."""
    if not _culls_per_tile(scene):
        return blocks.layout(scene)
    high, wide = (blocks.near_divisor(pixels, -(-pixels // _TILES)) for pixels in (scene.height, scene.width))
    return blocks.tiles(scene, high, wide)


def visible_in_tiles(scene: Scene, unit: shapes.UnitShapes, rays: Rays) -> jax.Array:
    """Determine which objects may be visible in which tiles, in any image of the batch.

    Args:
        scene: The scene.
        unit: Rendered objects.
        rays: [tiles, P].

    Returns:
        [tiles, G] bool, the same for the whole batch; always True for planes.
    """
    visible = jax.vmap(lambda rays: camera.in_view(scene, unit.ball[:, :3], unit.ball[:, 3], rays, None))(rays)
    return _anywhere(visible) | (np.array(scene.object_types) == shapes.PLANE)


def non_plane_rows(scene: Scene) -> list[int]:
    """Return the indices of the rendered opaque primitives other than planes."""
    return [row for row in raycast.primitive_rows(scene, transparent=False) if scene.object_types[row] != shapes.PLANE]


def initial_keys(scene: Scene, plane: jax.Array) -> tuple[jax.Array, ...]:
    """Return initial buffers of `nearest_key`: ``plane`` [P] int32 for each object with its own keys."""
    return (plane,) * len(non_plane_rows(scene)) if _culls_per_tile(scene) else ()


def nearest_key(
    scene: Scene,
    unit: shapes.UnitShapes,
    rays: Rays,
    visible: jax.Array,
    object_keys: tuple[jax.Array, ...],
    labelled: bool,
) -> tuple[jax.Array, jax.Array | None, tuple[jax.Array, ...]]:
    """Compute `raycast.nearest_key` of one tile.

    Args:
        scene: The scene.
        unit: Rendered objects.
        rays: [P].
        visible: [G] bool, a row of `visible_in_tiles`.
        object_keys: Buffers from `initial_keys`, with any contents.
        labelled: Include the object's row in the keys, instead of only the bits of the depth.

    Returns:
        The keys [P] int32, the rows [P] int32 if labelled and the scene has separate rows (otherwise None), and the buffers for
        the next tile.
    """
    if not _culls_per_tile(scene):
        if labelled and raycast.has_separate_rows(scene):
            return *raycast.nearest_row(scene, unit, rays), object_keys
        return raycast.nearest_key(scene, unit, rays, labelled), None, object_keys
    mask = raycast.code_mask(scene) if labelled else 0
    sky = raycast.sky_key(scene, mask)
    rows = non_plane_rows(scene)
    object_keys = keys_of_objects(scene, unit, rows, rays, visible, object_keys, sky, mask)
    best = jnp.broadcast_to(sky, rays.u.shape)
    for row in raycast.primitive_rows(scene, transparent=False):
        if row not in rows:
            best = jnp.minimum(best, raycast.object_key(scene, unit, row, rays, sky, mask))
    for row, key in zip(rows, object_keys, strict=True):
        best = jnp.minimum(best, jnp.where(visible[row], key, sky))
    return best, None, object_keys


def keys_of_objects(
    scene: Scene,
    unit: shapes.UnitShapes,
    rows: list[int],
    rays: Rays,
    visible: jax.Array,
    object_keys: tuple[jax.Array, ...],
    sky: jax.Array,
    mask: int,
) -> tuple[jax.Array, ...]:
    """Compute the keys of some objects in one tile, [P] int32 each; arbitrary for objects that are not ``visible`` there.

    Args:
        scene: The scene.
        unit: Rendered objects.
        rows: The objects, primitives.
        rays: [P].
        visible: [G] bool, a row of `visible_in_tiles`.
        object_keys: Buffers [P] for the results, with any contents.
        sky: [] int32, key where a ray misses an object.
        mask: As in `raycast.sky_key`.
    """

    def make_key_function(row: int) -> Callable[[jax.Array], jax.Array]:
        def compute(zero: jax.Array) -> jax.Array:
            unit_from_zero = jax.tree.map(lambda leaf: leaf + zero.astype(jnp.float32), unit)
            return raycast.object_key(scene, unit_from_zero, row, rays, sky, mask)

        return compute

    return tuple(once(visible[row], make_key_function(row), old) for row, old in zip(rows, object_keys, strict=True))


def once(condition: jax.Array, function: Callable[[jax.Array], jax.Array], otherwise: jax.Array) -> jax.Array:
    """Compute ``function(0)`` if the condition is True, only once regardless of the number of uses of the result.

    Args:
        condition: [] bool, the same for the whole batch.
        function: Function of an int32 zero that XLA cannot constant-fold; whatever does not depend on it is always computed.
        otherwise: Result if the condition is False; its memory is reused for the result of the function.
    """
    iteration = jnp.where(condition, 0, 1)
    return jax.lax.while_loop(
        lambda state: state[0] < 1, lambda state: (state[0] + 1, function(state[0])), (iteration, otherwise)
    )[1]


@jax.custom_batching.custom_vmap
def _anywhere(flags: jax.Array) -> jax.Array:
    """Return ``flags``, reduced over the batch under `jax.vmap`: True where they are True for any element."""
    return flags


@_anywhere.def_vmap
def _anywhere_in_batch(size: int, batched: list, flags: jax.Array) -> tuple[jax.Array, bool]:
    del size, batched
    return _anywhere(jnp.any(flags, axis=0)), False
