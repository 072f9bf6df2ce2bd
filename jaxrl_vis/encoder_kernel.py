"""The encoder's first three layers as one GPU kernel each way (Pallas, through Triton), and the pictures in the order it reads.

Windows of 2x2 pixels with stride 2 never overlap, so three layers see a *patch* of 8x8 pixels at a time and nothing else:

    patch 8x8 -> 4 quarters 4x4 -> 2 strips each, 2 rows by 4 columns: two windows side by side

    layer 1   strip    [R, 8 C]   @ [8 C, 2 F1]    both windows at once, block-diagonal: products 16 wide are wasted on a GPU
    layer 2   quarter  sum over its 2 strips of [R, 2 F1] @ [2 F1, F2]
    layer 3   patch    sum over its 4 quarters of [R, F2] @ [F2, F3]

for R patches (rows) in one program. Nothing but the patches is read and nothing but layer 3 is written: as separate products, the
layers spend nine tenths of their time on writing and reading each other's activations. The backward kernel computes layers 1 and
2 again, keeps the gradients of the weights in registers over several tiles of rows, and writes one partial sum per program; the
sums over programs are taken in a fixed order, so a resumed run repeats itself exactly.

`networks` has the same function as plain matrix products: that is the reference, and what every other backend runs.
"""

import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plgpu

LEVELS = 3
"""Layers in the kernel."""
_STRIPS = 8
_FORWARD_ROWS, _FORWARD_WARPS = 128, 4
_BACKWARD_ROWS, _BACKWARD_WARPS, _BACKWARD_TILES = 64, 4, 4
_PREPARE_PATCHES, _PREPARE_PICTURES, _PREPARE_WARPS = 16, 16, 8


class Weights(NamedTuple):
    """Three layers as the kernel multiplies them, float32.

    Attributes:
        kernel_1: [8 C', 2 F1] for a strip; C' is C padded to a power of two.
        bias_1: [2 F1].
        kernel_2: [2, 2 F1, F2], one for each strip of a quarter.
        bias_2: [F2].
        kernel_3: [4, F2, F3], one for each quarter of a patch.
        bias_3: [F3].
    """

    kernel_1: jax.Array
    bias_1: jax.Array
    kernel_2: jax.Array
    bias_2: jax.Array
    kernel_3: jax.Array
    bias_3: jax.Array


def supports(filters: tuple[int, ...]) -> bool:
    """Whether an encoder with these output channels begins with layers that the kernel can take: Triton wants powers of two."""
    return len(filters) >= LEVELS and all(16 <= size <= 128 and size & (size - 1) == 0 for size in filters[:LEVELS])


def _padded(channels: int) -> int:
    return max(2, pl.next_power_of_2(channels))


def _divisor(number: int, limit: int) -> int:
    """The largest power of two that divides ``number``, at most ``limit``."""
    return math.gcd(number, limit)


def make_weights(params: dict[str, Any], channels: int) -> Weights:
    """The first three layers of an encoder (`networks`) for pictures of ``channels`` channels."""
    first = params["kernel_0"].reshape(2, 2, channels, -1)  # row, column, channel, filter
    both = jnp.einsum("yxcf,ij->cyixjf", first, jnp.eye(2))  # the same window twice, side by side
    both = jnp.pad(both, [(0, _padded(channels) - channels)] + [(0, 0)] * 5)
    return Weights(
        kernel_1=both.reshape(8 * _padded(channels), -1),
        bias_1=jnp.tile(params["bias_0"], 2),
        kernel_2=params["kernel_1"].reshape(2, -1, params["kernel_1"].shape[-1]),
        bias_2=params["bias_1"],
        kernel_3=params["kernel_2"].reshape(4, -1, params["kernel_2"].shape[-1]),
        bias_3=params["bias_2"],
    )


# -- Pictures


