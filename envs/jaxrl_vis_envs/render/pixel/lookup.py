"""Table of object properties for shading, one row per object, and its lookup per pixel."""

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
    """Texture mapping of an object, and the texture's position in the atlas: scalars, or arrays [P] float32.

    Attributes:
        mapping: One of the constants of `textures`.
        scale: Factors of the coordinates, see `_texture_scales`.
        shift: Offsets of a flat texture's coordinates, horizontal and vertical.
        first_level: Index of the texture's first level.
        levels: Number of levels.
        six_faces: 1 for a cube with six faces, otherwise 0.
        width: Width of the finest level, texels.
        height: Height of the finest level, texels.
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
    """Properties of one object, or of the object at each pixel: scalars, or arrays [P] float32.

    Attributes:
        axes, origin, extra: As in `shapes.UnitShapes`.
        kind: Type, a `mujoco.mjtGeom`.
        colour: Red, green and blue.
        emission, specular: Coefficients of the material.
        exponent: Exponent of highlights, 128 times the shininess.
        texture: Texture mapping; None in a scene without textures.
    """

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
    """Properties of the triangle at each pixel, and a mask of the pixels that show one. Arrays [P] float32.

    Attributes:
        hit: [P] bool.
        maps: Rows of the map to the unit triangle (three coefficients and a constant each): second and third barycentric
            coordinate, height.
        normals: Normals at the three corners, in the frame of the geom.
        coordinates: Texture coordinates at the three corners.
        corners: Positions of the three corners, metres, in the frame of the geom.
    """

    hit: jax.Array
    maps: tuple
    normals: tuple
    coordinates: tuple
    corners: tuple


def object_table(scene: Scene, unit: shapes.UnitShapes) -> jax.Array:
    """Build the table [G, columns] float32 of the rendered objects' properties, in the order of `Row`."""
    columns = [
        *(unit.axes[:, row, column] for row in range(3) for column in range(3)),
        *(unit.origin[:, axis] for axis in range(3)),
        unit.extra,
    ]
    return jnp.stack(columns + appearance_columns(scene), axis=-1)


def appearance_columns(scene: Scene) -> list[jax.Array]:
    """Return the columns of `object_table` that do not depend on poses, starting with the type; [G] float32 each."""
    ids = np.array(scene.object_ids)
    columns = [jnp.asarray(scene.object_types, jnp.float32), *(scene.rgba[ids, channel] for channel in range(3))]
    columns += [scene.emission[ids], scene.specular[ids], 128.0 * scene.shininess[ids]]
    if scene.atlas.has_textures:
        facts, mapping = _atlas_places(scene, ids)
        columns.append(mapping)
        columns.extend(_texture_scales(scene, ids))
        columns.extend(facts[:, column] for column in range(facts.shape[1]))
    return columns


def _atlas_places(scene: Scene, ids: np.ndarray) -> tuple[jax.Array, jax.Array]:
    """Return first level, number of levels, 1 for six faces, width and height of the objects' textures, [G, 5] float32; and
    their mappings [G] float32, which are `textures.NONE` for textures that are not loaded.
    """
    images = [*scene.atlas.loaded, None]  # the last is selected by index -1
    chosen = jnp.clip(scene.texture[ids], -1, len(images) - 2)
    facts = np.zeros((len(images), 5), np.float32)
    for number, image in enumerate(images):
        first, levels, faces = image or textures.Image(0, 1, 1)
        facts[number] = (first, levels, faces == 6, *scene.atlas.levels[first][1:])
    is_loaded = jnp.asarray([image is not None for image in images])[chosen]
    return jnp.asarray(facts)[chosen], jnp.where(is_loaded, np.array(scene.atlas.mappings, np.float32), float(textures.NONE))


