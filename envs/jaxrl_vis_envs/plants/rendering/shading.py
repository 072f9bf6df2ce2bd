"""Radiance of the surfaces that rays hit: fibres, blotches and nodes, by flash or by daylight."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxrl_vis_envs.plants.rendering.backdrop import REACH
from jaxrl_vis_envs.plants.rendering.tables import CONE_HIT, TRIANGLE_HIT
from jaxrl_vis_envs.plants.rendering.texture import noise, ramp

_CANOPY = 1.6  # m: height of the leaves that cast shadows by day


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
        vertical_offset: [2] vertical offset of the image, pixels, and its slope per column; see `Drive`.
        rotation: [3, 3] from the world to the camera.
        position: [3] of the camera in the world, m.
        flash: [3] position of the flash in the camera's frame, m.
        light: [3] intensity of the flash (1: a white surface at ``reference`` facing it has radiance 1), intensity of ambient
            light, and the distance ``reference`` in m.
        day: Daylight; None at night, for which a separate program is compiled.
    """

    focal: jax.Array
    centre: jax.Array
    vertical_offset: jax.Array
    rotation: jax.Array
    position: jax.Array
    flash: jax.Array
    light: jax.Array
    day: Day | None = None


class Tables(NamedTuple):
    """Tables and lists of a `tables.View`, as JAX arrays."""

    cones: jax.Array
    cone_instance: jax.Array
    cone_material: jax.Array
    triangles: jax.Array
    triangle_instance: jax.Array
    triangle_material: jax.Array
    materials: jax.Array
    cone_list: jax.Array
    triangle_list: jax.Array


class Hit(NamedTuple):
    """First hit of each ray, arrays of one shape.

    Attributes:
        depth: Planar depth in m, float32; `FAR` for none.
        row: Row of `Tables.cones` or `Tables.triangles`, depending on ``kind``, int32; 0 otherwise.
        kind: 0 nothing, 1 ground, 2 cone, 3 triangle; int32.
    """

    depth: jax.Array
    row: jax.Array
    kind: jax.Array


class _SurfacePoint(NamedTuple):
    """Surface properties at hits: texture coordinates in m, unit normal, and factors of appearance (0 to 1)."""

    u: jax.Array
    v: jax.Array
    normal: tuple[jax.Array, ...]
    over: jax.Array
    ring: jax.Array
    edge: jax.Array


def _dot(a: tuple[jax.Array, ...], b: tuple[jax.Array, ...]) -> jax.Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cone_point(c: jax.Array, point: tuple[jax.Array, ...]) -> _SurfacePoint:
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
    return _SurfacePoint(
        1.5 * radius * around, arc + arc_rate * travelled, normal, over, node + node_rate * travelled, over * 0.0
    )


def _triangle_point(m: jax.Array, x: jax.Array, y: jax.Array, depth: jax.Array) -> _SurfacePoint:
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
    return _SurfacePoint(offset, along, normal, rib * 0.0, rib, ramp(0.7, 1.0, jnp.abs(across)))


def _unit(vector: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
    scale = jax.lax.rsqrt(jnp.maximum(_dot(vector, vector), 1e-12))
    return tuple(component * scale for component in vector)


def shade(tables: Tables, shot: Shot, x: jax.Array, y: jax.Array, hit: Hit) -> list[jax.Array]:
    """Compute the radiance towards the camera at the hits of rays (x, y, 1) [...]: red, green and blue, [...] float32 each."""
    kind, depth = hit.kind, hit.depth
    is_cone, is_leaf, is_ground = kind == 2, kind == 3, kind == 1
    point = (x * depth, y * depth, depth)
    cone_row, leaf_row = jnp.where(is_cone, hit.row, 0), jnp.where(is_leaf, hit.row, 0)
    stalk = _cone_point(tables.cones[cone_row], point)
    leaf = _triangle_point(tables.triangles[leaf_row], x, y, depth)
    world = [sum(point[i] * shot.rotation[i, k] for i in range(3)) + shot.position[k] for k in range(2)]
    flat = tuple(jnp.broadcast_to(shot.rotation[i, 2], x.shape) for i in range(3))
    ground = _SurfacePoint(world[0], world[1], flat, x * 0.0, x * 0.0, x * 0.0)
    surface = _SurfacePoint(*jax.tree.map(lambda s, t, g: jnp.where(is_cone, s, jnp.where(is_leaf, t, g)), stalk, leaf, ground))
    material = jnp.where(is_cone, tables.cone_material[cone_row], jnp.where(is_leaf, tables.triangle_material[leaf_row], 0))
    properties = tables.materials[material]
    albedo, gloss = _albedo(properties, surface, is_cone, is_leaf, is_ground)

    to_flash = tuple(shot.flash[i] - point[i] for i in range(3))
    square = _dot(to_flash, to_flash)
    to_flash = _unit(to_flash)
    facing = jnp.maximum(_dot(surface.normal, to_flash), 0.0)
    # Rough fibres reflect light even at grazing angles; leaves transmit some.
    rough = jnp.where(is_ground, 0.55, jnp.where(is_leaf, 0.35, 0.18))
    to_camera = _unit((-x, -y, -jnp.ones_like(x)))
    halfway = _unit(tuple(a + b for a, b in zip(to_flash, to_camera)))
    shine = gloss * jnp.maximum(_dot(surface.normal, halfway), 0.0) ** 24
    strength, ambient, reference = shot.light
    flash = strength * (reference * reference) / jnp.maximum(square, 0.02)
    lit = flash * (rough + (1.0 - rough) * facing) + ambient
    at_night = [jnp.where(kind > 0, channel * lit + shine * flash * facing, 0.0) for channel in albedo]
    if shot.day is None:
        return at_night
    by_day = _daylight(shot, shot.day, point, surface, is_leaf, albedo, gloss)
    beyond = _backdrop(shot, shot.day, x, y)
    return [jnp.where(kind > 0, night + day, far) for night, day, far in zip(at_night, by_day, beyond)]


def _daylight(
    shot: Shot,
    day: Day,
    point: tuple[jax.Array, ...],
    surface: _SurfacePoint,
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
    rows, columns = day.backdrop.shape[:2]
    column = (0.5 + 0.5 * jnp.arctan2(along, ahead) / REACH[1]) * columns - 0.5
    row = (0.5 - 0.5 * above / jnp.hypot(along, ahead) / REACH[0]) * rows - 0.5
    column, row = jnp.clip(column, 0.0, columns - 1.001), jnp.clip(row, 0.0, rows - 1.001)
    left, top = column.astype(jnp.int32), row.astype(jnp.int32)
    u, v = (column - left)[..., None], (row - top)[..., None]
    upper = day.backdrop[top, left] * (1 - u) + day.backdrop[top, left + 1] * u
    lower = day.backdrop[top + 1, left] * (1 - u) + day.backdrop[top + 1, left + 1] * u
    colour = upper * (1 - v) + lower * v
    return [colour[..., channel] for channel in range(3)]


def _albedo(
    material: jax.Array, surface: _SurfacePoint, is_cone: jax.Array, is_leaf: jax.Array, is_ground: jax.Array
) -> tuple[list[jax.Array], jax.Array]:
    """Compute the reflectance of surfaces (three channels), and the intensity of their highlights."""
    base, over = [material[..., k] for k in range(3)], [material[..., 3 + k] for k in range(3)]
    fibre_f, fibre_c, blotch_f, blotch_c, speckles, speckle_f, bands, band_f, bloom, gloss, texture_shift, edge = (
        material[..., 6 + k] for k in range(12)
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
