"""Renderer of fields, tile by tile: the first surface along each ray, and its colour.

    tables.build_view -> View -> draw: for each tile of up to 64 x 64 pixels
        its cones, its triangles, the ground       -> depth and row of the nearest surface  `_nearest`
        texture and light at the hit               -> colour                                `_colour`
        mean over a pixel's rays                   -> radiance, instance and depth

One compiled program serves all views of a size. On a CPU, tiles are rendered sequentially, by one thread per core; on an
accelerator, many at a time, batched by similar amounts of work. Memory: the images, and one batch of tiles.
"""

import concurrent.futures
import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs.compiling.compilation import compiler_options
from jaxrl_vis_envs.cores import num_cores
from jaxrl_vis_envs.plants.backdrop import REACH
from jaxrl_vis_envs.plants.surfaces import GROUND, NOTHING
from jaxrl_vis_envs.plants.tables import CONE_HIT, FAR, NEAR, TRIANGLE_HIT, View, tile_size
from jaxrl_vis_envs.plants.texture import noise, ramp

_GROUND_FAR = 3.5  # m: beyond, the ground is black at night
_HORIZON = 200.0  # m: by day
_CANOPY = 1.6  # m: height of the leaves that cast shadows by day
# The rays of a pixel have distinct subpixel columns and rows, so that edges of any direction are antialiased.
_RAYS = {1: ((0.0, 0.0),), 4: ((-0.125, -0.375), (0.375, -0.125), (-0.375, 0.125), (0.125, 0.375))}
_TILES_PER_BATCH = 256  # on an accelerator
# Number of surfaces tested per loop iteration on an accelerator, where reading and writing the hits so far in each iteration
# takes longer than testing a surface.
_SURFACES_PER_STEP = 8


class Day(NamedTuple):
    """Daylight, all float32.

    Attributes:
        sun: [3] unit vector towards the sun, in the world.
        sunlight, skylight: [3] light of sun and sky on a white surface, red, green and blue.
        shadow: [4] fraction of the sunlight that shadows block, fraction of the area that they cover, and feature sizes of
            the two layers of their pattern, m.
        backdrop: [h, w, 3] radiance of the background at infinity, see `backdrop`.
    """

    sun: jax.Array
    sunlight: jax.Array
    skylight: jax.Array
    shadow: jax.Array
    backdrop: jax.Array


class Shot(NamedTuple):
    """Camera and light parameters of a rendering, all float32.

    Attributes:
        focal: [] focal length, pixels.
        centre: [2] principal point, pixels.
        lines: [2] vertical offset of the image, pixels, and its slope per column; see `Drive`.
        rotation: [3, 3] from the world to the camera.
        position: [3] of the camera in the world, m.
        flash: [3] position of the flash in the camera's frame, m.
        light: [3] intensity of the flash (1: a white surface at ``reference`` facing it has radiance 1), intensity of ambient
            light, and the distance ``reference`` in m.
        day: Daylight; None at night, for which a separate program is compiled.
    """

    focal: jax.Array
    centre: jax.Array
    lines: jax.Array
    rotation: jax.Array
    position: jax.Array
    flash: jax.Array
    light: jax.Array
    day: Day | None = None


class _Tables(NamedTuple):
    cones: jax.Array
    cone_instance: jax.Array
    cone_material: jax.Array
    triangles: jax.Array
    triangle_instance: jax.Array
    triangle_material: jax.Array
    materials: jax.Array
    cone_list: jax.Array
    triangle_list: jax.Array


class _Hit(NamedTuple):
    """Ray hits: depth, row in the table, and kind (0 nothing, 1 ground, 2 cones, 3 triangles)."""

    depth: jax.Array
    row: jax.Array
    kind: jax.Array


