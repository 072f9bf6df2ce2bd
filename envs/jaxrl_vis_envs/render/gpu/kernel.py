"""The same image as one GPU kernel (Pallas, by Triton), for scenes of plain primitives: most scenes that robots learn in.

As XLA operations, every pixel meets every object. Here a program draws one tile of one image: it walks through the objects,
type by type, skips each whose bounding rectangle in the image misses the tile, and goes on to shade what it found without
leaving the chip. What happens to a pixel is the same code as in plain JAX (`raycast.entry`, `surface.meet`, `shade.shade`), but
in the kernel it reads scalars and blocks of memory instead of arrays.
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
from jaxrl_vis_envs.render.outputs import Outputs, Planes
from jaxrl_vis_envs.render.pixel import lights, lookup, raycast, shade, shapes, surface
from jaxrl_vis_envs.render.pixel.prepare import prepare
from jaxrl_vis_envs.render.scene import Scene

# Measured on an H200: pixels of a tile (a power of two, of which a few may be idle), and how a program is run.
_PIXELS = 128
_COMPILER = plgpu.CompilerParams(num_warps=4, num_stages=1)
_ENDLESS = 1e9
# Where the camera's numbers are in the vector that the kernel reads.
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


def takes(scene: Scene, outputs: Outputs) -> bool:
    """Returns whether the kernel draws these planes on the platform that is being traced for: any of a scene that it supports.

    But for labels where what reflects may coincide with something else.
    """
    return supports(scene) and not (outputs.segmentation and scene.reordered) and use_gpu_kernels(probe)


def supports(scene: Scene) -> bool:
    """Whether the kernel can draw this scene, wherever it runs: opaque primitives without shadows or haze."""
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
    appearance: Any
    texels: Any
    levels: Any
    lights: Any
    view: Any
    ids: Any


def _nearest(scene: Scene, refs: _Refs, place: Any, rays: Rays, znear: Any, best: tuple) -> tuple:
    """The least key of the objects of a tile, given ``best``: (key,), or (bits of the depth, row) where rows are kept apart."""
    mask = raycast.code_mask(scene)
    start, direction, inverse_square = camera.ray_parts(scene, rays)
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
                if raycast.culls(scene, kind):
                    meets = meets & raycast.one_sided(refs.origin[index, 2], refs.axes[index, 2, 2])
                bits = jax.lax.bitcast_convert_type(t, jnp.int32)
                if len(best) == 1:
                    key = (bits & ~mask) | index
                    return left & (left - 1), (jnp.minimum(best[0], jnp.where(meets & (t > znear), key, best[0])),)
                nearest, row = best
                nearer = meets & (t > znear) & ((bits < nearest) | ((bits == nearest) & (index < row)))
                return left & (left - 1), (jnp.where(nearer, bits, nearest), jnp.where(nearer, index, row))

            _, best = jax.lax.while_loop(lambda carry: carry[0] != 0, one_object, (bits & own, best))
    return best


def _kernel(*refs, scene: Scene, outputs: Outputs, tile: tuple[int, int]):
    count = len(_Refs._fields)
    refs, out = _Refs(*refs[:count]), list(refs[count:])
    high, wide = tile
    across = np.int32(-(-scene.width // wide))
    place = pl.program_id(0)
    top, left = jax.lax.div(place, across) * high, jax.lax.rem(place, across) * wide
    lane = jax.lax.broadcasted_iota(jnp.int32, (_PIXELS,), 0)
    row, column = top + jax.lax.div(lane, jnp.int32(wide)), left + jax.lax.rem(lane, jnp.int32(wide))
    inside = (lane < high * wide) & (row < scene.height) & (column < scene.width)

    middle_u, middle_v, half_u, half_v = (refs.view[index] for index in _LENS)
    znear, zfar = (refs.view[index] for index in _CLIP)
    u = middle_u + (2.0 * column.astype(jnp.float32) + (1.0 - scene.width)) * (1.0 / scene.width) * half_u
    v = middle_v + ((scene.height - 1.0) - 2.0 * row.astype(jnp.float32)) * (1.0 / scene.height) * half_v
    rays = Rays(u, v)

    mask = raycast.code_mask(scene)
    sky_key = (jax.lax.bitcast_convert_type(zfar, jnp.int32) & ~mask) | mask
    sky = jnp.broadcast_to(sky_key, (_PIXELS,))
    if raycast.keeps_rows(scene):
        none = len(scene.object_ids)
        best, index = _nearest(scene, refs, place, rays, znear, (sky, jnp.full((_PIXELS,), none, jnp.int32)))
        sees = index != none
    else:
        (best,) = _nearest(scene, refs, place, rays, znear, (sky,))
        index = best & mask
        sees = index != mask
    near = jax.lax.bitcast_convert_type(best & ~mask, jnp.float32)
    pixel = row * scene.width + column

    def store(value, plane=None):
        ref = out[0].at[pixel] if plane is None else out[0].at[plane, pixel]
        plgpu.store(ref, value.astype(out[0].dtype), mask=inside)

    top_colour, bottom_colour = ([refs.view[index] for index in colour] for colour in (_SKY_TOP, _SKY_BOTTOM))
    texels: Any = _BlockTexels(refs.texels, refs.levels)
    inner = scene.replace(sky_top=top_colour, sky_bottom=bottom_colour, zfar=zfar, fovy=refs.view[_FOVY], texels=texels)
    zero = jnp.zeros((_PIXELS,), jnp.float32)
    far, normal, colour = zero, (zero,) * 3, (zero,) * 3
    if outputs.rgb or outputs.depth or outputs.normals or outputs.distance:

        def surfaces():
            cell = _fetch(refs, jnp.where(sees, index, 0))
            hit = surface.meet(inner, cell, None, rays, near)
            colour = (zero,) * 3
            if outputs.rgb:
                colour = shade.shade(inner, None, lights.unpack(scene, refs.lights), cell, hit, rays)
            return hit.depth, tuple(hit.normal), tuple(colour)

        # A whole tile of sky is common.
        far, normal, colour = jax.lax.cond(jnp.max(sees.astype(jnp.int32)) > 0, surfaces, lambda: (far, normal, colour))
        far = jnp.where(sees, far, zfar)
    if outputs.rgb:

        def with_sky():
            rotation = _Matrix([[refs.view[_ROTATION[3 * i + j]] for j in range(3)] for i in range(3)])
            background = shade.sky(inner, rotation, rays)
            return tuple(jnp.where(sees, front, back) for front, back in zip(colour, background, strict=True))

        colour = jax.lax.cond(jnp.min(sees.astype(jnp.int32)) > 0, lambda: colour, with_sky)
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
            store(jnp.where(sees, value, 0.0), plane)
        out.pop(0)
    if outputs.distance:
        store(jnp.where(sees, far * camera.ray_length(scene, rays), zfar))
        out.pop(0)
    if outputs.segmentation:
        store(jnp.where(sees, plgpu.load(refs.ids.at[jnp.where(sees, index, 0)]), -1))


def _fetch(refs: _Refs, index: jax.Array) -> lookup.Row:
    """Of each pixel's object, the values that `surface.meet` and `shade.shade` need."""
    columns = [_column(refs.axes, index, i, j) for i in range(3) for j in range(3)]
    columns += [_column(refs.origin, index, i) for i in range(3)] + [_column(refs.extra, index)]
    return lookup.row_of(columns + [_column(refs.appearance, index, number) for number in range(refs.appearance.shape[1])])


