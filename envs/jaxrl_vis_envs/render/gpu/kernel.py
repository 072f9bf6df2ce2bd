"""GPU renderer in one kernel (Pallas with Triton), for scenes of opaque primitives: most robot learning scenes.

As XLA operations, every pixel would be tested against every object. Here, one program renders one tile of one image: it
iterates over the objects by type, skips those whose bounding rectangle in the image misses the tile, and shades the nearest
hits without leaving the chip. Per pixel, the code is the same as in plain JAX (`raycast.entry`, `surface.intersect`,
`shade.shade`), but reads scalars and blocks of memory instead of arrays.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plgpu

from jaxrl_vis_envs.compiling.compilation import use_gpu_kernels
from jaxrl_vis_envs.compiling.gpu_kernels import kernel_call
from jaxrl_vis_envs.render import camera
from jaxrl_vis_envs.render.camera import Rays
from jaxrl_vis_envs.render.gpu.tiles import PIXELS_PER_TILE, rectangles, tile_shape, tile_words
from jaxrl_vis_envs.render.model import reading
from jaxrl_vis_envs.render.outputs import Outputs, Planes
from jaxrl_vis_envs.render.pixel import lights, lookup, raycast, shade, shapes, surface
from jaxrl_vis_envs.render.pixel.prepare import prepare
from jaxrl_vis_envs.render.scene import Scene

# Tuned on an H200.
_COMPILER = plgpu.CompilerParams(num_warps=4, num_stages=1)
# Indices of the camera's parameters in the vector that the kernel reads.
_LENS, _CLIP, _ROTATION, _SKY_TOP, _SKY_BOTTOM, _FOVY = range(4), range(4, 6), range(6, 15), range(15, 18), range(18, 21), 21
_PROBE = """
<mujoco>
  <asset>
    <texture name="t" type="2d" builtin="checker" width="8" height="8"/><material name="t" texture="t"/>
    <texture name="sky" type="skybox" builtin="checker" width="8" height="8"/>
  </asset>
  <worldbody>
    <light type="directional"/><light type="spot" pos="0 0 2"/>
    <geom type="plane" size="1 1 1" material="t"/><geom type="sphere" size=".1"/><geom type="capsule" size=".1 .1"/>
    <geom type="ellipsoid" size=".1 .2 .1"/><geom type="cylinder" size=".1 .1"/><geom type="box" size=".1 .1 .1"/>
    <camera pos="0 0 1"/>
  </worldbody>
