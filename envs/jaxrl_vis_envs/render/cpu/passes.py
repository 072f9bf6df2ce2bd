"""CPU renderer for 8-bit colours: passes over the pixels, each with one 32-bit integer per pixel as its result.

XLA on a CPU recomputes a loop for each of its outputs, including most of their shared work: three channels would cost three
times the shading. So each pass has one output, and everything the next one needs is packed into its bits: the key of the
nearest object (`raycast`), its normal (in octahedral encoding, 16 bits per axis), its texture colour (10 bits per channel), and
the final colour (8 bits per channel). Each pass over a tile is a loop of one iteration (`tiles.once`), because XLA would fuse
the passes otherwise; if only planes are visible in a tile, a cheaper version runs.

Triangles are found and shaded before all tiles (`mesh_pixels`), as there are few pixels that show one. Transparent primitives
have passes of their own (`sheets`).

Per pixel, the code is that of the plain renderer, and results agree up to the last bits: in images with colours, depths are
decoded from the keys.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs.compiling.compilation import targets_cpu
from jaxrl_vis_envs.render import camera
from jaxrl_vis_envs.render.camera import Rays
from jaxrl_vis_envs.render.cpu import mesh_pixels, sheets, tiles
from jaxrl_vis_envs.render.cpu.mesh_pixels import MeshPixels
from jaxrl_vis_envs.render.cpu.packing import pack, pack_normal, unpack, unpack_normal
from jaxrl_vis_envs.render.outputs import Outputs, Planes
from jaxrl_vis_envs.render.pixel import blocks, lights, lookup, raycast, shade, shapes, surface, texturing
from jaxrl_vis_envs.render.pixel.arithmetic import Vector
from jaxrl_vis_envs.render.scene import Scene

# Up to this many objects, a pixel's row is selected by comparisons instead of being looked up.
_MAX_SELECTED = 24


def can_render(scene: Scene, outputs: Outputs) -> bool:
    """Return True if these passes render these planes on the platform being traced for.

    They run on CPUs, and support opaque objects without haze, with 8-bit colours, without normals and distances, and without
    segmentation if a reflecting object may coincide with another one. If there are triangles, colours are without shadows, and
    a few primitives may be transparent.
    """
    is_simple = scene.haze[0] < 0 and not (outputs.segmentation and scene.reordered)
    if scene.clusters.shape[-2]:
        is_simple = is_simple and sheets.can_blend(scene) and not (outputs.rgb and any(scene.light_shadows))
    else:
        is_simple = is_simple and not any(scene.transparent)
    return targets_cpu() and is_simple and (outputs.quantized or not outputs.rgb) and not (outputs.normals or outputs.distance)


def draw(outputs: Outputs, scene: Scene, rotation: jax.Array, unit: shapes.UnitShapes, light_table: jax.Array) -> Planes:
    """Render one environment; use ``jax.vmap`` for a batch. Not differentiable.

    Args:
        outputs: Requested planes.
        scene: Scene for which `can_render` holds with these planes.
        rotation: [3, 3] float32 of the camera, see `camera.camera_pose`.
        unit: Rendered objects.
        light_table: Lights, from `lights.pack`.

    Returns:
        The planes.
    """
    layout = tiles.layout(scene)
    rays = camera.pixel_rays(scene, layout.rows, layout.columns)
    # If only depths are requested, all bits of the keys hold the depth.
    labelled = outputs.rgb or outputs.segmentation
    colouring = _Colouring(scene, unit, rotation, light_table) if outputs.rgb else None
    mesh = None
    if scene.clusters.shape[-2]:
        mesh = mesh_pixels.draw(scene, unit, light_table if outputs.rgb else None, rays, layout, _colour_bits(scene))
    planes = _render_tiles(scene, unit, colouring, labelled, rays, mesh)
    key, packed, row = jax.tree.map(lambda plane: blocks.restore(scene, layout, plane), planes)
    colours = unpack(packed, _colour_bits(scene)) if outputs.rgb else None
    if not labelled:
        return Planes(colours, jax.lax.bitcast_convert_type(key, jnp.float32), None)
    near, index = raycast.decode(scene, key, row)
    far = labels = None
    if outputs.depth:
        # A key's depth has lost its lowest bits: use the middle of their range.
        centre = jax.lax.bitcast_convert_type(near, jnp.int32) | (raycast.code_mask(scene) >> 1)
        far = jnp.where(index >= 0, jax.lax.bitcast_convert_type(centre, jnp.float32), scene.zfar)
    if outputs.segmentation:
        labels = jnp.asarray(np.array([*scene.object_ids, -1], np.int32))[index]
    return Planes(colours, far, labels)


def _colour_bits(scene: Scene) -> int:
    """Return the bits per channel of packed colours: more than the result's if others are blended over them."""
    return sheets.BITS if sheets.sheet_rows(scene) else 8


