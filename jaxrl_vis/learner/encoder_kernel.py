"""The encoder's first three layers as one GPU kernel each way (Pallas, by Triton).

Windows of 2x2 pixels with stride 2 never overlap, so three layers see a *patch* of 8x8 pixels at a time and nothing else. A
tile of R patches (`encoder_kernel_patches` makes them) passes through all three without leaving the chip:

    4 R quarters of 4x4 pixels  [4 R, 16 C]   @ [16 C, 4 F1]   layer 1, its four windows at once: block-diagonal
                                [4 R, 4 F1]   @ [4 F1, F2]     layer 2
    R patches                   [R, 4 F2]     @ [4 F2, F3]     layer 3

Layer 1 multiplies three zeros for every number, because products 16 wide leave a GPU's matrix units idle anyway. As separate
products, the layers would spend nine tenths of their time on writing and reading each other's activations. The backward kernel
computes layers 1 and 2 again, keeps the gradients of the weights in registers over several tiles, and writes a partial sum
for each program; those are added up in a fixed order, so a resumed run repeats itself exactly.

`networks` has the same function as plain matrix products: that is the reference, and what a process without such a GPU runs.
Where there is one, images are put into patches whatever a program is compiled for, and a program for another platform computes
the layers here, from the same patches, in plain JAX.
"""

import functools
import itertools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plgpu

from jaxrl_vis.learner import tangents
from jaxrl_vis.learner.encoder_kernel_patches import LEVELS, WORD, divisor, padded_channels, prepare_on_gpu, prepare_plainly
from jaxrl_vis_envs.compilation import accelerator, by_platform, runs_gpu_kernels, tracing_for

_MOST_CHANNELS = 4  # beyond, the weights' gradients no longer fit into registers
_LEAST_ROWS = 16  # of a product
# Measured on an H200: patches in a tile, tiles that one program works through, and how they are run.
_FORWARD_PATCHES, _FORWARD_TILES, _FORWARD = 16, 8, plgpu.CompilerParams(num_warps=4, num_stages=3)
_BACKWARD_PATCHES, _BACKWARD_TILES, _BACKWARD = 16, 16, plgpu.CompilerParams(num_warps=4, num_stages=1)


class Weights(NamedTuple):
    """Three layers as the kernel multiplies them, float32.

    Attributes:
        kernel_1: [16 C', 4 F1] for a quarter; C' is C padded to a power of two.
        bias_1: [4 F1].
        kernel_2: [4 F1, F2].
        bias_2: [F2].
        kernel_3: [4 F2, F3].
        bias_3: [F3].
    """

    kernel_1: jax.Array
    bias_1: jax.Array
    kernel_2: jax.Array
    bias_2: jax.Array
    kernel_3: jax.Array
    bias_3: jax.Array


def supports(filters: tuple[int, ...], shape: tuple[int, ...]) -> bool:
    """Whether the kernel can take encoders with these output channels, and images [C, H, W] of this shape."""
    channels, _, width = shape
    powers = all(16 <= size <= 64 and size & (size - 1) == 0 for size in filters[:LEVELS])
    return len(filters) >= LEVELS and powers and channels <= _MOST_CHANNELS and width % WORD == 0


def is_available() -> bool:
    """Whether this process has a GPU that the kernels run on; `jaxrl_vis_envs.compilation` says how to choose."""
    if accelerator() != "cuda":
        return False
    with tracing_for("cuda"):
        return runs_gpu_kernels(probe)


def probe() -> None:
    """Compiles small instances of all three kernels for the device that is the default; raises what that raises."""
    probe_program().lower().compile()


def probe_program() -> Any:
    """Small instances of all three kernels in one program, traced (`jax.stages.Traced`)."""
    shape = (_MOST_CHANNELS, 8, 8)
    images, of_pixels = jnp.zeros((_LEAST_ROWS, *shape), jnp.uint8), jnp.zeros(shape)
    channels = (_MOST_CHANNELS, 16, 16, 16)
    layers = list(zip(range(LEVELS), channels, channels[1:], strict=False))
    kernels = {f"kernel_{level}": jnp.zeros((4 * inputs, outputs)) for level, inputs, outputs in layers}
    biases = {f"bias_{level}": jnp.zeros(outputs) for level, _, outputs in layers}

    def all_three(images: jax.Array, mean: jax.Array, scale: jax.Array, weights: Weights) -> Weights:
        patches = prepare_on_gpu(images, mean, scale, LEVELS, 5.0, jnp.bfloat16)[:, 0]
        out = _apply_on_gpu(patches, weights, 0, patches.shape[0])
        return _backward_on_gpu(patches, weights, out, out, 0, patches.shape[0])

    weights = make_weights(kernels | biases, _MOST_CHANNELS)
    return jax.jit(all_three).trace(images, of_pixels, of_pixels, weights)


