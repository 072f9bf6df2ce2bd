"""The colour of the texture that each pixel sees: where on the image it looks, and how many texels it spans there."""

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
    """Red, green and blue that the colour is multiplied with, [P] each in [0, 1]; None in a scene without textures.

    With ``alpha`` there is a fourth, for textures that all have it.
    """
    if not scene.atlas.used:
        return None
    texture = row.texture
    assert texture is not None
    if not sampling.texels_of(scene).few_textures:
        return _texture_colour(scene, row, texture, hit, alpha)
    plain = (jnp.ones_like(hit.depth),) * 3
    any_texture = jnp.max(texture.mapping) > 0.0
    return jax.lax.cond(any_texture, lambda: _texture_colour(scene, row, texture, hit, False), lambda: plain)


def _texture_colour(scene: Scene, row: Row, texture: TextureRow, hit: Hit, alpha: bool) -> Vector:
    """`texture_colour` of a scene that has textures."""
    changes = _changes(scene, row, hit)
    flat = {kind for kind, how in zip(scene.object_types, scene.atlas.mappings, strict=True) if how == textures.FLAT}

    def chart(*local):
        across, up = charts.chart(flat, row.kind, row.extra, local)
        return texture.scale[0] * across + texture.shift[0], texture.scale[1] * up + texture.shift[1]

    place: tuple = chart(*hit.local)
    moves = [jax.jvp(chart, hit.local, change)[1] for change in changes]
    face: jax.Array | int = 0
    repeats: jax.Array | bool = True
    if textures.UNWRAPPED in scene.atlas.mappings and hit.triangle is not None:
        unwrapped, corners = texture.mapping == textures.UNWRAPPED, hit.triangle.coordinates
        own = surface.mix(corners, surface.shares(hit.triangle, hit.local))
        place = tuple(jnp.where(unwrapped, s * o, p) for s, o, p in zip(texture.scale, own, place))
        for number, change in enumerate(changes):
            turned = surface.mix(corners, surface.shares(hit.triangle, change, moved=True), moved=True)
            moves[number] = tuple(jnp.where(unwrapped, s * t, m) for s, t, m in zip(texture.scale, turned, moves[number]))
    if textures.CUBE in scene.atlas.mappings:
        is_cube = texture.mapping == textures.CUBE
        x, y, z = hit.local
        if shapes.CAPSULE in scene.object_types:
            middle = jnp.clip(z, -row.extra, row.extra)
            z = jnp.where(row.kind == shapes.CAPSULE, middle / jnp.maximum(row.extra, 1e-9) + (z - middle), z)
        scaled = tuple(scale * value for scale, value in zip(texture.scale, (x, y, z), strict=True))
        cube_face, cube_place, choice = sampling.cube_place(scaled)
        face = jnp.where(is_cube & (texture.six_faces > 0.0), cube_face, 0)
        place = tuple(jnp.where(is_cube, c, p) for c, p in zip(cube_place, place, strict=True))
        repeats = ~is_cube
        for number, change in enumerate(changes):
            turned = sampling.cube_move(choice, cube_place, tuple(s * c for s, c in zip(texture.scale, change, strict=True)))
            moves[number] = tuple(jnp.where(is_cube, c, move) for c, move in zip(turned, moves[number], strict=True))
    spreads = [jnp.square(across * texture.width) + jnp.square(down * texture.height) for across, down in moves]
    colour = sampling.sample(
        sampling.texels_of(scene),
        jnp.asarray(texture.first_level, jnp.int32),
        jnp.asarray(texture.levels, jnp.int32),
        face,
        place,
        jnp.maximum(spreads[0], spreads[1]),
        repeats,
        alpha,
    )
    return tuple(jnp.where(texture.mapping > 0.0, value, 1.0) for value in colour)


def _changes(scene: Scene, row: Row, hit: Hit) -> list[Vector]:
    """How the point in the unit shape's frame moves over the surface from one pixel to the next, across and up."""
    perspective = scene.projection != "orthographic"
    direction = tuple(p / hit.depth for p in hit.point) if perspective else (0.0, 0.0, -1.0)
    ray = camera.mapped(row.axes, direction)
    changes = []
    for axis, pitch in enumerate(camera.pixel_pitch(scene)):
        across = tuple(row.axes[i][axis] * (pitch * hit.depth if perspective else pitch) for i in range(3))
        along = dot(hit.gradient, across) / hit.slope
        changes.append(tuple(a - along * r for a, r in zip(across, ray, strict=True)))
    return changes
