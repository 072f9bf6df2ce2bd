"""Design (b): rays walk bounding volume hierarchies without a stack, by skip pointers, in one program per tile.

`lane_walk`: every pixel walks the instances of its tile's list on its own, and waits for no neighbour to finish an instance.
`block_walk`: all pixels of a tile visit the same node at the same time, and a node is missed if all of them miss it.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plgpu

from benchmarks.mesh_kernels.structure import Structure
from benchmarks.mesh_kernels.views import Views, tile_lists
from jaxrl_vis_envs.compiling.gpu_kernels import kernel_call

_TINY = 1e-20
_SEAM = 1e-5  # as in `render.pixel.triangles`


class Settings(NamedTuple):
    """Shape of a program.

    Attributes:
        tile: Rows and columns.
        warps: Warps.
        steps: Nodes that a pixel may visit between two tests of triangles.
        scan: Candidates of the list that a pixel may look at between two tests of triangles.
        most: Instances that a tile's list holds.
    """

    tile: tuple[int, int] = (4, 8)
    warps: int = 1
    steps: int = 4
    scan: int = 2
    most: int = 96


class Images(NamedTuple):
    """Depth [I, P] float32 (m), geom [I, P] int32 (-1: sky) and colour [I, 3, P] uint8 of a design's images."""

    depth: jax.Array
    geom: jax.Array
    rgb: jax.Array


class Refs(NamedTuple):
    """Blocks of memory that a program reads."""

    near: Any
    rectangle: Any
    pose: Any
    mesh: Any
    octant: Any
    ids: Any
    depth: Any
    floor: Any
    list: Any
    count: Any
    nodes: Any
    maps: Any
    rgba: Any


