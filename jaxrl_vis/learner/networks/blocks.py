"""Images in nested 2x2 blocks, which make strided 2x2 convolutions, and transposed ones, plain matrix products."""

import jax
import jax.numpy as jnp


def to_blocks(frames: jax.Array, levels: int) -> jax.Array:
    """Reorder images into nested blocks: [..., C, H, W] -> [..., (H / 2^levels) * (W / 2^levels), 4^levels * C], same dtype.

    The last axis runs over (coarsest block, ..., finest block, channel).
    """
    *batch, channels, height, width = frames.shape
    rows, columns = height >> levels, width >> levels
    frames = frames[..., : rows << levels, : columns << levels]
    twos = (2,) * levels
    frames = frames.reshape(*batch, channels, rows, *twos, columns, *twos)
    first = len(batch)
    row_axis, column_axis = first + 1, first + 2 + levels
    pairs = [axis for level in range(1, levels + 1) for axis in (row_axis + level, column_axis + level)]
    frames = frames.transpose(*range(first), row_axis, column_axis, *pairs, first)
    return frames.reshape(*batch, rows * columns, 4**levels * channels)


def from_blocks(blocks: jax.Array, height: int, width: int) -> jax.Array:
    """Invert `to_blocks`: [..., blocks, 4^levels * C] -> [..., C, height, width], same dtype.

    Args:
        blocks: Nested blocks; their number, ``height`` and ``width`` determine the number of levels.
        height, width: Size of the images in pixels, without the border that `to_blocks` crops.
    """
    *batch, count, size = blocks.shape
    levels = ((height * width // count).bit_length() - 1) // 2
    channels = size // 4**levels
    first, twos = len(batch), (2,) * (2 * levels)
    blocks = blocks.reshape(*batch, height >> levels, width >> levels, *twos, channels)
    inside = range(first + 2, first + 2 + 2 * levels)
    blocks = blocks.transpose(*range(first), blocks.ndim - 1, first, *inside[::2], first + 1, *inside[1::2])
    return blocks.reshape(*batch, channels, height, width)


def shift_images(images: jax.Array, shift: jax.Array) -> jax.Array:
    """Shift planar images [B, C, H, W] by [B, 2] int32 pixels, down and to the right; fill with 0."""
    height, width = images.shape[-2:]

    def shift_image(image: jax.Array, shift: jax.Array) -> jax.Array:
        rows, columns = jnp.arange(height) - shift[0], jnp.arange(width) - shift[1]
        inside = ((rows >= 0) & (rows < height))[:, None] & ((columns >= 0) & (columns < width))
        rows, columns = jnp.clip(rows, 0, height - 1), jnp.clip(columns, 0, width - 1)
        return jnp.where(inside, image[..., rows, :][..., columns], 0)

    return jax.vmap(shift_image)(images, shift)
