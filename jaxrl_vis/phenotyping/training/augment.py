"""The same image, differently lit, leaning, mirrored: what the networks must not depend on."""

import jax
import jax.numpy as jnp

from jaxrl_vis.phenotyping.detector.losses import NOTHING


def relight(images: jax.Array, key: jax.Array) -> jax.Array:
    """Images [N, H, W, 3] uint8 with other exposure, contrast, colours and noise, uint8."""
    keys = dict(zip(("gain", "gamma", "colour", "grey", "noise", "read", "blotch"), jax.random.split(key, 7)))
    count = images.shape[0]
    values = images.astype(jnp.float32) / 255.0
    values = values ** jnp.exp(0.15 * jax.random.normal(keys["gamma"], (count, 1, 1, 1)))
    grey = values.mean(axis=-1, keepdims=True)
    values = grey + (values - grey) * jax.random.uniform(keys["grey"], (count, 1, 1, 1), minval=0.2, maxval=1.5)
    gain = jnp.exp(jax.random.uniform(keys["gain"], (count, 1, 1, 1), minval=-0.75, maxval=0.65))
    gain = gain * jnp.exp(0.12 * jax.random.normal(keys["colour"], (count, 1, 1, 3)))
    # Blotches of brightness, as of other textures, a few pixels to a tenth of the image large.
    coarse = jax.random.normal(keys["blotch"], (count, 24, 24, 1))
    strength = jax.random.uniform(keys["read"], (count, 1, 1, 1), maxval=0.15)
    gain = gain * jnp.exp(strength * jax.image.resize(coarse, (*images.shape[:3], 1), "linear"))
    values = values * gain
    level = jax.random.uniform(jax.random.fold_in(keys["noise"], 1), (count, 1, 1, 1), maxval=0.03)
    values = values + level * jnp.sqrt(jnp.maximum(values, 0.02)) * jax.random.normal(keys["noise"], values.shape)
    return jnp.round(255.0 * jnp.clip(values, 0.0, 1.0)).astype(jnp.uint8)