def tile_pixels(size: int, tile: tuple[int, int], half: float) -> tuple[Any, Any, Any, Any, Any]:
    """Return row, column and index [P] int32 of a tile's pixels, and their rays' u and v [P] float32 at 1 m."""
    high, wide = tile
    across = np.int32(size // wide)
    index = pl.program_id(0)
    lane = jax.lax.broadcasted_iota(jnp.int32, (high * wide,), 0)
    row = jax.lax.div(index, across) * high + jax.lax.div(lane, np.int32(wide))
    column = jax.lax.rem(index, across) * wide + jax.lax.rem(lane, np.int32(wide))
    u = (2.0 * column.astype(jnp.float32) + (1.0 - size)) * np.float32(half / size)
    v = ((size - 1.0) - 2.0 * row.astype(jnp.float32)) * np.float32(half / size)
    return row, column, row * size + column, u, v


def gather(ref: Any, index: jax.Array, mask: jax.Array, *before: int) -> jax.Array:
    """Load ``ref[*before, index]`` where ``mask`` is set, 0 elsewhere."""
    place = tuple(jnp.full(index.shape, number, jnp.int32) for number in before)
    return plgpu.load(ref.at[(*place, index)], mask=mask, other=0.0 if ref.dtype == jnp.float32 else 0)


def gather_row(ref: Any, index: jax.Array, mask: jax.Array, columns: Any) -> list[jax.Array]:
    """Load some columns of the rows ``index`` where ``mask`` is set, 0 elsewhere."""
    other = 0.0 if ref.dtype == jnp.float32 else 0
    places = [(index, jnp.full(index.shape, column, jnp.int32)) for column in columns]
    return [plgpu.load(ref.at[place], mask=mask, other=other) for place in places]


def box_test(words: tuple, begin: tuple, inverse: tuple, best: jax.Array, znear: float) -> jax.Array:
    """Return True where rays meet a node's box in front of ``best``; ``begin`` is the start times ``inverse``."""
    enters, leaves = [], []
    for axis in range(3):
        low, high = (((word >> 10 * axis) & 1023).astype(jnp.float32) for word in words)
        one, other = low * inverse[axis] - begin[axis], high * inverse[axis] - begin[axis]
        enters.append(jnp.minimum(one, other))
        leaves.append(jnp.maximum(one, other))
    enter = jnp.maximum(jnp.maximum(enters[0], enters[1]), jnp.maximum(enters[2], znear))
    leave = jnp.minimum(jnp.minimum(leaves[0], leaves[1]), jnp.minimum(leaves[2], best))
    # A ray within a face of a box of no thickness rounds either way.
    return enter <= leave * (1.0 + 1e-6)


def triangle_test(row: list, start: tuple, direction: tuple, best: jax.Array, znear: float) -> tuple[jax.Array, jax.Array]:
    """Return the depth at which rays meet a triangle from outside, and True where that is in front of ``best``."""

    def along(axis: int, vector: tuple) -> jax.Array:
        return row[4 * axis] * vector[0] + row[4 * axis + 1] * vector[1] + row[4 * axis + 2] * vector[2]

    slope = along(2, direction)
    t = -(along(2, start) + row[11]) / jnp.where(slope < 0.0, slope, -1.0)
    point = tuple(s + t * d for s, d in zip(start, direction, strict=True))
    first, second = along(0, point) + row[3], along(1, point) + row[7]
    margin = jnp.minimum(jnp.minimum(first, second), 1.0 - first - second)
    return t, (slope < 0.0) & (margin >= -_SEAM) & (t > znear) & (t < best)


def to_mesh(pose: list, u: jax.Array, v: jax.Array) -> tuple[tuple, tuple, tuple]:
    """Return the rays' direction in the frame of a mesh, its inverse, and the start times the inverse."""
    direction = tuple(pose[3 * i] * u + pose[3 * i + 1] * v - pose[3 * i + 2] for i in range(3))
    inverse = tuple(1.0 / jnp.where(jnp.abs(d) < _TINY, _TINY, d) for d in direction)
    return direction, inverse, tuple(pose[9 + i] * inverse[i] for i in range(3))


def _lane_kernel(*refs: Any, structure: Structure, settings: Settings, size: int, half: float, znear: float) -> None:
    ins, outs = Refs(*refs[:13]), refs[13:]
    _, _, pixel, u, v = tile_pixels(size, settings.tile, half)
    row, column = jax.lax.div(pixel, np.int32(size)), jax.lax.rem(pixel, np.int32(size))
    lanes = pixel.shape
    end, leaf_size = structure.steps, structure.leaf
    count = jnp.minimum(ins.count[...], settings.most)
    zero, izero = jnp.zeros(lanes, jnp.float32), jnp.zeros(lanes, jnp.int32)
    best = plgpu.load(ins.depth.at[pixel])

    def going(state: tuple) -> jax.Array:
        place, node = state[:2]
        return jnp.max(((node < end) | (place < count)).astype(jnp.int32)) > 0

    def fetch(state: tuple) -> tuple:
        place, node, slot, ray, best = state
        fresh = jnp.zeros(lanes, bool)
        for _ in range(settings.scan):
            wants = (node >= end) & (place < count) & ~fresh
            candidate = gather(ins.list, jnp.where(wants, place, 0), wants)
            sides = gather(ins.rectangle, candidate, wants)
            nearer = gather(ins.near, candidate, wants) < best
            covers = (column >= (sides & 255)) & (column <= ((sides >> 8) & 255))
            covers &= (row >= ((sides >> 16) & 255)) & (row <= ((sides >> 24) & 255))
            takes = wants & covers & nearer
            slot, fresh = jnp.where(takes, candidate, slot), fresh | takes
            # The list is sorted: all that follows is farther away, too.
            place = jnp.where(wants, jnp.where(nearer, place + 1, count), place)

        def begin() -> tuple:
            pose = gather_row(ins.pose, slot, fresh, range(12))
            mesh, octant = gather(ins.mesh, slot, fresh), gather(ins.octant, slot, fresh)
            direction, inverse, start = to_mesh(pose, u, v)
            new = (*pose[9:], *direction, *inverse, *start, (mesh * 8 + octant) * end, mesh * structure.triangles)
            return tuple(jnp.where(fresh, one, other) for one, other in zip(new, ray, strict=True))

        ray = jax.lax.cond(jnp.max(fresh.astype(jnp.int32)) > 0, begin, lambda: ray)
        return place, jnp.where(fresh, 0, node), slot, ray, best

    def advance(state: tuple) -> tuple:
        place, node, slot, ray, best, hit_slot, hit_row = state
        idle = jnp.max(((node >= end) & (place < count)).astype(jnp.int32)) > 0
        place, node, slot, ray, best = jax.lax.cond(
            idle, lambda: fetch((place, node, slot, ray, best)), lambda: (place, node, slot, ray, best)
        )
        start, direction, inverse, begin, base, rows = ray[:3], ray[3:6], ray[6:9], ray[9:12], ray[12], ray[13]
        leaf = jnp.full(lanes, -1, jnp.int32)
        for _ in range(settings.steps):
            active = (node < end) & (leaf < 0)
            address = jnp.where(active, base + node, 0)
            low, high, link = gather_row(ins.nodes, address, active, range(3))
            meets = active & box_test((low, high), begin, inverse, best, znear)
            number = (link >> 16) & 0xFFFF
            leaf = jnp.where(meets & (number > 0), number - 1, leaf)
            node = jnp.where(active, jnp.where(meets & (number == 0), node + 1, link & 0xFFFF), node)

        def triangles() -> tuple:
            nearest, triangle = best, hit_row
            for corner in range(leaf_size):
                place = jnp.where(leaf >= 0, rows + leaf * leaf_size + corner, 0)
                numbers = gather_row(ins.maps, place, leaf >= 0, range(12))
                t, meets = triangle_test(numbers, start, direction, nearest, znear)
                meets &= leaf >= 0
                nearest, triangle = jnp.where(meets, t, nearest), jnp.where(meets, place, triangle)
            return nearest, triangle

        nearest, triangle = jax.lax.cond(jnp.max(leaf) >= 0, triangles, lambda: (best, hit_row))
        return place, node, slot, ray, nearest, jnp.where(nearest < best, slot, hit_slot), triangle

    begin_state = (izero, izero + end, izero, (*(zero,) * 12, izero, izero), best, izero - 1, izero)
    state = jax.lax.while_loop(going, advance, begin_state)
    best, hit_slot, hit_row = state[4:]
    shade(ins, outs, pixel, best, hit_slot, hit_row)


def _block_kernel(*refs: Any, structure: Structure, settings: Settings, size: int, half: float, znear: float) -> None:
    ins, outs = Refs(*refs[:13]), refs[13:]
    _, _, pixel, u, v = tile_pixels(size, settings.tile, half)
    lanes = pixel.shape
    end, leaf_size = structure.steps, structure.leaf
    count = jnp.minimum(ins.count[...], settings.most)
    best = plgpu.load(ins.depth.at[pixel])
    izero = jnp.zeros(lanes, jnp.int32)

    def one_instance(state: tuple) -> tuple:
        place, best, hit_slot, hit_row = state
        slot = ins.list[place]
        pose = [ins.pose[slot, column] for column in range(12)]
        direction, inverse, begin = to_mesh(pose, u, v)
        start = tuple(pose[9:])
        base, rows = (ins.mesh[slot] * 8 + ins.octant[slot]) * end, ins.mesh[slot] * structure.triangles

        def visit(state: tuple) -> tuple:
            node, best, hit_slot, hit_row = state
            low, high, link = (ins.nodes[base + node, word] for word in range(3))
            meets = jnp.max(box_test((low, high), begin, inverse, best, znear).astype(jnp.int32)) > 0
            number = (link >> 16) & 0xFFFF

            def triangles() -> tuple:
                nearest, row = best, hit_row
                for corner in range(leaf_size):
                    place = rows + (number - 1) * leaf_size + corner
                    t, inside = triangle_test(
                        [ins.maps[place, column] for column in range(12)], start, direction, nearest, znear
                    )
                    nearest, row = jnp.where(inside, t, nearest), jnp.where(inside, place, row)
                return nearest, row

            nearest, row = jax.lax.cond(meets & (number > 0), triangles, lambda: (best, hit_row))
            node = jnp.where(meets & (number == 0), node + 1, link & 0xFFFF)
            return node, nearest, jnp.where(nearest < best, slot, hit_slot), row

        _, best, hit_slot, hit_row = jax.lax.while_loop(
            lambda state: state[0] < end, visit, (jnp.int32(0), best, hit_slot, hit_row)
        )
        return place + 1, best, hit_slot, hit_row

    def going(state: tuple) -> jax.Array:
        place = jnp.minimum(state[0], settings.most - 1)
        return (state[0] < count) & (ins.near[jnp.where(state[0] < count, ins.list[place], 0)] < jnp.max(state[1]))

    state = jax.lax.while_loop(going, one_instance, (jnp.int32(0), best, izero - 1, izero))
    shade(ins, outs, pixel, *state[1:])


def shade(ins: Refs, outs: Any, pixel: jax.Array, depth: jax.Array, slot: jax.Array, row: jax.Array) -> None:
    """Store depth, geom and a colour: that of the geom, darker the more its normal is turned away from the camera's axis.

    Args:
        ins: Blocks of memory.
        outs: Depth, geom and colour.
        pixel: [P] int32.
        depth: [P] float32, m.
        slot: [P] int32, instance in ``ins``, -1 for the floor and the sky.
        row: [P] int32, triangle in ``ins.maps``.
    """
    hit = slot >= 0
    place, row = jnp.where(hit, slot, 0), jnp.where(hit, row, 0)
    pose = gather_row(ins.pose, place, hit, range(12))
    height = gather_row(ins.maps, row, hit, (8, 9, 10))
    normal = [sum(pose[3 * i + j] * height[i] for i in range(3)) for j in range(3)]
    length = jax.lax.rsqrt(normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2] + 1e-20)
    facing = jnp.where(hit, jnp.abs(normal[2]) * length, 1.0)
    floor = plgpu.load(ins.floor.at[pixel])
    geom = jnp.where(hit, gather(ins.ids, place, hit), floor)
    plgpu.store(outs[0].at[pixel], depth)
    plgpu.store(outs[1].at[pixel], geom)
    for channel in range(3):
        colour = gather(ins.rgba, jnp.maximum(geom, 0), geom >= 0, channel)
        value = (facing * colour * 255.0 + 0.5).astype(jnp.int32).astype(jnp.uint8)
        plgpu.store(outs[2].at[jnp.full(pixel.shape, channel, jnp.int32), pixel], value)


