"""The same image on a CPU, with colours of 8 bits: passes over the pixels that each give one integer of 32 bits per pixel.

XLA computes a loop on a CPU anew for each of its outputs, and with it most of what they share: three channels cost three times
the shading. So each pass has one output, and what the next one needs of it is packed into its bits: the key of the nearest
object (`raycast`), its normal (as a point of an octahedron, 16 bits an axis), the colour of its texture (10 bits a channel),
and the colour that is seen (8 bits a channel). Each pass over a tile is a loop of one round (`tiles.once`), because XLA
would fuse them otherwise; and where only planes are seen in a tile, it is a cheaper one.

What happens to a pixel is the code of the plain renderer, but for the last bits: depths beside colours are those of the keys.
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
from jaxrl_vis_envs.render.pixel.arithmetic import Vector, clipped, larger, normalized, reciprocal
from jaxrl_vis_envs.render.scene import Scene

_FINE = {shapes.MESH, shapes.HFIELD}
# Up to this many objects, a pixel's row is chosen by comparing instead of being looked up.
_CHOSEN = 24
_NORMAL_STEPS = 32767.0


def takes(scene: Scene, outputs: Outputs) -> bool:
    """Returns whether these passes draw these planes on the platform that is being traced for.

    They are for CPUs, and draw opaque primitives without haze, with colours of 8 bits, and neither normals nor distances, nor
    labels where what reflects may coincide with something else.
    """
    plain = not any(scene.transparent) and scene.haze[0] < 0 and not _FINE & set(scene.object_types)
    plain = plain and not (outputs.segmentation and scene.reordered)
    return targets_cpu() and plain and (outputs.quantized or not outputs.rgb) and not (outputs.normals or outputs.distance)


def draw(outputs: Outputs, scene: Scene, rotation: jax.Array, unit: shapes.UnitShapes, light_table: jax.Array) -> Planes:
    """Draws one environment; ``jax.vmap`` it for a batch. Not differentiable.

    Args:
        outputs: Which planes.
        scene: One that the passes take, with these planes.
        rotation: [3, 3] float32 of the camera, see `camera.camera_pose`.
        unit: The drawn objects.
        light_table: From `lights.pack`.

    Returns:
        The planes.
    """
    layout = tiles.layout(scene)
    rays = camera.pixel_rays(scene, layout.rows, layout.columns)
    # Where nothing but depths is wanted, no bit of the keys is needed for anything else.
    labelled = outputs.rgb or outputs.segmentation
    colouring = _Colouring(scene, unit, rotation, light_table) if outputs.rgb else None
    planes = _tiles(scene, unit, colouring, labelled, rays)
    key, packed, row = jax.tree.map(lambda plane: blocks.restore(scene, layout, plane), planes)
    colours = _unpack(packed) if outputs.rgb else None
    if not labelled:
        return Planes(colours, jax.lax.bitcast_convert_type(key, jnp.float32), None)
    near, index = raycast.decode(scene, key, row)
    far = labels = None
    if outputs.depth:
        # A key's depth has lost its lowest bits: half of them come back.
        centre = jax.lax.bitcast_convert_type(near, jnp.int32) | (raycast.code_mask(scene) >> 1)
        far = jnp.where(index >= 0, jax.lax.bitcast_convert_type(centre, jnp.float32), scene.zfar)
    if outputs.segmentation:
        labels = jnp.asarray(np.array([*scene.object_ids, -1], np.int32))[index]
    return Planes(colours, far, labels)


class _Tile(NamedTuple):
    """Intermediate values of a tile, int32 [P] each: keys, colours, and what leads to them. The next tile's takes its memory.

    Rows are only there where they are no part of the keys.
    """

    key: jax.Array
    colour: jax.Array
    row: jax.Array | None
    own_keys: tuple[jax.Array, ...]
    normal: jax.Array
    texture: jax.Array


def _tiles(
    scene: Scene, unit: shapes.UnitShapes, colouring: "_Colouring | None", labelled: bool, rays: Rays
) -> tuple[jax.Array, ...]:
    """Keys, packed colours and rows (or None) of all pixels, [tiles, P] int32 each, one tile after the other."""
    seen = tiles.seen_in_tiles(scene, unit, rays)

    def draw_tile(carry: tuple, pixels: tuple) -> tuple:
        number, tile, results = carry
        # What goes straight into the results of a loop is computed on one core: it is copied there a round later.
        before = jnp.maximum(number - 1, 0)
        results = jax.tree.map(lambda whole, own: whole.at[before].set(own), results, (tile.key, tile.colour, tile.row))
        rays, seen = pixels
        key, row, own_keys = tiles.nearest_key(scene, unit, rays, seen, tile.own_keys, labelled)
        tile = tile._replace(key=key, row=row, own_keys=own_keys)
        if colouring is not None:
            tile = colouring.colour(tile, rays, jnp.any(seen[np.array(tiles.solids(scene), int)]))
        return (number + 1, tile, results), None

    shape = rays.u.shape
    empty = jnp.zeros(shape[1:], jnp.int32)
    # Zeros that XLA does not know to be the same: it would fill one array on one core, and copy it.
    keeps_rows = labelled and raycast.keeps_rows(scene)
    results = [
        jnp.zeros(shape, jnp.int32) + (0.0 * unit.origin[0, axis]).astype(jnp.int32) if axis < 2 or keeps_rows else None
        for axis in range(3)
    ]
    first = _Tile(empty, empty, empty if keeps_rows else None, tiles.memory(scene, empty), empty, empty)
    (_, last, found), _ = jax.lax.scan(draw_tile, (jnp.int32(0), first, tuple(results)), (rays, seen))
    return jax.tree.map(lambda whole, own: whole.at[shape[0] - 1].set(own), found, (last.key, last.colour, last.row))


class _Seen(NamedTuple):
    """Inputs of a pass: rows of the objects that may be seen, `lookup.object_table`, and rays and keys, [P] each.

    And the rows that keys are of, where they are no part of them.
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
        """The tile with its colours. In one that is not ``busy`` only planes are seen, and the sky."""
        every = list(range(len(self.scene.object_types)))
        planes = [row for row in every if self.scene.object_types[row] == shapes.PLANE]

        def seeing(rows: list[int], what: Callable, *more: jax.Array | None) -> Callable[[jax.Array], jax.Array]:
            def see(zero: jax.Array) -> jax.Array:
                # Everything depends on the zero, or XLA would compute and store parts of it for every tile.
                seen, packed = jax.tree.map(
                    lambda leaf: leaf + zero.astype(leaf.dtype), ((self.table, rays, tile.key, tile.row), more)
                )
                return what(_Seen(rows, *seen), *packed)

            return see

        normal = tiles.once(busy, seeing(every, self._normal), tile.normal)
        texture: jax.Array | None = None
        if self.scene.atlas.used or self.scene.atlas.sky is not None:
            texture = tiles.once(~busy, seeing(planes, self._texture), tile.texture)
            texture = tiles.once(busy, seeing(every, self._texture), texture)
        colour = tiles.once(~busy, seeing(planes, self._finish, None, texture), tile.colour)
        colour = tiles.once(busy, seeing(every, self._finish, normal, texture), colour)
        return tile._replace(normal=normal, texture=tile.texture if texture is None else texture, colour=colour)

    def _normal(self, seen: _Seen) -> jax.Array:
        """Packed, for objects whose rows are among these; as all that follow."""
        return _pack_normal(surface.outward(*self._met(seen)))

    def _texture(self, seen: _Seen) -> jax.Array:
        """What the colours of objects are multiplied with, and the colour of the sky: packed, 10 bits a channel."""
        image = texturing.texture_colour(self.scene, *self._met(seen)) or (jnp.ones_like(seen.rays.u),) * 3
        return _pack(self._in_front(seen, image, shade.sky(self.scene, self.rotation, seen.rays)), 10)

    def _finish(self, seen: _Seen, normal: jax.Array | None, texture: jax.Array | None) -> jax.Array:
        """What is seen: packed, 8 bits a channel. Without a ``normal`` it is that of a plane, which is not much to compute."""
        row, hit = self._met(seen)
        if normal is not None:
            hit = hit._replace(normal=_unpack_normal(normal))
        colour = shade.lighted(self.scene, self.unit, self.lights, row, hit, seen.rays)
        if texture is None:
            sky = shade.sky(self.scene, self.rotation, seen.rays)
        else:
            sky = tuple(((texture >> shift) & 1023).astype(jnp.float32) / 1023.0 for shift in (0, 10, 20))
            colour = tuple(value * texel for value, texel in zip(colour, sky, strict=True))
        return _pack(self._in_front(seen, colour, sky), 8)

    def _met(self, seen: _Seen) -> tuple[lookup.Row, surface.Hit]:
        """The object that each pixel sees, and where."""
        depth, index = raycast.decode(self.scene, seen.key, seen.row)
        row = _row(seen.table, seen.rows, index)
        return row, surface.meet(self.scene, row, None, seen.rays, depth, refined=False)

    def _in_front(self, seen: _Seen, colour: Vector, sky: Vector) -> Vector:
        """The colours of pixels that see an object, the sky's elsewhere."""
        sees = raycast.decode(self.scene, seen.key, seen.row)[1] >= 0
        return tuple(jnp.where(sees, front, back) for front, back in zip(colour, sky, strict=True))


