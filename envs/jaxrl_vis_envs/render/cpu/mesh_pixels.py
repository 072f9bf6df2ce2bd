"""Pixels of meshes and height fields for the passes: nearest triangles, and the colours of the pixels that show one.

Triangles are shaded for a list of pixels, because few pixels show one, and each needs more work than one of a primitive: it
looks up the triangle, and lights three corners.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import sequential_vmap

from jaxrl_vis_envs.render.camera import Rays
from jaxrl_vis_envs.render.cpu import raster
from jaxrl_vis_envs.render.cpu.packing import pack
from jaxrl_vis_envs.render.pixel import blocks, lights, lookup, raycast, shade, shapes, surface, triangles
from jaxrl_vis_envs.render.scene import Scene

# Pixels that are shaded together.
_PIXELS = 256


class MeshPixels(NamedTuple):
    """Nearest triangles, as if there were no primitives, [blocks, P] int32 each.

    Attributes:
        depth_bits: Bit pattern of the float32 depth, its lowest bits replaced; that of the far plane if there is no triangle.
        owner: Row of the object in the table of objects, -1 where there is no triangle.
        colour: Packed colour where there is a triangle; None without colours.
    """

    depth_bits: jax.Array
    owner: jax.Array
    colour: jax.Array | None


def draw(
    scene: Scene,
    unit: shapes.UnitShapes,
    light_table: jax.Array | None,
    rays: Rays,
    layout: blocks.Layout,
    colour_bits: int,
) -> MeshPixels:
    """Find and shade the nearest triangles of opaque objects.

    Args:
        scene: Scene with triangles.
        unit: Rendered objects.
        light_table: Lights, from `lights.pack`; None without colours.
        rays: [blocks, P], those of all pixels.
        layout: Order of the pixels.
        colour_bits: Bits per channel of a packed colour.
    """
    far = jnp.broadcast_to(scene.zfar, rays.u.shape)
    depth, triangle, owner = raster.nearest_triangle(scene, unit, far, layout)
    # The lowest bits of the depths hold other information: the middle of their range.
    middle = (jax.lax.bitcast_convert_type(depth, jnp.int32) & ~triangles.NUMBER) | (triangles.NUMBER + 1) // 2
    near = jnp.where(owner >= 0, middle, jax.lax.bitcast_convert_type(far, jnp.int32))
    if light_table is None:
        return MeshPixels(near, owner, None)
    colour = sequential_vmap(functools.partial(_colour, colour_bits))(scene, unit, light_table, rays, near, triangle, owner)
    return MeshPixels(near, owner, colour)


def _colour(
    colour_bits: int,
    scene: Scene,
    unit: shapes.UnitShapes,
    light_table: jax.Array,
    rays: Rays,
    near: jax.Array,
    triangle: jax.Array,
    owner: jax.Array,
) -> jax.Array:
    """Return the packed colours of the pixels with a triangle, [blocks, P] int32; 0 elsewhere."""
    shape = owner.shape
    rays, near, triangle, owner = jax.tree.map(jnp.ravel, (rays, near, triangle, owner))
    table = lookup.object_table(scene, unit)
    unpacked = lights.unpack(scene, light_table)
    counts = jnp.cumsum((owner >= 0).astype(jnp.int32), dtype=jnp.int32)
    last = counts.shape[0] - 1

    def colour_pixels(state: tuple) -> tuple:
        step, plane = state
        # The list's last group repeats its last pixel.
        ordinals = jnp.minimum(step * _PIXELS + np.arange(_PIXELS, dtype=np.int32), counts[last] - 1)
        pixel = triangles.kth(counts, ordinals)
        own = Rays(rays.u[pixel], rays.v[pixel])
        row, depth = lookup.fetch(table, owner[pixel]), jax.lax.bitcast_convert_type(near[pixel], jnp.float32)
        hit = surface.intersect(scene, row, lookup.fetch_triangle(scene, triangle[pixel]), own, depth)
        return step + 1, plane.at[pixel].set(pack(shade.shade(scene, unit, unpacked, row, hit, own), colour_bits))

    start = (jnp.zeros((), jnp.int32), jnp.zeros_like(owner))
    _, plane = jax.lax.while_loop(lambda state: state[0] * _PIXELS < counts[last], colour_pixels, start)
    return plane.reshape(shape)


def merge_triangles(
    scene: Scene, pixels: MeshPixels, key: jax.Array, row: jax.Array | None, labelled: bool
) -> tuple[jax.Array, jax.Array | None]:
    """Replace the keys and rows of primitives (see `tiles.nearest_key`) by those of nearer triangles, [P] int32 each.

    Without ``row``, the keys of a ``labelled`` pass hold the rows in their lowest bits, see `raycast.code_mask`.
    """
    is_triangle = pixels.owner >= 0
    if row is not None:
        is_nearer = is_triangle & (pixels.depth_bits <= key)
        return jnp.where(is_nearer, pixels.depth_bits, key), jnp.where(is_nearer, pixels.owner, row)
    mask = raycast.code_mask(scene) if labelled else 0
    own = (pixels.depth_bits & ~mask) | (pixels.owner & mask)
    return jnp.where(is_triangle, jnp.minimum(key, own), key), None
