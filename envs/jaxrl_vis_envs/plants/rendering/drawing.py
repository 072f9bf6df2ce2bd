"""Renderer of fields, tile by tile: the first surface along each ray, and its colour.

    tables.build_view -> View -> draw: for each tile of up to 64 x 64 pixels
        its cones, its triangles, the ground       -> depth and row of the nearest surface  `_first_hits`
        texture and light at the hit               -> colour                                `shading`
        mean over a pixel's rays                   -> radiance, instance and depth

One compiled program serves all views of a size. On a CPU, tiles are rendered sequentially, by one thread per core; on an
accelerator, many at a time, batched by similar amounts of work. Memory: the images, and one batch of tiles.
"""

import concurrent.futures
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs.compiling.compilation import compiler_options
from jaxrl_vis_envs.cores import num_cores
from jaxrl_vis_envs.plants.rendering.shading import Hit, Shot, Tables, shade
from jaxrl_vis_envs.plants.rendering.surfaces import GROUND, NOTHING
from jaxrl_vis_envs.plants.rendering.tables import CONE_HIT, FAR, NEAR, TRIANGLE_HIT, View, tile_size

_GROUND_FAR = 3.5  # m: beyond, the ground is black at night
_HORIZON = 200.0  # m: by day
# The rays of a pixel have distinct subpixel columns and rows, so that edges of any direction are antialiased.
_RAYS = {1: ((0.0, 0.0),), 4: ((-0.125, -0.375), (0.375, -0.125), (-0.375, 0.125), (0.125, 0.375))}
_TILES_PER_BATCH = 256  # on an accelerator
# Number of surfaces tested per loop iteration on an accelerator, where reading and writing the hits so far in each iteration
# takes longer than testing a surface.
_SURFACES_PER_STEP = 8