def _dispatch(on_gpu: Any, plain: Any, *arguments: Any, interpret: bool) -> Any:
    """The kernel where a program is compiled for a GPU that runs it, and the same in plain JAX for every other platform."""
    if interpret:
        return on_gpu(*arguments)
    return by_platform(lambda *given: (on_gpu if runs_gpu_kernels(probe) else plain)(*given), *arguments)


def make_weights(params: dict[str, Any], channels: int) -> Weights:
    """The first three layers of an encoder (`networks`) for images of ``channels`` channels."""
    window = params["kernel_0"].reshape(2, 2, channels, -1)  # row, column, channel, filter
    window = jnp.pad(window, [(0, 0), (0, 0), (0, padded_channels(channels) - channels), (0, 0)])
    # From (channel, window's row, row, window's column, column) to (window's row, window's column, filter), where a window only
    # sees itself. Written as a product by zeros and ones, which XLA makes one pass of.
    same = jnp.eye(2, dtype=window.dtype)
    same = same[:, None, None, None, :, None, None] * same[:, None, None, :, None]
    quarter = window.transpose(2, 0, 1, 3)[:, None, :, None, :, None, None, :] * same
    return Weights(
        kernel_1=quarter.reshape(16 * padded_channels(channels), -1),
        bias_1=jnp.tile(params["bias_0"], 4),
        kernel_2=params["kernel_1"],
        bias_2=params["bias_1"],
        kernel_3=params["kernel_2"],
        bias_3=params["bias_2"],
    )


# -- Images


def prepare(
    images: jax.Array, mean: jax.Array, scale: jax.Array, levels: int, limit: float, dtype: Any, interpret: bool = False
) -> jax.Array:
    """Normalises images and puts them into patches: [B, C, H, W] uint8 -> [B, patches, 64 C'] of ``dtype``.

    Args:
        images: Planar images, their width a multiple of `WORD`.
        mean, scale: [C, H, W] float32.
        levels: All the encoder's layers; borders that do not fill a block of 2^levels pixels are cropped.
        limit: Normalised values are clipped to plus and minus this.
        dtype: Of the result.
        interpret: Run the kernel without a GPU, slowly.
    """
    settings = {"levels": levels, "limit": limit, "dtype": dtype}
    on_gpu = functools.partial(prepare_on_gpu, **settings, interpret=interpret)
    return _dispatch(on_gpu, functools.partial(prepare_plainly, **settings), images, mean, scale, interpret=interpret)


# -- Layers


def _dot(left: jax.Array, right: jax.Array, contract: tuple[int, int] = (1, 0)) -> jax.Array:
    """A product in float32, over axis ``contract[0]`` of the left side and ``contract[1]`` of the right one."""
    dimensions = (((contract[0],), (contract[1],)), ((), ()))
    return jax.lax.dot_general(left, right, dimensions, preferred_element_type=jnp.float32)


def _layer(values: jax.Array, kernel: jax.Array, bias: jax.Array) -> jax.Array:
    """A product with bias and rectifier, in the dtype of ``values``."""
    return jnp.maximum(_dot(values, kernel) + bias[None, :], 0.0).astype(values.dtype)


def _before(after: jax.Array, gradient: jax.Array) -> jax.Array:
    """The gradient before a rectifier whose output is ``after``, in its dtype."""
    return jnp.where(after > 0.0, gradient, 0.0).astype(after.dtype)