def draw(
    views: Views,
    structure: Structure,
    arrays: dict[str, jax.Array],
    size: int,
    half: float,
    znear: float,
    settings: Settings,
    by_block: bool = False,
    interpret: bool = False,
) -> tuple[Images, jax.Array]:
    """Draw all images.

    Args:
        views: The images.
        structure: Structures of the meshes, of which only numbers are read.
        arrays: ``nodes``, ``maps``, and ``rgba`` [4, ngeom] float32.
        size: Height and width.
        half: Tangent of half the field of view.
        znear: Depth of the near plane, m.
        settings: Shape of a program.
        by_block: All pixels of a tile visit the same nodes.
        interpret: Run without a GPU.

    Returns:
        The images, and the largest number of instances in a tile's list.
    """
    lists, counts = tile_lists(views, size, settings.tile, settings.most, interpret)
    inputs, specs = inputs_and_specs(views, lists, counts, (arrays["nodes"], arrays["maps"], arrays["rgba"]), size)
    chosen = _block_kernel if by_block else _lane_kernel

    def kernel(*refs: Any) -> None:
        chosen(*refs, structure=structure, settings=settings, size=size, half=half, znear=znear)

    name = "block_walk" if by_block else "lane_walk"
    return launch(kernel, inputs, specs, lists, size, settings.warps, interpret, name), jnp.max(counts)


