"""Grey levels of observations, and interpolation between pixels."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp

_LUMINANCE = (0.299, 0.587, 0.114)  # ITU-R BT.601, as in OpenCV


def grey(images: jax.Array, frame_stack: int = 1) -> jax.Array:
    """Return the luminance of each observation's newest image, or its depth if it has no colours: [B, H, W] float32.

    Args:
        images: [B, C, H, W] of any dtype; channels RGBD, RGB or D of each image of the stack, the newest first.
        frame_stack: Number of images that an observation stacks.
    """
    channels = images.shape[-3] // frame_stack
    if channels < len(_LUMINANCE):
        return images[..., 0, :, :].astype(jnp.float32)
    red, green, blue = (weight * images[..., channel, :, :].astype(jnp.float32) for channel, weight in enumerate(_LUMINANCE))
    return red + green + blue


def read_planes_between(planes: Sequence[jax.Array], x: jax.Array, y: jax.Array) -> list[jax.Array]:
    """Sample planes by linear interpolation between pixel centres: [...] float32 each.

    Args:
        planes: [H, W] each, of any dtype.
        x, y: [...] float32, columns and rows, relative to the centre of the first pixel; outside of the image, the nearest
            border pixel is used.
    """
    height, width = planes[0].shape
    first, right, down = _neighbours(height, width, x, y)

    def read(plane: jax.Array) -> jax.Array:
        flat = plane.reshape(height * width).astype(jnp.float32)
        return _interpolate(lambda offset: flat.at[first + offset].get(mode="promise_in_bounds"), width, right, down)

    return [read(plane) for plane in planes]


def _neighbours(height: int, width: int, x: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return the flat index of the upper left of four pixels around each point [...], and offsets right and down from it."""
    x, y = jnp.clip(x, 0.0, width - 1.0), jnp.clip(y, 0.0, height - 1.0)
    left, top = jnp.clip(jnp.floor(x), 0, width - 2), jnp.clip(jnp.floor(y), 0, height - 2)
    return (top * width + left).astype(jnp.int32), x - left, y - top


def _interpolate(pixel: Callable[[int], jax.Array], width: int, right: jax.Array, down: jax.Array) -> jax.Array:
    """Interpolate bilinearly between four pixels.

    Args:
        pixel: Function from an index, relative to that of the upper left pixel in a flat image, to values.
        width: Width of the image.
        right, down: Position between the four pixels, 0 to 1 from the upper left one; broadcast to the values.
    """
    upper = (1.0 - right) * pixel(0) + right * pixel(1)
    lower = (1.0 - right) * pixel(width) + right * pixel(width + 1)
    return (1.0 - down) * upper + down * lower


_BYTES = 4  # in a word


def to_words(images: jax.Array) -> jax.Array:
    """Pack four channels into each word: [B, C, H, W] uint8 -> [B, ceil(C / 4), H, W] uint32, padded with zeros.

    Four channels of a pixel are then read at once.
    """
    batch, channels, *size = images.shape
    padded = jnp.pad(images, [(0, 0), (0, -channels % _BYTES), (0, 0), (0, 0)]).astype(jnp.uint32)
    padded = padded.reshape(batch, -1, _BYTES, *size)
    first, second, third, fourth = (padded[:, :, byte] << (8 * byte) for byte in range(_BYTES))
    return first | second | third | fourth


def from_words(words: jax.Array, channels: int) -> jax.Array:
    """Invert `to_words`: [B, words, H, W] uint32 -> [B, channels, H, W] uint8."""
    batch, _, *size = words.shape
    apart = jnp.stack([_select_byte(words, byte) for byte in range(_BYTES)], axis=2)
    return apart.reshape(batch, -1, *size)[:, :channels].astype(jnp.uint8)


def _select_byte(words: jax.Array, byte: int) -> jax.Array:
    return (words >> (8 * byte)) & 255


def read_words_between(words: jax.Array, x: jax.Array, y: jax.Array) -> jax.Array:
    """Apply `read_planes_between` to bytes packed in words, rounding: [words, ...] uint32.

    Args:
        words: [words, H, W] uint32 from `to_words`.
        x, y: See `read_planes_between`.
    """
    count, height, width = words.shape
    first, right, down = _neighbours(height, width, x, y)
    flat = words.reshape(count, height * width)
    places = (0, 1, width, width + 1)
    read = {offset: flat.at[:, first + offset].get(mode="promise_in_bounds") for offset in places}

    def value(byte: int) -> jax.Array:
        values = _interpolate(lambda offset: _select_byte(read[offset], byte).astype(jnp.float32), width, right, down)
        return jnp.round(values).astype(jnp.uint32) << (8 * byte)

    first_byte, second, third, fourth = (value(byte) for byte in range(_BYTES))
    return first_byte | second | third | fourth
