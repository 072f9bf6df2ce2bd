"""Lights in the camera's frame, once per environment, and their contributions to surface points."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxrl_vis_envs.render import mounts
from jaxrl_vis_envs.render.pixel.arithmetic import Vector, dot, maximum, normalized, power
from jaxrl_vis_envs.render.scene import Scene

_DIRECTIONAL = int(mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
_SPOT = int(mujoco.mjtLightType.mjLIGHT_SPOT)
COLUMNS = 20
"""Columns of the light table: six vectors and two numbers."""


class Light(NamedTuple):
    """Light in the camera's frame. Vectors are arrays [3] or three scalars; all other values are scalars.

    Attributes:
        is_directional: True for a directional light.
        has_highlights: True if the light can cause specular highlights.
        casts_shadows: True if the light casts shadows.
        position: Position, m; None for a directional light.
        direction: Unit vector along which the light shines.
        ambient: Ambient colour.
        diffuse: Diffuse colour.
        specular: Specular colour.
        attenuation: Constant, linear (1/m) and quadratic (1/m^2) attenuation; None for a directional light.
        cosine_cutoff: Cosine of the cone's half-angle; None except for a spot light.
        exponent: Exponent of the falloff from the cone's axis; None except for a spot light.
    """

    is_directional: bool
    has_highlights: bool
    casts_shadows: bool
    position: jax.Array | None
    direction: jax.Array
    ambient: jax.Array
    diffuse: jax.Array
    specular: jax.Array
    attenuation: jax.Array | None
    cosine_cutoff: jax.Array | None
    exponent: jax.Array | None


def light_poses(scene: Scene, data: Any) -> tuple[jax.Array, jax.Array]:
    """Compute the world poses of the scene's lights.

    Args:
        scene: The scene.
        data: Physics data with the body poses that `mounts.mount_position` reads.

    Returns:
        Positions [L, 3] in metres and unit directions [L, 3], float32.
    """
    bodies = mounts.Bodies(scene.body_mass, scene.body_parents)
    positions, directions = [], []
    for index, mount in enumerate(scene.light_mounts):
        position, frame = mounts.mount_position(bodies, data, mount, scene.light_position[index])
        direction = scene.light_direction[index]
        if mount.aims:
            direction = mounts.target_position(bodies, data, mount) - position
        elif frame is not None:
            direction = jnp.sum(frame * direction, -1)
        positions.append(position)
        directions.append(direction * jax.lax.rsqrt(jnp.sum(jnp.square(direction)) + 1e-20))
    return jnp.stack(positions), jnp.stack(directions)


def camera_lights(scene: Scene, data: Any, camera_position: jax.Array, camera_rotation: jax.Array) -> list[Light]:
    """Return the headlight, if it is on, and the model's lights, in the camera's frame."""
    lights = []
    if scene.headlight:
        ahead = jnp.array([0.0, 0.0, -1.0], jnp.float32)
        head = (scene.headlight_ambient, scene.headlight_diffuse, scene.headlight_specular)
        lights.append(Light(True, scene.light_highlights[-1], False, None, ahead, *head, None, None, None))
    if not scene.light_types:
        return lights
    positions, directions = light_poses(scene, data)
    positions = jnp.sum((positions - camera_position)[:, :, None] * camera_rotation, axis=1)
    directions = jnp.sum(directions[:, :, None] * camera_rotation, axis=1)
    for index, kind in enumerate(scene.light_types):
        colours = (scene.light_ambient[index], scene.light_diffuse[index], scene.light_specular[index])
        facts = (kind == _DIRECTIONAL, scene.light_highlights[index], scene.light_shadows[index])
        if kind == _DIRECTIONAL:
            lights.append(Light(*facts, None, directions[index], *colours, None, None, None))
            continue
        cutoff = scene.light_cutoff[index]
        # OpenGL supports cones of up to 90 degrees; a light with a wider one shines in all directions.
        cosine = jnp.where(cutoff > 90.0, -2.0, jnp.cos(cutoff * (np.pi / 180.0))) if kind == _SPOT else None
        exponent = jnp.where(cutoff > 90.0, 0.0, scene.light_exponent[index]) if kind == _SPOT else None
        attenuation = scene.light_attenuation[index]
        lights.append(Light(*facts, positions[index], directions[index], *colours, attenuation, cosine, exponent))
    return lights


class LightFacts(NamedTuple):
    """Static properties of a light: three as in `Light`, and ``is_spot``, True for a spot light."""

    is_directional: bool
    has_highlights: bool
    casts_shadows: bool
    is_spot: bool


def facts(scene: Scene) -> list[LightFacts]:
    """Return the static properties of the lights, in the order of `camera_lights`."""
    properties = zip(scene.light_types, scene.light_highlights, scene.light_shadows, strict=False)
    model_lights = [
        LightFacts(kind == _DIRECTIONAL, highlights, shadows, kind == _SPOT) for kind, highlights, shadows in properties
    ]
    return [LightFacts(True, scene.light_highlights[-1], False, False)] * scene.headlight + model_lights


def pack(lights: list[Light]) -> jax.Array:
    """Pack all parameters of the lights into one table: [L, COLUMNS] float32."""
    rows = []
    for light in lights:
        zeros, zero = jnp.zeros(3, jnp.float32), jnp.zeros((), jnp.float32)
        vectors = (light.position, light.direction, light.ambient, light.diffuse, light.specular, light.attenuation)
        numbers = (light.cosine_cutoff, light.exponent)
        rows.append(
            jnp.concatenate(
                [zeros if vector is None else vector for vector in vectors]
                + [(zero if number is None else number)[None] for number in numbers]
            )
        )
    return jnp.stack(rows) if rows else jnp.zeros((0, COLUMNS), jnp.float32)


def unpack(scene: Scene, table: Any) -> list[Light]:
    """Invert `pack`, with vectors as three scalars. The table may be an array or, in a kernel, a block of memory."""
    lights = []
    for index, fact in enumerate(facts(scene)):
        values = [table[index, column] for column in range(COLUMNS)]
        vectors: list[Any] = [tuple(values[first : first + 3]) for first in range(0, 18, 3)]
        if fact.is_directional:
            vectors[0] = vectors[5] = None
        cone = values[18:] if fact.is_spot else (None, None)
        lights.append(Light(*fact[:3], *vectors, *cone))
    return lights


def light_vector(light: Light, point: Vector) -> tuple[Vector, jax.Array | None, jax.Array | None]:
    """Return unit vectors to the light, distances (m) and their inverses, [P] each; the last two are None if directional."""
    if light.is_directional:
        return tuple(-light.direction[axis] for axis in range(3)), None, None
    assert light.position is not None
    offset = tuple(light.position[axis] - point[axis] for axis in range(3))
    distance_square = dot(offset, offset)
    inverse = jax.lax.rsqrt(distance_square + 1e-20)
    return tuple(component * inverse for component in offset), distance_square * inverse, inverse


def may_brighten(light: Light, point: Vector, normal: Vector) -> jax.Array:
    """Return False where a light adds nothing to a surface point, [P] bool: where `light_factors` times its colours are 0.

    Args:
        light: The light.
        point: Surface point in the camera's frame.
        normal: Unit outward normal.
    """
    to_light, _, _ = light_vector(light, point)
    brightens = dot(normal, to_light) > 0.0
    for channel in range(3):
        brightens = brightens | (light.ambient[channel] != 0.0)
    if light.cosine_cutoff is None:
        return brightens
    return brightens & (-dot(to_light, tuple(light.direction[axis] for axis in range(3))) >= light.cosine_cutoff)


def light_factors(
    light: Light, point: Vector, normal: Vector, to_camera: Vector, exponent: jax.Array, lit: jax.Array | None
) -> tuple:
    """Compute the factors of a light's ambient, diffuse and specular colour, each [P] or a scalar.

    Args:
        light: The light.
        point: Surface point in the camera's frame.
        normal: Unit outward normal.
        to_camera: Unit vector to the camera.
        exponent: Exponent of the highlight.
        lit: [P], 1 where the light is visible from the point, 0 in shadow; None if it casts no shadows.
    """
    to_light, distance, _ = light_vector(light, point)
    fade: Any = 1.0
    if distance is not None:
        assert light.attenuation is not None
        constant, linear, quadratic = (light.attenuation[index] for index in range(3))
        fade = 1.0 / (constant + distance * (linear + quadratic * distance))
        if light.cosine_cutoff is not None:
            assert light.exponent is not None
            along = -dot(to_light, tuple(light.direction[axis] for axis in range(3)))
            fade = jnp.where(along >= light.cosine_cutoff, fade * power(along, light.exponent), 0.0)
    if lit is not None:
        fade = fade * lit
    facing = maximum(dot(normal, to_light), 0.0)
    shine: Any = 0.0
    if light.has_highlights:
        halfway = normalized(tuple(to_light[axis] + to_camera[axis] for axis in range(3)))
        shine = fade * jnp.where(facing > 0.0, power(dot(normal, halfway), exponent), 0.0)
    return fade, fade * facing, shine
