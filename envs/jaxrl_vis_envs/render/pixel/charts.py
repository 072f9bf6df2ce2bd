"""MuJoCo's mapping of flat textures onto shapes: surface coordinates from -1 to 1, horizontal and vertical."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs.render.pixel import shapes


def chart(types: set[int], kind: jax.Array, half_length: jax.Array, local: tuple) -> tuple[jax.Array, jax.Array]:
    """Compute surface coordinates of points on shapes.

    Args:
        types: Types that may occur among objects with a flat texture; only these are computed.
        kind: Type of each point's shape.
        half_length: Half-length of a capsule over its radius.
        local: Points in the unit shape's frame, three [P] float32.

    Returns:
        Two [P] float32, horizontal and vertical. Planes and other types: x and y. Sides of boxes: z is vertical. Round shapes:
        the azimuth is horizontal, the elevation (for a cylinder, z) vertical; the caps of a cylinder are like planes upside
        down.
    """
    x, y, z = local
    across, up = x, y
    if shapes.BOX in types:
        size_x, size_y, size_z = jnp.abs(x), jnp.abs(y), jnp.abs(z)
        on_x = (size_x >= size_y) & (size_x >= size_z)
        on_side = on_x | (size_y >= size_z)
        is_box = kind == shapes.BOX
        across = jnp.where(is_box & on_x, y, across)
        up = jnp.where(is_box & on_side, z, up)
    if types & {shapes.SPHERE, shapes.ELLIPSOID, shapes.CYLINDER, shapes.CAPSULE}:
        around = 2.0 * _azimuth(x, y) - 1.0
        round_, height = jnp.zeros_like(x, bool), z
        if types & {shapes.SPHERE, shapes.ELLIPSOID}:
            is_ball = (kind == shapes.SPHERE) | (kind == shapes.ELLIPSOID)
            round_, height = is_ball, jnp.where(is_ball, elevation(z), height)
        if shapes.CAPSULE in types:
            is_capsule = kind == shapes.CAPSULE
            beyond = z - jnp.clip(z, -half_length, half_length)
            # Each cap spans the whole height of the texture.
            capped = 2.0 * elevation(beyond) - jnp.sign(beyond)
            on_capsule = jnp.where(beyond == 0.0, z / jnp.maximum(half_length, 1e-9), capped)
            round_, height = round_ | is_capsule, jnp.where(is_capsule, on_capsule, height)
        if shapes.CYLINDER in types:
            is_cylinder = kind == shapes.CYLINDER
            on_cap = z * z >= x * x + y * y
            up = jnp.where(is_cylinder & on_cap, -y, up)
            round_ = round_ | (is_cylinder & ~on_cap)
        across, up = jnp.where(round_, around, across), jnp.where(round_, height, up)
    return across, up


def _azimuth(x: jax.Array, y: jax.Array) -> jax.Array:
    """Compute the angle around z in turns, 0 to 1, accurate to 1e-6."""
    size_x, size_y = jnp.abs(x), jnp.abs(y)
    steep = size_y > size_x
    ratio = jnp.where(steep, size_x, size_y) / jnp.maximum(jnp.where(steep, size_y, size_x), 1e-20)
    square = ratio * ratio
    terms = (-0.33262347, 0.19354346, -0.11643287, 0.05265332, -0.01172120)
    series = jnp.zeros_like(square)
    for term in reversed(terms):
        series = square * (term + series)
    angle = ratio * (0.99997726 + series) * (0.5 / np.pi)
    angle = jnp.where(steep, 0.25 - angle, angle)
    angle = jnp.where(x < 0.0, 0.5 - angle, angle)
    return jnp.where(y < 0.0, 1.0 - angle, angle)


def elevation(sine: jax.Array) -> jax.Array:
    """Compute arcsin / (pi / 2) within 5e-5 (Abramowitz and Stegun, 4.4.45). XLA's own is a slow library call on a CPU."""
    size = jnp.minimum(jnp.abs(sine), 1.0 - 1e-7)
    series = 1.5707288 + size * (-0.2121144 + size * (0.0742610 - 0.0187293 * size))
    return jnp.sign(sine) * (1.0 - jnp.sqrt(1.0 - size) * series * (2.0 / np.pi))