def _forward_kernel(x_ref, *refs, patches):
    weights, out_ref = Weights(*(ref[...] for ref in refs[:-1])), refs[-1]

    def one_tile(tile, _):
        x = x_ref[pl.ds(tile * 4 * patches, 4 * patches), :]
        hidden = _layer(x, weights.kernel_1, weights.bias_1)
        hidden = _layer(hidden, weights.kernel_2, weights.bias_2).reshape(patches, -1)
        out_ref[pl.ds(tile * patches, patches), :] = _layer(hidden, weights.kernel_3, weights.bias_3)

    jax.lax.fori_loop(0, out_ref.shape[0] // patches, one_tile, None)


def _backward_kernel(x_ref, out_ref, gradient_ref, *refs, patches):
    weights, sums_ref = Weights(*(ref[...] for ref in refs[:-1])), refs[-1]

    def add_rows(values):
        """The sum over rows, in each of the result's rows: as a product, it costs half of what a reduction does."""
        return _dot(jnp.ones((_LEAST_ROWS, values.shape[0]), values.dtype), values)

    def one_tile(tile, sums):
        x = x_ref[pl.ds(tile * 4 * patches, 4 * patches), :]
        here = pl.ds(tile * patches, patches)
        hidden_1 = _layer(x, weights.kernel_1, weights.bias_1)
        hidden_2 = _layer(hidden_1, weights.kernel_2, weights.bias_2)
        before_3 = _before(out_ref[here, :], gradient_ref[here, :])
        gradient_2 = _dot(before_3, weights.kernel_3, (1, 1)).reshape(hidden_2.shape)
        before_2 = _before(hidden_2, gradient_2)
        before_1 = _before(hidden_1, _dot(before_2, weights.kernel_2, (1, 1)))
        return Weights(
            sums.kernel_1 + _dot(x, before_1, (0, 0)),
            sums.bias_1 + add_rows(before_1),
            sums.kernel_2 + _dot(hidden_1, before_2, (0, 0)),
            sums.bias_2 + add_rows(before_2),
            sums.kernel_3 + _dot(hidden_2.reshape(patches, -1), before_3, (0, 0)),
            sums.bias_3 + add_rows(before_3),
        )

    zeros = [jnp.zeros(value.shape if value.ndim > 1 else (_LEAST_ROWS, value.shape[0]), jnp.float32) for value in weights]
    sums = jax.lax.fori_loop(0, out_ref.shape[0] // patches, one_tile, Weights(*zeros))
    first = 0
    for like, value in zip(weights, sums, strict=True):
        if like.ndim == 1:  # sixteen times the same sum
            value = jnp.sum(value, axis=0) * (1.0 / _LEAST_ROWS)
        sums_ref[pl.ds(first, like.size)] = value.reshape(-1)
        first += like.size


def _whole(array: jax.Array) -> pl.BlockSpec:
    return pl.BlockSpec(array.shape, lambda program: (0,) * array.ndim)


def _rows(count: int, columns: int, skipped: int = 0) -> pl.BlockSpec:
    """``count`` rows of a matrix for each program, after the first ``skipped`` blocks of as many rows."""
    return pl.BlockSpec((count, columns), lambda program: (program + skipped, 0))


def _cast(weights: Weights, dtype: Any) -> Weights:
    """Kernels in the dtype of the products; biases are added in float32."""
    return weights._replace(**{name: getattr(weights, name).astype(dtype) for name in ("kernel_1", "kernel_2", "kernel_3")})


@functools.partial(jax.custom_vjp, nondiff_argnums=(2, 3, 4))
def apply(patches: jax.Array, weights: Weights, first: int, count: int, interpret: bool = False) -> jax.Array:
    """Three layers of 2x2 stride-2 convolutions with rectifiers, for some patches: [M, 64 C'] -> [count, F3], same dtype.

    Differentiable with respect to the weights only: patches are data.

    Args:
        patches: [M, 64 C'] from `prepare`.
        weights: From `make_weights`.
        first, count: Which rows; both multiples of 16.
        interpret: Run the kernel without a GPU, slowly.
    """
    rows = {"first": first, "count": count}
    on_gpu = functools.partial(_apply_on_gpu, **rows, interpret=interpret)
    return _dispatch(on_gpu, functools.partial(_apply_plainly, **rows), patches, weights, interpret=interpret)


def _apply_on_gpu(patches: jax.Array, weights: Weights, first: int, count: int, interpret: bool = False) -> jax.Array:
    size, outputs = patches.shape[1], weights.bias_3.shape[0]
    tile = divisor(math.gcd(first, count), _FORWARD_PATCHES)
    block = tile * divisor(math.gcd(first, count) // tile, _FORWARD_TILES)
    cast = _cast(weights, patches.dtype)
    return pl.pallas_call(
        functools.partial(_forward_kernel, patches=tile),
        out_shape=jax.ShapeDtypeStruct((count, outputs), patches.dtype),
        grid=(count // block,),
        in_specs=[_rows(4 * block, size // 4, first // block), *map(_whole, cast)],
        out_specs=_rows(block, outputs),
        compiler_params=_FORWARD,
        interpret=interpret,
        name="encode_patches",
    )(patches.reshape(-1, size // 4), *cast)


def _apply_plainly(patches: jax.Array, weights: Weights, first: int, count: int) -> jax.Array:
    cast = _cast(weights, patches.dtype)
    quarters = patches[first : first + count].reshape(-1, patches.shape[1] // 4)
    hidden = _layer(_layer(quarters, cast.kernel_1, cast.bias_1), cast.kernel_2, cast.bias_2)
    return _layer(hidden.reshape(count, -1), cast.kernel_3, cast.bias_3)


def _apply_forward(patches: jax.Array, weights: Weights, first: int, count: int, interpret: bool):
    out = apply(patches, weights, first, count, interpret)
    return out, (patches, weights, out)


def _apply_backward(first: int, count: int, interpret: bool, residuals: Any, gradient: jax.Array):
    patches, weights, out = residuals
    rows = {"first": first, "count": count}
    on_gpu = functools.partial(_backward_on_gpu, **rows, interpret=interpret)
    plainly = functools.partial(_backward_plainly, **rows)
    return jnp.zeros_like(patches), _dispatch(on_gpu, plainly, patches, weights, out, gradient, interpret=interpret)


def _backward_on_gpu(
    patches: jax.Array, weights: Weights, out: jax.Array, gradient: jax.Array, first: int, count: int, interpret: bool = False
) -> Weights:
    """Gradients of the weights, float32."""
    size, outputs = patches.shape[1], out.shape[1]
    tile = divisor(math.gcd(first, count), _BACKWARD_PATCHES)
    block = tile * divisor(math.gcd(first, count) // tile, _BACKWARD_TILES)
    programs = count // block
    cast = _cast(weights, patches.dtype)
    total = sum(array.size for array in weights)
    partial_sums = pl.pallas_call(
        functools.partial(_backward_kernel, patches=tile),
        # All weights in one row, so that one reduction adds up the programs.
        out_shape=jax.ShapeDtypeStruct((programs, total), jnp.float32),
        grid=(programs,),
        in_specs=[
            _rows(4 * block, size // 4, first // block),
            _rows(block, outputs),
            _rows(block, outputs),
            *map(_whole, cast),
        ],
        out_specs=pl.BlockSpec((None, total), lambda program: (program, 0)),
        compiler_params=_BACKWARD,
        interpret=interpret,
        name="encode_patches_backward",
    )(patches.reshape(-1, size // 4), out, gradient, *cast)
    sums = jnp.split(jnp.sum(partial_sums, axis=0), list(itertools.accumulate(array.size for array in weights))[:-1])
    return Weights(*(part.reshape(like.shape).astype(like.dtype) for part, like in zip(sums, weights, strict=True)))


def _backward_plainly(
    patches: jax.Array, weights: Weights, out: jax.Array, gradient: jax.Array, first: int, count: int
) -> Weights:
    return jax.vjp(lambda weights: _apply_plainly(patches, weights, first, count), weights)[1](gradient)[0]


apply.defvjp(_apply_forward, _apply_backward)


def encode(patches: jax.Array, weights: Weights, which: slice = slice(None), interpret: bool = False) -> jax.Array:
    """`apply` to ``which`` of the images: [B, patches, 64 C'] -> [images, patches, F3], same dtype.

    Images are chosen here rather than by slicing before, because a slice that a kernel reads is a copy.
    """
    batch, per_image, size = patches.shape
    images = range(batch)[which]
    first, count = images.start * per_image, len(images) * per_image
    rows = count
    if math.gcd(first, count) % _LEAST_ROWS:  # a few small images
        patches = jnp.pad(patches[which], ((0, -len(images) % _LEAST_ROWS), (0, 0), (0, 0)))
        first, rows = 0, patches.shape[0] * per_image
    if tangents.are_wanted():
        out = _apply_plainly(patches.reshape(-1, size), weights, first, rows)
    else:
        out: jax.Array = apply(patches.reshape(-1, size), weights, first, rows, interpret)  # type: ignore[assignment]
    return out[:count].reshape(-1, per_image, out.shape[-1])