def _texture_scales(scene: Scene, ids: np.ndarray) -> list[jax.Array]:
    """Return factors and offsets that map coordinates of a point to texture coordinates: five arrays [G].

    A flat texture multiplies the surface coordinates (see `charts`) by the first two and adds the last two; a cube multiplies
    the coordinates in the unit shape's frame by the first three; an unwrapped texture multiplies the mesh's own coordinates by
    the first two (if it repeats per metre, MuJoCo multiplies them by the half-sizes of the mesh).
    """
    kinds, mappings = np.array(scene.object_types), np.array(scene.atlas.mappings)
    size = _visual_size(kinds, scene.size[ids])
    metres = np.isin(kinds, (shapes.MESH, shapes.HFIELD))
    uniform, cube, unwrapped = np.array(scene.atlas.uniform), mappings == textures.CUBE, mappings == textures.UNWRAPPED
    infinite = jnp.any((size[:, :2] >= reading.INFINITE_SIZE) & (kinds == shapes.PLANE)[:, None], axis=1)
    scales, shifts = [], []
    for axis in range(3):
        half = size[:, axis]
        if axis == 2:
            scales.append(jnp.where(uniform, half, 1.0))
            continue
        # An infinite plane repeats per metre, regardless of its material; a mesh's own frame is already in metres.
        over_object = jnp.where(metres, 1.0 / jnp.where(half > 0.0, half, 1.0), 1.0)
        per_metre = uniform | (half >= reading.INFINITE_SIZE)
        repetitions = scene.texture_repeat[ids][:, axis]
        repeat = repetitions * jnp.where(per_metre, jnp.where(metres, 1.0, half), over_object)
        shift = jnp.where(half >= reading.INFINITE_SIZE, 0.0, 0.5 * repeat) + jnp.where(infinite, 0.5, 0.0)
        shifts.append(jnp.where(metres, -0.5, shift))
        sign = 0.5 if axis == 0 else -0.5
        scale = jnp.where(cube, jnp.where(uniform, half, 1.0), sign * repeat)
        scales.append(jnp.where(unwrapped, jnp.where(uniform, half, 1.0) * repetitions, scale))
    return scales + shifts


def _visual_size(kinds: np.ndarray, size: jax.Array) -> jax.Array:
    """Return the half-sizes [G, 3] (m) of objects along x, y and z (for a capsule, without the caps)."""
    x, y, z = size[:, 0], size[:, 1], size[:, 2]
    ball, tube = kinds == shapes.SPHERE, np.isin(kinds, (shapes.CAPSULE, shapes.CYLINDER))
    return jnp.stack([x, jnp.where(ball | tube, x, y), jnp.where(tube, y, jnp.where(ball, x, z))], axis=1)


def read_row(values: jax.Array) -> Row:
    """Split the columns of `object_table` (its last axis) into a `Row`."""
    return make_row([values[..., column] for column in range(values.shape[-1])])


def make_row(v: list) -> Row:
    """Build a `Row` from the columns of `object_table`."""
    axes = tuple(tuple(v[3 * row : 3 * row + 3]) for row in range(3))
    texture = TextureRow(v[20], tuple(v[21:24]), tuple(v[24:26]), *v[26:]) if len(v) > 20 else None
    return Row(axes, tuple(v[9:12]), v[12], v[13], tuple(v[14:17]), v[17], v[18], v[19], texture)


def fetch(table: jax.Array, row: jax.Array) -> Row:
    """Fetch each pixel's object from a table [G, columns] by indices [P] int32 (negative: the first object)."""
    return make_row(_look_up(table, row))


def fetch_triangle(scene: Scene, triangle: jax.Array | None) -> TriangleRow | None:
    """Fetch the triangles of pixels by rows of `Scene.triangles` [P] int32, negative for none; None in a scene without
    triangles.
    """
    if triangle is None:
        return None
    hit = triangle >= 0
    columns = _look_up(scene.triangles, triangle)
    parts = ((meshes.MAP, 4), (meshes.NORMALS, 3), (meshes.COORDINATES, 2), (meshes.CORNERS, 3))
    grouped = (tuple(zip(*[iter(columns[part])] * length, strict=True)) for part, length in parts)
    return TriangleRow(hit, *grouped)


def _look_up(table: jax.Array, row: jax.Array) -> list[jax.Array]:
    """Look up rows [P] int32 (negative: the first) of a table [N, columns]; return a list of its columns, [P] each."""
    index = jnp.maximum(row, 0)
    if targets_cpu():
        # Whole rows are stored per pixel and reused; single columns would be looked up again for every use.
        values = table.at[index].get(mode="promise_in_bounds")
        return [values[..., column] for column in range(table.shape[1])]
    # Elsewhere, separate columns avoid storing the rows of all pixels.
    return [table[:, column].at[index].get(mode="promise_in_bounds") for column in range(table.shape[1])]
