"""The colour of what each pixel sees: MuJoCo's fixed-function lighting, evaluated once per pixel after the nearest hit.

Per light, as OpenGL has it: attenuation x spot x (ambient x colour + diffuse x colour x N.L + specular x (N.H)^(128 x
shininess)), the highlight only where N.L > 0, all lights summed with the emission and clipped to [0, 1]. There are no shadows
and no reflections. Colours are computed per pixel, where OpenGL interpolates between corners, so a highlight on a coarse mesh
may differ. A plane seen from behind is drawn like any other surface, where MuJoCo makes it half transparent.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxrl_vis_envs.render.raycast import UnitShapes
from jaxrl_vis_envs.render.scene import Scene

_DIRECTIONAL = int(mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
_SPOT = int(mujoco.mjtLightType.mjLIGHT_SPOT)
# What MuJoCo lights a scene with that has no light at all.
_AMBIENT_WITHOUT_LIGHTS = 0.3

Vector = tuple[jax.Array, ...]  # three of them


class Light(NamedTuple):
    """One light in the camera's frame; the numbers are scalars or [3] arrays."""

    directional: bool
    position: jax.Array | None
    direction: jax.Array
    ambient: jax.Array
    diffuse: jax.Array
    specular: jax.Array
    attenuation: jax.Array | None
    cosine_cutoff: jax.Array | None
    exponent: jax.Array | None


def light_poses(scene: Scene, data: Any) -> tuple[jax.Array, jax.Array]:
    """World poses of the scene's lights, from body poses, because `mjx.Data` carries none.

    Args:
        scene: The scene.
        data: Has ``xpos`` [nbody, 3] and ``xmat`` [nbody, 3, 3] or [nbody, 9], and ``subtree_com`` [nbody, 3] where a light
            follows a centre of mass.

    Returns:
        Positions [L, 3] in metres and unit directions [L, 3], float32.
    """
    modes = mujoco.mjtCamLight
    body_position = jnp.asarray(data.xpos, jnp.float32)
    body_rotation = jnp.asarray(data.xmat, jnp.float32).reshape(-1, 3, 3)
    positions, directions = [], []
    for index, (mode, body, target) in enumerate(zip(scene.light_modes, scene.light_bodies, scene.light_targets, strict=True)):
        position, direction = scene.light_position[index], scene.light_direction[index]
        if mode == modes.mjCAMLIGHT_TRACK:
            position = body_position[body] + position
        elif mode == modes.mjCAMLIGHT_TRACKCOM:
            position = jnp.asarray(data.subtree_com, jnp.float32)[body] + position
        else:
            position = body_position[body] + jnp.sum(body_rotation[body] * position, -1)
            direction = jnp.sum(body_rotation[body] * direction, -1)
        if target >= 0 and mode in (modes.mjCAMLIGHT_TARGETBODY, modes.mjCAMLIGHT_TARGETBODYCOM):
            by_body = mode == modes.mjCAMLIGHT_TARGETBODY
            aim = body_position[target] if by_body else jnp.asarray(data.subtree_com, jnp.float32)[target]
            direction = aim - position
        positions.append(position)
        directions.append(direction * jax.lax.rsqrt(jnp.sum(jnp.square(direction)) + 1e-20))
    return jnp.stack(positions), jnp.stack(directions)


def camera_lights(scene: Scene, data: Any, camera_position: jax.Array, camera_rotation: jax.Array) -> list[Light]:
    """The headlight, if it is on, and the model's lights, in the camera's frame."""
    lights = []
    if scene.headlight:
        ahead = jnp.array([0.0, 0.0, -1.0], jnp.float32)
        head = (scene.headlight_ambient, scene.headlight_diffuse, scene.headlight_specular)
        lights.append(Light(True, None, ahead, *head, None, None, None))
    if not scene.light_types:
        return lights
    positions, directions = light_poses(scene, data)
    positions = jnp.sum((positions - camera_position)[:, :, None] * camera_rotation, axis=1)
    directions = jnp.sum(directions[:, :, None] * camera_rotation, axis=1)
    for index, kind in enumerate(scene.light_types):
        colours = (scene.light_ambient[index], scene.light_diffuse[index], scene.light_specular[index])
        if kind == _DIRECTIONAL:
            lights.append(Light(True, None, directions[index], *colours, None, None, None))
            continue
        spot = kind == _SPOT
        lights.append(
            Light(
                False,
                positions[index],
                directions[index],
                *colours,
                scene.light_attenuation[index],
                jnp.cos(scene.light_cutoff[index] * (np.pi / 180.0)) if spot else None,
                scene.light_exponent[index] if spot else None,
            )
        )
    return lights