</mujoco>
"""
_TYPES = {shapes.PLANE, shapes.SPHERE, shapes.CAPSULE, shapes.ELLIPSOID, shapes.CYLINDER, shapes.BOX}


def can_render(scene: Scene, outputs: Outputs) -> bool:
    """Return True if the kernel renders these planes on the platform being traced for.

    It renders all planes of supported scenes, except segmentation if a reflecting object may coincide with another one.
    """
    return supports(scene) and not (outputs.segmentation and scene.reordered) and use_gpu_kernels(probe)


def supports(scene: Scene) -> bool:
    """Return True if the kernel supports this scene, on any platform: opaque primitives without shadows or haze."""
    is_simple = not any(scene.transparent) and not any(scene.light_shadows) and scene.haze[0] < 0
    textured = scene.atlas.has_textures or scene.atlas.sky is not None
    # The kernel computes the texture footprint of a pixel, and does not support lenses with a sensor.
    return is_simple and not (textured and scene.projection == "intrinsic") and set(scene.object_types) <= _TYPES


class _Refs(NamedTuple):
    """Memory blocks read by a kernel, all of one environment."""

    words: Any
    order: Any
    axes: Any
    origin: Any
    extra: Any
    extra_square: Any
    appearance: Any
    texels: Any
    levels: Any
    lights: Any
    view: Any
    ids: Any


def _nearest(scene: Scene, refs: _Refs, tile_index: Any, rays: Rays, znear: Any, best: tuple) -> tuple:
    """Return the minimum of ``best`` and the keys of a tile's objects: (key,), or (depth bits, row) if rows are separate."""
    mask = raycast.code_mask(scene)
    start, direction, inverse_square = camera.ray_parts(scene, rays)
    kinds = sorted(scene.object_types[row] for row in raycast.primitive_rows(scene, transparent=False))
    bare_balls = not any(
        textured for kind, textured in zip(scene.object_types, scene.atlas.mappings, strict=True) if kind == shapes.SPHERE
    )

    for word in range(refs.words.shape[1]):
        bits = refs.words[tile_index, word]
        word_kinds = kinds[32 * word : 32 * (word + 1)]
        for kind in sorted(set(word_kinds)):
            kind_bits = sum(1 << bit for bit, other in enumerate(word_kinds) if other == kind)
            kind_bits = kind_bits - (1 << 32) if kind_bits >= 1 << 31 else kind_bits

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
                if raycast.can_be_culled(scene, kind):
                    meets = meets & raycast.is_plane_visible(refs.origin[index, 2], refs.axes[index, 2, 2])
                bits = jax.lax.bitcast_convert_type(t, jnp.int32)
                if len(best) == 1:
                    key = (bits & ~mask) | index
                    return left & (left - 1), (jnp.minimum(best[0], jnp.where(meets & (t > znear), key, best[0])),)
                nearest, row = best
                nearer = meets & (t > znear) & ((bits < nearest) | ((bits == nearest) & (index < row)))
                return left & (left - 1), (jnp.where(nearer, bits, nearest), jnp.where(nearer, index, row))

            _, best = jax.lax.while_loop(lambda carry: carry[0] != 0, one_object, (bits & kind_bits, best))
    return best


class _Tile(NamedTuple):
    """Pixels of a tile, [PIXELS_PER_TILE] each, of which some may lie beyond the image, and what is nearest there.

    Attributes:
        row: Row of the pixel.
        column: Its column.
        inside: True within the image.
        rays: The rays.
        zfar: [] float32, m.
        best: Keys, or depth bits and rows, as from `_nearest`.
    """

    row: Any
    column: Any
    inside: Any
    rays: Rays
    zfar: Any
    best: tuple


