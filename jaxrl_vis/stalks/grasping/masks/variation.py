"""Augmentation of crops: light, colours, textures, lean and scale, which a mask must not depend on.

A network trained on one family of plants relies on its colours and brightness; in a family with others it misses half of the
pixels. The augmentation is generic: none of its values is taken from a shifted family.
"""

import math

import jax
import jax.numpy as jnp

_UNCHANGED_FRACTION = 0.2  # fraction of crops that are only mirrored
_TAPS = 4  # radius of the blur's kernel, pixels


def augment(images: jax.Array, masks: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Augment crops in exposure, contrast, colour, texture, blur, noise, scale and lean, and mirror half of them.

    The strength is sampled per crop; for a fifth of them, it is 0, except for mirroring and a negligible blur.

    Args:
        images: [N, H, W, 3] uint8.
        masks: [N, H, W] bool.
        key: Typed key, [].

    Returns:
        Augmented images [N, H, W, 3] uint8 and masks [N, H, W] bool.
    """
    keys = dict(zip(("strength", "kept", "place", "texture", "colour", "light", "blur", "noise"), jax.random.split(key, 8)))
    count = len(images)
    strength = jax.random.uniform(keys["strength"], (count,), minval=0.3)
    strength = jnp.where(jax.random.bernoulli(keys["kept"], _UNCHANGED_FRACTION, (count,)), 0.0, strength)
    values, masks = _transform(images.astype(jnp.float32) / 255.0, masks, strength, keys["place"])
    strengths = strength[:, None, None, None]
    values = values * _textures(values.shape, strengths, keys["texture"])
    values = _shift_colours(values, strengths, keys["colour"])
    values = _shade(values, strengths, keys["light"])
    values = _blur(values, strength, keys["blur"])
    level, shot = jax.random.split(keys["noise"])
    amount = 0.06 * strengths * jax.random.uniform(level, strengths.shape)
    values = values + amount * jnp.sqrt(jnp.maximum(values, 0.05)) * jax.random.normal(shot, values.shape)
    return jnp.round(255.0 * jnp.clip(values, 0.0, 1.0)).astype(jnp.uint8), masks


def _transform(values: jax.Array, masks: jax.Array, strength: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Scale, stretch and shear crops and masks about their centres, and mirror half; edge pixels are repeated beyond the edges.

    Args:
        values: [N, H, W, 3] float32, crops.
        masks: [N, H, W] bool.
        strength: [N] float32, 0 to 1.
        key: Typed key, [].
    """
    count, height, width = masks.shape
    draws = jax.random.uniform(key, (4, count), minval=-1.0, maxval=1.0)
    size, wide, shear = jnp.exp(0.3 * strength * draws[0]), jnp.exp(0.25 * strength * draws[1]), 0.2 * strength * draws[2]
    mirror = jnp.where(draws[3] > 0.0, 1.0, -1.0)
    row, column = jnp.meshgrid(jnp.arange(height) - 0.5 * (height - 1), jnp.arange(width) - 0.5 * (width - 1), indexing="ij")

    def resample(image: jax.Array, mask: jax.Array, size: jax.Array, wide: jax.Array, shear: jax.Array, mirror: jax.Array):
        y = jnp.clip(row / size + 0.5 * (height - 1), 0.0, height - 1.0)
        x = jnp.clip(mirror * (column / wide + shear * row) / size + 0.5 * (width - 1), 0.0, width - 1.0)
        top, left = jnp.floor(y).astype(jnp.int32), jnp.floor(x).astype(jnp.int32)
        below, right = jnp.minimum(top + 1, height - 1), jnp.minimum(left + 1, width - 1)
        down, over = (y - top)[..., None], (x - left)[..., None]
        both = jnp.concatenate([image, mask[..., None].astype(image.dtype)], axis=-1)
        upper = both[top, left] * (1 - over) + both[top, right] * over
        lower = both[below, left] * (1 - over) + both[below, right] * over
        mixed = upper * (1 - down) + lower * down
        return mixed[..., :3], mixed[..., 3] >= 0.5

    return jax.vmap(resample)(values, masks, size, wide, shear, mirror)


def _smooth_noise(key: jax.Array, shape: tuple[int, ...], rows: int, columns: int, channels: int = 1) -> jax.Array:
    """Sample smooth noise [N, H, W, channels] float32: normal values on a coarse grid, upsampled linearly.

    Args:
        key: Typed key, [].
        shape: Shape that begins with N, H and W.
        rows, columns: Size of the grid; at least 2 are used.
        channels: Number of channels.
    """
    coarse = jax.random.normal(key, (shape[0], max(rows, 2), max(columns, 2), channels))
    return jax.image.resize(coarse, (*shape[:3], channels), "linear")


def _textures(shape: tuple[int, ...], strength: jax.Array, key: jax.Array) -> jax.Array:
    """Sample brightness factors [N, H, W, 1]: blotches, fibres along stalks, bands across them, and dark speckles.

    Args:
        shape: Shape that begins with N, H and W.
        strength: [N, 1, 1, 1] float32, 0 to 1.
        key: Typed key, [].
    """
    height, width = shape[1:3]
    names = ("blotches", "patches", "fibres", "bands", "speckles", "amounts")
    keys = dict(zip(names, jax.random.split(key, 6)))
    amount = strength * jax.random.uniform(keys["amounts"], (5, shape[0], 1, 1, 1))
    grain = 0.5 * amount[0] * _smooth_noise(keys["blotches"], shape, height // 24, width // 24)
    grain += 0.5 * amount[1] * _smooth_noise(keys["patches"], shape, height // 6, width // 6)
    grain += 0.6 * amount[2] * _smooth_noise(keys["fibres"], shape, height // 96, width // 2)
    grain += 0.6 * amount[3] * _smooth_noise(keys["bands"], shape, height // 6, width // 48)
    spots = _smooth_noise(keys["speckles"], shape, height // 4, width // 3) > 2.2 - 1.4 * amount[4]
    return jnp.exp(grain) * jnp.where(spots, 1.0 - 0.8 * amount[4], 1.0)


def _shift_colours(values: jax.Array, strength: jax.Array, key: jax.Array) -> jax.Array:
    """Vary hue, saturation and colour cast of each crop, and the cast also within it.

    Args:
        values: [N, H, W, 3] float32, crops.
        strength: [N, 1, 1, 1] float32, 0 to 1.
        key: Typed key, [].
    """
    count = len(values)
    keys = dict(zip(("hue", "grey", "cast", "parts"), jax.random.split(key, 4)))
    angle = 0.4 * strength * jax.random.normal(keys["hue"], (count, 1, 1, 1))
    grey = values.mean(axis=-1, keepdims=True)
    colour = values - grey
    # Rotation about the grey axis (1, 1, 1) / sqrt(3), by the cross product with it.
    across = (jnp.roll(colour, 1, axis=-1) - jnp.roll(colour, -1, axis=-1)) / math.sqrt(3.0)
    colour = jnp.cos(angle) * colour + jnp.sin(angle) * across
    saturation = jnp.exp(strength * jax.random.uniform(keys["grey"], (count, 1, 1, 1), minval=-1.5, maxval=0.5))
    cast = 0.2 * strength * jax.random.normal(keys["cast"], (count, 1, 1, 3))
    return (grey + saturation * colour) * jnp.exp(cast + 0.15 * strength * _smooth_noise(keys["parts"], values.shape, 6, 6, 3))


def _shade(values: jax.Array, strength: jax.Array, key: jax.Array) -> jax.Array:
    """Vary gain, gamma, contrast and black level, and apply an illumination gradient towards a side or corner.

    Args:
        values: [N, H, W, 3] float32, crops.
        strength: [N, 1, 1, 1] float32, 0 to 1.
        key: Typed key, [].
    """
    count = len(values)
    gain, gamma, contrast, black, amount, ramp = jax.random.split(key, 6)

    def sample_uniform(key: jax.Array, low: float, high: float) -> jax.Array:
        return strength * jax.random.uniform(key, (count, 1, 1, 1), minval=low, maxval=high)

    values = jnp.maximum(values, 1e-4) ** jnp.exp(sample_uniform(gamma, -0.5, 0.5))
    middle = values.mean(axis=(1, 2, 3), keepdims=True)
    values = middle + (values - middle) * jnp.exp(sample_uniform(contrast, -0.5, 0.4))
    ramp = sample_uniform(amount, 0.0, 0.6) * _smooth_noise(ramp, values.shape, 2, 2)
    return values * jnp.exp(sample_uniform(gain, -1.1, 0.8) + ramp) + sample_uniform(black, 0.0, 0.08)


def _blur(values: jax.Array, strength: jax.Array, key: jax.Array) -> jax.Array:
    """Apply a Gaussian blur with a standard deviation of up to 1.3 pixels to crops; edge pixels are repeated.

    Args:
        values: [N, H, W, 3] float32, crops.
        strength: [N] float32, 0 to 1.
        key: Typed key, [].
    """
    deviation = jnp.maximum(1.3 * strength * jax.random.uniform(key, strength.shape), 0.05)
    taps = jnp.exp(-0.5 * (jnp.arange(-_TAPS, _TAPS + 1) / deviation[:, None]) ** 2)
    taps = taps / taps.sum(axis=1, keepdims=True)
    for axis in (1, 2):
        padded = jnp.pad(values, [(_TAPS, _TAPS) if other == axis else (0, 0) for other in range(4)], mode="edge")
        size = values.shape[axis]
        parts = [jax.lax.slice_in_dim(padded, k, k + size, axis=axis) for k in range(2 * _TAPS + 1)]
        values = sum((taps[:, k, None, None, None] * part for k, part in enumerate(parts)), jnp.zeros_like(values))
    return values