def _dot(left: Vector, right: Vector) -> jax.Array:
    return left[0] * right[0] + left[1] * right[1] + left[2] * right[2]


def _normalized(vector: Vector) -> Vector:
    scale = jax.lax.rsqrt(_dot(vector, vector) + 1e-30)
    return vector[0] * scale, vector[1] * scale, vector[2] * scale


def _power(base: jax.Array, exponent: jax.Array) -> jax.Array:
    """``base ** exponent`` for a base in [0, 1], with finite gradients at 0 and vectorised everywhere."""
    return jnp.exp(exponent * jnp.log(jnp.maximum(base, 1e-6)))


def _unit_normal(kinds: jax.Array, types: set[int], hit: Vector, half_length: jax.Array) -> Vector:
    """Outward normal in the unit shape's frame at ``hit``, not normalised. Only the types in ``types`` cost anything."""
    x, y, z = hit
    zero, one = jnp.zeros_like(x), jnp.ones_like(x)
    normal = (x, y, z)  # sphere and ellipsoid
    geom = mujoco.mjtGeom
    if geom.mjGEOM_CAPSULE in types:
        is_capsule = kinds == float(geom.mjGEOM_CAPSULE)
        normal = (x, y, jnp.where(is_capsule, z - jnp.clip(z, -half_length, half_length), z))
    if geom.mjGEOM_CYLINDER in types:
        is_cylinder = kinds == float(geom.mjGEOM_CYLINDER)
        # On the surface either |z| is 1 and the radius less, or the radius is 1 and |z| less.
        on_cap = z * z >= x * x + y * y
        wall = is_cylinder & ~on_cap
        cap = is_cylinder & on_cap
        normal = (jnp.where(cap, zero, normal[0]), jnp.where(cap, zero, normal[1]), jnp.where(wall, zero, normal[2]))
    if geom.mjGEOM_BOX in types:
        is_box = kinds == float(geom.mjGEOM_BOX)
        most = jnp.maximum(jnp.maximum(jnp.abs(x), jnp.abs(y)), jnp.abs(z))
        normal = tuple(
            jnp.where(is_box, jnp.where(jnp.abs(value) >= most, jnp.sign(value), zero), old)
            for value, old in zip(hit, normal, strict=True)
        )
    if geom.mjGEOM_PLANE in types:
        is_plane = kinds == float(geom.mjGEOM_PLANE)
        normal = tuple(jnp.where(is_plane, value, old) for value, old in zip((zero, zero, one), normal, strict=True))
    return normal


def shade(
    scene: Scene, shapes: UnitShapes, lights: list[Light], u: jax.Array, v: jax.Array, depth: jax.Array, winner: jax.Array
) -> Vector:
    """Colour of every pixel that sees an object (anything where nothing is hit).

    Args:
        scene: The scene.
        shapes: The drawn objects.
        lights: The lights in the camera's frame.
        u: [P] float32, see `camera.pixel_rays`.
        v: [P] float32.
        depth: [P] float32, planar metres.
        winner: [P] int32, index into the drawn objects, -1 where nothing is hit.

    Returns:
        Red, green and blue, each [P] float32 in [0, 1].
    """
    ids = np.array(scene.object_ids)
    kinds = jnp.asarray(scene.object_types, jnp.float32)
    columns = [
        *(shapes.origin[:, axis] for axis in range(3)),
        *(shapes.axes[:, row, column] for row in range(3) for column in range(3)),
        shapes.extra, kinds, scene.rgba[ids, 0], scene.rgba[ids, 1], scene.rgba[ids, 2],
        scene.emission[ids], scene.specular[ids], scene.shininess[ids],
    ]  # fmt: skip
    values = fetch(columns, winner)
    origin, axes, (half_length, kind), rgb = values[:3], values[3:12], values[12:14], values[14:17]
    emission, specular, shininess = values[17:]
    point = (depth * u, depth * v, -depth)
    hit = tuple(origin[row] + _dot(tuple(axes[3 * row : 3 * row + 3]), point) for row in range(3))
    bare = _unit_normal(kind, set(scene.object_types), hit, half_length)
    # The normal is a gradient: it goes back to the camera's frame with the transpose of the map.
    normal = _normalized(tuple(axes[axis] * bare[0] + axes[3 + axis] * bare[1] + axes[6 + axis] * bare[2] for axis in range(3)))
    to_camera = _normalized((-u, -v, jnp.ones_like(u)))
    coloured = [emission if lights else emission + _AMBIENT_WITHOUT_LIGHTS] * 3
    highlight: list[Any] = [0.0] * 3
    for light in lights:
        factors = _light_factors(light, point, normal, to_camera, shininess)
        for channel in range(3):
            coloured[channel] += factors[0] * light.ambient[channel] + factors[1] * light.diffuse[channel]
            highlight[channel] += factors[2] * light.specular[channel]
    return tuple(
        jnp.clip(colour * base + specular * shine, 0.0, 1.0)
        for colour, base, shine in zip(coloured, rgb, highlight, strict=True)
    )


