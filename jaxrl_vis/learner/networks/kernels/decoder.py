"""Finest two layers of a decoder and its squared error in one GPU kernel (Pallas, by Triton), including gradients.

Each layer of a decoder (`auxtasks.heads`) doubles the height and width of its image, so nearly all activations are those of the
last two: for an image of 64x64 pixels with four channels 16,384 each, as many as in the observation. As separate products they
would be written and read a dozen times in the forward and backward passes. Here a tile of *cells*, 4x4 pixels each, passes
through all steps:

    cells    [R, 64]       with bias and rectifier
    layer    [R, 4 * 16]   4 quarters of a cell       @ [64, 64]
    layer    [R, 16 C']    16 pixels of it, C' channels      @ [64, 16 C'], block-diagonal
    error    of these pixels, followed by the backward pass at once: the gradient of a squared error follows from the error

Pixels have the order of the encoder's patches (`kernels.patches`): channel, row, column within a cell, and cells in
nested blocks. Targets of an autoencoder are thus identical to the encoder's inputs.

The gradient with respect to cells is written in the networks' dtype, those with respect to weights are accumulated in float32
as in `kernels.passes`; both are multiplied by the incoming gradient.
"""

import functools
import itertools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plgpu

from jaxrl_vis.learner.networks import forward_mode
from jaxrl_vis.learner.networks.kernels.passes import (
    MIN_ROWS,
    dispatch,
    dot,
    layer,
    rectifier_gradient,
    relu,
    rows,
    tiles_of_program,
    whole_block,
)
from jaxrl_vis.learner.networks.kernels.patches import divisor, padded_channels
from jaxrl_vis_envs.compiling.gpu_kernels import kernel_call

_MAX_CHANNELS = 4  # with more, the weights' gradients do not fit into registers
# Cells in a tile, maximum number of tiles per program, and compiler parameters.
_CELLS, _TILES, _PARAMS = 64, 32, plgpu.CompilerParams(num_warps=4, num_stages=1)


class Weights(NamedTuple):
    """Weights of the layers in the layout that the kernel multiplies, float32.

    F is the number of features of a cell, G that of a quarter of it, and C' that of channels padded to a power of two.

    Attributes:
        bias_in: [F], added to cells before their rectifier.
        kernel_1: [F, 4 G].
        bias_1: [4 G].
        kernel_2: [4 G, 16 C'].
        bias_2: [16 C'].
    """

    bias_in: jax.Array
    kernel_1: jax.Array
    bias_1: jax.Array
    kernel_2: jax.Array
    bias_2: jax.Array


def supports(channels: int, cell_features: int, quarter_features: int) -> bool:
    """Return True if the kernel supports decoders of images with ``channels`` channels and these feature counts.

    Args:
        channels: C, of the images.
        cell_features: F, features of a cell of 4x4 pixels.
        quarter_features: G, features of a quarter of a cell.
    """
    powers = all(16 <= size <= 64 and size & (size - 1) == 0 for size in (cell_features, 4 * quarter_features))
    return channels <= _MAX_CHANNELS and powers


def make_weights(bias_in: jax.Array, finer: dict[str, jax.Array], finest: dict[str, jax.Array]) -> Weights:
    """Convert a decoder's last two layers to the kernel's weights.

    Args:
        bias_in: [F], bias of the layer before.
        finer: kernel [F, 4 G] and bias [G] of the second-to-last layer.
        finest: kernel [G, 4 C] and bias [C] of the last layer.
    """
    features, channels = finest["kernel"].shape[0], finest["bias"].shape[0]
    missing = padded_channels(channels) - channels
    window = finest["kernel"].reshape(features, 2, 2, channels)  # feature, row and column in a quarter, channel
    window = jnp.pad(window, [(0, 0), (0, 0), (0, 0), (0, missing)]).transpose(0, 3, 1, 2)
    # To (quarter's row and column, feature) and (channel, quarter's row, row, quarter's column, column), where a quarter only
    # contributes to its own pixels.
    same = jnp.eye(2, dtype=window.dtype)
    of_rows, of_columns = same[:, None, None, None, :, None, None, None], same[None, :, None, None, None, None, :, None]
    cell = window[None, None, :, :, None, :, None, :] * of_rows * of_columns
    return Weights(
        bias_in=bias_in,
        kernel_1=finer["kernel"],
        bias_1=jnp.tile(finer["bias"], 4),
        kernel_2=cell.reshape(4 * features, -1),
        bias_2=jnp.repeat(jnp.pad(finest["bias"], (0, missing)), 16),
    )