def own(*shape: int) -> pl.BlockSpec:
    """Return a block: an image's part of an array [I, *shape]."""
    return pl.BlockSpec((None, *shape), lambda tile, image: (image, *(0,) * len(shape)))


def whole(array: jax.Array) -> pl.BlockSpec:
    """Return a block: all of an array."""
    return pl.BlockSpec(array.shape, lambda tile, image: (0,) * array.ndim)


def inputs_and_specs(
    views: Views, lists: jax.Array, counts: jax.Array, tables: tuple, size: int
) -> tuple[list[jax.Array], list[pl.BlockSpec]]:
    """Return the arrays of `Refs`, and their blocks; ``tables`` are ``nodes``, ``maps`` and ``rgba``."""
    padded, pixels = views.near.shape[1], size * size
    kept = (views.near, views.rectangle, views.pose, views.mesh, views.octant, views.ids, views.depth, views.floor)
    listed = [
        pl.BlockSpec((None, None, lists.shape[2]), lambda tile, image: (image, tile, 0)),
        pl.BlockSpec((None, None), lambda tile, image: (image, tile)),
    ]
    specs = [own(padded), own(padded), own(padded, 12), own(padded), own(padded), own(padded), own(pixels), own(pixels)]
    return [*kept, lists, counts, *tables], [*specs, *listed, *map(whole, tables)]


def launch(
    kernel: Any, inputs: list, specs: list, lists: jax.Array, size: int, warps: int, interpret: bool, name: str
) -> Images:
    """Run one program per tile and image."""
    images, tiles = lists.shape[:2]
    pixels = size * size
    outs = kernel_call(
        kernel,
        out_shape=[
            jax.ShapeDtypeStruct((images, pixels), jnp.float32),
            jax.ShapeDtypeStruct((images, pixels), jnp.int32),
            jax.ShapeDtypeStruct((images, 3, pixels), jnp.uint8),
        ],
        grid=(tiles, images),
        in_specs=specs,
        out_specs=[own(pixels), own(pixels), own(3, pixels)],
        compiler_params=plgpu.CompilerParams(num_warps=warps, num_stages=1),
        interpret=interpret,
        name=name,
    )(*inputs)
    return Images(*outs)
