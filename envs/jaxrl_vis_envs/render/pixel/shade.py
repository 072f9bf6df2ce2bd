"""Shading: MuJoCo's fixed-function lighting, evaluated once per pixel at the nearest hit.

Per light, as in OpenGL: attenuation x spot x (ambient x colour + diffuse x colour x N.L + specular x (N.H)^(128 x shininess)),
the highlight only if N.L > 0; all lights are added to the emission, clipped to [0, 1] and then multiplied by the texture.
Meshes are lit at the corners of their triangles and the colours interpolated, as in OpenGL; primitives, which OpenGL
tessellates and lights likewise, are lit at every pixel. There are no reflections. A point light shines from its position
(MuJoCo's renderer does not support point lights).
"""

import functools
from collections.abc import Callable, Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs.render import camera
from jaxrl_vis_envs.render.camera import Rays
from jaxrl_vis_envs.render.pixel import charts, sampling, shapes, surface, texturing
from jaxrl_vis_envs.render.pixel import lights as lighting
from jaxrl_vis_envs.render.pixel.arithmetic import Vector, clip_to_unit, normalized
from jaxrl_vis_envs.render.pixel.lookup import Row
from jaxrl_vis_envs.render.pixel.raycast import entry
from jaxrl_vis_envs.render.pixel.surface import Hit
from jaxrl_vis_envs.render.pixel.triangles import Segments
from jaxrl_vis_envs.render.scene import Scene

Blocked = Callable[[Segments, lighting.Light], jax.Array]

# Ambient light that MuJoCo uses in a scene without any light.
_AMBIENT_WITHOUT_LIGHTS = 0.3
# Distance of MuJoCo's sky, relative to the far plane.
_SKY_DISTANCE = 0.7


def shade(
    scene: Scene,
    unit: shapes.UnitShapes | None,
    lights: list[lighting.Light],
    row: Row,
    hit: Hit,
    rays: Rays,
    blocked: Blocked | None = None,
) -> Vector:
    """Compute the colour of surfaces, including their textures; arguments and result as in `light_surface`."""
    colour = light_surface(scene, unit, lights, row, hit, rays, blocked)
    texture = texturing.texture_colour(scene, row, hit)
    return colour if texture is None else tuple(value * texel for value, texel in zip(colour, texture, strict=True))


def light_surface(
    scene: Scene,
    unit: shapes.UnitShapes | None,
    lights: list[lighting.Light],
    row: Row,
    hit: Hit,
    rays: Rays,
    blocked: Blocked | None = None,
) -> Vector:
    """Compute the colour of surfaces without their textures.

    Args:
        scene: The scene.
        unit: Rendered objects, for shadows; None if no light casts shadows.
        lights: Lights in the camera's frame.
        row: Object at each pixel.
        hit: Intersection at each pixel.
        rays: [P].
        blocked: Function that returns True where segments [P] to a light meet a triangle; None if there are no triangles or no
            shadows.

    Returns:
        Red, green and blue, each [P] float32 in [0, 1].
    """
    if hit.triangle is None:
        u, v = rays
        if scene.projection == "orthographic":
            to_camera = normalized(tuple(-p for p in hit.point))  # OpenGL's viewer is a point even so
        else:
            to_camera = normalized((-u, -v, jnp.ones_like(u)))
        return _light_points(scene, unit, lights, row, hit, to_camera)
    # Corners are lit, but shadows fall on points.
    corners = surface.corners(row, hit)
    lit = [_shadow_mask(scene, unit, light, hit, blocked, corners) if light.casts_shadows else None for light in lights]
    colour: Vector = (0.0, 0.0, 0.0)
    for share, corner in corners:
        to_camera = normalized(tuple(-p for p in corner.point))
        corner_colour = _light_points(scene, unit, lights, row, corner, to_camera, lit)
        colour = tuple(total + share * value for total, value in zip(colour, corner_colour, strict=True))
    return colour


def _light_points(
    scene: Scene,
    unit: shapes.UnitShapes | None,
    lights: list[lighting.Light],
    row: Row,
    hit: Hit,
    to_camera: Vector,
    lit: list[jax.Array | None] | None = None,
) -> Vector:
    """Compute the colour of surface points without textures, each [P] float32 in [0, 1].

    ``lit`` has the `_shadow_mask` of each light; None to compute it from ``hit``.
    """
    coloured: list[Any] = [row.emission if lights else row.emission + _AMBIENT_WITHOUT_LIGHTS] * 3
    highlight: list[Any] = [0.0] * 3
    for number, light in enumerate(lights):
        if lit is not None:
            mask = lit[number]
        else:
            mask = _shadow_mask(scene, unit, light, hit, None) if light.casts_shadows else None
        factors = lighting.light_factors(light, hit.point, hit.normal, to_camera, row.exponent, mask)
        for channel in range(3):
            coloured[channel] += factors[0] * light.ambient[channel] + factors[1] * light.diffuse[channel]
            if light.has_highlights:
                highlight[channel] += factors[2] * light.specular[channel]
    return tuple(
        clip_to_unit(light * base + row.specular * shine)
        for light, base, shine in zip(coloured, row.colour, highlight, strict=True)
    )