def draw(
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
    tables = _Tables(*(jnp.asarray(getattr(view, name)) for name in _Tables._fields))
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
    columns, lines = -(-width // tile), -(-height // tile)

    def join(position: jax.Array, *parts: jax.Array) -> jax.Array:
        tiles = jnp.concatenate(parts)[position]
        tiles = tiles.reshape(lines, columns, *tiles.shape[1:])
        image = jnp.moveaxis(tiles, 2, 1).reshape(lines * tile, columns * tile, *tiles.shape[4:])
        return image[:height, :width]

    return jax.jit(join)


@functools.cache
def _program(samples: int, size: int, batch_size: int, surfaces: int):
    """Return the compiled rendering of a list of tiles."""

    def program(tables: _Tables, shot: Shot, tiles: jax.Array, cone_ranges: jax.Array, triangle_ranges: jax.Array):
        def one(tile: tuple[jax.Array, jax.Array, jax.Array]):
            return _tile(tables, shot, samples, size, surfaces, *tile)

        return jax.lax.map(one, (tiles, cone_ranges, triangle_ranges), batch_size=None if batch_size == 1 else batch_size)

    options = compiler_options()
    options.pop("xla_cpu_use_fusion_emitters", None)
    return jax.jit(program, compiler_options=options)


def _tile(
    tables: _Tables,
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
    line = corner[1] + jnp.arange(size, dtype=jnp.float32)[None, :, None] + offsets[:, 1, None, None]
    column, line = jnp.broadcast_arrays(column, line)
    line = line - shot.lines[0] - shot.lines[1] * (column - shot.centre[0])
    x, y = (column - shot.centre[0]) / shot.focal, (line - shot.centre[1]) / shot.focal
    hit = _nearest(tables, shot, x, y, surfaces, cone_range, triangle_range)
    middle = _Hit(*(part[0] for part in hit))
    if samples > 1:
        hit, x, y = _Hit(*(part[1:] for part in hit)), x[1:], y[1:]
    radiance = jnp.stack([colour.mean(axis=0) for colour in _colour(tables, shot, x, y, hit)], axis=-1)
    instance = jnp.select(
        [middle.kind == 2, middle.kind == 3, middle.kind == 1],
        [tables.cone_instance[middle.row], tables.triangle_instance[middle.row], GROUND],
        NOTHING,
    )
    return radiance, instance, jnp.where(middle.kind > 0, middle.depth, jnp.inf)


def _nearest(
    tables: _Tables,
    shot: Shot,
    x: jax.Array,
    y: jax.Array,
    surfaces: int,
    cone_range: jax.Array,
    triangle_range: jax.Array,
) -> _Hit:
    """Find the first hits of rays (x, y, 1), testing ``surfaces`` surfaces per loop iteration."""
    up = shot.rotation[:, 2]
    falling = x * up[0] + y * up[1] + up[2]
    ground = jnp.where(falling < -1e-6, -shot.position[2] / jnp.minimum(falling, -1e-6), FAR)
    is_visible = ground < _GROUND_FAR
    if shot.day is not None:  # the ground extends to the horizon
        is_visible = falling < -1e-3
        ground = jnp.minimum(ground, _HORIZON)
    start = _Hit(jnp.where(is_visible, ground, FAR), jnp.zeros(x.shape, jnp.int32), is_visible.astype(jnp.int32))
    square = x * x + y * y + 1.0

    def cone(index: jax.Array, is_valid: jax.Array, hit: _Hit) -> _Hit:
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
        return _Hit(
            jnp.where(is_nearer, depth, hit.depth), jnp.where(is_nearer, row, hit.row), jnp.where(is_nearer, 2, hit.kind)
        )

    def triangle(index: jax.Array, is_valid: jax.Array, hit: _Hit) -> _Hit:
        row = tables.triangle_list[index]
        m = jax.lax.dynamic_index_in_dim(tables.triangles, row, keepdims=False)[:TRIANGLE_HIT]
        first, second, third = (m[3 * k] * x + m[3 * k + 1] * y + m[3 * k + 2] for k in range(3))
        depth = 1.0 / (first + second + third)
        minimum = jnp.minimum(jnp.minimum(first, second), third)
        is_nearer = is_valid & (minimum >= 0.0) & (depth > NEAR) & (depth < hit.depth)
        return _Hit(
            jnp.where(is_nearer, depth, hit.depth), jnp.where(is_nearer, row, hit.row), jnp.where(is_nearer, 3, hit.kind)
        )

    def intersect_all(surface: Callable[[jax.Array, jax.Array, _Hit], _Hit], list_range: jax.Array, hit: _Hit) -> _Hit:
        first, last = list_range[0], list_range[1]

        def step(number: jax.Array, hit: _Hit) -> _Hit:
            for offset_in_step in range(surfaces):
                index = first + number * surfaces + offset_in_step
                hit = surface(jnp.minimum(index, last - 1), index < last, hit)
            return hit

        return jax.lax.fori_loop(0, (last - first + surfaces - 1) // surfaces, step, hit)

    return intersect_all(triangle, triangle_range, intersect_all(cone, cone_range, start))


class _Point(NamedTuple):
    """Surface properties at hits: texture coordinates in m, unit normal, and factors of appearance (0 to 1)."""

    u: jax.Array
    v: jax.Array
    normal: tuple[jax.Array, ...]
    over: jax.Array
    ring: jax.Array
    edge: jax.Array


def _dot(a: tuple[jax.Array, ...], b: tuple[jax.Array, ...]) -> jax.Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _intersect_cone(c: jax.Array, point: tuple[jax.Array, ...]) -> _Point:
    """Compute the surface point on cones; ``c`` [..., columns] are rows of the table."""
    axis, major = (tuple(c[..., k + i] for i in range(3)) for k in (3, 6))
    start = tuple(c[..., CONE_HIT + i] for i in range(3))
    slope, arc, arc_rate, sheath, sheath_rate, node, node_rate, radius = (c[..., CONE_HIT + 3 + i] for i in range(8))
    offset = tuple(p - s for p, s in zip(point, start))
    travelled = _dot(offset, axis)
    outward = tuple(o - travelled * a for o, a in zip(offset, axis))
    bulge = c[..., 9] * _dot(outward, major)
    normal = tuple(o + bulge * m for o, m in zip(outward, major))
    length = jnp.sqrt(jnp.maximum(_dot(normal, normal), 1e-12))
    normal = _unit(tuple(n / length - slope * a for n, a in zip(normal, axis)))
    # Angle around the stalk without an arctangent: 0 in front, with its seam behind.
    turn = outward[0] / (jnp.abs(outward[0]) + jnp.abs(outward[2]) + 1e-9)
    around = jnp.where(outward[2] < 0.0, turn, jnp.sign(turn) * (2.0 - jnp.abs(turn)))
    over = sheath + sheath_rate * travelled
    return _Point(1.5 * radius * around, arc + arc_rate * travelled, normal, over, node + node_rate * travelled, over * 0.0)


def _intersect_triangle(m: jax.Array, x: jax.Array, y: jax.Array, depth: jax.Array) -> _Point:
    """Compute the surface point on leaves, which have a midrib."""

    def interpolate(first: int) -> jax.Array:
        """Interpolate corner values."""
        k = TRIANGLE_HIT + first
        return depth * (m[..., k] * x + m[..., k + 1] * y + m[..., k + 2])

    along, across, offset = (interpolate(3 * i) for i in range(3))
    normal = tuple(interpolate(9 + 3 * i) for i in range(3))
    facing = jnp.where(normal[0] * x + normal[1] * y + normal[2] > 0.0, -1.0, 1.0)
    normal = _unit(tuple(component * facing for component in normal))
    rib = ramp(0.13, 0.05, jnp.abs(across))
    return _Point(offset, along, normal, rib * 0.0, rib, ramp(0.7, 1.0, jnp.abs(across)))


def _unit(vector: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
    scale = jax.lax.rsqrt(jnp.maximum(_dot(vector, vector), 1e-12))
    return tuple(component * scale for component in vector)


def _colour(tables: _Tables, shot: Shot, x: jax.Array, y: jax.Array, hit: _Hit) -> list[jax.Array]:
    """Compute radiance towards the camera at the hits: red, green and blue."""
    kind, depth = hit.kind, hit.depth
    is_cone, is_leaf, is_ground = kind == 2, kind == 3, kind == 1
    point = (x * depth, y * depth, depth)
    cone_row, leaf_row = jnp.where(is_cone, hit.row, 0), jnp.where(is_leaf, hit.row, 0)
    stalk, leaf = _intersect_cone(tables.cones[cone_row], point), _intersect_triangle(tables.triangles[leaf_row], x, y, depth)
    world = [sum(point[i] * shot.rotation[i, k] for i in range(3)) + shot.position[k] for k in range(2)]
    flat = tuple(jnp.broadcast_to(shot.rotation[i, 2], x.shape) for i in range(3))
    ground = _Point(world[0], world[1], flat, x * 0.0, x * 0.0, x * 0.0)
    at = _Point(*jax.tree.map(lambda s, t, g: jnp.where(is_cone, s, jnp.where(is_leaf, t, g)), stalk, leaf, ground))
    material = jnp.where(is_cone, tables.cone_material[cone_row], jnp.where(is_leaf, tables.triangle_material[leaf_row], 0))
    m = tables.materials[material]
    albedo, gloss = _albedo(m, at, is_cone, is_leaf, is_ground)

    to_flash = tuple(shot.flash[i] - point[i] for i in range(3))
    square = _dot(to_flash, to_flash)
    to_flash = _unit(to_flash)
    facing = jnp.maximum(_dot(at.normal, to_flash), 0.0)
    # Rough fibres reflect light even at grazing angles; leaves transmit some.
    rough = jnp.where(is_ground, 0.55, jnp.where(is_leaf, 0.35, 0.18))
    to_camera = _unit((-x, -y, -jnp.ones_like(x)))
    halfway = _unit(tuple(a + b for a, b in zip(to_flash, to_camera)))
    shine = gloss * jnp.maximum(_dot(at.normal, halfway), 0.0) ** 24
    strength, ambient, reference = shot.light
    flash = strength * (reference * reference) / jnp.maximum(square, 0.02)
    lit = flash * (rough + (1.0 - rough) * facing) + ambient
    at_night = [jnp.where(kind > 0, channel * lit + shine * flash * facing, 0.0) for channel in albedo]
    if shot.day is None:
        return at_night
    by_day = _daylight(shot, shot.day, point, at, is_leaf, albedo, gloss)
    beyond = _backdrop(shot, shot.day, x, y)
    return [jnp.where(kind > 0, night + day, far) for night, day, far in zip(at_night, by_day, beyond)]


def _daylight(
    shot: Shot,
    day: Day,
    point: tuple[jax.Array, ...],
    surface: _Point,
    is_leaf: jax.Array,
    albedo: list[jax.Array],
    gloss: jax.Array,
) -> list[jax.Array]:
    """Compute radiance by sun and sky at points of the camera's frame, m: red, green and blue."""
    sun = tuple(shot.rotation[i] @ day.sun for i in range(3))
    facing = _dot(surface.normal, sun)
    # Leaves transmit light.
    lit = jnp.maximum(facing, jnp.where(is_leaf, -0.45, 0.0) * facing)
    place = [sum(point[i] * shot.rotation[i, k] for i in range(3)) + shot.position[k] for k in range(3)]
    # Shadows are cast by a canopy at one height: look up its pattern where the ray to the sun intersects it.
    rise = jnp.maximum(_CANOPY - place[2], 0.0) / jnp.maximum(day.sun[2], 0.1)
    u, v = (place[k] + rise * day.sun[k] for k in range(2))
    depth, cover, size, gap = day.shadow
    pattern = 0.65 * noise(u / size, v / size, 6) + 0.35 * noise(u / gap, v / gap, 7)
    sunny = 1.0 - depth * ramp(1.0 - cover - 0.03, 1.0 - cover + 0.03, pattern)
    upward = sum(surface.normal[i] * shot.rotation[i, 2] for i in range(3))
    open_sky = 0.55 + 0.45 * upward
    to_camera = _unit(tuple(-part for part in point))
    halfway = _unit(tuple(a + b for a, b in zip(sun, to_camera)))
    shine = gloss * jnp.maximum(_dot(surface.normal, halfway), 0.0) ** 24
    return [
        sunlight * sunny * (channel * lit + shine) + skylight * channel * open_sky
        for channel, sunlight, skylight in zip(albedo, day.sunlight, day.skylight)
    ]


def _backdrop(shot: Shot, day: Day, x: jax.Array, y: jax.Array) -> list[jax.Array]:
    """Look up the backdrop in the direction of rays (x, y, 1): red, green and blue."""
    along, ahead, above = (x * shot.rotation[0, k] + y * shot.rotation[1, k] + shot.rotation[2, k] for k in range(3))
    lines, columns = day.backdrop.shape[:2]
    column = (0.5 + 0.5 * jnp.arctan2(along, ahead) / REACH[1]) * columns - 0.5
    line = (0.5 - 0.5 * above / jnp.hypot(along, ahead) / REACH[0]) * lines - 0.5
    column, line = jnp.clip(column, 0.0, columns - 1.001), jnp.clip(line, 0.0, lines - 1.001)
    left, top = column.astype(jnp.int32), line.astype(jnp.int32)
    u, v = (column - left)[..., None], (line - top)[..., None]
    upper = day.backdrop[top, left] * (1 - u) + day.backdrop[top, left + 1] * u
    lower = day.backdrop[top + 1, left] * (1 - u) + day.backdrop[top + 1, left + 1] * u
    colour = upper * (1 - v) + lower * v
    return [colour[..., channel] for channel in range(3)]


def _albedo(
    m: jax.Array, surface: _Point, is_cone: jax.Array, is_leaf: jax.Array, is_ground: jax.Array
) -> tuple[list[jax.Array], jax.Array]:
    """Compute the reflectance of surfaces (three channels), and the intensity of their highlights."""
    base, over = [m[..., k] for k in range(3)], [m[..., 3 + k] for k in range(3)]
    fibre_f, fibre_c, blotch_f, blotch_c, speckles, speckle_f, bands, band_f, bloom, gloss, texture_shift, edge = (
        m[..., 6 + k] for k in range(12)
    )
    u, v = surface.u + texture_shift, surface.v + texture_shift
    # Fibres run along a stalk or leaf; the ground's grains have no direction.
    stretch = jnp.where(is_ground, 1.0, 0.03)
    fibres = 0.6 * noise(u * fibre_f, v * fibre_f * stretch, 0) + 0.4 * noise(u * fibre_f * 2.7, v * fibre_f * stretch * 2.0, 1)
    longer = jnp.where(is_ground, 1.0, 0.45)
    blotches = 0.65 * noise(u * blotch_f, v * blotch_f * longer, 2) + 0.35 * noise(
        u * blotch_f * 2.9, v * blotch_f * longer * 2.9, 3
    )
    spots = noise(u * speckle_f, v * speckle_f * 0.8, 4)
    # Ragged ends: sheaths and dry leaf edges do not end in a straight line.
    cover = jnp.where(is_leaf, ramp(0.75, 1.0, 0.8 * surface.edge * edge + 0.75 * blotches), surface.over)
    cover = jnp.where(is_ground, ramp(0.5, 0.75, blotches), cover)
    spot = ramp(1.0 - 0.55 * speckles, 1.12 - 0.55 * speckles, spots)
    wave = 0.5 + 0.5 * jnp.sin(2.0 * jnp.pi * (v * band_f + 1.5 * blotches))
    dark = (
        (1.0 - fibre_c * fibres * jnp.where(is_cone, 1.8 + surface.over, 1.6))
        * (1.0 - blotch_c * ramp(0.35, 0.75, blotches))
        * (1.0 - 0.6 * spot)
        * (1.0 - bands * wave)
    )
    # A node is a dark scar under a pale ring; a leaf's rib is pale.
    ring = jnp.where(is_cone, 1.0 - 0.55 * surface.ring, 1.0 + 0.5 * surface.ring)
    wax = jnp.where(is_cone, bloom * ramp(0.3, 0.7, noise(u * 90.0, v * 9.0, 5)) * (1.0 - surface.over), 0.0)
    scale = dark * ring
    mixed = [(b + (o - b) * cover) * scale for b, o in zip(base, over)]
    return [channel + (0.62 - channel) * 0.45 * wax for channel in mixed], gloss * (1.0 - 0.5 * blotches)