def _light_factors(light: Light, point: Vector, normal: Vector, to_camera: Vector, shininess: jax.Array) -> tuple:
    """What the ambient, diffuse and specular colour of one light are multiplied with, each [P]."""
    if light.directional:
        to_light = tuple(-light.direction[axis] for axis in range(3))
        fade = 1.0
    else:
        assert light.position is not None and light.attenuation is not None
        offset = tuple(light.position[axis] - point[axis] for axis in range(3))
        distance_square = _dot(offset, offset)
        inverse_distance = jax.lax.rsqrt(distance_square + 1e-20)
        distance = distance_square * inverse_distance
        to_light = tuple(component * inverse_distance for component in offset)
        constant, linear, quadratic = (light.attenuation[index] for index in range(3))
        fade = 1.0 / (constant + linear * distance + quadratic * distance_square)
        if light.cosine_cutoff is not None:
            assert light.exponent is not None
            along = -_dot(to_light, tuple(light.direction[axis] for axis in range(3)))
            fade = jnp.where(along >= light.cosine_cutoff, fade * _power(along, light.exponent), 0.0)
    facing = jnp.maximum(_dot(normal, to_light), 0.0)
    halfway = _normalized(tuple(to_light[axis] + to_camera[axis] for axis in range(3)))
    shine = jnp.where(facing > 0.0, _power(_dot(normal, halfway), 128.0 * shininess), 0.0)
    return fade, fade * facing, fade * shine


def fetch(columns: list[jax.Array], winner: jax.Array) -> list[jax.Array]:
    """Each column's value for every pixel's winner: [G] each and [P] -> [P] each."""
    index = jnp.maximum(winner, 0)
    if jax.default_backend() == "cpu":
        # One row per pixel is kept and read by all that follows; a column at a time is looked up anew for every use.
        table = jnp.stack(columns, axis=-1)
        rows = table.at[index].get(mode="promise_in_bounds")
        return [rows[:, column] for column in range(len(columns))]
    return [column.at[index].get(mode="promise_in_bounds") for column in columns]


def _elevation(sine: jax.Array) -> jax.Array:
    """Arcsin over a right angle, within 5e-5 (Abramowitz and Stegun, 4.4.45). XLA's own is a slow library call on a CPU."""
    size = jnp.minimum(jnp.abs(sine), 1.0 - 1e-7)
    series = 1.5707288 + size * (-0.2121144 + size * (0.0742610 - 0.0187293 * size))
    return jnp.sign(sine) * (1.0 - jnp.sqrt(1.0 - size) * series * (2.0 / np.pi))


def sky(scene: Scene, camera_rotation: jax.Array, u: jax.Array, v: jax.Array) -> Vector:
    """Colour of the sky along every ray: MuJoCo's gradient between the colours straight up and straight down.

    Returns:
        Red, green and blue, each [P] float32 in [0, 1].
    """
    upward = camera_rotation[2, 0] * u + camera_rotation[2, 1] * v - camera_rotation[2, 2]
    sine = jnp.clip(upward * jax.lax.rsqrt(u * u + v * v + 1.0), -1.0, 1.0)
    elevation = _elevation(sine)
    # The curve that MuJoCo fills a gradient texture with; 0 straight down, 1 straight up.
    share = 0.5 + elevation * jax.lax.rsqrt(2.0 * (1.0 + elevation * elevation))
    return tuple(scene.sky_bottom[channel] * (1.0 - share) + scene.sky_top[channel] * share for channel in range(3))
