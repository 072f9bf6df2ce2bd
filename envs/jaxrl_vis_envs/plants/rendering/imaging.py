"""Camera model from radiance to pixel values: lens, exposure, sensor noise, tone curve. Plain JAX."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs.plants.rendering.texture import approximate_normal, hash_words

_PSF_RADIUS = 4  # pixels, of the point spread function


class Exposure(NamedTuple):
    """Exposure parameters of one image, all [] float32 except the seed.

    Attributes:
        gain: Brightness.
        blur: Standard deviation of the point spread function, pixels.
        vignetting: Relative loss of light in the corners.
        full_well: Electrons in a white pixel.
        read_noise: Read noise, electrons.
        noise: Factor of the standard deviation of all noise.
        seed: [] uint32, seed of the noise.
    """

    gain: float | jax.Array
    blur: float | jax.Array
    vignetting: float | jax.Array
    full_well: float | jax.Array
    read_noise: float | jax.Array
    noise: float | jax.Array
    seed: int | jax.Array


def expose(radiance: jax.Array, exposure: Exposure) -> jax.Array:
    """Simulate the image that a camera takes.

    Args:
        radiance: [H, W, 3] float32; 1 is white at a gain of 1.
        exposure: Exposure parameters.

    Returns:
        [H, W, 3] uint8, with the tone curve of sRGB.
    """
    arrays = jax.tree.map(np.float32, exposure._replace(seed=0))._replace(seed=np.uint32(exposure.seed))
    return _expose(radiance, arrays)


@jax.jit
def _expose(radiance: jax.Array, exposure: Exposure) -> jax.Array:
    height, width, _ = radiance.shape
    taps = jnp.exp(-0.5 * (jnp.arange(-_PSF_RADIUS, _PSF_RADIUS + 1) / jnp.maximum(exposure.blur, 0.05)) ** 2)
    taps = taps / taps.sum()
    for axis in (0, 1):
        padded = jnp.pad(radiance, [(_PSF_RADIUS, _PSF_RADIUS) if index == axis else (0, 0) for index in range(3)], mode="edge")
        size = radiance.shape[axis]
        radiance = sum(  # pyright: ignore
            taps[k] * jax.lax.slice_in_dim(padded, k, k + size, axis=axis) for k in range(2 * _PSF_RADIUS + 1)
        )
    x = (jnp.arange(width) - (width - 1) / 2) / (math.hypot(width, height) / 2)
    y = (jnp.arange(height) - (height - 1) / 2) / (math.hypot(width, height) / 2)
    falloff = 1.0 - exposure.vignetting * (x[None, :] ** 2 + y[:, None] ** 2)
    electrons = radiance * (falloff * exposure.gain * exposure.full_well)[..., None]
    index = jnp.arange(height * width * 3, dtype=jnp.uint32).reshape(height, width, 3)
    drawn = approximate_normal(hash_words(index, jnp.broadcast_to(exposure.seed, index.shape)))
    deviation = exposure.noise * jnp.sqrt(jnp.maximum(electrons, 0.0) + exposure.read_noise**2)
    signal = jnp.clip((electrons + deviation * drawn) / exposure.full_well, 0.0, 1.0)
    curved = jnp.where(signal <= 0.0031308, 12.92 * signal, 1.055 * signal ** (1 / 2.4) - 0.055)
    return jnp.round(curved * 255.0).astype(jnp.uint8)
