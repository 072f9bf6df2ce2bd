"""Grey levels of observations, and images read between their pixels."""

import jax
import jax.numpy as jnp

_LUMINANCE = (0.299, 0.587, 0.114)  # ITU-R BT.601, which OpenCV uses, too


def grey(images: jax.Array, frame_stack: int = 1) -> jax.Array:
    """Luminance of the newest image of each observation, or its depth where it has no colours: [B, H, W] float32.

    Args:
        images: [B, C, H, W] of any dtype: R, G, B and D, R, G and B, or D, for each image of the stack, the newest first.
        frame_stack: Images that an observation stacks.
    """
    channels = images.shape[-3] // frame_stack
    if channels < len(_LUMINANCE):
        return images[..., 0, :, :].astype(jnp.float32)
    red, green, blue = (weight * images[..., channel, :, :].astype(jnp.float32) for channel, weight in enumerate(_LUMINANCE))
    return red + green + blue


def read_between(values: jax.Array, x: jax.Array, y: jax.Array) -> jax.Array:
    """Values at any place, by linear interpolation between the centres of pixels: [..., K] float32.

    Args:
        values: [H, W, K] of any dtype.
        x, y: [...] float32, columns and rows, counted from the centre of the first; outside of the image, what is read is that
            of the nearest border.
    """
    height, width, size = values.shape
    x, y = jnp.clip(x, 0.0, width - 1.0), jnp.clip(y, 0.0, height - 1.0)
    left, top = jnp.clip(jnp.floor(x), 0, width - 2), jnp.clip(jnp.floor(y), 0, height - 2)
    right, down = (x - left)[..., None], (y - top)[..., None]
    first = (top * width + left).astype(jnp.int32)
    flat = values.reshape(height * width, size)

    def pixel(offset: int) -> jax.Array:
        return flat.at[first + offset].get(mode="clip").astype(jnp.float32)

    upper = (1.0 - right) * pixel(0) + right * pixel(1)
    lower = (1.0 - right) * pixel(width) + right * pixel(width + 1)
    return (1.0 - down) * upper + down * lower
