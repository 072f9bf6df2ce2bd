"""The nearest object of every pixel on a CPU, tile by tile, and in a tile only what may be seen there.

A program for a batch cannot leave out of one image what it does in another. But cameras mostly stand still, and robots stay
where they are: most tiles show the same few objects in all images of a batch. So what depends on a tile is a loop of no or
one round (`once`), which all images of the batch go through or leave out together.

XLA needs to be told so in three ways. A condition that differs between the images would become a choice after the work is
done: it is made one for the batch (`_anywhere`). A branch of ``cond`` runs on one core, the body of a ``while`` on all. And a
loop that reads what it overwrites is not vectorised, so every object has keys of its own, which are compared afterwards.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs.render import camera
from jaxrl_vis_envs.render.camera import Rays
from jaxrl_vis_envs.render.pixel import blocks, raycast, shapes
from jaxrl_vis_envs.render.scene import Scene

# So many tiles across and down. Each costs some microseconds for each object, and smaller images than this would lose by it.
_TILES = 4
_LEAST_PIXELS = 48 * 48


def _culls(scene: Scene) -> bool:
    """Whether each object is looked for where it may be seen; otherwise `raycast.nearest_key` finds them all."""
    return not blocks.tiled(scene) and scene.height * scene.width >= _LEAST_PIXELS


def layout(scene: Scene) -> blocks.Layout:
    """The tiles of the image."""
    if not _culls(scene):
        return blocks.layout(scene)
    high, wide = (blocks.near_divisor(pixels, -(-pixels // _TILES)) for pixels in (scene.height, scene.width))
    return blocks.tiles(scene, high, wide)


def seen_in_tiles(scene: Scene, unit: shapes.UnitShapes, rays: Rays) -> jax.Array:
    """Which objects may be seen in which tiles, in any image of the batch.

    Args:
        scene: The scene.
        unit: The drawn objects.
        rays: [tiles, P].

    Returns:
        [tiles, G] bool, the same for the whole batch; planes are always there.
    """
    touching = jax.vmap(lambda rays: camera.in_view(scene, unit.ball[:, :3], unit.ball[:, 3], rays, None))(rays)
    return _anywhere(touching) | (np.array(scene.object_types) == shapes.PLANE)


def solids(scene: Scene) -> list[int]:
    """Rows of the drawn objects that are no planes."""
    return [row for row in raycast.primitive_rows(scene, transparent=False) if scene.object_types[row] != shapes.PLANE]


def memory(scene: Scene, plane: jax.Array) -> tuple[jax.Array, ...]:
    """``plane`` [P] int32 for each object whose keys `nearest_key` keeps."""
    return (plane,) * len(solids(scene)) if _culls(scene) else ()


def nearest_key(
    scene: Scene,
    unit: shapes.UnitShapes,
    rays: Rays,
    seen: jax.Array,
    own: tuple[jax.Array, ...],
    labelled: bool,
) -> tuple[jax.Array, jax.Array | None, tuple[jax.Array, ...]]:
    """`raycast.nearest_key` of one tile.

    Args:
        scene: The scene.
        unit: The drawn objects.
        rays: [P].
        seen: [G] bool, a row of `seen_in_tiles`.
        own: From `memory`, whatever is in it now.
        labelled: Whether the keys say which object it is, or are nothing but the bits of its depth.

    Returns:
        The keys [P] int32, the rows [P] int32 where the scene `raycast.keeps_rows` and they are wanted (otherwise None), and
        the memory for the next tile.
    """
    if not _culls(scene):
        if labelled and raycast.keeps_rows(scene):
            return *raycast.nearest_row(scene, unit, rays), own
        return raycast.nearest_key(scene, unit, rays, labelled), None, own
    mask = raycast.code_mask(scene) if labelled else 0
    sky = raycast.sky_key(scene, mask)
    rows = solids(scene)

    def keys_of(row: int) -> Callable[[jax.Array], jax.Array]:
        def find(nothing: jax.Array) -> jax.Array:
            moving = jax.tree.map(lambda leaf: leaf + nothing.astype(jnp.float32), unit)
            return raycast.object_key(scene, moving, row, rays, sky, mask)

        return find

    own = tuple(once(seen[row], keys_of(row), old) for row, old in zip(rows, own, strict=True))
    best = jnp.broadcast_to(sky, rays.u.shape)
    for row in raycast.primitive_rows(scene, transparent=False):
        if row not in rows:
            best = jnp.minimum(best, raycast.object_key(scene, unit, row, rays, sky, mask))
    for row, key in zip(rows, own, strict=True):
        best = jnp.minimum(best, jnp.where(seen[row], key, sky))
    return best, None, own


def once(condition: jax.Array, function: Callable[[jax.Array], jax.Array], otherwise: jax.Array) -> jax.Array:
    """``function(0)`` where the condition, one for the whole batch, is true; computed once, whatever is done with the result.

    Args:
        condition: [] bool.
        function: Takes an int32 that is 0, which XLA does not know: what does not depend on it is computed in any case.
        otherwise: The result where the condition is false; its memory is used for that of the function.
    """
    rounds = jnp.where(condition, 0, 1)
    return jax.lax.while_loop(
        lambda state: state[0] < 1, lambda state: (state[0] + 1, function(state[0])), (rounds, otherwise)
    )[1]


@jax.custom_batching.custom_vmap
def _anywhere(flags: jax.Array) -> jax.Array:
    """``flags``; in a batch, whether they are true anywhere in it: one answer for all."""
    return flags


@_anywhere.def_vmap
def _anywhere_in_batch(size: int, batched: list, flags: jax.Array) -> tuple[jax.Array, bool]:
    del size, batched
    return _anywhere(jnp.any(flags, axis=0)), False
