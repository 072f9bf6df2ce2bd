"""The same image as one GPU kernel (Pallas, by Triton), for scenes of plain primitives: most scenes that robots learn in.

As XLA operations, every pixel meets every object. Here a program draws one tile of one image: it walks through the objects,
type by type, skips each whose bounding rectangle in the image misses the tile, and goes on to shade what it found without
leaving the chip. What happens to a pixel is the same code either way (`raycast.entry`, `surface.meet`, `shade.shade`): in the
kernel, what it reads are scalars and blocks of memory instead of arrays.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plgpu

from jaxrl_vis_envs.compilation import runs_gpu_kernels
from jaxrl_vis_envs.render import camera, lights, raycast, shade, shapes, surface
from jaxrl_vis_envs.render.scene import Scene

# Measured on an H200: pixels of a tile (a power of two, of which a few may be idle), and how a program is run.
_PIXELS = 128
_COMPILER = plgpu.CompilerParams(num_warps=4, num_stages=1)
_ENDLESS = 1e9
_TYPES = {shapes.PLANE, shapes.SPHERE, shapes.CAPSULE, shapes.ELLIPSOID, shapes.CYLINDER, shapes.BOX}


def takes(scene: Scene) -> bool:
    """Whether the kernel draws this scene here: opaque primitives without shadows or haze, on a GPU that runs kernels."""
    return runs_gpu_kernels() and supports(scene)


def supports(scene: Scene) -> bool:
    """Whether the kernel can draw this scene, wherever it runs."""
    plain = not any(scene.transparent) and not any(scene.light_shadows) and scene.haze[0] < 0
    textured = scene.atlas.used or scene.atlas.sky is not None
    # How far a texture is spread over a pixel is found out in the kernel, which does not know lenses with a sensor.
    return plain and not (textured and scene.projection == "intrinsic") and set(scene.object_types) <= _TYPES


def tile_shape(height: int, width: int) -> tuple[int, int]:
    """Rows and columns of a tile: about twice as wide as high, with little hanging over the image's border."""

    def cost(shape: tuple[int, int]) -> float:
        high, wide = shape
        return -(-height // high) * -(-width // wide) * (1.0 + 0.1 * abs(np.log2(wide / high) - 1.0))

    return min(((_PIXELS // wide, wide) for wide in range(8, _PIXELS + 1)), key=cost)


def rectangles(scene: Scene, unit: shapes.UnitShapes) -> jax.Array:
    """[G, 4] float32: least and largest u, least and largest v of a ball around each object; endless for planes."""
    x, y, depth, radius = unit.ball[:, 0], unit.ball[:, 1], -unit.ball[:, 2], unit.ball[:, 3]
    radius = radius * (1.0 + 1e-4) + 1e-6
    if scene.projection == "orthographic":
        sides = [x - radius, x + radius, y - radius, y + radius]
        behind, around = depth < -radius, jnp.zeros(depth.shape, bool)
    else:
        square = depth * depth - radius * radius
        safe = jnp.where(square > 0.0, square, 1.0)
        sides = []
        for along in (x, y):
            root = radius * jnp.sqrt(jnp.maximum(along * along + square, 0.0))
            sides += [(along * depth - root) / safe, (along * depth + root) / safe]
        behind, around = depth <= -radius, depth <= radius
    endless = np.array(scene.object_types) == shapes.PLANE
    low, high = jnp.where(around, -_ENDLESS, 0.0), jnp.where(around, _ENDLESS, 0.0)
    sides = [jnp.where(around, high if i % 2 else low, side) for i, side in enumerate(sides)]
    # What is behind the camera has its sides the wrong way round, so no tile meets it.
    sides = [jnp.where(behind, -_ENDLESS if i % 2 else _ENDLESS, side) for i, side in enumerate(sides)]
    return jnp.stack([jnp.where(endless, _ENDLESS if i % 2 else -_ENDLESS, side) for i, side in enumerate(sides)], axis=1)


def tile_words(scene: Scene, sides: jax.Array, tile: tuple[int, int]) -> tuple[jax.Array, np.ndarray]:
    """Which objects may be seen in which tile.

    Args:
        scene: The scene.
        sides: [G, 4] from `rectangles`.
        tile: Rows and columns of a tile.

    Returns:
        Bits [tiles, words] int32: bit b of word w is for object ``order[32 w + b]``; and the order [G], which goes by type.
    """
    order = np.argsort(np.array(scene.object_types), kind="stable").astype(np.int32)
    high, wide = tile
    tops, lefts = np.arange(0, scene.height, high), np.arange(0, scene.width, wide)
    middle_u, middle_v, half_u, half_v = camera.lens(scene)

    def u_of(column: np.ndarray) -> jax.Array:
        return middle_u + jnp.asarray((2.0 * column + 1.0 - scene.width) / scene.width, jnp.float32) * half_u

    def v_of(row: np.ndarray) -> jax.Array:
        return middle_v + jnp.asarray((scene.height - 1.0 - 2.0 * row) / scene.height, jnp.float32) * half_v

    sides = sides[order]
    across = (sides[:, 0] <= u_of(lefts + wide)[:, None]) & (sides[:, 1] >= u_of(lefts - 1)[:, None])
    down = (sides[:, 2] <= v_of(tops - 1)[:, None]) & (sides[:, 3] >= v_of(tops + high)[:, None])
    meets = (down[:, None] & across[None, :]).reshape(len(tops) * len(lefts), -1)
    words = -(-len(order) // 32)
    meets = jnp.pad(meets, ((0, 0), (0, 32 * words - len(order)))).reshape(-1, words, 32)
    bits = jnp.asarray(np.left_shift(np.uint32(1), np.arange(32, dtype=np.uint32)))
    return jax.lax.bitcast_convert_type(jnp.sum(jnp.where(meets, bits, 0), axis=-1, dtype=jnp.uint32), jnp.int32), order


class _Refs(NamedTuple):
    """What a kernel reads, all of one environment."""

    words: Any
    order: Any
    axes: Any
    origin: Any
    extra: Any
    extra_square: Any
    looks: Any
    texels: Any
    levels: Any
    lights: Any
    view: Any
    ids: Any


def _nearest(scene: Scene, refs: _Refs, place: Any, u: jax.Array, v: jax.Array, znear: Any, best: jax.Array) -> jax.Array:
    """The least key of the objects of a tile."""
    mask = raycast.code_mask(scene)
    start, direction, inverse_square = camera.ray_parts(scene, u, v)
    kinds = sorted(scene.object_types)
    bare_balls = not any(
        textured for kind, textured in zip(scene.object_types, scene.atlas.mappings, strict=True) if kind == shapes.SPHERE
    )

    for word in range(refs.words.shape[1]):
        bits = refs.words[place, word]
        some = kinds[32 * word : 32 * (word + 1)]
        for kind in sorted(set(some)):
            own = sum(1 << bit for bit, other in enumerate(some) if other == kind)
            own = own - (1 << 32) if own >= 1 << 31 else own

            def one_object(carry, kind=kind, word=word):
                left, best = carry
                bit = 31 - jax.lax.clz(left & -left)
                index = refs.order[32 * word + bit]
                axes = (
                    None
                    if kind == shapes.SPHERE and bare_balls
                    else [[refs.axes[index, i, j] for j in range(3)] for i in range(3)]
                )
                values = ([refs.origin[index, i] for i in range(3)], axes, refs.extra[index], refs.extra_square[index])
                t, meets = raycast.entry(kind, values, start, direction, inverse_square)
                key = (jax.lax.bitcast_convert_type(t, jnp.int32) & ~mask) | index
                return left & (left - 1), jnp.minimum(best, jnp.where(meets & (t > znear), key, best))

            _, best = jax.lax.while_loop(lambda carry: carry[0] != 0, one_object, (bits & own, best))
    return best


def _kernel(*refs, scene, wanted, quantized, tile):
    count = len(_Refs._fields)
    refs, out = _Refs(*refs[:count]), list(refs[count:])
    rgb, depth, normals, distance, segmentation = wanted
    high, wide = tile
    across = -(-scene.width // wide)
    place = pl.program_id(0)
    top, left = jax.lax.div(place, across) * high, jax.lax.rem(place, across) * wide
    lane = jax.lax.broadcasted_iota(jnp.int32, (_PIXELS,), 0)
    row, column = top + jax.lax.div(lane, jnp.int32(wide)), left + jax.lax.rem(lane, jnp.int32(wide))
    inside = (lane < high * wide) & (row < scene.height) & (column < scene.width)

    middle_u, middle_v, half_u, half_v, znear, zfar = (refs.view[index] for index in range(6))
    u = middle_u + (2.0 * column.astype(jnp.float32) + (1.0 - scene.width)) * (1.0 / scene.width) * half_u
    v = middle_v + ((scene.height - 1.0) - 2.0 * row.astype(jnp.float32)) * (1.0 / scene.height) * half_v

    mask = raycast.code_mask(scene)
    sky_key = (jax.lax.bitcast_convert_type(zfar, jnp.int32) & ~mask) | mask
    best = _nearest(scene, refs, place, u, v, znear, jnp.broadcast_to(sky_key, (_PIXELS,)))
    index = best & mask
    near = jax.lax.bitcast_convert_type(best & ~mask, jnp.float32)
    sees = index != mask
    pixel = row * scene.width + column

    def store(value, plane=None):
        ref = out[0].at[pixel] if plane is None else out[0].at[plane, pixel]
        plgpu.store(ref, value.astype(out[0].dtype), mask=inside)

    top_colour, bottom_colour = ([refs.view[first + i] for i in range(3)] for first in (15, 18))
    texels = _Rows(refs.texels, levels=_Rows(refs.levels))
    inner = scene.replace(sky_top=top_colour, sky_bottom=bottom_colour, zfar=zfar, fovy=refs.view[21], texels=texels)
    zero = jnp.zeros((_PIXELS,))
    far, normal, colour = zero, (zero,) * 3, (zero,) * 3
    if rgb or depth or normals or distance:

        def surfaces():
            cell = _fetch(refs, jnp.where(sees, index, 0))
            hit = surface.meet(inner, cell, None, u, v, near)
            colour = shade.shade(inner, None, lights.unpack(scene, refs.lights), cell, hit, u, v) if rgb else (zero,) * 3
            return hit.depth, tuple(hit.normal), tuple(colour)

        # A whole tile of sky is common.
        far, normal, colour = jax.lax.cond(jnp.max(sees.astype(jnp.int32)) > 0, surfaces, lambda: (far, normal, colour))
        far = jnp.where(sees, far, zfar)
    if rgb:

        def with_sky():
            rotation = _Matrix([[refs.view[6 + 3 * i + j] for j in range(3)] for i in range(3)])
            background = shade.sky(inner, rotation, u, v)
            return tuple(jnp.where(sees, front, back) for front, back in zip(colour, background, strict=True))

        colour = jax.lax.cond(jnp.min(sees.astype(jnp.int32)) > 0, lambda: colour, with_sky)
        for plane, value in enumerate(colour):
            if quantized:
                value = (jnp.clip(value, 0.0, 1.0) * 255.0 + 0.5).astype(jnp.int32)
            store(value, plane)
        out.pop(0)
    if depth:
        store(far)
        out.pop(0)
    if normals:
        for plane, value in enumerate(normal):
            store(jnp.where(sees, value, 0.0), plane)
        out.pop(0)
    if distance:
        length = 1.0 if scene.projection == "orthographic" else jnp.sqrt(u * u + v * v + 1.0)
        store(jnp.where(sees, far * length, zfar))
        out.pop(0)
    if segmentation:
        store(jnp.where(sees, plgpu.load(refs.ids.at[jnp.where(sees, index, 0)]), -1))


def _fetch(refs: _Refs, index: jax.Array) -> surface.Row:
    """Of each pixel's object, the values that `surface.meet` and `shade.shade` need."""

    def column(ref, *place):
        return plgpu.load(ref.at[(index, *(jnp.full(index.shape, number, jnp.int32) for number in place))])

    columns = [column(refs.axes, i, j) for i in range(3) for j in range(3)] + [column(refs.origin, i) for i in range(3)]
    return surface.row_of(
        [*columns, column(refs.extra), *(column(refs.looks, number) for number in range(refs.looks.shape[1]))]
    )


class _Rows:
    """A block of memory whose rows are looked up as those of an array; only the columns that are asked for are read."""

    def __init__(self, ref: Any, row: Any = None, levels: Any = None):
        self.ref, self.row, self.levels = ref, row, levels

    def __len__(self) -> int:
        return self.ref.shape[0]

    @property
    def at(self) -> Any:
        return self

    def get(self, mode: str) -> Any:
        del mode
        return self

    def __getitem__(self, place: Any) -> Any:
        if self.row is None:
            return _Rows(self.ref, place)
        return plgpu.load(self.ref.at[self.row, jnp.full(self.row.shape, place[-1], jnp.int32)])


class _Matrix:
    """Scalars that are read like an array."""

    def __init__(self, rows: list):
        self.rows = rows

    def __getitem__(self, place: tuple[int, int]) -> Any:
        return self.rows[place[0]][place[1]]


def draw(
    wanted: tuple[bool, ...],
    quantized: bool,
    scene: Scene,
    rotation: jax.Array,
    unit: shapes.UnitShapes,
    light_table: jax.Array,
    interpret: bool = False,
) -> list[jax.Array | None]:
    """Draws one environment; ``jax.vmap`` it for a batch. Not differentiable.

    Args:
        wanted: Whether to return rgb, depth, normals, distance and segmentation.
        quantized: Whether rgb is uint8 rather than float32 in [0, 1].
        scene: One that the kernel `takes`.
        rotation: [3, 3] float32 of the camera, see `camera.camera_pose`.
        unit: The drawn objects.
        light_table: From `lights.pack`.
        interpret: Run without a GPU, slowly.

    Returns:
        Those five planes, [3, H, W] or [H, W], None where not wanted.
    """
    tile = tile_shape(scene.height, scene.width)
    words, order = tile_words(scene, rectangles(scene, unit), tile)
    ids = np.array(scene.object_ids, np.int32)
    lens, sky = jnp.stack(camera.lens(scene)), (scene.sky_top, scene.sky_bottom)
    inputs = _Refs(
        words=words,
        order=jnp.asarray(order),
        axes=unit.axes,
        origin=unit.origin,
        extra=unit.extra,
        extra_square=unit.extra_square,
        looks=jnp.stack(surface.look_columns(scene), axis=1),
        texels=scene.texels if len(scene.texels) else jnp.zeros((1, 4), jnp.uint32),
        levels=jnp.asarray(scene.atlas.levels or [(0, 1, 1)], jnp.int32),
        lights=light_table if len(light_table) else jnp.zeros((1, 1)),
        view=jnp.concatenate([lens, jnp.stack([scene.znear, scene.zfar]), rotation.reshape(9), *sky, scene.fovy[None]]),
        ids=jnp.asarray(ids),
    )
    pixels = scene.height * scene.width
    kinds = (
        ((3, pixels), jnp.uint8 if quantized else jnp.float32),
        ((pixels,), jnp.float32),
        ((3, pixels), jnp.float32),
        ((pixels,), jnp.float32),
        ((pixels,), jnp.int32),
    )
    outputs = [jax.ShapeDtypeStruct(*kind) for want, kind in zip(wanted, kinds, strict=True) if want]
    drawn = pl.pallas_call(
        functools.partial(_kernel, scene=_without_arrays(scene), wanted=wanted, quantized=quantized, tile=tile),
        out_shape=outputs,
        grid=(words.shape[0],),
        in_specs=[_whole(array.shape) for array in inputs],
        out_specs=[_whole(like.shape) for like in outputs],
        compiler_params=_COMPILER,
        interpret=interpret,
        name="draw_tiles",
    )(*inputs)
    planes = iter([plane.reshape(*plane.shape[:-1], scene.height, scene.width) for plane in drawn])
    return [next(planes) if want else None for want in wanted]


def _whole(shape: tuple[int, ...]) -> pl.BlockSpec:
    """Every program sees all of it."""
    return pl.BlockSpec(shape, lambda place: (0,) * len(shape))


def _without_arrays(scene: Scene) -> Scene:
    """A kernel must not capture any."""
    leaves, structure = jax.tree.flatten(scene)
    return jax.tree.unflatten(structure, [None] * len(leaves))