def _cast(weights: Weights, dtype: Any) -> Weights:
    """Cast kernels to the dtype of the products; biases stay float32."""
    return weights._replace(kernel_1=weights.kernel_1.astype(dtype), kernel_2=weights.kernel_2.astype(dtype))


def _forward(cells: jax.Array, weights: Weights) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Compute rectified cells [R, F] and the next layer [R, 4 G] in the dtype of ``cells``, and pixels [R, 16 C'] float32."""
    dtype = cells.dtype
    hidden = relu(cells.astype(jnp.float32) + weights.bias_in[None, :]).astype(dtype)
    finer = layer(hidden, weights.kernel_1, weights.bias_1)
    return hidden, finer, dot(finer, weights.kernel_2) + weights.bias_2[None, :]


def _kernel(cells_ref, target_ref, *refs, tile, scale):
    weights, (gradient_ref, sums_ref) = Weights(*(ref[...] for ref in refs[:-2])), refs[-2:]

    def add_rows(values):
        """Sum over rows, repeated in every row of the result, as in `kernels.passes`."""
        return dot(jnp.ones((MIN_ROWS, values.shape[0]), values.dtype), values)

    def process_tile(number, carry):
        sums, squares = carry
        here = pl.ds(number * tile, tile)
        hidden, finer, pixels = _forward(cells_ref[here, :], weights)
        error = pixels - target_ref[here, :].astype(jnp.float32)
        squares += jnp.sum(error * error, axis=0)
        before_2 = (2.0 * scale * error).astype(hidden.dtype)
        before_1 = rectifier_gradient(finer, dot(before_2, weights.kernel_2, (1, 1)))
        before_in = rectifier_gradient(hidden, dot(before_1, weights.kernel_1, (1, 1)))
        gradient_ref[here, :] = before_in
        sums = Weights(
            sums.bias_in + add_rows(before_in),
            sums.kernel_1 + dot(hidden, before_1, (0, 0)),
            sums.bias_1 + add_rows(before_1),
            sums.kernel_2 + dot(finer, before_2, (0, 0)),
            sums.bias_2 + add_rows(before_2),
        )
        return sums, squares

    zeros = [jnp.zeros(value.shape if value.ndim > 1 else (MIN_ROWS, value.shape[0]), jnp.float32) for value in weights]
    start = Weights(*zeros), jnp.zeros(weights.bias_2.shape, jnp.float32)
    sums, squares = jax.lax.fori_loop(0, cells_ref.shape[0] // tile, process_tile, start)
    first = 0
    for like, value in zip((*weights, weights.bias_2), (*sums, squares), strict=True):
        if value.shape != like.shape:  # sixteen copies of the same sum
            value = jnp.sum(value, axis=0) * (1.0 / MIN_ROWS)
        sums_ref[pl.ds(first, like.size)] = value.reshape(-1)
        first += like.size


def _squared_error_on_gpu(
    cells: jax.Array, target: jax.Array, weights: Weights, scale: float, interpret: bool = False
) -> tuple[jax.Array, jax.Array, Weights]:
    """Compute the scaled sum of squared errors [], and its gradients with respect to cells and weights; see `squared_error`."""
    count, features = cells.shape
    tile = divisor(count, _CELLS)
    block = tile * tiles_of_program(count // tile, count // tile, _TILES)
    programs, cast = count // block, _cast(weights, cells.dtype)
    total = sum(array.size for array in weights) + weights.bias_2.size
    gradient, partial_sums = kernel_call(
        functools.partial(_kernel, tile=tile, scale=scale),
        out_shape=(
            jax.ShapeDtypeStruct((count, features), cells.dtype),
            # All sums in one row, so that one reduction adds up the programs.
            jax.ShapeDtypeStruct((programs, total), jnp.float32),
        ),
        grid=(programs,),
        in_specs=[rows(block, features), rows(block, target.shape[1]), *map(whole_block, cast)],
        out_specs=(rows(block, features), pl.BlockSpec((None, total), lambda program: (program, 0))),
        compiler_params=_PARAMS,
        interpret=interpret,
        name="decode_cells",
    )(cells, target, *cast)
    ends = list(itertools.accumulate(array.size for array in weights))
    *sums, squares = jnp.split(jnp.sum(partial_sums, axis=0), ends)
    weight_gradients = Weights(*(part.reshape(like.shape).astype(like.dtype) for part, like in zip(sums, weights, strict=True)))
    return scale * jnp.sum(squares), gradient, weight_gradients


def _plain_squared_error(cells: jax.Array, target: jax.Array, weights: Weights, scale: float) -> jax.Array:
    pixels = _forward(cells, _cast(weights, cells.dtype))[2]
    return scale * jnp.sum(jnp.square(pixels - target[: cells.shape[0]].astype(jnp.float32)))


def _plain_squared_error_and_gradients(
    cells: jax.Array, target: jax.Array, weights: Weights, scale: float
) -> tuple[jax.Array, jax.Array, Weights]:
    error, gradients = jax.value_and_grad(_plain_squared_error, (0, 2))(cells, target, weights, scale)
    return error, *gradients


@functools.partial(jax.custom_vjp, nondiff_argnums=(3, 4))
def _squared_error(cells: jax.Array, target: jax.Array, weights: Weights, scale: float, interpret: bool) -> jax.Array:
    return _plain_squared_error(cells, target, weights, scale)


def _squared_error_forward(cells: jax.Array, target: jax.Array, weights: Weights, scale: float, interpret: bool):
    on_gpu = functools.partial(_squared_error_on_gpu, scale=scale, interpret=interpret)
    plainly = functools.partial(_plain_squared_error_and_gradients, scale=scale)
    error, *gradients = dispatch(on_gpu, plainly, cells, target, weights, interpret=interpret)
    return error, (gradients, target)


def _squared_error_backward(scale: float, interpret: bool, residuals: Any, factor: jax.Array):
    (of_cells, of_weights), target = residuals
    of_cells, of_weights = jax.tree.map(lambda leaf: (factor * leaf).astype(leaf.dtype), (of_cells, of_weights))
    return of_cells, jnp.zeros_like(target), of_weights


_squared_error.defvjp(_squared_error_forward, _squared_error_backward)


def squared_error(cells: jax.Array, target: jax.Array, weights: Weights, scale: float, interpret: bool = False) -> jax.Array:
    """Compute ``scale`` times the sum of squared errors, [] float32; differentiable with respect to cells and weights.

    Args:
        cells: [M, F], M a multiple of 16: output of the previous layer, without its bias.
        target: [at least M, 16 C'], of which the first M rows are used; padding must be 0.
        weights: From `make_weights`.
        scale: Python number, so that the kernel writes the scaled gradient directly.
        interpret: Whether to interpret the kernel without a GPU, which is slow.

    Raises:
        ValueError: M is not a multiple of 16.
    """
    if cells.shape[0] % MIN_ROWS:
        raise ValueError(f"{cells.shape[0]} cells are not a multiple of {MIN_ROWS}")
    if forward_mode.is_active():
        return _plain_squared_error(cells, target, weights, scale)
    return _squared_error(cells, target, weights, scale, interpret)