def _offsets(first_patch: Any, patches: int, shape: tuple[int, int, int], levels: int) -> tuple[jax.Array, jax.Array]:
    """Where the values of some patches lie in a planar picture, and whether they are there: [patches, 64 C'] int32 and bool.

    Patches run over the 2^levels blocks of the picture, row by row, and within a block over its halves of halves (as
    `networks.to_blocks`), so that the next layers find their windows side by side. Values of a patch run over (quarter's row and
    column, strip, channel, row, column): four neighbouring bytes at a time.
    """
    channels, height, width = shape
    columns = width >> levels
    size = (patches, 64 * _padded(channels))
    # Non-negative throughout: lax.div and lax.rem, unlike // and %, then compile to shifts and masks.
    div, rem = lambda a, b: jax.lax.div(a, jnp.int32(b)), lambda a, b: jax.lax.rem(a, jnp.int32(b))
    patch = first_patch + jax.lax.broadcasted_iota(jnp.int32, size, 0)
    value = jax.lax.broadcasted_iota(jnp.int32, size, 1)

    finer = levels - LEVELS
    block = div(patch, 4**finer)
    row, column = div(block, columns), rem(block, columns)
    for level in reversed(range(finer)):
        quarter = rem(div(patch, 4**level), 4)
        row, column = 2 * row + div(quarter, 2), 2 * column + rem(quarter, 2)

    column = 8 * column + 4 * rem(div(value, 16 * _padded(channels)), 2) + rem(value, 4)
    row = 8 * row + 4 * div(value, 32 * _padded(channels)) + 2 * rem(div(value, 8 * _padded(channels)), 2) + rem(div(value, 4), 2)
    channel = rem(div(value, 8), _padded(channels))
    return channel * (height * width) + row * width + column, channel < channels


def _prepare_kernel(frames_ref, mean_ref, scale_ref, out_ref, *, shape, levels, limit):
    pictures, patches, _ = out_ref.shape
    offsets, there = _offsets(pl.program_id(0) * patches, patches, shape, levels)
    # The same pixels of every picture: their statistics stay in registers.
    mean = plgpu.load(mean_ref.at[offsets], mask=there, other=0.0)
    scale = plgpu.load(scale_ref.at[offsets], mask=there, other=0.0)

    def one_picture(picture, _):
        frame = plgpu.load(frames_ref.at[picture, offsets], mask=there, other=0).astype(jnp.float32)
        out_ref[picture] = jnp.clip((frame - mean) * scale, -limit, limit).astype(out_ref.dtype)

    jax.lax.fori_loop(0, pictures, one_picture, None)