class _Tile(NamedTuple):
    """Intermediate int32 values [P] of a tile: keys, colours, and the results of earlier passes. ``row`` is None if rows are
    part of the keys. Transparent objects have their own keys and colours.

    The next tile reuses their memory.
    """

    key: jax.Array
    colour: jax.Array
    row: jax.Array | None
    own_keys: tuple[jax.Array, ...]
    normal: jax.Array
    texture: jax.Array
    sheet_keys: tuple[jax.Array, ...]
    faces: tuple[jax.Array, ...]


def _render_tiles(
    scene: Scene,
    unit: shapes.UnitShapes,
    colouring: "_Colouring | None",
    labelled: bool,
    rays: Rays,
    mesh: MeshPixels | None,
) -> tuple[jax.Array, ...]:
    """Render all tiles sequentially; return keys, packed colours, and rows (or None) of all pixels, [tiles, P] int32 each."""
    visible = tiles.visible_in_tiles(scene, unit, rays)
    sheet_rows = sheets.sheet_rows(scene)

    def draw_tile(carry: tuple, pixels: tuple) -> tuple:
        number, tile, results = carry
        # XLA computes values that are stored directly in a loop's results on one core: store them one iteration later.
        previous = jnp.maximum(number - 1, 0)
        results = jax.tree.map(lambda whole, own: whole.at[previous].set(own), results, (tile.key, tile.colour, tile.row))
        rays, visible, mesh = pixels
        key, row, own_keys = tiles.nearest_key(scene, unit, rays, visible, tile.own_keys, labelled)
        if mesh is not None:
            key, row = mesh_pixels.merge_triangles(scene, mesh, key, row, labelled)
        tile = tile._replace(key=key, row=row, own_keys=own_keys)
        if sheet_rows:
            mask = raycast.code_mask(scene) if labelled else 0
            missed = raycast.sky_key(scene, mask)
            own_keys = tiles.keys_of_objects(scene, unit, sheet_rows, rays, visible, tile.sheet_keys, missed, mask)
            tile = tile._replace(sheet_keys=own_keys)
        if colouring is not None:
            tile = colouring.colour(tile, rays, visible, mesh)
        for sheet, own in zip(sheet_rows, tile.sheet_keys, strict=True):
            key = jnp.where(visible[sheet], jnp.minimum(key, own), key)
        tile = tile._replace(key=key)
        return (number + 1, tile, results), None

    shape = rays.u.shape
    empty = jnp.zeros(shape[1:], jnp.int32)
    # Zeros that XLA cannot prove equal: otherwise it would fill one array on one core, and copy it.
    has_separate_rows = labelled and raycast.has_separate_rows(scene)
    results = [
        jnp.zeros(shape, jnp.int32) + (0.0 * unit.origin[0, axis]).astype(jnp.int32) if axis < 2 or has_separate_rows else None
        for axis in range(3)
    ]
    row, of_sheets = empty if has_separate_rows else None, (empty,) * len(sheet_rows)
    first = _Tile(empty, empty, row, tiles.initial_keys(scene, empty), empty, empty, of_sheets, of_sheets)
    (_, last, planes), _ = jax.lax.scan(draw_tile, (jnp.int32(0), first, tuple(results)), (rays, visible, mesh))
    return jax.tree.map(lambda whole, own: whole.at[shape[0] - 1].set(own), planes, (last.key, last.colour, last.row))


