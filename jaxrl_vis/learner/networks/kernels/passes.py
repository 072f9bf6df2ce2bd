"""Forward and backward GPU kernels of the encoder's first layers, see `kernels.encoder`; that of tangents is in `kernels.jvp`.

Each has an equivalent in plain JAX, as a reference and for processes without a GPU that runs the kernels.
"""

import functools
import itertools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plgpu

from jaxrl_vis.learner.networks.kernels.patches import LEVELS, divisor, prepare_on_gpu
from jaxrl_vis_envs.compiling.compilation import accelerator, dispatch_by_platform, tracing_for, use_gpu_kernels
from jaxrl_vis_envs.compiling.gpu_kernels import kernel_call

MIN_ROWS = 16
"""Minimum number of rows of a product in a kernel."""
TILE = 16
"""Number of patches in a tile."""
# Tuned on an H200: number of tiles per program (a maximum in the backward pass), and compiler parameters.
FORWARD_TILES, FORWARD = 8, plgpu.CompilerParams(num_warps=4, num_stages=3)
_BACKWARD_TILES, _BACKWARD = 64, plgpu.CompilerParams(num_warps=4, num_stages=1)
# Maximum number of sums that fit into the registers of four warps; more need eight.
_MAX_SUMS, _BACKWARD_WITH_MORE = 16_384, plgpu.CompilerParams(num_warps=8, num_stages=1)
_MIN_PROGRAMS = 256  # about two for each of a large GPU's processors


class Weights(NamedTuple):
    """Weights of the first three layers, float32, in the layout that the GPU kernels read.

    Attributes:
        kernels: [16 C', 4 F1], applied to each quarter of a patch; [4 F1, F2]; [4 F2, F3]. C' is the number of channels padded
            to a power of two, and Fi the number of features of layer i.
        biases: [4 F1]; [F2]; [F3].
    """

    kernels: tuple[jax.Array, ...]
    biases: tuple[jax.Array, ...]


# -- Where they run


def is_available() -> bool:
    """Return True if this process has a GPU that runs the kernels, see `jaxrl_vis_envs.compiling.compilation`."""
    if accelerator() != "cuda":
        return False
    with tracing_for("cuda"):
        return use_gpu_kernels(probe)


def probe() -> jax.stages.Traced:
    """Trace small instances of three kernels in one program: preparation, forward and backward pass."""
    shape, levels = (4, 16, 16), LEVELS + 1
    images, of_pixels = jnp.zeros((MIN_ROWS, *shape), jnp.uint8), jnp.zeros(shape)
    sizes = (64, 64), (64, 16), (64, 16)
    weights = Weights(tuple(map(jnp.zeros, sizes)), tuple(jnp.zeros(columns) for _, columns in sizes))

    def run_kernels(images: jax.Array, mean: jax.Array, scale: jax.Array, weights: Weights) -> Weights:
        patches = prepare_on_gpu(images, mean, scale, None, levels, 5.0, jnp.bfloat16)
        patches = patches.reshape(-1, patches.shape[-1])
        out = _apply_on_gpu(patches, weights, 0, patches.shape[0])
        return _gpu_backward(patches, weights, out, out, 0, patches.shape[0])

    return jax.jit(run_kernels).trace(images, of_pixels, of_pixels, weights)


def dispatch(on_gpu: Any, plain: Any, *arguments: Any, interpret: bool) -> Any:
    """Call the kernel if the program is compiled for a GPU that runs it, or interpreted, else its equivalent in plain JAX."""
    if interpret:
        return on_gpu(*arguments)
    return dispatch_by_platform(lambda *args: (on_gpu if use_gpu_kernels(probe) else plain)(*args), *arguments)


# -- Layers


def dot(left: jax.Array, right: jax.Array, contract: tuple[int, int] = (1, 0)) -> jax.Array:
    """Multiply matrices, contracting axis ``contract[0]`` of the left with ``contract[1]`` of the right; return float32."""
    dimensions = (((contract[0],), (contract[1],)), ((), ()))
    return jax.lax.dot_general(left, right, dimensions, preferred_element_type=jnp.float32)


def layer(values: jax.Array, kernel: jax.Array, bias: jax.Array) -> jax.Array:
    """Apply a dense layer with rectifier: [R, inputs] -> [R, outputs], in the dtype of ``values``.

    ``kernel`` is [inputs, outputs], ``bias`` [outputs].
    """
    return relu(dot(values, kernel) + bias[None, :]).astype(values.dtype)


def relu(values: jax.Array) -> jax.Array:
    """Apply a ReLU, with gradient 0 at 0 like `jax.nn.relu` and unlike `jnp.maximum`: blank image regions are exactly 0."""
    return jnp.where(values > 0.0, values, 0.0)


