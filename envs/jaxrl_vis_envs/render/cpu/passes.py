"""CPU renderer for 8-bit colours: passes over the pixels, each with one 32-bit integer per pixel as its result.

XLA on a CPU recomputes a loop for each of its outputs, including most of their shared work: three channels would cost three
times the shading. So each pass has one output, and everything the next one needs is packed into its bits: the key of the
nearest object (`raycast`), its normal (in octahedral encoding, 16 bits per axis), its texture colour (10 bits per channel), and
the final colour (8 bits per channel). Each pass over a tile is a loop of one iteration (`tiles.once`), because XLA would fuse
the passes otherwise; if only planes are visible in a tile, a cheaper version runs.

Per pixel, the code is that of the plain renderer, and results agree up to the last bits: in images with colours, depths are
decoded from the keys.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs.compiling.compilation import targets_cpu
from jaxrl_vis_envs.render import camera
from jaxrl_vis_envs.render.camera import Rays
from jaxrl_vis_envs.render.cpu import tiles
from jaxrl_vis_envs.render.outputs import Outputs, Planes
from jaxrl_vis_envs.render.pixel import blocks, lights, lookup, raycast, shade, shapes, surface, texturing
from jaxrl_vis_envs.render.pixel.arithmetic import Vector, clip_to_unit, maximum, normalized, reciprocal
from jaxrl_vis_envs.render.scene import Scene

_FINE = {shapes.MESH, shapes.HFIELD}
# Up to this many objects, a pixel's row is selected by comparisons instead of being looked up.
_MAX_SELECTED = 24
_NORMAL_STEPS = 32767.0


def can_render(scene: Scene, outputs: Outputs) -> bool:
    """Return True if these passes render these planes on the platform being traced for.

    They run on CPUs, and support opaque primitives without haze, with 8-bit colours, without normals and distances, and without
    segmentation if a reflecting object may coincide with another one.
    """
    is_simple = not any(scene.transparent) and scene.haze[0] < 0 and not _FINE & set(scene.object_types)
    is_simple = is_simple and not (outputs.segmentation and scene.reordered)
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
    planes = _render_tiles(scene, unit, colouring, labelled, rays)
    key, packed, row = jax.tree.map(lambda plane: blocks.restore(scene, layout, plane), planes)
    colours = _unpack(packed) if outputs.rgb else None
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


class _Tile(NamedTuple):
    """Intermediate int32 values [P] of a tile: keys, colours, and the results of earlier passes. ``row`` is None if rows are
    part of the keys.

    The next tile reuses their memory.
    """

    key: jax.Array
    colour: jax.Array
    row: jax.Array | None
    own_keys: tuple[jax.Array, ...]
    normal: jax.Array
    texture: jax.Array


def _render_tiles(
    scene: Scene, unit: shapes.UnitShapes, colouring: "_Colouring | None", labelled: bool, rays: Rays
) -> tuple[jax.Array, ...]:
    """Render all tiles sequentially; return keys, packed colours, and rows (or None) of all pixels, [tiles, P] int32 each."""
    visible = tiles.visible_in_tiles(scene, unit, rays)

    def draw_tile(carry: tuple, pixels: tuple) -> tuple:
        number, tile, results = carry
        # XLA computes values that are stored directly in a loop's results on one core: store them one iteration later.
        previous = jnp.maximum(number - 1, 0)
        results = jax.tree.map(lambda whole, own: whole.at[previous].set(own), results, (tile.key, tile.colour, tile.row))
        rays, visible = pixels
        key, row, own_keys = tiles.nearest_key(scene, unit, rays, visible, tile.own_keys, labelled)
        tile = tile._replace(key=key, row=row, own_keys=own_keys)
        if colouring is not None:
            tile = colouring.colour(tile, rays, jnp.any(visible[np.array(tiles.non_plane_rows(scene), int)]))
        return (number + 1, tile, results), None

    shape = rays.u.shape
    empty = jnp.zeros(shape[1:], jnp.int32)
    # Zeros that XLA cannot prove equal: otherwise it would fill one array on one core, and copy it.
    has_separate_rows = labelled and raycast.has_separate_rows(scene)
    results = [
        jnp.zeros(shape, jnp.int32) + (0.0 * unit.origin[0, axis]).astype(jnp.int32) if axis < 2 or has_separate_rows else None
        for axis in range(3)
    ]
    first = _Tile(empty, empty, empty if has_separate_rows else None, tiles.initial_keys(scene, empty), empty, empty)
    (_, last, planes), _ = jax.lax.scan(draw_tile, (jnp.int32(0), first, tuple(results)), (rays, visible))
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

    def colour(self, tile: _Tile, rays: Rays, busy: jax.Array) -> _Tile:
        """Return the tile with its colours. Unless ``busy`` ([] bool), only planes and sky are visible in it."""
        all_rows = list(range(len(self.scene.object_types)))
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
        if self.scene.atlas.used or self.scene.atlas.sky is not None:
            texture = tiles.once(~busy, make_pass(planes, self._texture), tile.texture)
            texture = tiles.once(busy, make_pass(all_rows, self._texture), texture)
        colour = tiles.once(~busy, make_pass(planes, self._finish, None, texture), tile.colour)
        colour = tiles.once(busy, make_pass(all_rows, self._finish, normal, texture), colour)
        return tile._replace(normal=normal, texture=tile.texture if texture is None else texture, colour=colour)

    def _normal(self, inputs: _PassInputs) -> jax.Array:
        """Compute packed normals [P] int32. As in the following passes, only the objects ``inputs.rows`` may be visible."""
        return _pack_normal(surface.outward_normal(*self._intersect(inputs)))

    def _texture(self, inputs: _PassInputs) -> jax.Array:
        """Compute the texture factor of objects, or the colour of the sky: [P] int32, 10 bits per channel."""
        image = texturing.texture_colour(self.scene, *self._intersect(inputs)) or (jnp.ones_like(inputs.rays.u),) * 3
        return _pack(self._over_sky(inputs, image, shade.sky(self.scene, self.rotation, inputs.rays)), 10)

    def _finish(self, inputs: _PassInputs, normal: jax.Array | None, texture: jax.Array | None) -> jax.Array:
        """Compute the final colour: [P] int32, 8 bits per channel. Without ``normal``, compute normals (cheap for planes)."""
        row, hit = self._intersect(inputs)
        if normal is not None:
            hit = hit._replace(normal=_unpack_normal(normal))
        colour = shade.light_surface(self.scene, self.unit, self.lights, row, hit, inputs.rays)
        if texture is None:
            sky = shade.sky(self.scene, self.rotation, inputs.rays)
        else:
            sky = tuple(((texture >> shift) & 1023).astype(jnp.float32) / 1023.0 for shift in (0, 10, 20))
            colour = tuple(value * texel for value, texel in zip(colour, sky, strict=True))
        return _pack(self._over_sky(inputs, colour, sky), 8)

    def _intersect(self, inputs: _PassInputs) -> tuple[lookup.Row, surface.Hit]:
        """Return the visible object and the intersection at each pixel."""
        depth, index = raycast.decode(self.scene, inputs.key, inputs.row)
        row = _select_row(inputs.table, inputs.rows, index)
        return row, surface.meet(self.scene, row, None, inputs.rays, depth, refined=False)

    def _over_sky(self, inputs: _PassInputs, colour: Vector, sky: Vector) -> Vector:
        """Return ``colour`` at pixels that show an object, ``sky`` elsewhere."""
        is_object = raycast.decode(self.scene, inputs.key, inputs.row)[1] >= 0
        return tuple(jnp.where(is_object, front, back) for front, back in zip(colour, sky, strict=True))


def _select_row(table: jax.Array, rows: list[int], index: jax.Array) -> lookup.Row:
    """Return the row of every pixel, as `lookup.fetch`. Few rows are selected by comparisons, since XLA would store lookups."""
    if len(rows) > _MAX_SELECTED:
        return lookup.fetch(table, index)
    first, *others = rows or [0]
    columns = [jnp.broadcast_to(value, index.shape) for value in table[first]]
    for number in others:
        is_row = index == number
        columns = [jnp.where(is_row, value, column) for value, column in zip(table[number], columns, strict=True)]
    return lookup.make_row(columns)


def _pack(colour: Vector, bits: int) -> jax.Array:
    """Quantise three channels [P] in [0, 1] to ``bits`` bits each, and pack them: [P] int32."""
    steps = float(2**bits - 1)
    red, green, blue = ((clip_to_unit(channel) * steps + 0.5).astype(jnp.int32) for channel in colour)
    return red | (green << bits) | (blue << 2 * bits)


def _unpack(packed: jax.Array) -> jax.Array:
    """Unpack 8-bit colours: [H, W] int32 -> [3, H, W] uint8."""
    return (packed >> jnp.array([0, 8, 16], jnp.int32)[:, None, None]).astype(jnp.uint8)


def _pack_normal(normal: Vector) -> jax.Array:
    """Encode directions of any norm in the octahedral encoding: [P] int32, 16 bits per axis."""
    inverse = reciprocal(jnp.abs(normal[0]) + jnp.abs(normal[1]) + jnp.abs(normal[2]) + 1e-30)
    x, y = normal[0] * inverse, normal[1] * inverse
    below = normal[2] < 0.0
    folded = (1.0 - jnp.abs(y)) * jnp.where(x >= 0.0, 1.0, -1.0), (1.0 - jnp.abs(x)) * jnp.where(y >= 0.0, 1.0, -1.0)
    low, high = (
        ((jnp.where(below, fold, flat) + 1.0) * _NORMAL_STEPS + 0.5).astype(jnp.int32)
        for fold, flat in zip(folded, (x, y), strict=True)
    )
    return low | (high << 16)


def _unpack_normal(packed: jax.Array) -> Vector:
    """Decode `_pack_normal` to unit vectors, accurate to 5e-5."""
    x, y = (
        half.astype(jnp.float32) * (1.0 / _NORMAL_STEPS) - 1.0
        for half in (packed & 0xFFFF, jax.lax.shift_right_logical(packed, np.int32(16)))
    )
    z = 1.0 - jnp.abs(x) - jnp.abs(y)
    fold = maximum(-z, 0.0)
    return normalized((x - jnp.where(x >= 0.0, fold, -fold), y - jnp.where(y >= 0.0, fold, -fold), z))
