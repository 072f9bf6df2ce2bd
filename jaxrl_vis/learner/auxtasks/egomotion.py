"""Egomotion: prediction of an image's rotation from its latents before and after, by a linear layer (thesis, 5.2.3.1)."""

import math

import jax
import jax.numpy as jnp

from jaxrl_vis.learner.auxtasks import heads
from jaxrl_vis.learner.auxtasks.images import from_words, read_words_between, to_words
from jaxrl_vis.learner.auxtasks.task import AuxTask, Border, Spec, View, mean_squared_error, read
from jaxrl_vis.types import Params

MAX_ANGLE = math.radians(30.0)


def make(spec: Spec) -> AuxTask:
    """Build the egomotion task. With ``spec.options.max_shift``, it predicts the shift as well as the angle."""
    options = spec.options

    def predict(params: Params, view: View) -> jax.Array:
        return heads.linear(params, view.latent_t, read(view, "latent_view"))

    return AuxTask(
        name="egomotion",
        init=lambda key: heads.init_linear(key, 2 * spec.latent_size, 3 if options.max_shift else 1),
        predict=predict,
        loss=lambda params, view: mean_squared_error(predict(params, view), read(view, "target")),
        view=lambda key, batch: egomotion_pair(key, batch.images_t, options.border, options.max_shift),
        key_index=2,
        uses_batch_key=True,
    )


def egomotion_pair(
    key: jax.Array, images: jax.Array, border: Border = "clip", max_shift: float = 0.0
) -> tuple[jax.Array, jax.Array]:
    """Rotate images by random angles, uniform up to 30 degrees in either direction, and optionally shift them.

    Args:
        key: [] typed key.
        images: [B, C, H, W] uint8.
        border: Treatment of empty corners.
        max_shift: Maximum shift in each direction, as a fraction of the image's size; 0.1 in the release, 0 in the thesis.

    Returns:
        Transformed images [B, C, H, W] uint8, and motion in [-1, 1] in units of its maximum: angles [B, 1], or angles and
        shifts to the right and down [B, 3], float32.
    """
    motion = jax.random.uniform(key, (images.shape[0], 3 if max_shift else 1), minval=-1.0, maxval=1.0)
    size = jnp.array([images.shape[-1], images.shape[-2]])
    shift = max_shift * size * motion[:, 1:] if max_shift else jnp.zeros((images.shape[0], 2))
    return rotate(images, MAX_ANGLE * motion[:, 0], shift, border), motion


def rotate(images: jax.Array, angle: jax.Array, shift: jax.Array, border: Border = "clip") -> jax.Array:
    """Rotate images about their centres, then shift them: [B, C, H, W] uint8, 0 outside of the image.

    Args:
        images: [B, C, H, W] uint8.
        angle: [B] float32 in radians, counter-clockwise in the displayed image.
        shift: [B, 2] float32 in pixels, to the right and down.
        border: Treatment of empty corners.
    """
    height, width = images.shape[-2:]
    last_x, last_y = width - 1.0, height - 1.0

    def rotate_one(words: jax.Array, angle: jax.Array, shift: jax.Array) -> jax.Array:
        cos, sin = jnp.cos(angle), jnp.sin(angle)
        zoom = jnp.float32(1.0)
        if border == "clip":
            along, across = jnp.abs(cos), jnp.abs(sin)
            zoom = jnp.minimum(last_x / (last_x * along + last_y * across), last_y / (last_x * across + last_y * along))
        # Source position of each pixel, relative to the centre.
        right = zoom * (jnp.arange(width) - last_x / 2 - shift[0])
        down = zoom * (jnp.arange(height)[:, None] - last_y / 2 - shift[1])
        x, y = cos * right - sin * down + last_x / 2, sin * right + cos * down + last_y / 2
        # A pixel reaches half a pixel beyond its centre.
        is_inside = (jnp.abs(x - last_x / 2) <= width / 2) & (jnp.abs(y - last_y / 2) <= height / 2)
        return jnp.where(is_inside, read_words_between(words, x, y), jnp.uint32(0))

    # The barrier keeps the compiler from recomputing a word for each of its bytes.
    words = jax.lax.optimization_barrier(jax.vmap(rotate_one)(to_words(images), angle, shift))
    return from_words(words, images.shape[1])
