"""Conversion of images to the layout that `kernels.encoder` reads: normalised, in patches of 8x8 pixels, four quarters each.

Implemented as one GPU kernel (Pallas, by Triton) and in plain JAX; `kernels.encoder.prepare` chooses between them.
"""

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plgpu

from jaxrl_vis.learner.networks.blocks import shift_images
from jaxrl_vis_envs.compiling.gpu_kernels import kernel_call

LEVELS = 3
"""Number of layers that reduce a patch to one row."""
_SIDE = 4
"""Side of a quarter of a patch, in pixels."""
# Tuned on an H100: elements of one image and number of images per program, and compiler parameters.
_PREPARE_NUMBERS, _PREPARE_IMAGES, _PREPARE = 4096, 16, plgpu.CompilerParams(num_warps=8, num_stages=2)


def padded_channels(channels: int) -> int:
    """Return C', the smallest power of two that is not less than ``channels``."""
    return pl.next_power_of_2(channels)


def divisor(number: int, limit: int) -> int:
    """Return the largest power of two up to ``limit`` that divides ``number``; ``limit`` must be a power of two."""
    return math.gcd(number, limit)


def _prepare_kernel(images_ref, mean_ref, scale_ref, *refs, shape, levels, limit):
    """Rearrange adjacent blocks of several images into patches on the chip, reading pixels in image order.

    The last of ``refs`` is the result, preceded by the shift of each image, if images are shifted.
    """
    *moves, out_ref = refs
    images, patches, size = out_ref.shape
    channels, height, width = shape
    block, columns, finer = 1 << levels, width >> levels, levels - LEVELS
    across = patches // 4**finer
    tile = (size // (16 * _SIDE), block, across * block)
    # Non-negative: lax.div and lax.rem, unlike // and %, then compile to shifts and masks.
    first, columns = pl.program_id(0) * across, jnp.int32(columns)
    channel, row, column = (jax.lax.broadcasted_iota(jnp.int32, tile, axis) for axis in range(3))
    row += jax.lax.div(first, columns) * block
    column += jax.lax.rem(first, columns) * block
    # Coarse to fine: block, halves of halves, quarter of a patch; then channel, row, column.
    parts = (tile[0], *[2] * finer, 2, _SIDE, across, *[2] * finer, 2, _SIDE)
    halves = [axis for level in range(finer + 1) for axis in (1 + level, finer + 4 + level)]
    order = (finer + 3, *halves, 0, finer + 2, 2 * finer + 5)

    def statistics(pixel: jax.Array, mask: jax.Array) -> list[jax.Array]:
        return [plgpu.load(ref.at[pixel], mask=mask, other=0.0) for ref in (mean_ref, scale_ref)]

    pixel, is_channel = (channel * height + row) * width + column, channel < channels
    still = [pixel, is_channel, *statistics(pixel, is_channel)]

    def prepare_image(image, _):
        places = still
        if moves:
            from_row, from_column = row - moves[0][image, 0], column - moves[0][image, 1]
            is_inside = (from_row >= 0) & (from_row < height) & (from_column >= 0) & (from_column < width) & is_channel
            pixel = (channel * height + from_row) * width + from_column
            places = [pixel, is_inside, *statistics(pixel, is_inside)]
        pixel, is_inside, mean, scale = places
        values = plgpu.load(images_ref.at[image, pixel], mask=is_inside, other=0).astype(jnp.float32)
        values = jnp.clip((values - mean) * scale, -limit, limit).astype(out_ref.dtype)
        out_ref[image] = values.reshape(parts).transpose(order).reshape(patches, size)

    jax.lax.fori_loop(0, images, prepare_image, None)


def prepare_on_gpu(
    images: jax.Array,
    mean: jax.Array,
    scale: jax.Array,
    shift: jax.Array | None,
    levels: int,
    limit: float,
    dtype: Any,
    interpret: bool = False,
) -> jax.Array:
    """Compute `kernels.encoder.prepare` with the GPU kernel; ``interpret`` interprets it without a GPU, which is slow."""
    batch, *shape = images.shape
    channels, height, width = shape
    rows, columns, of_block = height >> levels, width >> levels, 4 ** (levels - LEVELS)
    size, together = 16 * _SIDE * padded_channels(channels), divisor(batch, _PREPARE_IMAGES)
    tile = of_block * divisor(columns, max(1, _PREPARE_NUMBERS // (of_block * size)))
    patches, pixels = rows * columns * of_block, math.prod(shape)
    moves = () if shift is None else (shift,)

    def image_block(numbers: int) -> pl.BlockSpec:
        return pl.BlockSpec((together, numbers), lambda _, image: (image, 0))

    all_pixels = pl.BlockSpec((pixels,), lambda patch, image: (0,))
    return kernel_call(
        functools.partial(_prepare_kernel, shape=tuple(shape), levels=levels, limit=limit),
        out_shape=jax.ShapeDtypeStruct((batch, patches, size), dtype),
        grid=(patches // tile, batch // together),
        in_specs=[image_block(pixels), all_pixels, all_pixels, *(image_block(2) for _ in moves)],
        out_specs=pl.BlockSpec((together, tile, size), lambda patch, image: (image, patch, 0)),
        compiler_params=_PREPARE,
        interpret=interpret,
        name="prepare_shifted_patches" if moves else "prepare_patches",
    )(images.reshape(batch, pixels), mean.reshape(pixels), scale.reshape(pixels), *moves)


def prepare_plain(
    images: jax.Array, mean: jax.Array, scale: jax.Array, shift: jax.Array | None, levels: int, limit: float, dtype: Any
) -> jax.Array:
    """Compute `kernels.encoder.prepare` in plain JAX."""
    if shift is not None:
        values = jnp.clip((images.astype(jnp.float32) - mean) * scale, -limit, limit).astype(dtype)
        return to_patches(shift_images(values, shift), levels)
    patches, mean, scale = (to_patches(array, levels) for array in (images, mean, scale))
    return jnp.clip((patches.astype(jnp.float32) - mean) * scale, -limit, limit).astype(dtype)


def to_patches(images: jax.Array, levels: int) -> jax.Array:
    """Rearrange [..., C, H, W] to [..., patches, 64 C']; padding channels are zeros.

    Patches are ordered by blocks of 2^levels pixels, row by row, and within a block by recursive 2x2 subdivision (as in
    `blocks.to_blocks`), so that the windows of the next layers are contiguous. Pixels of a patch are in the order (quarter's
    row, quarter's column, channel, row, column).
    """
    *batch, channels, height, width = images.shape
    rows, columns, finer = height >> levels, width >> levels, (2,) * (levels - LEVELS)
    images = images[..., : rows << levels, : columns << levels]
    images = images.reshape(*batch, channels, rows, *finer, 2, _SIDE, columns, *finer, 2, _SIDE)
    first, along = len(batch), levels - LEVELS + 3  # axes before the channels', and those of a side
    row_axis, column_axis = first + 1, first + 1 + along
    # Coarse to fine; within a quarter of a patch: channel, row, column.
    pairs = [axis for level in range(along - 1) for axis in (row_axis + level, column_axis + level)]
    images = images.transpose(*range(first), *pairs, first, row_axis + along - 1, column_axis + along - 1)
    images = images.reshape(*batch, -1, 4, channels, _SIDE * _SIDE)
    images = jnp.pad(images, [(0, 0)] * (first + 2) + [(0, padded_channels(channels) - channels), (0, 0)])
    return images.reshape(*batch, -1, 64 * padded_channels(channels))
