"""The same picture on a CPU, with colours of 8 bits: passes over the pixels that each give one integer of 32 bits per pixel.

XLA computes a loop on a CPU anew for each of its outputs, and with it most of what they share: three channels cost three times
the shading. So each pass has one output, and what the next one needs of it is packed into its bits: the key of the nearest
object (`raycast`), its normal (as a point of an octahedron, 16 bits an axis), the colour of its texture (10 bits a channel),
and the colour that is seen (8 bits a channel). Between the passes are loops over blocks of pixels (`blocks`), because XLA
would fuse them otherwise.

What happens to a pixel is the code of the plain renderer, but for the last bits: depths beside colours are those of the keys.
"""

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs.render import blocks, camera, lights, raycast, shade, shapes, surface
from jaxrl_vis_envs.render.scene import Scene
from jaxrl_vis_envs.render.surface import Vector

_FINE = {shapes.MESH, shapes.HFIELD}
# So many objects at most are chosen from by comparing.
_CHOSEN = 24
_NORMAL_STEPS = 32767.0


def takes(scene: Scene) -> bool:
    """Whether these passes draw this scene here: opaque primitives without haze, on a CPU."""
    plain = not any(scene.transparent) and scene.haze[0] < 0 and not _FINE & set(scene.object_types)
    return jax.default_backend() == "cpu" and plain


def draw(
    wanted: tuple[bool, ...],
    quantized: bool,
    scene: Scene,
    rotation: jax.Array,
    unit: shapes.UnitShapes,
    light_table: jax.Array,
) -> list[jax.Array | None]:
    """Draws one environment; ``jax.vmap`` it for a batch. Not differentiable.

    Args:
        wanted: Whether to return rgb, depth, normals (which must be false), distance (false) and segmentation.
        quantized: Whether rgb is uint8 (must be true if it is wanted).
        scene: One that the passes take.
        rotation: [3, 3] float32 of the camera, see `camera.camera_pose`.
        unit: The drawn objects.
        light_table: From `lights.pack`.

    Returns:
        Those five planes, [3, H, W] uint8 or [H, W], None where not wanted.
    """
    rgb, depth, normals, distance, segmentation = wanted
    assert not (normals or distance) and (quantized or not rgb)
    layout = blocks.layout(scene)
    u, v = camera.pixel_rays(scene, layout.rows, layout.columns)
    if not (rgb or segmentation):
        # Nothing but depths: keys of which no bit is needed for anything else.
        bits = blocks.scan_one(lambda u, v: raycast.nearest_key(scene, unit, u, v, labelled=False), u, v)
        return [None, jax.lax.bitcast_convert_type(blocks.restore(scene, layout, bits), jnp.float32), None, None, None]
    key, _ = blocks.nearest(scene, unit, u, v)
    colours = far = labels = None
    if rgb:
        packed = _colours(scene, unit, rotation, light_table, *blocks.joined((u, v, key), halves=True))
        colours = _unpack(blocks.restore(scene, layout, packed))
    near, index = raycast.decode(scene, blocks.restore(scene, layout, key))
    if depth:
        # A key's depth has lost its lowest bits: half of them come back.
        centre = jax.lax.bitcast_convert_type(near, jnp.int32) | (raycast.code_mask(scene) >> 1)
        far = jnp.where(index >= 0, jax.lax.bitcast_convert_type(centre, jnp.float32), scene.zfar)
    if segmentation:
        labels = jnp.asarray(np.array([*scene.object_ids, -1], np.int32))[index]
    return [colours, far, None, None, labels]


def _colours(
    scene: Scene,
    unit: shapes.UnitShapes,
    rotation: jax.Array,
    light_table: jax.Array,
    u: jax.Array,
    v: jax.Array,
    key: jax.Array,
) -> jax.Array:
    """What pixels [blocks, P] see: packed, 8 bits a channel, int32."""
    table = surface.object_table(scene, unit)
    shines = lights.unpack(scene, light_table)

    def finish(u: jax.Array, v: jax.Array, key: jax.Array, normal: jax.Array, texture: jax.Array | None) -> jax.Array:
        row, hit = _met(scene, table, u, v, key)
        colour = shade.lighted(scene, unit, shines, row, hit._replace(normal=_unpack_normal(normal)), u, v)
        if texture is None:
            sky = shade.sky(scene, rotation, u, v)
        else:
            sky = tuple(((texture >> shift) & 1023).astype(jnp.float32) / 1023.0 for shift in (0, 10, 20))
            colour = tuple(value * texel for value, texel in zip(colour, sky, strict=True))
        return _pack(_in_front(scene, key, colour, sky), 8)

    normal = blocks.scan_one(lambda u, v, key: _pack_normal(surface.outward(*_met(scene, table, u, v, key))), u, v, key)
    texture = None
    if scene.atlas.used or scene.atlas.sky is not None:
        texture = blocks.scan_one(lambda u, v, key: _texture(scene, table, rotation, u, v, key), u, v, key)
    return blocks.scan_one(finish, u, v, key, normal, texture)


