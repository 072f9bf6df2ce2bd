"""Images in the order that `encoder_kernel` reads: normalised, in patches of 8x8 pixels, four quarters each.

As one GPU kernel (Pallas, by Triton), and the same in plain JAX; `encoder_kernel.prepare` chooses.
"""

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plgpu

LEVELS = 3
"""Layers in the kernel."""
WORD = 4
"""Pixels that are read at a time: four neighbours in a row, one byte each."""
# Measured on an H200: patches and images of one program, and how it is run.
_PREPARE_PATCHES, _PREPARE_IMAGES, _PREPARE = 16, 16, plgpu.CompilerParams(num_warps=8, num_stages=2)


def padded_channels(channels: int) -> int:
    """C': the next power of two."""
    return pl.next_power_of_2(channels)


def divisor(number: int, limit: int) -> int:
    """The largest power of two that divides ``number``, at most ``limit``."""
    return math.gcd(number, limit)


def _word_offsets(first_patch: Any, patches: int, shape: tuple[int, int, int], levels: int) -> tuple[jax.Array, jax.Array]:
    """Where the words of some patches lie in a planar image, and whether they are there: [patches, 16 C'] int32 and bool.

    Patches run over the 2^levels blocks of the image, row by row, and within a block over its halves of halves (as
    `blocks.to_blocks`), so that the next layers find their windows side by side. Words of a patch run over (quarter's row,
    quarter's column, channel, row).
    """
    channels, height, width = shape
    columns, padded = width >> levels, padded_channels(channels)
    size = (patches, 16 * padded)
    # Non-negative throughout: lax.div and lax.rem, unlike // and %, then compile to shifts and masks.
    div, rem = lambda a, b: jax.lax.div(a, jnp.int32(b)), lambda a, b: jax.lax.rem(a, jnp.int32(b))
    patch = first_patch + jax.lax.broadcasted_iota(jnp.int32, size, 0)
    word = jax.lax.broadcasted_iota(jnp.int32, size, 1)

    finer = levels - LEVELS
    block = div(patch, 4**finer)
    row, column = div(block, columns), rem(block, columns)
    for level in reversed(range(finer)):
        quarter = rem(div(patch, 4**level), 4)
        row, column = 2 * row + div(quarter, 2), 2 * column + rem(quarter, 2)

    row = 8 * row + 4 * div(word, 8 * padded) + rem(word, 4)
    column = 2 * column + rem(div(word, 4 * padded), 2)
    channel = rem(div(word, 4), padded)
    return channel * (height * width // WORD) + row * (width // WORD) + column, channel < channels


def _prepare_kernel(words_ref, mean_ref, scale_ref, out_ref, *, shape, levels, limit):
    images, patches, size = out_ref.shape
    offsets, there = _word_offsets(pl.program_id(0) * patches, patches, shape, levels)
    pixels = (patches, size // WORD, WORD)
    byte = jax.lax.broadcasted_iota(jnp.int32, pixels, 2)
    inside = jnp.broadcast_to(there[:, :, None], pixels)
    places = offsets[:, :, None] * WORD + byte
    # The same pixels of every image: their statistics stay in registers.
    mean = plgpu.load(mean_ref.at[places], mask=inside, other=0.0)
    scale = plgpu.load(scale_ref.at[places], mask=inside, other=0.0)
    shift = (8 * byte).astype(jnp.uint32)

    def one_image(image, _):
        words = plgpu.load(words_ref.at[image, offsets], mask=there, other=0)
        values = (jax.lax.shift_right_logical(jnp.broadcast_to(words[:, :, None], pixels), shift) & 255).astype(jnp.float32)
        values = jnp.clip((values - mean) * scale, -limit, limit)
        out_ref[image] = values.astype(out_ref.dtype).reshape(patches, size)

    jax.lax.fori_loop(0, images, one_image, None)


def prepare_on_gpu(
    images: jax.Array, mean: jax.Array, scale: jax.Array, levels: int, limit: float, dtype: Any, interpret: bool = False
) -> jax.Array:
    """`encoder_kernel.prepare` as a kernel; ``interpret`` runs it without a GPU."""
    batch, *shape = images.shape
    channels, height, width = shape
    patches = (height >> levels) * (width >> levels) * 4 ** (levels - LEVELS)
    size = 64 * padded_channels(channels)
    tile, together = divisor(patches, _PREPARE_PATCHES), divisor(batch, _PREPARE_IMAGES)
    pixels = math.prod(shape)
    words = jax.lax.bitcast_convert_type(images.reshape(batch, pixels // WORD, WORD), jnp.uint32)
    whole = pl.BlockSpec((pixels,), lambda patch, image: (0,))
    return pl.pallas_call(
        functools.partial(_prepare_kernel, shape=tuple(shape), levels=levels, limit=limit),
        out_shape=jax.ShapeDtypeStruct((batch, patches, size), dtype),
        grid=(patches // tile, batch // together),
        in_specs=[pl.BlockSpec((together, pixels // WORD), lambda patch, image: (image, 0)), whole, whole],
        out_specs=pl.BlockSpec((together, tile, size), lambda patch, image: (image, patch, 0)),
        compiler_params=_PREPARE,
        interpret=interpret,
        name="prepare_patches",
    )(words, mean.reshape(pixels), scale.reshape(pixels))


def prepare_plainly(images: jax.Array, mean: jax.Array, scale: jax.Array, levels: int, limit: float, dtype: Any) -> jax.Array:
    """`encoder_kernel.prepare` in plain JAX."""
    patches, mean, scale = (_to_patches(array, levels) for array in (images, mean, scale))
    return jnp.clip((patches.astype(jnp.float32) - mean) * scale, -limit, limit).astype(dtype)


def _to_patches(images: jax.Array, levels: int) -> jax.Array:
    """[..., C, H, W] -> [..., patches, 64 C'], in the order of `_word_offsets`; channels that are padding hold zeros."""
    *batch, channels, height, width = images.shape
    rows, columns, finer = height >> levels, width >> levels, (2,) * (levels - LEVELS)
    images = images[..., : rows << levels, : columns << levels]
    images = images.reshape(*batch, channels, rows, *finer, 2, WORD, columns, *finer, 2, WORD)
    first, along = len(batch), levels - LEVELS + 3  # axes before the channels', and those of a side
    row_axis, column_axis = first + 1, first + 1 + along
    # Coarse to fine; within a quarter of a patch: channel, row, column.
    pairs = [axis for level in range(along - 1) for axis in (row_axis + level, column_axis + level)]
    images = images.transpose(*range(first), *pairs, first, row_axis + along - 1, column_axis + along - 1)
    images = images.reshape(*batch, -1, 4, channels, WORD * WORD)
    images = jnp.pad(images, [(0, 0)] * (first + 2) + [(0, padded_channels(channels) - channels), (0, 0)])
    return images.reshape(*batch, -1, 64 * padded_channels(channels))
