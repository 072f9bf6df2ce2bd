"""The colour of what each pixel sees: MuJoCo's fixed-function lighting, evaluated once per pixel after the nearest hit.

Per light, as OpenGL has it: attenuation x spot x (ambient x colour + diffuse x colour x N.L + specular x (N.H)^(128 x
shininess)), the highlight only where N.L > 0, all lights summed with the emission, clipped to [0, 1] and then multiplied with
the texture. The corners of a mesh's triangles are lit and their colours mixed, as by OpenGL; primitives, which OpenGL cuts into
polygons and lights likewise, are lit at every pixel. There are no reflections. A point light shines from its position (MuJoCo's
renderer does not know them).
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs.render import camera
from jaxrl_vis_envs.render.camera import Rays
from jaxrl_vis_envs.render.pixel import charts, sampling, shapes, surface, texturing
from jaxrl_vis_envs.render.pixel import lights as lighting
from jaxrl_vis_envs.render.pixel.arithmetic import Vector, clipped, normalized
from jaxrl_vis_envs.render.pixel.lookup import Row
from jaxrl_vis_envs.render.pixel.raycast import entry
from jaxrl_vis_envs.render.pixel.surface import Hit
from jaxrl_vis_envs.render.scene import Scene

# What MuJoCo lights a scene with that has no light at all.
_AMBIENT_WITHOUT_LIGHTS = 0.3
# MuJoCo's sky stands at this share of the far plane.
_SKY_DISTANCE = 0.7


def shade(scene: Scene, unit: shapes.UnitShapes | None, lights: list[lighting.Light], row: Row, hit: Hit, rays: Rays) -> Vector:
    """Colour of surfaces: `lighted`, with their sampling."""
    colour = lighted(scene, unit, lights, row, hit, rays)
    texture = texturing.texture_colour(scene, row, hit)
    return colour if texture is None else tuple(value * texel for value, texel in zip(colour, texture, strict=True))


def lighted(
    scene: Scene, unit: shapes.UnitShapes | None, lights: list[lighting.Light], row: Row, hit: Hit, rays: Rays
) -> Vector:
    """Colour of surfaces as if they had no sampling.

    Args:
        scene: The scene.
        unit: The drawn objects (for shadows; None where no light casts any).
        lights: The lights in the camera's frame.
        row: The object of each pixel.
        hit: Where it is met.
        rays: [P].

    Returns:
        Red, green and blue, each [P] float32 in [0, 1].
    """
    if hit.triangle is None:
        u, v = rays
        if scene.projection == "orthographic":
            to_camera = normalized(tuple(-p for p in hit.point))  # OpenGL's viewer is a point all the same
        else:
            to_camera = normalized((-u, -v, jnp.ones_like(u)))
        return _lighted(scene, unit, lights, row, hit, to_camera)
    colour: Vector = (0.0, 0.0, 0.0)
    for share, corner in surface.corners(row, hit):
        to_camera = normalized(tuple(-p for p in corner.point))
        of_corner = _lighted(scene, unit, lights, row, corner, to_camera)
        colour = tuple(total + share * own for total, own in zip(colour, of_corner, strict=True))
    return colour


def _lighted(
    scene: Scene, unit: shapes.UnitShapes | None, lights: list[lighting.Light], row: Row, hit: Hit, to_camera: Vector
) -> Vector:
    """Colour of points of surfaces without a texture, each [P] float32 in [0, 1]."""
    coloured: list[Any] = [row.emission if lights else row.emission + _AMBIENT_WITHOUT_LIGHTS] * 3
    highlight: list[Any] = [0.0] * 3
    for light in lights:
        lit = _lit(scene, unit, light, hit) if light.shadows else None
        factors = lighting.light_factors(light, hit.point, hit.normal, to_camera, row.exponent, lit)
        for channel in range(3):
            coloured[channel] += factors[0] * light.ambient[channel] + factors[1] * light.diffuse[channel]
            if light.highlights:
                highlight[channel] += factors[2] * light.specular[channel]
    return tuple(
        clipped(light * base + row.specular * shine) for light, base, shine in zip(coloured, row.colour, highlight, strict=True)
    )


def _lit(scene: Scene, unit: shapes.UnitShapes | None, light: lighting.Light, hit: Hit) -> jax.Array:
    """[P] float32: 1 where no geom is between the point and the light, otherwise 0. Sites cast no shadow."""
    assert unit is not None
    to_light, distance, _ = lighting.towards(light, hit.point)
    start = tuple(jax.lax.stop_gradient(p) for p in hit.point)
    to_light = tuple(jax.lax.stop_gradient(component) for component in to_light)
    margin = 1e-4 * (1.0 - start[2])
    shadowed = jnp.zeros(start[2].shape, bool)
    for index in range(len(scene.object_ids)):
        if scene.object_ids[index] >= scene.geom_count:
            continue
        axes = [[unit.axes[index, i, j] for j in range(3)] for i in range(3)]
        values = ([unit.origin[index, i] for i in range(3)], axes, unit.extra[index], unit.extra_square[index])
        t, meets = entry(scene.object_types[index], values, start, to_light, 1.0)
        blocks = meets & (t > margin)
        shadowed = shadowed | (blocks if distance is None else blocks & (t < distance))
    return 1.0 - shadowed.astype(jnp.float32)


def sky(scene: Scene, camera_rotation: Any, rays: Rays) -> Vector:
    """Colour of the sky along every ray.

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
        # MuJoCo's skies have their up along y.
        face, place, choice = sampling.cube_place((world[0], world[2], -world[1]))
        pitches = _pitches(scene)
        spreads = []
        for axis, pitch in enumerate(pitches):
            change = [camera_rotation[i, axis] * pitch for i in range(3)]
            moved = sampling.cube_move(choice, place, (change[0], change[2], -change[1]))
            spreads.append(moved[0] * moved[0] + moved[1] * moved[1])
        spread = jnp.maximum(spreads[0], spreads[1]) * float(scene.atlas.levels[image.first_level][1]) ** 2
        face = face if image.faces == 6 else 0
        return sampling.sample(sampling.texels_of(scene), image.first_level, image.levels, face, place, spread, repeats=False)
    sine = jnp.clip(world[2] * jax.lax.rsqrt(u * u + v * v + 1.0), -1.0, 1.0)
    elevation = charts.elevation(sine)
    # The curve that MuJoCo fills a gradient texture with; 0 straight down, 1 straight up.
    share = 0.5 + elevation * jax.lax.rsqrt(2.0 * (1.0 + elevation * elevation))
    return tuple(scene.sky_bottom[channel] * (1.0 - share) + scene.sky_top[channel] * share for channel in range(3))