def _texture(scene: Scene, table: jax.Array, rotation: jax.Array, u: jax.Array, v: jax.Array, key: jax.Array) -> jax.Array:
    """What the colours of objects are multiplied with, and the colour of the sky: [P] int32, packed, 10 bits a channel."""
    picture = surface.texture_colour(scene, *_met(scene, table, u, v, key)) or (jnp.ones_like(u),) * 3
    return _pack(_in_front(scene, key, picture, shade.sky(scene, rotation, u, v)), 10)


def _in_front(scene: Scene, key: jax.Array, colour: Vector, sky: Vector) -> Vector:
    """The colours of pixels that see an object, the sky's elsewhere."""
    sees = raycast.decode(scene, key)[1] >= 0
    return tuple(jnp.where(sees, front, back) for front, back in zip(colour, sky, strict=True))


def _met(scene: Scene, table: jax.Array, u: jax.Array, v: jax.Array, key: jax.Array) -> tuple[surface.Row, surface.Hit]:
    """The object that each pixel sees, and where."""
    depth, index = raycast.decode(scene, key)
    row = _row(table, index)
    return row, surface.meet(scene, row, None, u, v, depth, refined=False)


def _row(table: jax.Array, index: jax.Array) -> surface.Row:
    """The row of every pixel, as `surface.fetch`; few are chosen from, because rows that are looked up would be stored."""
    if len(table) > _CHOSEN:
        return surface.fetch(table, index)
    columns = [jnp.broadcast_to(first, index.shape) for first in table[0]]
    for number in range(1, len(table)):
        here = index == number
        columns = [jnp.where(here, value, column) for value, column in zip(table[number], columns, strict=True)]
    return surface.row_of(columns)


def _pack(colour: Vector, bits: int) -> jax.Array:
    """Three channels [P] in [0, 1], rounded to so many bits each: [P] int32."""
    steps = float(2**bits - 1)
    red, green, blue = (jnp.floor(jnp.clip(channel, 0.0, 1.0) * steps + 0.5).astype(jnp.int32) for channel in colour)
    return red | (green << bits) | (blue << 2 * bits)


def _unpack(packed: jax.Array) -> jax.Array:
    """Colours of 8 bits a channel, [H, W] int32 -> [3, H, W] uint8."""
    return (packed >> jnp.array([0, 8, 16])[:, None, None]).astype(jnp.uint8)


def _pack_normal(normal: Vector) -> jax.Array:
    """A direction of any length -> [P] int32: where it meets an octahedron whose lower half is folded out, 16 bits an axis."""
    inverse = _reciprocal(jnp.abs(normal[0]) + jnp.abs(normal[1]) + jnp.abs(normal[2]) + 1e-30)
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
        for half in (packed & 0xFFFF, jax.lax.shift_right_logical(packed, 16))
    )
    z = 1.0 - jnp.abs(x) - jnp.abs(y)
    fold = jnp.maximum(-z, 0.0)
    return surface.normalized((x - jnp.where(x >= 0.0, fold, -fold), y - jnp.where(y >= 0.0, fold, -fold), z))


def _reciprocal(value: jax.Array) -> jax.Array:
    """1 / value for positive values, right to a few bits, by Newton's method from a guess at the exponent.

    XLA never fuses a division of which the quotient is used twice: it would store it, and compute all else in the loop again.
    """
    guess = jax.lax.bitcast_convert_type(0x7EF311C7 - jax.lax.bitcast_convert_type(value, jnp.int32), jnp.float32)
    for _ in range(3):
        guess = guess * (2.0 - value * guess)
    return guess
