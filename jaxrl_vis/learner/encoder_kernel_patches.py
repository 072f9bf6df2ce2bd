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

from jaxrl_vis.learner.blocks import shifted

LEVELS = 3
"""Layers of which a patch is one row of the result."""
WORD = 4
"""Pixels that are read at a time: four neighbours in a row, one byte each."""
# Measured on an H200: patches, or numbers where those are large, and images of one program, and how it is run.
_PREPARE_PATCHES, _PREPARE_NUMBERS, _PREPARE_IMAGES, _PREPARE = 16, 4096, 16, plgpu.CompilerParams(num_warps=8, num_stages=2)


def padded_channels(channels: int) -> int:
    """C': the next power of two."""
    return pl.next_power_of_2(channels)


def divisor(number: int, limit: int) -> int:
    """The largest power of two that divides ``number``, at most ``limit``."""
    return math.gcd(number, limit)


def _word_places(first_patch: Any, patches: int, shape: tuple[int, int, int], levels: int) -> tuple[jax.Array, ...]:
    """Channel, row and column, in words, of the words of some patches in a planar image: [patches, 16 C'] int32 each.

    Patches run over the 2^levels blocks of the image, row by row, and within a block over its halves of halves (as
    `blocks.to_blocks`), so that the next layers find their windows side by side. Words of a patch run over (quarter's row,
    quarter's column, channel, row).
    """
    channels, _, width = shape
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
    return rem(div(word, 4), padded), row, column


def _prepare_kernel(words_ref, mean_ref, scale_ref, out_ref, *, shape, levels, limit):
    images, patches, size = out_ref.shape
    channels, height, width = shape
    channel, row, column = _word_places(pl.program_id(0) * patches, patches, shape, levels)
    offsets, there = channel * (height * width // WORD) + row * (width // WORD) + column, channel < channels
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


def _prepare_shifted_kernel(bytes_ref, mean_ref, scale_ref, shift_ref, out_ref, *, shape, levels, limit):
    """As `_prepare_kernel`, of images that move: no pixel keeps its place in a word, nor its statistics."""
    images, patches, size = out_ref.shape
    channels, height, width = shape
    pixels = (patches, size // WORD, WORD)
    places = _word_places(pl.program_id(0) * patches, patches, shape, levels)
    channel, row, column = (jnp.broadcast_to(place[:, :, None], pixels) for place in places)
    column = column * WORD + jax.lax.broadcasted_iota(jnp.int32, pixels, 2)

    def one_image(image, _):
        from_row, from_column = row - shift_ref[image, 0], column - shift_ref[image, 1]
        there = (from_row >= 0) & (from_row < height) & (from_column >= 0) & (from_column < width) & (channel < channels)
        pixel = (channel * height + from_row) * width + from_column
        values = plgpu.load(bytes_ref.at[image, pixel], mask=there, other=0).astype(jnp.float32)
        mean = plgpu.load(mean_ref.at[pixel], mask=there, other=0.0)
        scale = plgpu.load(scale_ref.at[pixel], mask=there, other=0.0)
        values = jnp.clip((values - mean) * scale, -limit, limit)
        out_ref[image] = values.astype(out_ref.dtype).reshape(patches, size)

    jax.lax.fori_loop(0, images, one_image, None)


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
    """`encoder_kernel.prepare` as a kernel; ``interpret`` runs it without a GPU."""
    batch, *shape = images.shape
    channels, height, width = shape
    patches = (height >> levels) * (width >> levels) * 4 ** (levels - LEVELS)
    size = 64 * padded_channels(channels)
    tile, together = divisor(patches, min(_PREPARE_PATCHES, _PREPARE_NUMBERS // size)), divisor(batch, _PREPARE_IMAGES)
    pixels = math.prod(shape)
    data, of_images = (
        images.reshape(batch, pixels),
        lambda columns: pl.BlockSpec((together, columns), lambda _, image: (image, 0)),
    )
    whole = pl.BlockSpec((pixels,), lambda patch, image: (0,))
    if shift is None:
        kernel, data = _prepare_kernel, jax.lax.bitcast_convert_type(data.reshape(batch, -1, WORD), jnp.uint32)
        more, more_specs = (), []
    else:
        kernel, more, more_specs = _prepare_shifted_kernel, (shift,), [of_images(2)]
    return pl.pallas_call(
        functools.partial(kernel, shape=tuple(shape), levels=levels, limit=limit),
        out_shape=jax.ShapeDtypeStruct((batch, patches, size), dtype),
        grid=(patches // tile, batch // together),
        in_specs=[of_images(data.shape[1]), whole, whole, *more_specs],
        out_specs=pl.BlockSpec((together, tile, size), lambda patch, image: (image, patch, 0)),
        compiler_params=_PREPARE,
        interpret=interpret,
        name="prepare_patches" if shift is None else "prepare_shifted_patches",
    )(data, mean.reshape(pixels), scale.reshape(pixels), *more)


def prepare_plainly(
    images: jax.Array, mean: jax.Array, scale: jax.Array, shift: jax.Array | None, levels: int, limit: float, dtype: Any
) -> jax.Array:
    """`encoder_kernel.prepare` in plain JAX."""
    if shift is not None:
        values = jnp.clip((images.astype(jnp.float32) - mean) * scale, -limit, limit).astype(dtype)
        return to_patches(shifted(values, shift), levels)
    patches, mean, scale = (to_patches(array, levels) for array in (images, mean, scale))
    return jnp.clip((patches.astype(jnp.float32) - mean) * scale, -limit, limit).astype(dtype)


def to_patches(images: jax.Array, levels: int) -> jax.Array:
    """[..., C, H, W] -> [..., patches, 64 C'], in the order of `_word_places`; channels that are padding hold zeros."""
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