def _row(table: jax.Array, rows: list[int], index: jax.Array) -> lookup.Row:
    """The row of every pixel, as `lookup.fetch`; few are chosen from, because rows that are looked up would be stored."""
    if len(rows) > _CHOSEN:
        return lookup.fetch(table, index)
    first, *others = rows or [0]
    columns = [jnp.broadcast_to(value, index.shape) for value in table[first]]
    for number in others:
        here = index == number
        columns = [jnp.where(here, value, column) for value, column in zip(table[number], columns, strict=True)]
    return lookup.row_of(columns)


def _pack(colour: Vector, bits: int) -> jax.Array:
    """Three channels [P] in [0, 1], rounded to this many bits each: [P] int32."""
    steps = float(2**bits - 1)
    red, green, blue = ((clipped(channel) * steps + 0.5).astype(jnp.int32) for channel in colour)
    return red | (green << bits) | (blue << 2 * bits)


def _unpack(packed: jax.Array) -> jax.Array:
    """Colours of 8 bits a channel, [H, W] int32 -> [3, H, W] uint8."""
    return (packed >> jnp.array([0, 8, 16], jnp.int32)[:, None, None]).astype(jnp.uint8)


def _pack_normal(normal: Vector) -> jax.Array:
    """A direction of any length -> [P] int32: where it meets an octahedron whose lower half is folded out, 16 bits an axis."""
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
    """Undoes `_pack_normal`: unit vectors, right to 5e-5."""
    x, y = (
        half.astype(jnp.float32) * (1.0 / _NORMAL_STEPS) - 1.0
        for half in (packed & 0xFFFF, jax.lax.shift_right_logical(packed, np.int32(16)))
    )
    z = 1.0 - jnp.abs(x) - jnp.abs(y)
    fold = larger(-z, 0.0)
    return normalized((x - jnp.where(x >= 0.0, fold, -fold), y - jnp.where(y >= 0.0, fold, -fold), z))