def prepare(
    frames: jax.Array, mean: jax.Array, scale: jax.Array, levels: int, limit: float, dtype: Any, interpret: bool = False
) -> jax.Array:
    """Normalises pictures and puts them into patches: [B, C, H, W] uint8 -> [B, patches, 64 C'] of ``dtype``.

    Args:
        frames: Planar pictures.
        mean, scale: [C, H, W] float32.
        levels: All the encoder's layers; borders that do not fill a block of 2^levels pixels are cropped.
        limit: Normalised values are clipped to plus and minus this.
        dtype: Of the result.
        interpret: Run without a GPU, slowly.
    """
    batch, *shape = frames.shape
    channels, height, width = shape
    patches = (height >> levels) * (width >> levels) * 4 ** (levels - LEVELS)
    size = 64 * _padded(channels)
    tile, pictures = _divisor(patches, _PREPARE_PATCHES), _divisor(batch, _PREPARE_PICTURES)
    pixels = math.prod(shape)
    whole = pl.BlockSpec((pixels,), lambda patch, picture: (0,))
    return pl.pallas_call(
        functools.partial(_prepare_kernel, shape=tuple(shape), levels=levels, limit=limit),
        out_shape=jax.ShapeDtypeStruct((batch, patches, size), dtype),
        grid=(patches // tile, batch // pictures),
        in_specs=[pl.BlockSpec((pictures, pixels), lambda patch, picture: (picture, 0)), whole, whole],
        out_specs=pl.BlockSpec((pictures, tile, size), lambda patch, picture: (picture, patch, 0)),
        compiler_params=plgpu.CompilerParams(num_warps=_PREPARE_WARPS, num_stages=2),
        interpret=interpret,
        name="prepare_patches",
    )(frames.reshape(batch, pixels), mean.reshape(pixels), scale.reshape(pixels))


# -- Layers


def _dot(left: jax.Array, right: jax.Array, contract: tuple[int, int] = (1, 0)) -> jax.Array:
    """A product in float32, over axis ``contract[0]`` of the left side and ``contract[1]`` of the right one."""
    dimensions = (((contract[0],), (contract[1],)), ((), ()))
    return jax.lax.dot_general(left, right, dimensions, preferred_element_type=jnp.float32)


def _quarter(x_ref, rows, quarter, weights):
    """Layers 1 and 2 of one quarter of some patches: ((strip [R, 8 C'], layer 1 [R, 2 F1] float32) twice, layer 2 [R, F2] float32)."""
    strips, total = [], weights.bias_2[...][None, :]
    for strip in range(2):
        x = x_ref[rows, 2 * quarter + strip, :]
        hidden = jnp.maximum(_dot(x, weights.kernel_1[...]) + weights.bias_1[...][None, :], 0.0)
        total = total + _dot(hidden.astype(x.dtype), weights.kernel_2[strip])
        strips.append((x, hidden))
    return strips, jnp.maximum(total, 0.0)


def _forward_kernel(x_ref, *refs):
    *weight_refs, out_ref = refs
    weights = Weights(*weight_refs)
    total = weights.bias_3[...][None, :]
    for quarter in range(4):
        _, hidden = _quarter(x_ref, slice(None), quarter, weights)
        total = total + _dot(hidden.astype(x_ref.dtype), weights.kernel_3[quarter])
    out_ref[...] = jnp.maximum(total, 0.0).astype(out_ref.dtype)


def _masked(hidden: jax.Array, gradient: jax.Array, dtype: Any) -> jax.Array:
    """The gradient before a rectifier whose output is ``hidden``."""
    return jnp.where(hidden > 0.0, gradient, 0.0).astype(dtype)


def _backward_kernel(x_ref, out_ref, gradient_ref, *refs, rows):
    weights, partial_refs = Weights(*refs[:6]), Weights(*refs[6:])
    dtype = x_ref.dtype

    def one_tile(tile, sums):
        kernel_1, bias_1, kernel_2, bias_2, kernel_3, bias_3 = sums
        kernel_2, kernel_3 = list(kernel_2), list(kernel_3)
        here = pl.ds(tile * rows, rows)
        before_3 = _masked(out_ref[here, :].astype(jnp.float32), gradient_ref[here, :].astype(jnp.float32), dtype)
        all_2 = all_1 = 0.0
        for quarter in range(4):
            strips, hidden_2 = _quarter(x_ref, here, quarter, weights)
            kernel_3[quarter] += _dot(hidden_2.astype(dtype), before_3, (0, 0))
            before_2 = _masked(hidden_2, _dot(before_3, weights.kernel_3[quarter], (1, 1)), dtype)
            all_2 += before_2.astype(jnp.float32)
            for strip, (x, hidden_1) in enumerate(strips):
                kernel_2[strip] += _dot(hidden_1.astype(dtype), before_2, (0, 0))
                before_1 = _masked(hidden_1, _dot(before_2, weights.kernel_2[strip], (1, 1)), dtype)
                all_1 += before_1.astype(jnp.float32)
                kernel_1 += _dot(x, before_1, (0, 0))
        bias_1 += jnp.sum(all_1, axis=0)
        bias_2 += jnp.sum(all_2, axis=0)
        bias_3 += jnp.sum(before_3.astype(jnp.float32), axis=0)
        return kernel_1, bias_1, tuple(kernel_2), bias_2, tuple(kernel_3), bias_3

    def zeros(ref):
        return jnp.zeros(ref.shape[1:], jnp.float32)

    sums = (
        jnp.zeros(weights.kernel_1.shape, jnp.float32),
        jnp.zeros(weights.bias_1.shape, jnp.float32),
        (zeros(weights.kernel_2),) * 2,
        jnp.zeros(weights.bias_2.shape, jnp.float32),
        (zeros(weights.kernel_3),) * 4,
        jnp.zeros(weights.bias_3.shape, jnp.float32),
    )
    sums = Weights(*jax.lax.fori_loop(0, x_ref.shape[0] // rows, one_tile, sums))
    for name in ("kernel_1", "bias_1", "bias_2", "bias_3"):
        getattr(partial_refs, name)[...] = getattr(sums, name)
    for name in ("kernel_2", "kernel_3"):
        for index, value in enumerate(getattr(sums, name)):
            getattr(partial_refs, name)[index] = value


def _whole(array: jax.Array) -> pl.BlockSpec:
    return pl.BlockSpec(array.shape, lambda program: (0,) * array.ndim)


def _rows(count: int, *rest: int) -> pl.BlockSpec:
    return pl.BlockSpec((count, *rest), lambda program: (program,) + (0,) * len(rest))


def _cast(weights: Weights, dtype: Any) -> Weights:
    """Kernels in the dtype of the products; biases are added in float32."""
    return weights._replace(**{name: getattr(weights, name).astype(dtype) for name in ("kernel_1", "kernel_2", "kernel_3")})


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def apply(patches: jax.Array, weights: Weights, interpret: bool = False) -> jax.Array:
    """Three layers of 2x2 stride-2 convolutions with rectifiers: [M, 64 C'] -> [M, F3], same dtype.

    Differentiable with respect to the weights only: patches are data.

    Args:
        patches: [M, 64 C'] from `prepare`, M of any size.
        weights: From `make_weights`.
        interpret: Run without a GPU, slowly.
    """
    count, size = patches.shape
    outputs = weights.bias_3.shape[0]
    rows = _divisor(count, _FORWARD_ROWS)
    if rows < 16:  # Triton's smallest product
        rows = 64
        patches = jnp.pad(patches, ((0, -count % rows), (0, 0)))
    cast = _cast(weights, patches.dtype)
    return pl.pallas_call(
        _forward_kernel,
        out_shape=jax.ShapeDtypeStruct((patches.shape[0], outputs), patches.dtype),
        grid=(patches.shape[0] // rows,),
        in_specs=[_rows(rows, _STRIPS, size // _STRIPS), *map(_whole, cast)],
        out_specs=_rows(rows, outputs),
        compiler_params=plgpu.CompilerParams(num_warps=_FORWARD_WARPS, num_stages=2),
        interpret=interpret,
        name="encode_patches",
    )(patches.reshape(-1, _STRIPS, size // _STRIPS), *cast)[:count]


def _apply_forward(patches: jax.Array, weights: Weights, interpret: bool):
    out = apply(patches, weights, interpret)
    return out, (patches, weights, out)


def _apply_backward(interpret: bool, residuals: Any, gradient: jax.Array):
    patches, weights, out = residuals
    (count, size), outputs = patches.shape, out.shape[1]
    rows = _divisor(count, _BACKWARD_ROWS)
    if rows < 16:
        rows = 64
        # Rows without a gradient add nothing.
        patches, out, gradient = (jnp.pad(array, ((0, -count % rows), (0, 0))) for array in (patches, out, gradient))
    block = rows * _divisor(patches.shape[0] // rows, _BACKWARD_TILES)
    programs = patches.shape[0] // block
    cast = _cast(weights, patches.dtype)
    partial = pl.pallas_call(
        functools.partial(_backward_kernel, rows=rows),
        out_shape=[jax.ShapeDtypeStruct((programs, *array.shape), jnp.float32) for array in weights],
        grid=(programs,),
        in_specs=[_rows(block, _STRIPS, size // _STRIPS), _rows(block, outputs), _rows(block, outputs), *map(_whole, cast)],
        out_specs=[pl.BlockSpec((None, *array.shape), lambda program, n=array.ndim: (program,) + (0,) * n) for array in weights],
        compiler_params=plgpu.CompilerParams(num_warps=_BACKWARD_WARPS, num_stages=2),
        interpret=interpret,
        name="encode_patches_backward",
    )(patches.reshape(-1, _STRIPS, size // _STRIPS), out, gradient, *cast)
    return jnp.zeros_like(residuals[0]), Weights(*(jnp.sum(array, axis=0) for array in partial))


apply.defvjp(_apply_forward, _apply_backward)
