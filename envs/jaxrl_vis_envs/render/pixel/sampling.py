"""Texture sampling as in MuJoCo's renderer, and cube map lookups.

Bilinear within a mipmap level and linear between two (OpenGL's trilinear filter). See `textures` for the storage format.
"""

from typing import Any, Protocol

import jax
import jax.numpy as jnp

from jaxrl_vis_envs.render.scene import Scene


class Texels(Protocol):
    """Reader of a texture atlas: from arrays (`ArrayTexels`), or from blocks of memory in a kernel.

    Attributes:
        few_textures: True to check first if any pixel has a texture at all.
        differentiable: True if derivatives with respect to texture coordinates exist.
    """

    few_textures: bool
    differentiable: bool

    def level(self, number: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return first row in the texels, width and height of levels [P] int32; out-of-range numbers are clipped."""
        ...

    def quad(self, row: jax.Array) -> tuple[jax.Array, ...]:
        """Return the four packed texels of rows [P] int32; out-of-range rows are clipped."""
        ...


class ArrayTexels:
    """Atlas in arrays: texels [T, 4] uint32 and levels as in `textures.Atlas`."""

    few_textures = False
    differentiable = True

    def __init__(self, texels: jax.Array, levels: tuple[tuple[int, int, int], ...]):
        self.texels, self.levels = texels, jnp.asarray(levels, jnp.int32)

    def level(self, number: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """See `Texels`."""
        bounds = self.levels.at[jnp.clip(number, 0, len(self.levels) - 1)].get(mode="promise_in_bounds")
        return bounds[..., 0], bounds[..., 1], bounds[..., 2]

    def quad(self, row: jax.Array) -> tuple[jax.Array, ...]:
        """See `Texels`."""
        quad = self.texels.at[jnp.clip(row, 0, len(self.texels) - 1)].get(mode="promise_in_bounds")
        return tuple(quad[..., corner] for corner in range(4))


def atlas_reader(scene: Scene) -> Texels:
    """Return the reader of the scene's atlas: ``scene.texels`` if a kernel has replaced them by its own reader."""
    own: Any = scene.texels
    return own if hasattr(own, "quad") else ArrayTexels(own, scene.atlas.levels)


def sample(
    texels: Texels,
    first_level: jax.Array | int,
    level_count: jax.Array | int,
    face: jax.Array | int,
    coordinates: tuple[jax.Array, jax.Array],
    spread_square: jax.Array,
    repeats: jax.Array | bool,
    alpha: bool = False,
) -> tuple[jax.Array, ...]:
    """Sample textures at many points.

    Args:
        texels: Atlas reader.
        first_level: [P] int32 or an int, first level of the texture.
        level_count: [P] int32 or an int, number of its levels.
        face: [P] int32 or an int, face of a cube.
        coordinates: Horizontal and vertical texture coordinates, [P] float32 each; 0 to 1 is the whole image.
        spread_square: [P] float32, squared footprint of a pixel in texels of the finest level.
        repeats: [P] bool or a bool, True to repeat the image beyond its border, False to clamp to the border.
        alpha: Also return alpha.

    Returns:
        Red, green and blue, and alpha if requested, [P] float32 each, in [0, 1].
    """
    level = jnp.clip(0.5 * jnp.log2(jnp.maximum(spread_square, 1e-12)), 0.0, level_count - 1.0)
    fine = jnp.floor(level)
    weight = level - fine
    fine = fine.astype(jnp.int32)
    coarse = jnp.minimum(fine + 1, level_count - 1)
    near = _bilinear(texels, first_level + fine, face, coordinates, repeats, alpha)
    far = _bilinear(texels, first_level + coarse, face, coordinates, repeats, alpha)
    return tuple(a + weight * (b - a) for a, b in zip(near, far, strict=True))


def _bilinear(
    texels: Texels, level: jax.Array, face: jax.Array | int, coordinates: tuple, repeats: jax.Array | bool, alpha: bool
) -> tuple:
    first, *shape = texels.level(level)
    lows, shares = [], []
    for axis in range(2):
        count = shape[axis].astype(jnp.float32)
        at = coordinates[axis] * count - 0.5
        at = jnp.where(repeats, at, jnp.clip(at, 0.0, count - 1.0))
        low = jnp.floor(at)
        shares.append(at - low)
        lows.append((low - count * jnp.floor(low / count)).astype(jnp.int32))
    index = first + (face * shape[1] + lows[1]) * shape[0] + lows[0]
    quad = texels.quad(index)
    colour = (_mixed if texels.differentiable else _mix)(quad, *shares)
    return (*colour, _mix_alpha(quad, *shares)) if alpha else colour


def _mix_alpha(corners: tuple, right: jax.Array, below: jax.Array) -> jax.Array:
    """Interpolate alpha between four texels."""
    one, two, three, four = ((corner >> 24).astype(jnp.int32).astype(jnp.float32) / 255.0 for corner in corners)
    upper, lower = one + right * (two - one), three + right * (four - three)
    return upper + below * (lower - upper)


def _mix(corners: tuple, right: jax.Array, below: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Interpolate red, green and blue between four texels, with weights quantised to 1/256 as in graphics hardware.

    Two channels then share one integer product.
    """
    right, below = ((256.0 * share + 0.5).astype(jnp.int32) for share in (right, below))
    both = (right * below + 128) >> 8
    weights = (256 - right - below + both, right - both, below - both, both)
    red_blue, green = jnp.uint32(0), jnp.uint32(0)
    for texel, weight in zip(corners, weights, strict=True):
        weight = weight.astype(jnp.uint32)
        red_blue += (texel & 0xFF00FF) * weight
        green += ((texel >> 8) & 0xFF) * weight
    red, green, blue = (
        part.astype(jnp.int32).astype(jnp.float32) * (1.0 / (255.0 * 256.0))
        for part in (red_blue & 0xFFFF, green, red_blue >> 16)
    )
    return red, green, blue


_mixed = jax.custom_jvp(_mix)


@_mixed.defjvp
def _mix_tangents(primals: tuple, tangents: tuple) -> tuple[tuple, tuple]:
    """Differentiate the interpolation in floating point, since the integer arithmetic has no derivative."""
    corners, right, below = primals
    _, right_tangent, below_tangent = tangents
    colour_tangents = []
    for channel in range(3):
        one, two, three, four = (((c >> (8 * channel)) & 255).astype(jnp.int32).astype(jnp.float32) / 255.0 for c in corners)
        to_right = (two - one) * (1.0 - below) + (four - three) * below
        to_below = (three - one) * (1.0 - right) + (four - two) * right
        colour_tangents.append(to_right * right_tangent + to_below * below_tangent)
    return _mix(corners, right, below), tuple(colour_tangents)


def cube_coordinates(direction: tuple) -> tuple[jax.Array, tuple[jax.Array, jax.Array], tuple]:
    """Compute the face and the coordinates of a direction in a cube map, as in OpenGL.

    Args:
        direction: Three [P] float32, of any norm.

    Returns:
        Face [P] int32, horizontal and vertical coordinates on it ([P] each), and the choice of axes for `cube_tangent`.
    """
    x, y, z = direction
    ax, ay, az = jnp.abs(x), jnp.abs(y), jnp.abs(z)
    along_x = (ax >= ay) & (ax >= az)
    along_y = ~along_x & (ay >= az)
    major = jnp.where(along_x, x, jnp.where(along_y, y, z))
    negative = major < 0.0
    face = jnp.where(along_x, 0, jnp.where(along_y, 2, 4)) + negative
    sign = jnp.where(negative, -1.0, 1.0)
    across = jnp.where(along_x, -sign * z, jnp.where(along_y, x, sign * x))
    down = jnp.where(along_y, sign * z, -y)
    inverse = 0.5 / jnp.maximum(jnp.abs(major), 1e-20)
    coordinates = (across * inverse + 0.5, down * inverse + 0.5)
    return face, coordinates, (along_x, along_y, sign, inverse)


def cube_tangent(choice: tuple, coordinates: tuple, change: tuple) -> tuple[jax.Array, jax.Array]:
    """Compute the change of coordinates on a cube's face ([P] each) for a ``change`` of the direction."""
    along_x, along_y, sign, inverse = choice
    x, y, z = change
    major = sign * jnp.where(along_x, x, jnp.where(along_y, y, z))
    across = jnp.where(along_x, -sign * z, jnp.where(along_y, x, sign * x))
    down = jnp.where(along_y, sign * z, -y)
    return (across - (2.0 * coordinates[0] - 1.0) * major) * inverse, (down - (2.0 * coordinates[1] - 1.0) * major) * inverse