def render_view(
    view: View, shot: Shot, width: int, height: int, samples: int, batch_size: int | None = None
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Render a view.

    Args:
        view: Surfaces visible to the camera.
        shot: Camera and light.
        width, height: Image size, pixels.
        samples: Rays per pixel, 1 or 4; instance and depth are those of a ray through the pixel's centre.
        batch_size: Number of tiles per batch; by default chosen for the platform.

    Returns:
        Radiance [height, width, 3] float32, instance [height, width] int32 and planar depth [height, width] float32 in m
        (infinite if nothing is hit).
    """
    tables = Tables(*(jnp.asarray(getattr(view, name)) for name in Tables._fields))
    work = (view.cone_ranges[:, 1] - view.cone_ranges[:, 0]) + (view.triangle_ranges[:, 1] - view.triangle_ranges[:, 0])
    order = np.argsort(-work, kind="stable")
    on_cpu = jax.default_backend() == "cpu"
    batch_size = min(batch_size or (1 if on_cpu else _TILES_PER_BATCH), len(order))
    workers = num_cores() if on_cpu else 1
    parts = [order[start::workers] for start in range(workers)]
    length = max(map(len, parts))  # all parts have one size, hence one program: pad with a repeated tile
    parts = [np.concatenate([part, np.repeat(order[:1], length - len(part))]) for part in parts]
    tile = tile_size(width)
    program = _program(samples, tile, batch_size, 1 if on_cpu else _SURFACES_PER_STEP)
    jobs = [(view.tiles[part], view.cone_ranges[part], view.triangle_ranges[part]) for part in parts]
    with concurrent.futures.ThreadPoolExecutor(workers) as pool:
        results = list(pool.map(lambda job: jax.block_until_ready(program(tables, shot, *job)), jobs))
    position = np.empty(len(order), np.int64)
    position[np.concatenate(parts)[::-1]] = np.arange(length * workers)[::-1]
    join = _joiner(tile, width, height)
    return tuple(join(jnp.asarray(position), *(result[part] for result in results)) for part in range(3))  # pyright: ignore


@functools.cache
def _joiner(tile: int, width: int, height: int):
    columns, rows = -(-width // tile), -(-height // tile)

    def join(position: jax.Array, *parts: jax.Array) -> jax.Array:
        tiles = jnp.concatenate(parts)[position]
        tiles = tiles.reshape(rows, columns, *tiles.shape[1:])
        image = jnp.moveaxis(tiles, 2, 1).reshape(rows * tile, columns * tile, *tiles.shape[4:])
        return image[:height, :width]

    return jax.jit(join)


@functools.cache
def _program(samples: int, size: int, batch_size: int, surfaces: int):
    """Return the compiled function that renders a list of tiles; ``surfaces`` are tested per loop iteration."""

    def program(tables: Tables, shot: Shot, tiles: jax.Array, cone_ranges: jax.Array, triangle_ranges: jax.Array):
        def render_tile(tile: tuple[jax.Array, jax.Array, jax.Array]):
            return _render_tile(tables, shot, samples, size, surfaces, *tile)

        return jax.lax.map(
            render_tile, (tiles, cone_ranges, triangle_ranges), batch_size=None if batch_size == 1 else batch_size
        )

    options = compiler_options()
    options.pop("xla_cpu_use_fusion_emitters", None)
    # XLA's default, which flags of the environment (as in the tests) may lower for programs that run for a moment. This one
    # runs long enough for its optimisation to pay with the first image.
    options["xla_backend_optimization_level"] = 3
    return jax.jit(program, compiler_options=options)


def _render_tile(
    tables: Tables,
    shot: Shot,
    samples: int,
    size: int,
    surfaces: int,
    corner: jax.Array,
    cone_range: jax.Array,
    triangle_range: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Render one tile: radiance [size, size, 3], instance and depth [size, size]."""
    offsets = np.array(_RAYS[samples] if samples == 1 else ((0.0, 0.0), *_RAYS[samples]), np.float32)
    column = corner[0] + jnp.arange(size, dtype=jnp.float32)[None, None, :] + offsets[:, 0, None, None]
    image_row = corner[1] + jnp.arange(size, dtype=jnp.float32)[None, :, None] + offsets[:, 1, None, None]
    column, image_row = jnp.broadcast_arrays(column, image_row)
    image_row = image_row - shot.vertical_offset[0] - shot.vertical_offset[1] * (column - shot.centre[0])
    x, y = (column - shot.centre[0]) / shot.focal, (image_row - shot.centre[1]) / shot.focal
    hit = _first_hits(tables, shot, x, y, surfaces, cone_range, triangle_range)
    middle = Hit(*(part[0] for part in hit))
    if samples > 1:
        hit, x, y = Hit(*(part[1:] for part in hit)), x[1:], y[1:]
    radiance = jnp.stack([colour.mean(axis=0) for colour in shade(tables, shot, x, y, hit)], axis=-1)
    instance = jnp.select(
        [middle.kind == 2, middle.kind == 3, middle.kind == 1],
        [tables.cone_instance[middle.row], tables.triangle_instance[middle.row], GROUND],
        NOTHING,
    )
    return radiance, instance, jnp.where(middle.kind > 0, middle.depth, jnp.inf)


def _first_hits(
    tables: Tables,
    shot: Shot,
    x: jax.Array,
    y: jax.Array,
    surfaces: int,
    cone_range: jax.Array,
    triangle_range: jax.Array,
) -> Hit:
    """Find the first hits of rays (x, y, 1) [samples, size, size], testing ``surfaces`` surfaces per loop iteration."""
    up = shot.rotation[:, 2]
    falling = x * up[0] + y * up[1] + up[2]
    ground = jnp.where(falling < -1e-6, -shot.position[2] / jnp.minimum(falling, -1e-6), FAR)
    is_visible = ground < _GROUND_FAR
    if shot.day is not None:  # the ground extends to the horizon
        is_visible = falling < -1e-3
        ground = jnp.minimum(ground, _HORIZON)
    start = Hit(jnp.where(is_visible, ground, FAR), jnp.zeros(x.shape, jnp.int32), is_visible.astype(jnp.int32))
    square = x * x + y * y + 1.0

    def cone(index: jax.Array, is_valid: jax.Array, hit: Hit) -> Hit:
        row = tables.cone_list[index]
        c = jax.lax.dynamic_index_in_dim(tables.cones, row, keepdims=False)[:CONE_HIT]
        offset = c[0] * x + c[1] * y + c[2]
        along = c[3] * x + c[4] * y + c[5]
        major = c[6] * x + c[7] * y + c[8]
        a = square + c[9] * major * major - c[11] * along * along
        b = offset - along * c[12]
        discriminant = b * b - a * c[13]
        depth = (-b - jnp.sqrt(jnp.maximum(discriminant, 0.0))) / a
        travelled = c[10] + depth * along
        is_nearer = (
            is_valid & (discriminant > 0.0) & (travelled >= c[14]) & (travelled <= c[15]) & (depth > NEAR) & (depth < hit.depth)
        )
        return Hit(
            jnp.where(is_nearer, depth, hit.depth), jnp.where(is_nearer, row, hit.row), jnp.where(is_nearer, 2, hit.kind)
        )

    def triangle(index: jax.Array, is_valid: jax.Array, hit: Hit) -> Hit:
        row = tables.triangle_list[index]
        m = jax.lax.dynamic_index_in_dim(tables.triangles, row, keepdims=False)[:TRIANGLE_HIT]
        first, second, third = (m[3 * k] * x + m[3 * k + 1] * y + m[3 * k + 2] for k in range(3))
        depth = 1.0 / (first + second + third)
        minimum = jnp.minimum(jnp.minimum(first, second), third)
        is_nearer = is_valid & (minimum >= 0.0) & (depth > NEAR) & (depth < hit.depth)
        return Hit(
            jnp.where(is_nearer, depth, hit.depth), jnp.where(is_nearer, row, hit.row), jnp.where(is_nearer, 3, hit.kind)
        )

    def intersect_all(surface: Callable[[jax.Array, jax.Array, Hit], Hit], list_range: jax.Array, hit: Hit) -> Hit:
        first, last = list_range[0], list_range[1]

        def step(number: jax.Array, hit: Hit) -> Hit:
            for offset_in_step in range(surfaces):
                index = first + number * surfaces + offset_in_step
                hit = surface(jnp.minimum(index, last - 1), index < last, hit)
            return hit

        return jax.lax.fori_loop(0, (last - first + surfaces - 1) // surfaces, step, hit)

    return intersect_all(triangle, triangle_range, intersect_all(cone, cone_range, start))