def _column(ref: Any, index: jax.Array, *place: int) -> jax.Array:
    """One column of the rows ``index`` [P] of a block of memory."""
    return plgpu.load(ref.at[(index, *(jnp.full(index.shape, number, jnp.int32) for number in place))])


class _BlockTexels:
    """The atlas as blocks of memory, see `sampling.Texels`."""

    few_textures = True  # many tiles see nothing that has one
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
    """Scalars that are read like an array."""

    def __init__(self, rows: list):
        self.rows = rows

    def __getitem__(self, place: tuple[int, int]) -> Any:
        return self.rows[place[0]][place[1]]


def draw(
    outputs: Outputs,
    scene: Scene,
    rotation: jax.Array,
    unit: shapes.UnitShapes,
    light_table: jax.Array,
    interpret: bool = False,
) -> Planes:
    """Draws one environment; ``jax.vmap`` it for a batch. Not differentiable.

    Args:
        outputs: Which planes.
        scene: One that the kernel `supports`.
        rotation: [3, 3] float32 of the camera, see `camera.camera_pose`.
        unit: The drawn objects.
        light_table: From `lights.pack`.
        interpret: Run without a GPU, slowly.

    Returns:
        The planes.
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
        appearance=jnp.stack(lookup.appearance_columns(scene), axis=1),
        texels=scene.texels if len(scene.texels) else jnp.zeros((1, 4), jnp.uint32),
        levels=jnp.asarray(scene.atlas.levels or [(0, 1, 1)], jnp.int32),
        lights=light_table if len(light_table) else jnp.zeros((1, 1), jnp.float32),
        view=jnp.concatenate([lens, jnp.stack([scene.znear, scene.zfar]), rotation.reshape(9), *sky, scene.fovy[None]]),
        ids=jnp.asarray(ids),
    )
    pixels = scene.height * scene.width
    # In the order in which the kernel writes them.
    kinds = {
        "rgb": ((3, pixels), jnp.uint8 if outputs.quantized else jnp.float32),
        "depth": ((pixels,), jnp.float32),
        "normals": ((3, pixels), jnp.float32),
        "distance": ((pixels,), jnp.float32),
        "segmentation": ((pixels,), jnp.int32),
    }
    drawn = {name: jax.ShapeDtypeStruct(*kind) for name, kind in kinds.items() if getattr(outputs, name)}
    planes = kernel_call(
        functools.partial(_kernel, scene=_without_arrays(scene), outputs=outputs, tile=tile),
        out_shape=list(drawn.values()),
        grid=(words.shape[0],),
        in_specs=[_whole(array.shape) for array in inputs],
        out_specs=[_whole(like.shape) for like in drawn.values()],
        compiler_params=_COMPILER,
        interpret=interpret,
        name="draw_tiles",
    )(*inputs)
    upright = {
        name: plane.reshape(*plane.shape[:-1], scene.height, scene.width) for name, plane in zip(drawn, planes, strict=True)
    }
    return Planes(**{**dict.fromkeys(Planes._fields), **upright})


def probe() -> None:
    """Compiles a small instance of the kernel."""
    probe_program().lower().compile()


def probe_program() -> Any:
    """A small instance of the kernel, traced (`jax.stages.Traced`): every type of object, two lights, a texture, a sky."""
    mj_model = mujoco.MjModel.from_xml_string(_PROBE)
    mj_data = mujoco.MjData(mj_model)
    mujoco.mj_forward(mj_model, mj_data)
    scene = Scene.from_mjmodel(mj_model, 0, 8, 8)
    prepared = jax.eval_shape(lambda scene: prepare(scene, mj_data), scene)  # nothing is compiled for it
    outputs = Outputs(rgb=True, depth=True, segmentation=True, quantized=True)
    assert supports(scene)
    return jax.jit(functools.partial(draw, outputs)).trace(scene, *prepared)


def _whole(shape: tuple[int, ...]) -> pl.BlockSpec:
    """Every program sees all of it."""
    return pl.BlockSpec(shape, lambda place: (0,) * len(shape))


def _without_arrays(scene: Scene) -> Scene:
    """A kernel must not capture any."""
    leaves, structure = jax.tree.flatten(scene)
    return jax.tree.unflatten(structure, [None] * len(leaves))