def move(
    images: jax.Array, stalks: jax.Array, kinds: jax.Array, shape: tuple[int, int], key: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Images mirrored, sheared, stretched and shifted, with their stalks; a quarter of them is only mirrored.

    Args:
        images: [N, H, W, 3] uint8, padded below and on the right.
        stalks: [N, T, 6].
        kinds: [N, T] int32.
        shape: Lines and columns of the images without what was added.
        key: For the random numbers.
    """
    keys = jax.random.split(key, images.shape[0])
    return jax.vmap(lambda image, stalk, kind, each: _moved(image, stalk, kind, shape, each))(images, stalks, kinds, keys)


def _moved(image: jax.Array, stalks: jax.Array, kinds: jax.Array, shape: tuple[int, int], key: jax.Array):
    drawn = jax.random.uniform(key, (7,), minval=-1.0, maxval=1.0)
    height, width = shape
    still = drawn[0] > 0.5
    wide, tall = (jnp.where(still, 1.0, jnp.exp(0.12 * each)) for each in drawn[1:3])
    shear = jnp.where(still, 0.0, 0.14 * drawn[3])
    over, down = jnp.where(still, 0.0, 0.04 * width * drawn[4]), jnp.where(still, 0.0, 0.04 * height * drawn[5])
    mirror = drawn[6] > 0.0
    # x' = wide (x - w/2) + shear (y - h/2) + w/2 + over, and then mirrored; y' = tall (y - h/2) + h/2 + down.
    line, column = jnp.meshgrid(jnp.arange(image.shape[0]) + 0.5, jnp.arange(image.shape[1]) + 0.5, indexing="ij")
    column = jnp.where(mirror, width - column, column)
    y = (line - down - height / 2) / tall + height / 2
    x = (column - over - width / 2 - shear * (y - height / 2)) / wide + width / 2
    moved = _sample(image, y - 0.5, x - 0.5, shape)

    def across(x: jax.Array, y: jax.Array) -> jax.Array:
        return wide * (x - width / 2) + shear * (y - height / 2) + width / 2 + over

    left, top, right, bottom, above, below = stalks.T
    first, last = jnp.minimum(above, below), jnp.maximum(above, below)
    above, below = across(above, top), across(below, bottom)
    begin = jnp.minimum(above, below) + wide * (left - first)
    end = jnp.maximum(above, below) + wide * (right - last)
    top, bottom = (tall * (each - height / 2) + height / 2 + down for each in (top, bottom))
    begin, end = jnp.where(mirror, width - end, begin), jnp.where(mirror, width - begin, end)
    above, below = (jnp.where(mirror, width - each, each) for each in (above, below))
    # The axis goes on beyond what the image's edges leave of the box.
    begin, end = jnp.clip(begin, 0.0, width), jnp.clip(end, 0.0, width)
    low, high = jnp.clip(top, 0.0, height), jnp.clip(bottom, 0.0, height)
    slope = (below - above) / jnp.maximum(bottom - top, 1.0)
    above, below = above + slope * (low - top), below + slope * (high - bottom)
    kinds = jnp.where((end - begin < 3.0) | (high - low < 16.0), NOTHING, kinds)
    return moved, jnp.stack([begin, low, end, high, above, below], axis=-1), kinds


def _sample(image: jax.Array, line: jax.Array, column: jax.Array, shape: tuple[int, int]) -> jax.Array:
    """An image at other places, by bilinear interpolation; black beyond ``shape``."""
    inside = (line >= -0.5) & (line <= shape[0] - 0.5) & (column >= -0.5) & (column <= shape[1] - 0.5)
    line, column = jnp.clip(line, 0.0, shape[0] - 1.0), jnp.clip(column, 0.0, shape[1] - 1.0)
    top, left = jnp.floor(line).astype(jnp.int32), jnp.floor(column).astype(jnp.int32)
    down, over = (line - top)[..., None], (column - left)[..., None]
    below, beside = jnp.minimum(top + 1, shape[0] - 1), jnp.minimum(left + 1, shape[1] - 1)
    values = image.astype(jnp.float32)
    upper = values[top, left] * (1 - over) + values[top, beside] * over
    lower = values[below, left] * (1 - over) + values[below, beside] * over
    return jnp.round((upper * (1 - down) + lower * down) * inside[..., None]).astype(jnp.uint8)


def vary_snips(snips: jax.Array, masks: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Snips [N, H, W, 3] uint8 and masks [N, H, W] bool: relit, with other textures and widths, and half of them mirrored."""
    light, side, marks, size = jax.random.split(key, 4)
    snips, masks = _stretched(snips, masks, size)
    snips = _textured(snips, marks)
    mirror = jax.random.bernoulli(side, 0.5, (snips.shape[0],))
    snips = jnp.where(mirror[:, None, None, None], snips[:, :, ::-1], snips)
    masks = jnp.where(mirror[:, None, None], masks[:, :, ::-1], masks)
    return relight(snips, light), masks


def _stretched(snips: jax.Array, masks: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Snips and masks wider or narrower by up to a third, about their middle."""
    count, _, width = snips.shape[:3]
    wider = jnp.exp(jax.random.uniform(key, (count,), minval=-0.3, maxval=0.3))
    place = (jnp.arange(width) + 0.5 - width / 2) / wider[:, None] + width / 2 - 0.5  # [N, W], where a column comes from
    place = jnp.clip(place, 0.0, width - 1.0)
    left = jnp.minimum(jnp.floor(place).astype(jnp.int32), width - 2)
    share = (place - left)[:, None, :]

    def columns(values: jax.Array, at: jax.Array) -> jax.Array:
        return jnp.take_along_axis(values, at.reshape(count, 1, width, *(1,) * (values.ndim - 3)), axis=2)

    values = snips.astype(jnp.float32)
    mixed = columns(values, left) * (1 - share[..., None]) + columns(values, left + 1) * share[..., None]
    inside = masks.astype(jnp.float32)
    return jnp.round(mixed).astype(jnp.uint8), columns(inside, left) * (1 - share) + columns(inside, left + 1) * share >= 0.5


def _textured(snips: jax.Array, key: jax.Array) -> jax.Array:
    """Snips with speckles, fibres along the stalk and dark sides: the textures of a family are not all that there are."""
    count, height, width = snips.shape[:3]
    spots, fibres, shades, amounts = jax.random.split(key, 4)
    amount = jax.random.uniform(amounts, (4, count, 1, 1))

    def noise(key: jax.Array, lines: int, columns: int) -> jax.Array:
        shape = (count, max(height // lines, 1), max(width // columns, 1))
        return jax.image.resize(jax.random.normal(key, shape), (count, height, width), "linear")

    dark = jnp.where(noise(spots, 6, 3) > 2.2 - 1.4 * amount[0], 1.0 - 0.6 * amount[1], 1.0)
    grain = jnp.exp(0.25 * amount[2] * noise(fibres, 160, 2) + 0.35 * amount[3] * noise(shades, 80, 10))
    return jnp.round(jnp.clip(snips * (dark * grain)[..., None], 0.0, 255.0)).astype(jnp.uint8)