class _PassInputs(NamedTuple):
    """Inputs of a pass.

    Attributes:
        rows: Rows of the objects that may be visible.
        table: `lookup.object_table`.
        rays: [P].
        key: [P] int32.
        row: [P] int32, rows of the keys; None if they are part of the keys.
    """

    rows: list[int]
    table: jax.Array
    rays: Rays
    key: jax.Array
    row: jax.Array | None


class _Colouring:
    """Passes over the pixels of a tile whose nearest objects are known."""

    def __init__(self, scene: Scene, unit: shapes.UnitShapes, rotation: jax.Array, light_table: jax.Array) -> None:
        self.scene, self.unit, self.rotation = scene, unit, rotation
        self.table = lookup.object_table(scene, unit)
        self.lights = lights.unpack(scene, light_table)
        self.light_table = light_table

    def colour(self, tile: _Tile, rays: Rays, visible: jax.Array, mesh: MeshPixels | None) -> _Tile:
        """Return the tile with its colours; ``visible`` [G] bool as in `tiles.nearest_key`."""
        # If only planes and sky are visible, less is computed.
        busy = jnp.any(visible[np.array(tiles.non_plane_rows(self.scene), int)])
        fine = (shapes.MESH, shapes.HFIELD)
        all_rows = [row for row, kind in enumerate(self.scene.object_types) if kind not in fine]
        planes = [row for row in all_rows if self.scene.object_types[row] == shapes.PLANE]

        def make_pass(
            rows: list[int], function: Callable, *packed_inputs: jax.Array | None
        ) -> Callable[[jax.Array], jax.Array]:
            def run(zero: jax.Array) -> jax.Array:
                # Everything must depend on the zero, or XLA would hoist parts of it and store them for every tile.
                inputs, packed = jax.tree.map(
                    lambda leaf: leaf + zero.astype(leaf.dtype), ((self.table, rays, tile.key, tile.row), packed_inputs)
                )
                return function(_PassInputs(rows, *inputs), *packed)

            return run

        normal = tiles.once(busy, make_pass(all_rows, self._normal), tile.normal)
        texture: jax.Array | None = None
        if self.scene.atlas.has_textures or self.scene.atlas.sky is not None:
            texture = tiles.once(~busy, make_pass(planes, self._texture), tile.texture)
            texture = tiles.once(busy, make_pass(all_rows, self._texture), texture)
        of_mesh = () if mesh is None else (mesh.owner, mesh.colour)
        colour = tiles.once(~busy, make_pass(planes, self._finish, None, texture, *of_mesh), tile.colour)
        colour = tiles.once(busy, make_pass(all_rows, self._finish, normal, texture, *of_mesh), colour)
        rows, faces = sheets.sheet_rows(self.scene), []
        for row, own, old in zip(rows, tile.sheet_keys, tile.faces, strict=True):
            face = functools.partial(self._face, row)
            new = tiles.once(visible[row], make_pass([row], face, own), old)
            faces.append(jnp.where(visible[row], new, 0))
        if rows:
            any_face = jnp.any(visible[np.array(rows)])
            colour = tiles.once(any_face, make_pass(rows, self._blend, colour, *faces), colour)
        texture = tile.texture if texture is None else texture
        return tile._replace(normal=normal, texture=texture, colour=colour, faces=tuple(faces))

    def _normal(self, inputs: _PassInputs) -> jax.Array:
        """Compute packed normals [P] int32. As in the following passes, only the objects ``inputs.rows`` may be visible."""
        return pack_normal(surface.outward_normal(*self._intersect(inputs)))

    def _texture(self, inputs: _PassInputs) -> jax.Array:
        """Compute the texture factor of objects, or the colour of the sky: [P] int32, 10 bits per channel."""
        image = texturing.texture_colour(self.scene, *self._intersect(inputs)) or (jnp.ones_like(inputs.rays.u),) * 3
        return pack(self._over_sky(inputs, image, shade.sky(self.scene, self.rotation, inputs.rays)), 10)

    def _finish(
        self,
        inputs: _PassInputs,
        normal: jax.Array | None,
        texture: jax.Array | None,
        owner: jax.Array | None = None,
        mesh_colour: jax.Array | None = None,
    ) -> jax.Array:
        """Compute the colour of opaque objects and sky: [P] int32, packed.

        Without ``normal``, compute normals (cheap for planes). Where a triangle's ``owner`` is the nearest object, the colour
        is ``mesh_colour``, packed.
        """
        row, hit = self._intersect(inputs)
        if normal is not None:
            hit = hit._replace(normal=unpack_normal(normal))
        colour = shade.light_surface(self.scene, self.unit, self.lights, row, hit, inputs.rays)
        if texture is None:
            sky = shade.sky(self.scene, self.rotation, inputs.rays)
        else:
            sky = tuple(((texture >> shift) & 1023).astype(jnp.float32) / 1023.0 for shift in (0, 10, 20))
            colour = tuple(value * texel for value, texel in zip(colour, sky, strict=True))
        packed = pack(self._over_sky(inputs, colour, sky), _colour_bits(self.scene))
        if owner is None or mesh_colour is None:
            return packed
        index = raycast.decode(self.scene, inputs.key, inputs.row)[1]
        return jnp.where((owner >= 0) & (owner == index), mesh_colour, packed)

    def _face(self, row: int, inputs: _PassInputs, own: jax.Array) -> jax.Array:
        """Compute the colour of the transparent object ``row``, which has its ``own`` keys: [P] int32, see `sheets.face`."""
        return sheets.face(self.scene, self.unit, inputs.table, self.light_table, row, inputs.rays, own, inputs.key)

    def _blend(self, inputs: _PassInputs, colour: jax.Array, *faces: jax.Array) -> jax.Array:
        """Blend the faces of all transparent objects over the packed ``colour``: [P] int32."""
        del inputs
        return sheets.blend(self.scene, self.unit, faces, colour)

    def _intersect(self, inputs: _PassInputs) -> tuple[lookup.Row, surface.Hit]:
        """Return the visible object and the intersection at each pixel."""
        depth, index = raycast.decode(self.scene, inputs.key, inputs.row)
        row = _select_row(inputs.table, inputs.rows, index)
        return row, surface.intersect(self.scene, row, None, inputs.rays, depth, refined=False)

    def _over_sky(self, inputs: _PassInputs, colour: Vector, sky: Vector) -> Vector:
        """Return ``colour`` at pixels that show an object, ``sky`` elsewhere."""
        is_object = raycast.decode(self.scene, inputs.key, inputs.row)[1] >= 0
        return tuple(jnp.where(is_object, front, back) for front, back in zip(colour, sky, strict=True))


def _select_row(table: jax.Array, rows: list[int], index: jax.Array) -> lookup.Row:
    """Return the table row of the object at each pixel, as `lookup.fetch` does.

    Up to `_MAX_SELECTED` candidate ``rows`` are compared instead of looked up, since XLA would write the result of a lookup to
    memory.
    """
    if len(rows) > _MAX_SELECTED:
        return lookup.fetch(table, index)
    first, *others = rows or [0]
    columns = [jnp.broadcast_to(value, index.shape) for value in table[first]]
    for number in others:
        is_row = index == number
        columns = [jnp.where(is_row, value, column) for value, column in zip(table[number], columns, strict=True)]
    return lookup.make_row(columns)