def _shadow_mask(
    scene: Scene,
    unit: shapes.UnitShapes | None,
    light: lighting.Light,
    hit: Hit,
    blocked: Blocked | None,
    corners: Iterable[tuple[jax.Array, Hit]] = (),
) -> jax.Array:
    """Return 0 where a geom or tendon occludes the light, else 1: [P] float32. Sites cast no shadow.

    The triangles of meshes are omitted where the light brightens none of the ``corners`` anyway.
    """
    assert unit is not None
    to_light, distance, _ = lighting.light_vector(light, hit.point)
    start = tuple(jax.lax.stop_gradient(p) for p in hit.point)
    to_light = tuple(jax.lax.stop_gradient(component) for component in to_light)
    margin = 1e-4 * (1.0 - start[2])
    shadowed = jnp.zeros(start[2].shape, bool)
    for index in range(len(scene.object_ids)):
        is_site = 0 <= scene.object_ids[index] - scene.geom_count < scene.site_count
        if is_site or scene.object_types[index] in (shapes.MESH, shapes.HFIELD):
            continue
        axes = [[unit.axes[index, i, j] for j in range(3)] for i in range(3)]
        values = ([unit.origin[index, i] for i in range(3)], axes, unit.extra[index], unit.extra_square[index])
        t, meets = entry(scene.object_types[index], values, start, to_light, 1.0)
        blocks = meets & (t > margin)
        shadowed = shadowed | (blocks if distance is None else blocks & (t < distance))
    if blocked is not None:
        farthest = jnp.full_like(margin, np.inf) if distance is None else jax.lax.stop_gradient(distance)
        brightens = [lighting.may_brighten(light, corner.point, corner.normal) for _, corner in corners]
        farthest = jnp.where(jax.lax.stop_gradient(functools.reduce(jnp.logical_or, brightens)), farthest, 0.0)
        to_light = tuple(jnp.broadcast_to(component, margin.shape) for component in to_light)
        shadowed = shadowed | blocked(Segments(start, to_light, margin, farthest), light)
    return 1.0 - shadowed.astype(jnp.float32)


def sky(scene: Scene, camera_rotation: Any, rays: Rays) -> Vector:
    """Compute the colour of the sky along every ray.

    Returns:
        Red, green and blue, each [P] float32 in [0, 1].
    """
    u, v = rays
    if scene.projection == "orthographic":
        far = 1.0 / (_SKY_DISTANCE * scene.zfar)
        u, v = u * far, v * far
    world = [camera_rotation[axis, 0] * u + camera_rotation[axis, 1] * v - camera_rotation[axis, 2] for axis in range(3)]
    image = scene.atlas.sky
    if image is not None:
        # In MuJoCo's sky textures, y is up.
        face, coordinates, choice = sampling.cube_coordinates((world[0], world[2], -world[1]))
        pitches = _pitches(scene)
        spreads = []
        for axis, pitch in enumerate(pitches):
            change = [camera_rotation[i, axis] * pitch for i in range(3)]
            tangent = sampling.cube_tangent(choice, coordinates, (change[0], change[2], -change[1]))
            spreads.append(tangent[0] * tangent[0] + tangent[1] * tangent[1])
        spread = jnp.maximum(spreads[0], spreads[1]) * float(scene.atlas.levels[image.first_level][1]) ** 2
        face = face if image.faces == 6 else 0
        return sampling.sample(
            sampling.atlas_reader(scene), image.first_level, image.levels, face, coordinates, spread, repeats=False
        )
    sine = jnp.clip(world[2] * jax.lax.rsqrt(u * u + v * v + 1.0), -1.0, 1.0)
    elevation = charts.elevation(sine)
    # MuJoCo's gradient curve: 0 at the nadir, 1 at the zenith.
    share = 0.5 + elevation * jax.lax.rsqrt(2.0 * (1.0 + elevation * elevation))
    return tuple(scene.sky_bottom[channel] * (1.0 - share) + scene.sky_top[channel] * share for channel in range(3))


def _pitches(scene: Scene) -> tuple[jax.Array, jax.Array]:
    """Return the change of u and of v of the sky's rays from one pixel to the next."""
    pitches = camera.pixel_pitch(scene)
    if scene.projection == "orthographic":
        far = 1.0 / (_SKY_DISTANCE * scene.zfar)
        return pitches[0] * far, pitches[1] * far
    return pitches


def haze(scene: Scene, unit: shapes.UnitShapes, rays: Rays, depth: jax.Array, colour: Vector) -> Vector:
    """Blend the haze at the horizon over the colours; MuJoCo renders it as a wide funnel around the camera.

    Args:
        scene: Scene with a hazy plane.
        unit: Rendered objects.
        rays: [P].
        depth: [P] float32, metres, depth of the visible surface, which may occlude the funnel.
        colour: Three [P] float32.
    """
    plane, width = scene.haze
    row = scene.object_ids.index(plane)
    axes, origin = unit.axes[row], unit.origin[row]
    height = origin[2]  # camera's height above the plane: the shape's z is in metres
    reach = _SKY_DISTANCE * scene.zfar
    u, v = rays
    up = axes[2, 0] * u + axes[2, 1] * v - axes[2, 2]
    level = jnp.sqrt(jnp.maximum(u * u + v * v + 1.0 - up * up, 1e-12))
    safe_height = jnp.maximum(height, 1e-9)
    closing = level - width * reach * up / safe_height
    at = reach / jnp.maximum(closing, 1e-9)
    level_ratio = 1.0 + at * up / safe_height  # 0 on the plane, 1 at the camera's height
    # The haze is thickest at the elevation where the funnel meets the sky's cylinder from below.
    alpha = np.arctan2(1.0, width)
    thickest = float(np.sqrt(0.5) * width * np.sin(alpha) / np.sin(0.75 * np.pi - alpha))
    strength = jnp.where(level_ratio < thickest, level_ratio / thickest, (1.0 - level_ratio) / (1.0 - thickest))
    visible = (height > 0.0) & (level_ratio >= 0.0) & (level_ratio <= 1.0) & (closing > 0.0) & (at < depth)
    strength = jnp.where(visible, jnp.clip(strength, 0.0, 1.0), 0.0)
    return tuple(c + strength * (scene.haze_colour[channel] - c) for channel, c in enumerate(colour))
