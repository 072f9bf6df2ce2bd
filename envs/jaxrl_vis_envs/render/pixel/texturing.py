"""Texture colour of each pixel: texture coordinates and the pixel's footprint in texels."""

import jax
import jax.numpy as jnp

from jaxrl_vis_envs.render import camera
from jaxrl_vis_envs.render.model import textures
from jaxrl_vis_envs.render.pixel import charts, sampling, shapes, surface
from jaxrl_vis_envs.render.pixel.arithmetic import Vector, dot
from jaxrl_vis_envs.render.pixel.lookup import Row, TextureRow
from jaxrl_vis_envs.render.pixel.surface import Hit
from jaxrl_vis_envs.render.scene import Scene


def texture_colour(scene: Scene, row: Row, hit: Hit, alpha: bool = False) -> Vector | None:
    """Compute the texture's red, green and blue ([P] each, in [0, 1]), factors of the surface colour; None without textures.

    With ``alpha``, a fourth component is the texture's alpha, which all textures must have.
    """
    if not scene.atlas.has_textures:
        return None
    texture = row.texture
    assert texture is not None
    if not sampling.atlas_reader(scene).few_textures:
        return _texture_colour(scene, row, texture, hit, alpha)
    plain = (jnp.ones_like(hit.depth),) * 3
    any_texture = jnp.max(texture.mapping) > 0.0
    return jax.lax.cond(any_texture, lambda: _texture_colour(scene, row, texture, hit, False), lambda: plain)


def _texture_colour(scene: Scene, row: Row, texture: TextureRow, hit: Hit, alpha: bool) -> Vector:
    """Compute `texture_colour` for a scene with textures."""
    changes = _changes(scene, row, hit)
    flat = {kind for kind, mapping in zip(scene.object_types, scene.atlas.mappings, strict=True) if mapping == textures.FLAT}

    def chart(*local):
        across, up = charts.chart(flat, row.kind, row.extra, local)
        return texture.scale[0] * across + texture.shift[0], texture.scale[1] * up + texture.shift[1]

    coordinates: tuple = chart(*hit.local)
    tangents = [jax.jvp(chart, hit.local, change)[1] for change in changes]
    face: jax.Array | int = 0
    repeats: jax.Array | bool = True
    if textures.UNWRAPPED in scene.atlas.mappings and hit.triangle is not None:
        is_unwrapped, corners = texture.mapping == textures.UNWRAPPED, hit.triangle.coordinates
        own = surface.mix(corners, surface.barycentric(hit.triangle, hit.local))
        coordinates = tuple(jnp.where(is_unwrapped, s * o, p) for s, o, p in zip(texture.scale, own, coordinates))
        for number, change in enumerate(changes):
            tangent = surface.mix(corners, surface.barycentric(hit.triangle, change, is_tangent=True), is_tangent=True)
            tangents[number] = tuple(
                jnp.where(is_unwrapped, s * t, m) for s, t, m in zip(texture.scale, tangent, tangents[number])
            )
    if textures.CUBE in scene.atlas.mappings:
        is_cube = texture.mapping == textures.CUBE
        x, y, z = hit.local
        if shapes.CAPSULE in scene.object_types:
            middle = jnp.clip(z, -row.extra, row.extra)
            z = jnp.where(row.kind == shapes.CAPSULE, middle / jnp.maximum(row.extra, 1e-9) + (z - middle), z)
        scaled = tuple(scale * value for scale, value in zip(texture.scale, (x, y, z), strict=True))
        cube_face, cube_coordinates, choice = sampling.cube_coordinates(scaled)
        face = jnp.where(is_cube & (texture.six_faces > 0.0), cube_face, 0)
        coordinates = tuple(jnp.where(is_cube, c, p) for c, p in zip(cube_coordinates, coordinates, strict=True))
        repeats = ~is_cube
        for number, change in enumerate(changes):
            tangent = sampling.cube_tangent(
                choice, cube_coordinates, tuple(s * c for s, c in zip(texture.scale, change, strict=True))
            )
            tangents[number] = tuple(jnp.where(is_cube, c, t) for c, t in zip(tangent, tangents[number], strict=True))
    spreads = [jnp.square(across * texture.width) + jnp.square(down * texture.height) for across, down in tangents]
    colour = sampling.sample(
        sampling.atlas_reader(scene),
        jnp.asarray(texture.first_level, jnp.int32),
        jnp.asarray(texture.levels, jnp.int32),
        face,
        coordinates,
        jnp.maximum(spreads[0], spreads[1]),
        repeats,
        alpha,
    )
    return tuple(jnp.where(texture.mapping > 0.0, value, 1.0) for value in colour)


def _changes(scene: Scene, row: Row, hit: Hit) -> list[Vector]:
    """Compute the change of the hit point in the unit shape's frame from one pixel to the next, horizontally and vertically."""
    perspective = scene.projection != "orthographic"
    direction = tuple(p / hit.depth for p in hit.point) if perspective else (0.0, 0.0, -1.0)
    ray = camera.multiply(row.axes, direction)
    changes = []
    for axis, pitch in enumerate(camera.pixel_pitch(scene)):
        across = tuple(row.axes[i][axis] * (pitch * hit.depth if perspective else pitch) for i in range(3))
        along = dot(hit.gradient, across) / hit.slope
        changes.append(tuple(a - along * r for a, r in zip(across, ray, strict=True)))
    return changes