def _pitches(scene: Scene) -> tuple[jax.Array, jax.Array]:
    """How much u and v of the rays to the sky change from one pixel to the next."""
    pitches = camera.pixel_pitch(scene)
    if scene.projection == "orthographic":
        far = 1.0 / (_SKY_DISTANCE * scene.zfar)
        return pitches[0] * far, pitches[1] * far
    return pitches


def haze(scene: Scene, unit: shapes.UnitShapes, rays: Rays, depth: jax.Array, colour: Vector) -> Vector:
    """The colours with the horizon's haze over them, which MuJoCo draws as a wide funnel around the camera.

    Args:
        scene: A scene with a hazy plane.
        unit: The drawn objects.
        rays: [P].
        depth: [P] float32, metres, of what is seen; the funnel only counts in front of it.
        colour: Three [P] float32.
    """
    plane, width = scene.haze
    row = scene.object_ids.index(plane)
    axes, origin = unit.axes[row], unit.origin[row]
    height = origin[2]  # of the camera above the plane: the shape's z is in metres
    reach = _SKY_DISTANCE * scene.zfar
    u, v = rays
    up = axes[2, 0] * u + axes[2, 1] * v - axes[2, 2]
    level = jnp.sqrt(jnp.maximum(u * u + v * v + 1.0 - up * up, 1e-12))
    safe_height = jnp.maximum(height, 1e-9)
    closing = level - width * reach * up / safe_height
    at = reach / jnp.maximum(closing, 1e-9)
    place = 1.0 + at * up / safe_height  # 0 on the plane, 1 at the camera's height
    # Where the haze is thickest: the elevation at which the funnel meets the sky's cylinder from below.
    alpha = np.arctan2(1.0, width)
    thickest = float(np.sqrt(0.5) * width * np.sin(alpha) / np.sin(0.75 * np.pi - alpha))
    strength = jnp.where(place < thickest, place / thickest, (1.0 - place) / (1.0 - thickest))
    seen = (height > 0.0) & (place >= 0.0) & (place <= 1.0) & (closing > 0.0) & (at < depth)
    strength = jnp.where(seen, jnp.clip(strength, 0.0, 1.0), 0.0)
    return tuple(c + strength * (scene.haze_colour[channel] - c) for channel, c in enumerate(colour))
