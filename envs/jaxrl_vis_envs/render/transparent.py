"""Objects that let light through, laid over the opaque picture as MuJoCo does it.

MuJoCo sorts them by the distance of their nearest point and draws them twice, front to back and then back to front, so that a
single sheet of alpha a covers 1 - (1 - a)^2 of what is behind it. They have no depth, but they do have a segmentation.
"""

from typing import Any

import jax
import jax.numpy as jnp

from jaxrl_vis_envs.render import model_reading, raycast, shade, shapes, surface, triangles
from jaxrl_vis_envs.render.lights import Light
from jaxrl_vis_envs.render.scene import Scene

# What MuJoCo leaves of a plane's alpha when it is seen from behind.
_PLANE_BACK = 0.3


def _seen(scene: Scene, unit: shapes.UnitShapes, row: int, u: Any, v: Any, depth: Any) -> tuple:
    """Where rays meet the transparent object of a row, whether that is in front of ``depth``, and the triangle; [P] each.

    The triangle is None for a primitive.
    """
    if scene.object_types[row] in (shapes.MESH, shapes.HFIELD):
        t, triangle, _ = triangles.nearest_triangle(scene, jax.lax.stop_gradient(unit), u, v, depth, only=row)
        return t, triangle >= 0, triangle
    t, meets = raycast.row_entry(scene, unit, row, u, v)
    seen = meets & (t > scene.znear) & (t < depth)
    if scene.transparent[row] == raycast.CLEAR_FROM_BEHIND:
        seen = seen & raycast.behind(scene, unit, row)
    return t, seen, None


def blend(
    scene: Scene,
    unit: shapes.UnitShapes,
    table: jax.Array,
    lights: list[Light],
    u: jax.Array,
    v: jax.Array,
    depth: jax.Array,
    colour: tuple,
) -> tuple:
    """The colours [P] (three) with what is transparent in front of ``depth`` [P] laid over them."""
    rows = [row for row, clear in enumerate(scene.transparent) if clear]
    if not rows:
        return colour
    sheets, distances = [], []
    for row in rows:
        t, seen, triangle = _seen(scene, unit, row, u, v, jax.lax.stop_gradient(depth))
        values = surface.read_row(table[row])
        hit = surface.meet(scene, values, surface.fetch_triangle(scene, triangle), u, v, t)
        own = shade.shade(scene, unit, [light._replace(shadows=False) for light in lights], values, hit, u, v)
        alpha = scene.rgba[scene.object_ids[row], 3]
        ball = unit.ball[row]
        near = jnp.sqrt(jnp.sum(jnp.square(ball[:3]))) - ball[3]
        if scene.object_types[row] == shapes.PLANE:
            alpha = jnp.where(raycast.behind(scene, unit, row), _PLANE_BACK * alpha, alpha)
            near = jnp.full((), model_reading.ENDLESS)
        sheets.append(jnp.stack([*own, jnp.where(seen, alpha, 0.0)]))
        distances.append(near)
    stack = jnp.stack(sheets)
    order = jnp.argsort(jnp.stack(distances))
    for place in [*range(len(rows)), *reversed(range(len(rows)))]:
        sheet = stack[order[place]]
        colour = tuple(c + sheet[3] * (sheet[channel] - c) for channel, c in enumerate(colour))
    return colour


def nearest_transparent(
    scene: Scene, unit: shapes.UnitShapes, u: jax.Array, v: jax.Array, depth: jax.Array, index: jax.Array
) -> jax.Array:
    """The row of the nearest object of all, [P] int32, where ``index`` [P] at ``depth`` [P] is the nearest opaque one."""
    for row in (row for row, clear in enumerate(scene.transparent) if clear):
        t, seen, _ = _seen(scene, unit, row, u, v, depth)
        index = jnp.where(seen, row, index)
        depth = jnp.where(seen, t, depth)
    return index
