"""Design (a): rasterisation over bins.

`tiles`: a program per tile of pixels goes through its list of instances, tests their clusters of eight triangles against the
tile, 32 at a time, and the triangles of those that pass against every pixel.
`scatter`: a program per instance and image tests clusters of 64 triangles (facing away, out of view, between the pixels), then
gives every triangle a lane, which puts the few pixels that it covers into the image by an atomic minimum.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plgpu

from benchmarks.mesh_kernels import walk
from benchmarks.mesh_kernels.structure import CELLS, CLUSTER, FINE, SMALL, Structure
from benchmarks.mesh_kernels.views import FAR, Views, tile_lists
from jaxrl_vis_envs.compiling.gpu_kernels import kernel_call

_SLOTS = 511
"""Mask of the bits of a key that hold the instance; all ones: the background."""


class Settings(NamedTuple):
    """Shape of a program.

    Attributes:
        tile: Rows and columns (`tiles`).
        warps: Warps.
        most: Instances that a tile's list holds (`tiles`).
    """

    tile: tuple[int, int] = (8, 8)
    warps: int = 2
    most: int = 128


def draw(
    views: Views,
    structure: Structure,
    arrays: dict[str, jax.Array],
    size: int,
    half: float,
    znear: float,
    settings: Settings,
    design: str,
    interpret: bool = False,
) -> tuple[walk.Images, jax.Array]:
    """Draw all images by the ``design`` "tiles" or "scatter"; arguments and results as of `walk.draw`."""
    if design == "tiles":
        return _draw_tiles(views, structure, arrays, size, half, znear, settings, interpret)
    keys = _scatter(views, structure, arrays, size, half, znear, settings, interpret)
    return _resolve(views, arrays, size, half, keys), jnp.int32(0)


def _tile_kernel(*refs: Any, settings: Settings, size: int, half: float, znear: float, clusters: int) -> None:
    ins, (balls, back), outs = walk.Refs(*refs[:13]), refs[13:15], refs[15:]
    _, _, pixel, u, v = walk.tile_pixels(size, settings.tile, half)
    lanes = pixel.shape
    lane = jax.lax.broadcasted_iota(jnp.int32, (32,), 0)
    bounds = (jnp.min(u), jnp.max(u)), (jnp.min(v), jnp.max(v))
    count = jnp.minimum(ins.count[...], settings.most)
    best = plgpu.load(ins.depth.at[pixel])
    none = jnp.full(lanes, -1, jnp.int32)

    def one_instance(state: tuple) -> tuple:
        place, best, hit_slot, hit_row = state
        slot = ins.list[place]
        pose = [ins.pose[slot, number] for number in range(12)]
        turn = [back[slot, number] for number in range(12)]
        direction, _, _ = walk.to_mesh(pose, u, v)
        start, mesh = tuple(pose[9:]), ins.mesh[slot]

        def one_chunk(chunk: Any, state: tuple) -> tuple:
            first = mesh * clusters + chunk * 32
            x, y, z, radius = (plgpu.load(balls.at[jnp.full((32,), number, jnp.int32), first + lane]) for number in range(4))
            middle = [turn[3 * i] * x + turn[3 * i + 1] * y + turn[3 * i + 2] * z + turn[9 + i] for i in range(3)]
            ahead = -middle[2]
            meets = (radius >= 0.0) & (ahead + radius > znear) & (ahead - radius < jnp.max(state[0]))
            for (lowest, highest), across in zip(bounds, middle, strict=False):
                meets &= across - highest * ahead <= radius * jnp.sqrt(1.0 + highest * highest)
                meets &= lowest * ahead - across <= radius * jnp.sqrt(1.0 + lowest * lowest)
            bits = jnp.sum(jnp.where(meets, jnp.left_shift(jnp.int32(1), lane), 0))

            def one_cluster(state: tuple) -> tuple:
                bits, best, hit_slot, hit_row = state
                cluster = first + 31 - jax.lax.clz(bits & -bits)
                nearest, triangle = best, hit_row
                for number in range(SMALL):
                    place = cluster * SMALL + number
                    maps = [ins.maps[place, entry] for entry in range(12)]
                    t, inside = walk.triangle_test(maps, start, direction, nearest, znear)
                    nearest, triangle = jnp.where(inside, t, nearest), jnp.where(inside, place, triangle)
                return bits & (bits - 1), nearest, jnp.where(nearest < best, slot, hit_slot), triangle

            return jax.lax.while_loop(lambda state: state[0] != 0, one_cluster, (bits, *state))[1:]

        state = jax.lax.fori_loop(0, clusters // 32, one_chunk, (best, hit_slot, hit_row))
        return place + 1, *state

    def going(state: tuple) -> jax.Array:
        return (state[0] < count) & (ins.near[jnp.where(state[0] < count, ins.list[state[0]], 0)] < jnp.max(state[1]))

    state = jax.lax.while_loop(going, one_instance, (jnp.int32(0), best, none, none + 1))
    walk.shade(ins, outs, pixel, state[1], state[2], state[3])


def _draw_tiles(
    views: Views,
    structure: Structure,
    arrays: dict[str, jax.Array],
    size: int,
    half: float,
    znear: float,
    settings: Settings,
    interpret: bool,
) -> tuple[walk.Images, jax.Array]:
    lists, counts = tile_lists(views, size, settings.tile, settings.most, interpret)
    tables = (arrays["nodes"], arrays["small_maps"], arrays["rgba"])
    clusters = structure.balls.shape[1] // len(structure.radius)

    def kernel(*refs: Any) -> None:
        _tile_kernel(*refs, settings=settings, size=size, half=half, znear=znear, clusters=clusters)

    inputs, specs = walk.inputs_and_specs(views, lists, counts, tables, size)
    more = (arrays["balls"], views.back)
    specs += [walk.whole(arrays["balls"]), walk.own(*views.back.shape[1:])]
    return walk.launch(kernel, [*inputs, *more], specs, lists, size, settings.warps, interpret, "tiles"), jnp.max(counts)


def _scatter_kernel(*refs: Any, size: int, half: float, znear: float, clusters: int, interpret: bool) -> None:
    near, mesh_of, back, cones, corners, frames, _, keys = refs
    slot = pl.program_id(0)

    @pl.when(near[slot] < FAR)
    def _visible() -> None:
        turn = [back[slot, number] for number in range(12)]
        mesh = mesh_of[slot]
        low, unit = [frames[mesh, axis] for axis in range(3)], [frames[mesh, 3 + axis] for axis in range(3)]
        # From corners, stored as integers, to the camera's frame.
        map_ = [[turn[3 * i + j] * unit[j] for j in range(3)] for i in range(3)]
        shift = [sum(turn[3 * i + j] * (low[j] + 32768.0 * unit[j]) for j in range(3)) + turn[9 + i] for i in range(3)]
        lane32 = jax.lax.broadcasted_iota(jnp.int32, (32,), 0)

        def one_chunk(chunk: Any, carry: jax.Array) -> jax.Array:
            first = mesh * clusters + chunk * 32
            visible = _visible_clusters(cones, first + lane32, turn, size, half, znear)
            bits = jnp.sum(jnp.where(visible, jnp.left_shift(jnp.int32(1), lane32), 0))

            def one_cluster(bits: jax.Array) -> jax.Array:
                cluster = first + 31 - jax.lax.clz(bits & -bits)
                _scatter_cluster(corners, cluster, (map_, shift), slot, keys, (size, half, znear), interpret)
                return bits & (bits - 1)

            jax.lax.while_loop(lambda bits: bits != 0, one_cluster, bits)
            return carry

        jax.lax.fori_loop(0, clusters // 32, one_chunk, jnp.int32(0))


def _visible_clusters(cones: Any, index: jax.Array, turn: list, size: int, half: float, znear: float) -> jax.Array:
    """Return the mask of clusters that may face the camera and cover the middle of a pixel."""
    x, y, z, radius, *axis, cutoff = (
        plgpu.load(cones.at[jnp.full(index.shape, number, jnp.int32), index]) for number in range(8)
    )
    middle = [turn[3 * i] * x + turn[3 * i + 1] * y + turn[3 * i + 2] * z + turn[9 + i] for i in range(3)]
    facing = [turn[3 * i] * axis[0] + turn[3 * i + 1] * axis[1] + turn[3 * i + 2] * axis[2] for i in range(3)]
    distance = jnp.sqrt(middle[0] * middle[0] + middle[1] * middle[1] + middle[2] * middle[2])
    away = middle[0] * facing[0] + middle[1] * facing[1] + middle[2] * facing[2]
    visible = (radius >= 0.0) & (away < cutoff * distance + radius)
    ahead = -middle[2]
    around = ahead - radius <= znear
    depth = jnp.where(around, 1.0, ahead)
    scale = size / (2.0 * half)
    for coordinate in middle[:2]:
        tangent = coordinate / depth
        reach = radius * (1.0 + jnp.abs(tangent)) / jnp.where(around, 1.0, ahead - radius)
        first = jnp.ceil((tangent - reach) * scale + (size - 1) * 0.5 - 1e-3)
        last = jnp.floor((tangent + reach) * scale + (size - 1) * 0.5 + 1e-3)
        visible &= around | ((first <= last) & (last >= 0.0) & (first <= size - 1.0))
    return visible & (ahead + radius > znear)


def _scatter_cluster(corners: Any, cluster: Any, frame: tuple, slot: Any, keys: Any, lens: tuple, interpret: bool) -> None:
    """Put the triangles of one cluster into the image, one per lane. Those that cross the near plane are left out."""
    map_, shift = frame
    size, half, znear = lens
    lane = jax.lax.broadcasted_iota(jnp.int32, (CLUSTER,), 0)
    stored = [
        plgpu.load(corners.at[jnp.full((CLUSTER,), number, jnp.int32), cluster * CLUSTER + lane]).astype(jnp.float32)
        for number in range(9)
    ]
    points = []
    for corner in range(3):
        whole = stored[3 * corner : 3 * corner + 3]
        points.append([map_[i][0] * whole[0] + map_[i][1] * whole[1] + map_[i][2] * whole[2] + shift[i] for i in range(3)])
    aheads = [-point[2] for point in points]
    in_front = (aheads[0] > znear) & (aheads[1] > znear) & (aheads[2] > znear)
    weights = [1.0 / jnp.where(in_front, ahead, 1.0) for ahead in aheads]
    scale, centre = np.float32(size / (2.0 * half)), np.float32((size - 1) * 0.5)
    x = [point[0] * weight * scale + centre for point, weight in zip(points, weights, strict=True)]
    y = [point[1] * weight * scale + centre for point, weight in zip(points, weights, strict=True)]
    area = (x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0])
    lows = [jnp.maximum(jnp.ceil(jnp.minimum(jnp.minimum(a, b), c) - 1e-4), 0.0) for a, b, c in (x, y)]
    highs = [jnp.minimum(jnp.floor(jnp.maximum(jnp.maximum(a, b), c) + 1e-4), size - 1.0) for a, b, c in (x, y)]
    wide, high = highs[0] - lows[0] + 1.0, highs[1] - lows[1] + 1.0
    covers = in_front & (area > 0.0) & (wide > 0.0) & (high > 0.0)
    number = jnp.where(covers, wide * high, 0.0)
    inverse = 1.0 / jnp.where(area > 0.0, area, 1.0)

    def one_pixel(state: tuple) -> tuple:
        left, column, line = state
        over_x, over_y = column - x[0], line - y[0]
        first = (over_x * (y[2] - y[0]) - (x[2] - x[0]) * over_y) * inverse
        second = ((x[1] - x[0]) * over_y - over_x * (y[1] - y[0])) * inverse
        rest = 1.0 - first - second
        inside = (left > 0.0) & (jnp.minimum(jnp.minimum(first, second), rest) >= -1e-5)
        depth = 1.0 / (rest * weights[0] + first * weights[1] + second * weights[2])
        key = _key(depth, slot)
        pixel = jnp.where(inside, (size - 1 - line.astype(jnp.int32)) * size + column.astype(jnp.int32), 0)
        if interpret:  # atomics have no masks there
            keys[...] = keys[...].at[pixel].min(jnp.where(inside, key, np.inf))
        else:
            inside &= key < plgpu.load(keys.at[pixel], mask=inside, other=0.0)

            @pl.when(jnp.max(inside.astype(jnp.int32)) > 0)
            def _() -> None:  # an atomic waits for all of the program's memory, and most triangles are hidden
                plgpu.atomic_min(keys, (pixel,), key, mask=inside)

        wraps = column >= highs[0]
        return left - 1.0, jnp.where(wraps, lows[0], column + 1.0), jnp.where(wraps, line + 1.0, line)

    jax.lax.while_loop(lambda state: jnp.max(state[0]) > 0.0, one_pixel, (number, lows[0], lows[1]))


def _key(depth: jax.Array, slot: Any) -> jax.Array:
    """Return depths whose lowest nine bits hold an instance: floats, since Pallas has an atomic minimum of vectors for them."""
    bits = (jax.lax.bitcast_convert_type(depth, jnp.int32) & ~_SLOTS) | slot
    return jax.lax.bitcast_convert_type(bits, jnp.float32)


def _scatter(
    views: Views,
    structure: Structure,
    arrays: dict[str, jax.Array],
    size: int,
    half: float,
    znear: float,
    settings: Settings,
    interpret: bool,
) -> jax.Array:
    """Return the smallest `_key` of each pixel, [I, P] float32."""
    images, padded = views.near.shape
    assert padded <= _SLOTS + 1
    clusters = structure.cones.shape[1] // len(structure.radius)
    frames = jnp.asarray(np.concatenate([structure.low, structure.cell * CELLS / FINE], axis=1), jnp.float32)
    background = _key(views.depth, np.int32(_SLOTS))

    def kernel(*refs: Any) -> None:
        _scatter_kernel(*refs, size=size, half=half, znear=znear, clusters=clusters, interpret=interpret)

    inputs = (views.near, views.mesh, views.back, arrays["cones"], arrays["corners"], frames, background)
    return kernel_call(
        kernel,
        out_shape=jax.ShapeDtypeStruct(background.shape, jnp.float32),
        grid=(padded, images),
        in_specs=[
            *(walk.own(padded), walk.own(padded), walk.own(padded, 12)),
            *(walk.whole(array) for array in inputs[3:6]),
            walk.own(size * size),
        ],
        out_specs=walk.own(size * size),
        input_output_aliases={6: 0},
        compiler_params=plgpu.CompilerParams(num_warps=settings.warps, num_stages=1),
        interpret=interpret,
        name="scatter",
    )(*inputs)


def _resolve(views: Views, arrays: dict[str, jax.Array], size: int, half: float, keys: jax.Array) -> walk.Images:
    """Convert keys to images; normals are those of the depth's slope, which suffices to time one colour."""
    bits = jax.lax.bitcast_convert_type(keys, jnp.int32)
    slot, near = bits & _SLOTS, jax.lax.bitcast_convert_type(bits & ~_SLOTS, jnp.float32)
    hit = slot != _SLOTS
    depth = jnp.where(hit, near, views.depth)
    place = jnp.where(hit, slot, 0)
    geom = jnp.where(hit, jnp.take_along_axis(views.ids, place, axis=1), views.floor)
    plane = depth.reshape(-1, size, size)
    pitch = plane * (2.0 * half / size)
    slopes = [(jnp.roll(plane, -1, axis) - plane) / pitch for axis in (1, 2)]
    facing = jax.lax.rsqrt(1.0 + slopes[0] ** 2 + slopes[1] ** 2).reshape(depth.shape)
    colour = jnp.where(geom >= 0, arrays["rgba"][:3, jnp.maximum(geom, 0)], 0.0)  # [3, I, P]
    rgb = (jnp.where(hit, facing, 1.0) * colour * 255.0 + 0.5).astype(jnp.uint8)
    return walk.Images(depth, geom, jnp.moveaxis(rgb, 0, 1))
