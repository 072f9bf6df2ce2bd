"""Transparent primitives for the passes: colours of their faces, and blending, see `transparent`."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs.render.camera import Rays
from jaxrl_vis_envs.render.cpu.packing import pack, unpack_channels
from jaxrl_vis_envs.render.model import reading
from jaxrl_vis_envs.render.pixel import lookup, raycast, shapes, surface, transparent
from jaxrl_vis_envs.render.scene import Scene

BITS = 10
"""Bits per channel of a packed colour that is blended."""

_VISIBLE = 1 << 30  # set in the packed colour of a face that is visible
# Faces are blended by comparisons, some for each pair of objects.
_MAX_SHEETS = 8


def can_blend(scene: Scene) -> bool:
    """Return True if `blend` supports the scene.

    Its transparent objects must be few primitives that are transparent from all sides, without alpha in their textures, and
    the keys must contain the rows (`raycast.has_separate_rows`).
    """
    rows = sheet_rows(scene)
    fine = (shapes.MESH, shapes.HFIELD)
    simple = [scene.transparent[row] == reading.CLEAR and scene.object_types[row] not in fine for row in rows]
    simple += [not scene.atlas.alpha[row] for row in rows]
    return len(rows) <= _MAX_SHEETS and all(simple) and not (rows and raycast.has_separate_rows(scene))


def sheet_rows(scene: Scene) -> list[int]:
    """Return the indices of the transparent objects, in the order in which the model declares them."""
    rows = [row for row, clear in enumerate(scene.transparent) if clear]
    return sorted(rows, key=lambda row: scene.object_ids[row])


def face(
    scene: Scene,
    unit: shapes.UnitShapes,
    table: jax.Array,
    light_table: Any,
    row: int,
    rays: Rays,
    own: jax.Array,
    key: jax.Array,
) -> jax.Array:
    """Compute the packed colour of an object's face, [P] int32, with a bit that is set where it is visible.

    Args:
        scene: The scene.
        unit: Rendered objects.
        table: `lookup.object_table`.
        light_table: Lights, from `lights.pack`.
        row: Index of the object.
        rays: [P].
        own: [P] int32, keys of the object.
        key: [P] int32, keys of the nearest opaque objects.
    """
    depth, index = raycast.decode(scene, own, None)
    # A face at the depth of an opaque surface, within a key's resolution, may be that surface, rendered twice.
    visible = (index == row) & ((own & ~raycast.code_mask(scene)) <= key)
    values = lookup.read_row(table[row])
    hit = surface.intersect(scene, values, None, rays, jnp.where(visible, depth, 1.0))
    colour, _ = transparent.face_colour(scene, unit, light_table, transparent.Sheet(row, values, hit, visible), rays)
    return pack(colour, BITS) | jnp.where(visible, _VISIBLE, 0)


def blend(scene: Scene, unit: shapes.UnitShapes, faces: tuple[jax.Array, ...], colour: jax.Array) -> jax.Array:
    """Blend the faces of all `sheet_rows` over packed colours [P] int32; return packed colours."""
    rows = sheet_rows(scene)
    mixed: Any = unpack_channels(colour, BITS)
    order = jnp.argsort(unit.distance[np.array(rows)])  # stable
    alphas = jnp.stack([transparent.alpha_of(scene, unit, row) for row in rows])
    for rank in [*range(len(rows)), *reversed(range(len(rows)))]:
        packed = faces[0]
        for number, own in enumerate(faces[1:], start=1):
            packed = jnp.where(order[rank] == number, own, packed)
        alpha = jnp.where(packed & _VISIBLE != 0, alphas[order[rank]], 0.0)
        mixed = tuple(old + alpha * (new - old) for old, new in zip(mixed, unpack_channels(packed, BITS), strict=True))
    return pack(mixed, BITS)