def rectifier_gradient(output: jax.Array, gradient: jax.Array) -> jax.Array:
    """Multiply a gradient, or a tangent, by the derivative of a rectifier with output ``output``, in its dtype."""
    return jnp.where(output > 0.0, gradient, 0.0).astype(output.dtype)


def _layers(quarters: jax.Array, weights: Weights) -> list[jax.Array]:
    """Return the output of each layer for quarters of patches [4 R, 16 C']; see `layer_inputs` for their rows."""
    outputs, values = [], quarters
    for level, (kernel, bias) in enumerate(zip(*weights, strict=True)):
        values = layer(layer_inputs(values, level), kernel, bias)
        outputs.append(values)
    return outputs


def layer_inputs(values: jax.Array, level: int) -> jax.Array:
    """Return the rows that layer ``level`` multiplies: for the last layer [4 R, F] -> [R, 4 F], else unchanged."""
    return values.reshape(values.shape[0] // 4, -1) if level == LEVELS - 1 else values


def load_weights(refs: Any) -> Weights:
    """Load the weights from a kernel's arguments: kernels, then biases."""
    values = tuple(ref[...] for ref in refs)
    return Weights(values[: len(values) // 2], values[len(values) // 2 :])


def _forward_kernel(x_ref, *refs):
    weights, out_ref = load_weights(refs[:-1]), refs[-1]

    def process_tile(tile, _):
        *_, out_ref[tile_rows(tile), :] = _layers(x_ref[tile_quarters(tile), :], weights)

    jax.lax.fori_loop(0, out_ref.shape[0] // TILE, process_tile, None)


def tile_rows(tile: Any) -> Any:
    """Return the slice of a tile's rows in the result."""
    return pl.ds(tile * TILE, TILE)


def tile_quarters(tile: Any) -> Any:
    """Return the slice of a tile's quarters of patches."""
    return pl.ds(4 * tile * TILE, 4 * TILE)


def _backward_kernel(x_ref, out_ref, gradient_ref, *refs):
    weights, sums_ref = load_weights(refs[:-1]), refs[-1]
    hidden_layers = Weights(weights.kernels[:-1], weights.biases[:-1])

    def add_rows(values):
        """Sum over rows, repeated in every row of the result: as a matrix product, this takes half the time of a reduction."""
        return dot(jnp.ones((MIN_ROWS, values.shape[0]), values.dtype), values)

    def process_tile(tile, sums):
        values = [x_ref[tile_quarters(tile), :]]
        values += [*_layers(values[0], hidden_layers), out_ref[tile_rows(tile), :]]
        gradient, of_kernels, of_biases = gradient_ref[tile_rows(tile), :], list(sums.kernels), list(sums.biases)
        for level in reversed(range(LEVELS)):
            gradient = rectifier_gradient(values[level + 1], gradient)
            of_kernels[level] += dot(layer_inputs(values[level], level), gradient, (0, 0))
            of_biases[level] += add_rows(gradient)
            if level:
                gradient = dot(gradient, weights.kernels[level], (1, 1)).reshape(values[level].shape)
        return Weights(tuple(of_kernels), tuple(of_biases))

    start = Weights(
        tuple(jnp.zeros(kernel.shape, jnp.float32) for kernel in weights.kernels),
        tuple(jnp.zeros((MIN_ROWS, bias.shape[0]), jnp.float32) for bias in weights.biases),
    )
    sums, first = jax.lax.fori_loop(0, out_ref.shape[0] // TILE, process_tile, start), 0
    # Sums of biases are sixteen copies of the same row.
    for value in (*sums.kernels, *(jnp.sum(value, axis=0) * (1.0 / MIN_ROWS) for value in sums.biases)):
        sums_ref[pl.ds(first, value.size)] = value.reshape(-1)
        first += value.size


def whole_block(array: jax.Array) -> pl.BlockSpec:
    """Return a block that gives every program the whole array."""
    return pl.BlockSpec(array.shape, lambda program: (0,) * array.ndim)


def rows(count: int, columns: int, skipped: int = 0) -> pl.BlockSpec:
    """Return blocks of ``count`` rows of a matrix, one per program, skipping the first ``skipped`` blocks."""
    return pl.BlockSpec((count, columns), lambda program: (program + skipped, 0))


def tiles_of_program(tiles: int, total: int, limit: int) -> int:
    """Return the largest number of tiles per program that keeps all processors busy, so that there are few partial sums.

    Args:
        tiles: Number that the result must divide.
        total: Number of tiles of all programs.
        limit: Maximum of the result.
    """
    block = divisor(tiles, limit)
    while block > 1 and total < block * _MIN_PROGRAMS:
        block //= 2
    return block


def cast_kernels(weights: Weights, dtype: Any) -> Weights:
    """Cast kernels to the dtype of the products; biases stay float32."""
    return weights._replace(kernels=tuple(kernel.astype(dtype) for kernel in weights.kernels))


@functools.partial(jax.custom_vjp, nondiff_argnums=(2, 3, 4))
def apply(patches: jax.Array, weights: Weights, first: int, count: int, interpret: bool = False) -> jax.Array:
    """Apply 2x2 stride-2 convolutions with rectifiers to some patches: [M, 64 C'] -> [count, F], same dtype.

    Differentiable with respect to the weights only: patches are data.

    Args:
        patches: [M, 64 C'] from `prepare`.
        weights: From `make_weights`.
        first, count: Index of the first patch, and number of patches; both multiples of `TILE`.
        interpret: Whether to interpret the kernel without a GPU, which is slow.
    """
    place = {"first": first, "count": count}
    on_gpu = functools.partial(_apply_on_gpu, **place, interpret=interpret)
    return dispatch(on_gpu, functools.partial(apply_plain, **place), patches, weights, interpret=interpret)


def as_quarters(patches: jax.Array, first: int, block: int) -> tuple[jax.Array, pl.BlockSpec]:
    """Return patches in the shape that the kernels read, and the specification of a program's ``block`` of them."""
    size = patches.shape[1] // 4
    return patches.reshape(-1, size), rows(4 * block, size, first // block)


def _apply_on_gpu(patches: jax.Array, weights: Weights, first: int, count: int, interpret: bool = False) -> jax.Array:
    outputs = weights.biases[-1].shape[0]
    block = TILE * divisor(math.gcd(first, count) // TILE, FORWARD_TILES)
    data, data_spec = as_quarters(patches, first, block)
    cast = jax.tree.leaves(cast_kernels(weights, patches.dtype))
    return kernel_call(
        _forward_kernel,
        out_shape=jax.ShapeDtypeStruct((count, outputs), patches.dtype),
        grid=(count // block,),
        in_specs=[data_spec, *map(whole_block, cast)],
        out_specs=rows(block, outputs),
        compiler_params=FORWARD,
        interpret=interpret,
        name="encode_patches",
    )(data, *cast)


def apply_plain(patches: jax.Array, weights: Weights, first: int, count: int) -> jax.Array:
    """Compute `apply` in plain JAX."""
    chosen = patches[first : first + count].reshape(-1, patches.shape[1] // 4)
    return _layers(chosen, cast_kernels(weights, patches.dtype))[-1]


def _apply_forward(patches: jax.Array, weights: Weights, first: int, count: int, interpret: bool):
    out = apply(patches, weights, first, count, interpret)
    return out, (patches, weights, out)


def _apply_backward(first: int, count: int, interpret: bool, residuals: Any, gradient: jax.Array):
    patches, weights, out = residuals
    place = {"first": first, "count": count}
    on_gpu = functools.partial(_gpu_backward, **place, interpret=interpret)
    plainly = functools.partial(_plain_backward, **place)
    return jnp.zeros_like(patches), dispatch(on_gpu, plainly, patches, weights, out, gradient, interpret=interpret)


def _gpu_backward(
    patches: jax.Array, weights: Weights, out: jax.Array, gradient: jax.Array, first: int, count: int, interpret: bool = False
) -> Weights:
    """Compute the gradients with respect to the weights, float32, from the result ``out`` of `apply` and its gradient."""
    outputs = out.shape[1]
    block = TILE * tiles_of_program(math.gcd(first, count) // TILE, count // TILE, _BACKWARD_TILES)
    programs = count // block
    data, data_spec = as_quarters(patches, first, block)
    cast, like = jax.tree.leaves(cast_kernels(weights, patches.dtype)), jax.tree.leaves(weights)
    total = sum(array.size for array in like)
    partial_sums = kernel_call(
        _backward_kernel,
        # All weights in one row, so that one reduction adds up the programs.
        out_shape=jax.ShapeDtypeStruct((programs, total), jnp.float32),
        grid=(programs,),
        in_specs=[data_spec, rows(block, outputs), rows(block, outputs), *map(whole_block, cast)],
        out_specs=pl.BlockSpec((None, total), lambda program: (program, 0)),
        compiler_params=_BACKWARD if total <= _MAX_SUMS else _BACKWARD_WITH_MORE,
        interpret=interpret,
        name="encode_patches_backward",
    )(data, out, gradient, *cast)
    sums = jnp.split(jnp.sum(partial_sums, axis=0), list(itertools.accumulate(array.size for array in like))[:-1])
    sums = [part.reshape(array.shape).astype(array.dtype) for part, array in zip(sums, like, strict=True)]
    return jax.tree.unflatten(jax.tree.structure(weights), sums)


def _plain_backward(
    patches: jax.Array, weights: Weights, out: jax.Array, gradient: jax.Array, first: int, count: int
) -> Weights:
    return jax.vjp(lambda weights: apply_plain(patches, weights, first, count), weights)[1](gradient)[0]


apply.defvjp(_apply_forward, _apply_backward)