def _search_tile(refs: _Refs, scene: Scene, tile: tuple[int, int]) -> _Tile:
    """Find the nearest objects of the tile that a program renders."""
    high, wide = tile
    across = np.int32(-(-scene.width // wide))
    tile_index = pl.program_id(0)
    top, left = jax.lax.div(tile_index, across) * high, jax.lax.rem(tile_index, across) * wide
    lane = jax.lax.broadcasted_iota(jnp.int32, (PIXELS_PER_TILE,), 0)
    row, column = top + jax.lax.div(lane, jnp.int32(wide)), left + jax.lax.rem(lane, jnp.int32(wide))
    inside = (lane < high * wide) & (row < scene.height) & (column < scene.width)

    middle_u, middle_v, half_u, half_v = (refs.view[index] for index in _LENS)
    znear, zfar = (refs.view[index] for index in _CLIP)
    u = middle_u + (2.0 * column.astype(jnp.float32) + (1.0 - scene.width)) * (1.0 / scene.width) * half_u
    v = middle_v + ((scene.height - 1.0) - 2.0 * row.astype(jnp.float32)) * (1.0 / scene.height) * half_v
    rays = Rays(u, v)

    mask = raycast.code_mask(scene)
    sky = jnp.broadcast_to((jax.lax.bitcast_convert_type(zfar, jnp.int32) & ~mask) | mask, (PIXELS_PER_TILE,))
    best: tuple = (sky,)
    if raycast.has_separate_rows(scene):
        best = (sky, jnp.full((PIXELS_PER_TILE,), len(scene.object_ids), jnp.int32))
    best = _nearest(scene, refs, tile_index, rays, znear, best)
    return _Tile(row, column, inside, rays, zfar, best)


def _kernel(*refs, scene: Scene, outputs: Outputs, tile: tuple[int, int]):
    count = len(_Refs._fields)
    refs, out = _Refs(*refs[:count]), list(refs[count:])
    row, column, inside, rays, zfar, best = _search_tile(refs, scene, tile)
    mask = raycast.code_mask(scene)
    if raycast.has_separate_rows(scene):
        index = best[1]
        hit_mask = index != len(scene.object_ids)
    else:
        index = best[0] & mask
        hit_mask = index != mask
    near = jax.lax.bitcast_convert_type(best[0] & ~mask, jnp.float32)
    pixel = row * scene.width + column

    def store(value, plane=None):
        ref = out[0].at[pixel] if plane is None else out[0].at[plane, pixel]
        plgpu.store(ref, value.astype(out[0].dtype), mask=inside)

    top_colour, bottom_colour = ([refs.view[index] for index in colour] for colour in (_SKY_TOP, _SKY_BOTTOM))
    texels: Any = _BlockTexels(refs.texels, refs.levels)
    inner = scene.replace(sky_top=top_colour, sky_bottom=bottom_colour, zfar=zfar, fovy=refs.view[_FOVY], texels=texels)
    zero = jnp.zeros((PIXELS_PER_TILE,), jnp.float32)
    far, normal, colour = zero, (zero,) * 3, (zero,) * 3
    if outputs.rgb or outputs.depth or outputs.normals or outputs.distance:

        def surfaces():
            object_row = _fetch(refs, jnp.where(hit_mask, index, 0))
            hit = surface.intersect(inner, object_row, None, rays, near)
            colour = (zero,) * 3
            if outputs.rgb:
                colour = shade.shade(inner, None, lights.unpack(scene, refs.lights), object_row, hit, rays)
            return hit.depth, tuple(hit.normal), tuple(colour)

        # Tiles that show only sky are common.
        far, normal, colour = jax.lax.cond(jnp.max(hit_mask.astype(jnp.int32)) > 0, surfaces, lambda: (far, normal, colour))
        far = jnp.where(hit_mask, far, zfar)
    if outputs.rgb:

        def with_sky():
            rotation = _Matrix([[refs.view[_ROTATION[3 * i + j]] for j in range(3)] for i in range(3)])
            background = shade.sky(inner, rotation, rays)
            return tuple(jnp.where(hit_mask, front, back) for front, back in zip(colour, background, strict=True))

        colour = jax.lax.cond(jnp.min(hit_mask.astype(jnp.int32)) > 0, lambda: colour, with_sky)
        for plane, value in enumerate(colour):
            if outputs.quantized:
                value = (jnp.clip(value, 0.0, 1.0) * 255.0 + 0.5).astype(jnp.int32)
            store(value, plane)
        out.pop(0)
    if outputs.depth:
        store(far)
        out.pop(0)
    if outputs.normals:
        for plane, value in enumerate(normal):
            store(jnp.where(hit_mask, value, 0.0), plane)
        out.pop(0)
    if outputs.distance:
        store(jnp.where(hit_mask, far * camera.ray_length(scene, rays), zfar))
        out.pop(0)
    if outputs.segmentation:
        store(jnp.where(hit_mask, plgpu.load(refs.ids.at[jnp.where(hit_mask, index, 0)]), -1))


def _fetch(refs: _Refs, index: jax.Array) -> lookup.Row:
    """Fetch the properties of each pixel's object that `surface.intersect` and `shade.shade` need."""
    columns = [_column(refs.axes, index, i, j) for i in range(3) for j in range(3)]
    columns += [_column(refs.origin, index, i) for i in range(3)] + [_column(refs.extra, index)]
    return lookup.make_row(columns + [_column(refs.appearance, index, number) for number in range(refs.appearance.shape[1])])


def _column(ref: Any, index: jax.Array, *columns: int) -> jax.Array:
    """Load one column of the rows ``index`` [P] of a block of memory."""
    return plgpu.load(ref.at[(index, *(jnp.full(index.shape, number, jnp.int32) for number in columns))])


class _BlockTexels:
    """Texture atlas in blocks of memory, see `sampling.Texels`."""

    few_textures = True  # many tiles show no textured object
    differentiable = False

    def __init__(self, texels: Any, levels: Any):
        self.texels, self.levels = texels, levels

    def level(self, number: jax.Array) -> tuple[jax.Array, ...]:
        """See `sampling.Texels`."""
        number = jnp.clip(number, 0, self.levels.shape[0] - 1)
        return tuple(_column(self.levels, number, column) for column in range(3))

    def quad(self, row: jax.Array) -> tuple[jax.Array, ...]:
        """See `sampling.Texels`."""
        row = jnp.clip(row, 0, self.texels.shape[0] - 1)
        return tuple(_column(self.texels, row, corner) for corner in range(4))


class _Matrix:
    """Scalars indexed like an array."""

    def __init__(self, rows: list):
        self.rows = rows

    def __getitem__(self, index: tuple[int, int]) -> Any:
        return self.rows[index[0]][index[1]]


def draw(
    outputs: Outputs,
    scene: Scene,
    rotation: jax.Array,
    unit: shapes.UnitShapes,
    light_table: jax.Array,
    interpret: bool = False,
) -> Planes:
    """Render one environment; use ``jax.vmap`` for a batch. Not differentiable.

    Args:
        outputs: Requested planes.
        scene: Scene that the kernel `supports`.
        rotation: [3, 3] float32 of the camera, see `camera.camera_pose`.
        unit: Rendered objects.
        light_table: Lights, from `lights.pack`.
        interpret: Run without a GPU, slowly.

    Returns:
        The planes.
    """
    inputs = _inputs(scene, rotation, unit, light_table)
    pixels = scene.height * scene.width
    # Outputs in the order in which the kernel writes them.
    kinds = {
        "rgb": ((3, pixels), jnp.uint8 if outputs.quantized else jnp.float32),
        "depth": ((pixels,), jnp.float32),
        "normals": ((3, pixels), jnp.float32),
        "distance": ((pixels,), jnp.float32),
        "segmentation": ((pixels,), jnp.int32),
    }
    out_shapes = {name: jax.ShapeDtypeStruct(*kind) for name, kind in kinds.items() if getattr(outputs, name)}
    planes = kernel_call(
        functools.partial(_kernel, scene=_without_arrays(scene), outputs=outputs, tile=tile_shape(scene.height, scene.width)),
        out_shape=list(out_shapes.values()),
        grid=(inputs.words.shape[0],),
        in_specs=[_full_block(array.shape) for array in inputs],
        out_specs=[_full_block(like.shape) for like in out_shapes.values()],
        compiler_params=_COMPILER,
        interpret=interpret,
        name="draw_tiles",
    )(*inputs)
    reshaped = {
        name: plane.reshape(*plane.shape[:-1], scene.height, scene.width)
        for name, plane in zip(out_shapes, planes, strict=True)
    }
    return Planes(**{**dict.fromkeys(Planes._fields), **reshaped})


def can_search(scene: Scene) -> bool:
    """Return True if `nearest_primitives` searches this scene, on any platform."""
    return bool(raycast.primitive_rows(scene, transparent=False)) and reading.CLEAR_FROM_BEHIND not in scene.transparent


def nearest_primitives(scene: Scene, unit: shapes.UnitShapes, interpret: bool = False) -> tuple[jax.Array, jax.Array | None]:
    """Find the nearest opaque primitive of each pixel. Not differentiable.

    Args:
        scene: Scene for which `can_search` holds, which may have other objects too.
        unit: Rendered objects.
        interpret: Run without a GPU, slowly.

    Returns:
        Key [H * W] int32 of the pixels, row by row, see `raycast`, and the row of the object [H * W] int32, -1 for the sky; the
        row is None if it is part of the key.
    """
    inputs = _inputs(scene, jnp.eye(3, dtype=jnp.float32), unit, jnp.zeros((0, lights.COLUMNS), jnp.float32))
    is_separate = raycast.has_separate_rows(scene)
    pixels = jax.ShapeDtypeStruct((scene.height * scene.width,), jnp.int32)
    planes = kernel_call(
        functools.partial(_search_kernel, scene=_without_arrays(scene), tile=tile_shape(scene.height, scene.width)),
        out_shape=[pixels] * (2 if is_separate else 1),
        grid=(inputs.words.shape[0],),
        in_specs=[_full_block(array.shape) for array in inputs],
        out_specs=[_full_block(pixels.shape)] * (2 if is_separate else 1),
        compiler_params=_COMPILER,
        interpret=interpret,
        name="find_primitive",
    )(*inputs)
    return planes[0], jnp.where(planes[1] == len(scene.object_ids), -1, planes[1]) if is_separate else None


def _search_kernel(*refs, scene: Scene, tile: tuple[int, int]):
    count = len(_Refs._fields)
    result = _search_tile(_Refs(*refs[:count]), scene, tile)
    for out, plane in zip(refs[count:], result.best, strict=True):
        plgpu.store(out.at[result.row * scene.width + result.column], plane, mask=result.inside)


def _inputs(scene: Scene, rotation: jax.Array, unit: shapes.UnitShapes, light_table: jax.Array) -> _Refs:
    """Return the arrays that a kernel reads; arguments as in `draw`."""
    tile = tile_shape(scene.height, scene.width)
    rows = raycast.primitive_rows(scene, transparent=False)
    words, order = tile_words(scene, rectangles(scene, unit), tile, rows)
    ids = np.array(scene.object_ids, np.int32)
    lens, sky = jnp.stack(camera.lens(scene)), (scene.sky_top, scene.sky_bottom)
    return _Refs(
        words=words,
        order=jnp.asarray(order),
        axes=unit.axes,
        origin=unit.origin,
        extra=unit.extra,
        extra_square=unit.extra_square,
        appearance=jnp.stack(lookup.appearance_columns(scene), axis=1),
        texels=scene.texels if len(scene.texels) else jnp.zeros((1, 4), jnp.uint32),
        levels=jnp.asarray(scene.atlas.levels or [(0, 1, 1)], jnp.int32),
        lights=light_table if len(light_table) else jnp.zeros((1, 1), jnp.float32),
        view=jnp.concatenate([lens, jnp.stack([scene.znear, scene.zfar]), rotation.reshape(9), *sky, scene.fovy[None]]),
        ids=jnp.asarray(ids),
    )


def probe() -> jax.stages.Traced:
    """Trace a small instance of the kernel: every type of object, two lights, a texture, a sky."""
    mj_model = mujoco.MjModel.from_xml_string(_PROBE)
    mj_data = mujoco.MjData(mj_model)
    mujoco.mj_forward(mj_model, mj_data)
    scene = Scene.from_mjmodel(mj_model, 0, 8, 8)
    prepared = jax.eval_shape(lambda scene: prepare(scene, mj_data), scene)  # avoids compilation
    outputs = Outputs(rgb=True, depth=True, segmentation=True, quantized=True)
    assert supports(scene)
    return jax.jit(functools.partial(draw, outputs)).trace(scene, *prepared)


def _full_block(shape: tuple[int, ...]) -> pl.BlockSpec:
    """Return a block that gives every program the whole array."""
    return pl.BlockSpec(shape, lambda tile_index: (0,) * len(shape))


def _without_arrays(scene: Scene) -> Scene:
    """Return the scene without its arrays, which a kernel must not capture."""
    leaves, structure = jax.tree.flatten(scene)
    return jax.tree.unflatten(structure, [None] * len(leaves))
