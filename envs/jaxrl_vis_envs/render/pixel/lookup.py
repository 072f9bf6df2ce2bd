"""Everything about a drawn object that a pixel which sees it needs, as a row of numbers, and how a pixel fetches it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs.compiling.compilation import targets_cpu
from jaxrl_vis_envs.render.model import meshes, reading, textures
from jaxrl_vis_envs.render.pixel import shapes
from jaxrl_vis_envs.render.pixel.arithmetic import Vector
from jaxrl_vis_envs.render.scene import Scene


class TextureRow(NamedTuple):
    """How the texture of an object lies on it, and where it is in the atlas: numbers, or arrays [P] float32.

    Attributes:
        mapping: One of the constants of `textures`.
        scale: What coordinates are multiplied with, see `_texture_scales`.
        shift: What is added to a flat texture's, across and up.
        first_level: Number of its first level.
        levels: How many there are.
        six_faces: 1 for a cube with six faces, otherwise 0.
        width: Texels of its finest level.
        height: Texels of its finest level.
    """

    mapping: jax.Array
    scale: Vector
    shift: tuple[jax.Array, jax.Array]
    first_level: jax.Array
    levels: jax.Array
    six_faces: jax.Array
    width: jax.Array
    height: jax.Array


class Row(NamedTuple):
    """Of one object, or of the object that each pixel sees: numbers, or arrays [P] float32."""

    axes: Vector  # of three vectors
    origin: Vector
    extra: jax.Array
    kind: jax.Array
    colour: Vector
    emission: jax.Array
    specular: jax.Array
    exponent: jax.Array
    texture: TextureRow | None  # None in a scene without textures


class TriangleRow(NamedTuple):
    """Of the triangle that each pixel sees: arrays [P] float32, and whether it sees one.

    Attributes:
        seen: [P] bool.
        maps: Rows of the map to the unit triangle (three numbers and a constant each): second and third share, height.
        normals: Of the three corners, in the frame of the geom.
        coordinates: Of the texture at the three corners, across and up.
        corners: Metres, in the frame of the geom.
    """

    seen: jax.Array
    maps: tuple
    normals: tuple
    coordinates: tuple
    corners: tuple


def object_table(scene: Scene, unit: shapes.UnitShapes) -> jax.Array:
    """[G, columns] float32: everything about each drawn object that a pixel which sees it needs, in the order of `Row`."""
    columns = [
        *(unit.axes[:, row, column] for row in range(3) for column in range(3)),
        *(unit.origin[:, axis] for axis in range(3)),
        unit.extra,
    ]
    return jnp.stack(columns + appearance_columns(scene), axis=-1)


def appearance_columns(scene: Scene) -> list[jax.Array]:
    """The columns of `object_table` that do not depend on poses, from the kind on; [G] float32 each."""
    ids = np.array(scene.object_ids)
    columns = [jnp.asarray(scene.object_types, jnp.float32), *(scene.rgba[ids, channel] for channel in range(3))]
    columns += [scene.emission[ids], scene.specular[ids], 128.0 * scene.shininess[ids]]
    if scene.atlas.used:
        images = [image or textures.Image(0, 1, 1) for image in scene.atlas.images]
        columns.append(jnp.asarray(scene.atlas.mappings, jnp.float32))
        columns.extend(_texture_scales(scene, ids))
        columns.append(jnp.asarray([image.first_level for image in images], jnp.float32))
        columns.append(jnp.asarray([image.levels for image in images], jnp.float32))
        columns.append(jnp.asarray([image.faces == 6 for image in images], jnp.float32))
        sizes = np.array([scene.atlas.levels[image.first_level][1:] for image in images], np.float32)
        columns.extend(jnp.asarray(sizes[:, axis]) for axis in range(2))
    return columns


def _texture_scales(scene: Scene, ids: np.ndarray) -> list[jax.Array]:
    """How the coordinates of a point become those of the texture: five [G].

    For a flat one, coordinates across and up (see `charts`) are multiplied with the first two and the last two added; for a
    cube, the coordinates in the unit shape's frame are multiplied with the first three; for an unwrapped one, a mesh's own
    coordinates with the first two (where it repeats per metre, MuJoCo multiplies them with the half-sizes of the mesh).
    """
    kinds, mappings = np.array(scene.object_types), np.array(scene.atlas.mappings)
    size = _visual_size(kinds, scene.size[ids])
    metres = np.isin(kinds, (shapes.MESH, shapes.HFIELD))
    uniform, cube, unwrapped = np.array(scene.atlas.uniform), mappings == textures.CUBE, mappings == textures.UNWRAPPED
    endless = jnp.any((size[:, :2] >= reading.ENDLESS) & (kinds == shapes.PLANE)[:, None], axis=1)
    scales, shifts = [], []
    for axis in range(3):
        half = size[:, axis]
        if axis == 2:
            scales.append(jnp.where(uniform, half, 1.0))
            continue
        # An endless plane repeats per metre, whatever the material says; a mesh's own frame is in metres already.
        over_object = jnp.where(metres, 1.0 / jnp.where(half > 0.0, half, 1.0), 1.0)
        per_metre = uniform | (half >= reading.ENDLESS)
        times = scene.texture_repeat[ids][:, axis]
        repeat = times * jnp.where(per_metre, jnp.where(metres, 1.0, half), over_object)
        shift = jnp.where(half >= reading.ENDLESS, 0.0, 0.5 * repeat) + jnp.where(endless, 0.5, 0.0)
        shifts.append(jnp.where(metres, -0.5, shift))
        sign = 0.5 if axis == 0 else -0.5
        scale = jnp.where(cube, jnp.where(uniform, half, 1.0), sign * repeat)
        scales.append(jnp.where(unwrapped, jnp.where(uniform, half, 1.0) * times, scale))
    return scales + shifts


def _visual_size(kinds: np.ndarray, size: jax.Array) -> jax.Array:
    """[G, 3] metres: half-sizes along x, y and z of each object (of a capsule, without the caps)."""
    x, y, z = size[:, 0], size[:, 1], size[:, 2]
    ball, tube = kinds == shapes.SPHERE, np.isin(kinds, (shapes.CAPSULE, shapes.CYLINDER))
    return jnp.stack([x, jnp.where(ball | tube, x, y), jnp.where(tube, y, jnp.where(ball, x, z))], axis=1)


def read_row(values: jax.Array) -> Row:
    """Sorts the columns of `object_table` (its last axis) into a `Row`."""
    return row_of([values[..., column] for column in range(values.shape[-1])])


def row_of(v: list) -> Row:
    """A `Row` of the columns of `object_table`."""
    axes = tuple(tuple(v[3 * row : 3 * row + 3]) for row in range(3))
    texture = TextureRow(v[20], tuple(v[21:24]), tuple(v[24:26]), *v[26:]) if len(v) > 20 else None
    return Row(axes, tuple(v[9:12]), v[12], v[13], tuple(v[14:17]), v[17], v[18], v[19], texture)


def fetch(table: jax.Array, row: jax.Array) -> Row:
    """The row of every pixel: table [G, columns] and [P] int32 (below 0: the first row)."""
    return row_of(_look_up(table, row))


def fetch_triangle(scene: Scene, triangle: jax.Array | None) -> TriangleRow | None:
    """The triangles of pixels, given their rows in `Scene.triangles` [P] int32, below 0 for none; None in a scene without."""
    if triangle is None:
        return None
    seen = triangle >= 0
    columns = _look_up(scene.triangles, triangle)
    parts = ((meshes.MAP, 4), (meshes.NORMALS, 3), (meshes.COORDINATES, 2), (meshes.CORNERS, 3))
    grouped = (tuple(zip(*[iter(columns[part])] * length, strict=True)) for part, length in parts)
    return TriangleRow(seen, *grouped)


def _look_up(table: jax.Array, row: jax.Array) -> list[jax.Array]:
    """The columns [P] of the rows [P] of a table."""
    index = jnp.maximum(row, 0)
    if targets_cpu():
        # One row per pixel is kept and read by all that follows; a column at a time is looked up anew for every use.
        values = table.at[index].get(mode="promise_in_bounds")
        return [values[..., column] for column in range(table.shape[1])]
    # Elsewhere that is what keeps the rows of all pixels out of the memory.
    return [table[:, column].at[index].get(mode="promise_in_bounds") for column in range(table.shape[1])]
