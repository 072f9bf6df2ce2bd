"""Objects that let light through, laid over the opaque image as MuJoCo does it.

MuJoCo sorts them by the distance of their nearest point and draws them twice, front to back and then back to front, so that a
single sheet of alpha a covers 1 - (1 - a)^2 of what is behind it. In depth and segmentation they count like any other object.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxrl_vis_envs.render.camera import Rays
from jaxrl_vis_envs.render.model import reading
from jaxrl_vis_envs.render.pixel import lookup, raycast, shade, shapes, surface, triangles
from jaxrl_vis_envs.render.pixel.lights import Light
from jaxrl_vis_envs.render.scene import Scene

# What MuJoCo leaves of a plane's alpha when it is seen from behind.
_PLANE_BACK = 0.3


class Sheet(NamedTuple):
    """One transparent object: its row, its columns, where it is met and where that is before all that is opaque ([P] bool)."""

    index: int
    row: lookup.Row
    hit: surface.Hit
    seen: jax.Array


def sheets(scene: Scene, unit: shapes.UnitShapes, rows: jax.Array, rays: Rays, depth: jax.Array) -> list[Sheet]:
    """The transparent objects before ``depth`` ([P] float32, metres, of what is opaque)."""
    depth = jax.lax.stop_gradient(depth)
    found = []
    for index in (index for index, clear in enumerate(scene.transparent) if clear):
        triangle = None
        if scene.object_types[index] in (shapes.MESH, shapes.HFIELD):
            frozen = jax.lax.stop_gradient(unit)
            t, triangle, _ = triangles.nearest_triangle(scene, frozen, rays, depth, only=index)
            seen = triangle >= 0
        else:
            t, meets = raycast.row_entry(scene, jax.lax.stop_gradient(unit), index, rays)
            seen = meets & (t > scene.znear) & (t < depth)
        if scene.transparent[index] == reading.CLEAR_FROM_BEHIND:
            seen = seen & raycast.behind(unit, index)
        row = lookup.read_row(rows[index])
        # A start that means nothing would be a source of NaN in gradients.
        t = jnp.where(seen, t, 1.0)
        found.append(Sheet(index, row, surface.meet(scene, row, lookup.fetch_triangle(scene, triangle), rays, t), seen))
    return found


def nearest(found: list[Sheet], depth: jax.Array, index: jax.Array, normal: tuple) -> tuple[jax.Array, jax.Array, tuple]:
    """Depth, row and normal of the nearest object of all, given those of the nearest opaque one; [P] each."""
    for sheet in found:
        nearer = sheet.seen & (sheet.hit.depth < depth)
        depth = jnp.where(nearer, sheet.hit.depth, depth)
        index = jnp.where(nearer, sheet.index, index)
        normal = tuple(jnp.where(nearer, new, old) for new, old in zip(sheet.hit.normal, normal, strict=True))
    return depth, index, normal


def blend(
    scene: Scene,
    unit: shapes.UnitShapes,
    lights: list[Light],
    found: list[Sheet],
    rays: Rays,
    colour: tuple,
) -> tuple:
    """The colours [P] (three) of what is opaque, with the sheets laid over them."""
    if not found:
        return colour
    layers, distances = [], []
    bare = [light._replace(shadows=False) for light in lights]  # only what is opaque shows shadows
    for index, row, hit, seen in found:
        own: Any = shade.shade(scene, unit, bare, row, hit, rays)
        alpha = scene.rgba[scene.object_ids[index], 3]
        ball = unit.ball[index]
        near = jnp.sqrt(jnp.sum(jnp.square(ball[:3])) + 1e-20) - ball[3]
        if scene.object_types[index] == shapes.PLANE:
            alpha = jnp.where(raycast.behind(unit, index), _PLANE_BACK * alpha, alpha)
            near = jnp.full((), reading.ENDLESS, jnp.float32)
        layers.append(jnp.stack([*own, jnp.where(seen, alpha, 0.0)]))
        distances.append(near)
    stack = jnp.stack(layers)
    order = jnp.argsort(jnp.stack(distances))
    for place in [*range(len(found)), *reversed(range(len(found)))]:
        layer = stack[order[place]]
        colour = tuple(c + layer[3] * (layer[channel] - c) for channel, c in enumerate(colour))
    return colour
