"""The kernels of the encoder's first three layers: forward, backward, and forward with tangents (`encoder_kernel`).

Each with the same in plain JAX, for processes without such a GPU and as the kernels' reference.
"""

import functools
import itertools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plgpu

from jaxrl_vis.learner.encoder_kernel_patches import LEVELS, divisor, prepare_on_gpu
from jaxrl_vis_envs.compilation import accelerator, by_platform, runs_gpu_kernels, tracing_for

LEAST_ROWS = 16
"""Of a product in a kernel."""
# Measured on an H200: patches in a tile, tiles that one program works through (at most, on the way back), and how they are run.
_FORWARD_PATCHES, _FORWARD_TILES, _FORWARD = 16, 8, plgpu.CompilerParams(num_warps=4, num_stages=3)
_BACKWARD_PATCHES, _BACKWARD_TILES, _BACKWARD = 16, 64, plgpu.CompilerParams(num_warps=4, num_stages=1)
_LEAST_PROGRAMS = 256  # about two for each of a large GPU's processors


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


# -- Where they run


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
    shape = (4, 8, 8)
    images, of_pixels = jnp.zeros((LEAST_ROWS, *shape), jnp.uint8), jnp.zeros(shape)
    weights = Weights(*(jnp.zeros(size) for size in ((64, 64), (64,), (64, 16), (16,), (64, 16), (16,))))

    def all_three(images: jax.Array, mean: jax.Array, scale: jax.Array, weights: Weights) -> Weights:
        patches = prepare_on_gpu(images, mean, scale, None, LEVELS, 5.0, jnp.bfloat16)[:, 0]
        out = _apply_on_gpu(patches, weights, 0, patches.shape[0])
        return _backward_on_gpu(patches, weights, out, out, 0, patches.shape[0])

    return jax.jit(all_three).trace(images, of_pixels, of_pixels, weights)


def dispatch(on_gpu: Any, plain: Any, *arguments: Any, interpret: bool) -> Any:
    """The kernel where a program is compiled for a GPU that runs it, and the same in plain JAX for every other platform."""
    if interpret:
        return on_gpu(*arguments)
    return by_platform(lambda *given: (on_gpu if runs_gpu_kernels(probe) else plain)(*given), *arguments)


# -- Layers


def dot(left: jax.Array, right: jax.Array, contract: tuple[int, int] = (1, 0)) -> jax.Array:
    """A product in float32, over axis ``contract[0]`` of the left side and ``contract[1]`` of the right one."""
    dimensions = (((contract[0],), (contract[1],)), ((), ()))
    return jax.lax.dot_general(left, right, dimensions, preferred_element_type=jnp.float32)


def layer(values: jax.Array, kernel: jax.Array, bias: jax.Array) -> jax.Array:
    """A product with bias and rectifier, in the dtype of ``values``."""
    return rectified(dot(values, kernel) + bias[None, :]).astype(values.dtype)


def rectified(values: jax.Array) -> jax.Array:
    """A rectifier with gradient 0 at 0, as `jax.nn.relu` has and `jnp.maximum` has not: blank parts of images lie there."""
    return jnp.where(values > 0.0, values, 0.0)


def before(after: jax.Array, gradient: jax.Array) -> jax.Array:
    """The gradient before a rectifier whose output is ``after``, in its dtype."""
    return jnp.where(after > 0.0, gradient, 0.0).astype(after.dtype)


def _forward_kernel(x_ref, *refs, patches):
    weights, out_ref = Weights(*(ref[...] for ref in refs[:-1])), refs[-1]

    def one_tile(tile, _):
        x = x_ref[pl.ds(tile * 4 * patches, 4 * patches), :]
        hidden = layer(x, weights.kernel_1, weights.bias_1)
        hidden = layer(hidden, weights.kernel_2, weights.bias_2).reshape(patches, -1)
        out_ref[pl.ds(tile * patches, patches), :] = layer(hidden, weights.kernel_3, weights.bias_3)

    jax.lax.fori_loop(0, out_ref.shape[0] // patches, one_tile, None)


def _backward_kernel(x_ref, out_ref, gradient_ref, *refs, patches):
    weights, sums_ref = Weights(*(ref[...] for ref in refs[:-1])), refs[-1]

    def add_rows(values):
        """The sum over rows, in each of the result's rows: as a product, it costs half of what a reduction does."""
        return dot(jnp.ones((LEAST_ROWS, values.shape[0]), values.dtype), values)

    def one_tile(tile, sums):
        x = x_ref[pl.ds(tile * 4 * patches, 4 * patches), :]
        here = pl.ds(tile * patches, patches)
        hidden_1 = layer(x, weights.kernel_1, weights.bias_1)
        hidden_2 = layer(hidden_1, weights.kernel_2, weights.bias_2)
        before_3 = before(out_ref[here, :], gradient_ref[here, :])
        gradient_2 = dot(before_3, weights.kernel_3, (1, 1)).reshape(hidden_2.shape)
        before_2 = before(hidden_2, gradient_2)
        before_1 = before(hidden_1, dot(before_2, weights.kernel_2, (1, 1)))
        return Weights(
            sums.kernel_1 + dot(x, before_1, (0, 0)),
            sums.bias_1 + add_rows(before_1),
            sums.kernel_2 + dot(hidden_1, before_2, (0, 0)),
            sums.bias_2 + add_rows(before_2),
            sums.kernel_3 + dot(hidden_2.reshape(patches, -1), before_3, (0, 0)),
            sums.bias_3 + add_rows(before_3),
        )

    zeros = [jnp.zeros(value.shape if value.ndim > 1 else (LEAST_ROWS, value.shape[0]), jnp.float32) for value in weights]
    sums = jax.lax.fori_loop(0, out_ref.shape[0] // patches, one_tile, Weights(*zeros))
    first = 0
    for like, value in zip(weights, sums, strict=True):
        if like.ndim == 1:  # sixteen times the same sum
            value = jnp.sum(value, axis=0) * (1.0 / LEAST_ROWS)
        sums_ref[pl.ds(first, like.size)] = value.reshape(-1)
        first += like.size


def whole(array: jax.Array) -> pl.BlockSpec:
    """All of an array for each program."""
    return pl.BlockSpec(array.shape, lambda program: (0,) * array.ndim)


def rows(count: int, columns: int, skipped: int = 0) -> pl.BlockSpec:
    """``count`` rows of a matrix for each program, after the first ``skipped`` blocks of as many rows."""
    return pl.BlockSpec((count, columns), lambda program: (program + skipped, 0))


def tiles_of_program(tiles: int, total: int, limit: int) -> int:
    """How many tiles one program works through where it leaves a sum: many, for few sums, as long as all processors are busy.

    Args:
        tiles: What the number must divide.
        total: Tiles of all programs.
        limit: At most so many.
    """
    most = divisor(tiles, limit)
    while most > 1 and total < most * _LEAST_PROGRAMS:
        most //= 2
    return most


def cast_kernels(weights: Weights, dtype: Any) -> Weights:
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
    place = {"first": first, "count": count}
    on_gpu = functools.partial(_apply_on_gpu, **place, interpret=interpret)
    return dispatch(on_gpu, functools.partial(_apply_plainly, **place), patches, weights, interpret=interpret)


def _apply_on_gpu(patches: jax.Array, weights: Weights, first: int, count: int, interpret: bool = False) -> jax.Array:
    size, outputs = patches.shape[1], weights.bias_3.shape[0]
    tile = divisor(math.gcd(first, count), _FORWARD_PATCHES)
    block = tile * divisor(math.gcd(first, count) // tile, _FORWARD_TILES)
    cast = cast_kernels(weights, patches.dtype)
    return pl.pallas_call(
        functools.partial(_forward_kernel, patches=tile),
        out_shape=jax.ShapeDtypeStruct((count, outputs), patches.dtype),
        grid=(count // block,),
        in_specs=[rows(4 * block, size // 4, first // block), *map(whole, cast)],
        out_specs=rows(block, outputs),
        compiler_params=_FORWARD,
        interpret=interpret,
        name="encode_patches",
    )(patches.reshape(-1, size // 4), *cast)


def _apply_plainly(patches: jax.Array, weights: Weights, first: int, count: int) -> jax.Array:
    cast = cast_kernels(weights, patches.dtype)
    quarters = patches[first : first + count].reshape(-1, patches.shape[1] // 4)
    hidden = layer(layer(quarters, cast.kernel_1, cast.bias_1), cast.kernel_2, cast.bias_2)
    return layer(hidden.reshape(count, -1), cast.kernel_3, cast.bias_3)


def _apply_forward(patches: jax.Array, weights: Weights, first: int, count: int, interpret: bool):
    out = apply(patches, weights, first, count, interpret)
    return out, (patches, weights, out)


def _apply_backward(first: int, count: int, interpret: bool, residuals: Any, gradient: jax.Array):
    patches, weights, out = residuals
    place = {"first": first, "count": count}
    on_gpu = functools.partial(_backward_on_gpu, **place, interpret=interpret)
    plainly = functools.partial(_backward_plainly, **place)
    return jnp.zeros_like(patches), dispatch(on_gpu, plainly, patches, weights, out, gradient, interpret=interpret)


def _backward_on_gpu(
    patches: jax.Array, weights: Weights, out: jax.Array, gradient: jax.Array, first: int, count: int, interpret: bool = False
) -> Weights:
    """Gradients of the weights, float32."""
    size, outputs = patches.shape[1], out.shape[1]
    tile = divisor(math.gcd(first, count), _BACKWARD_PATCHES)
    tiles = math.gcd(first, count) // tile
    block = tile * tiles_of_program(tiles, count // tile, _BACKWARD_TILES)
    programs = count // block
    cast = cast_kernels(weights, patches.dtype)
    total = sum(array.size for array in weights)
    partial_sums = pl.pallas_call(
        functools.partial(_backward_kernel, patches=tile),
        # All weights in one row, so that one reduction adds up the programs.
        out_shape=jax.ShapeDtypeStruct((programs, total), jnp.float32),
        grid=(programs,),
        in_specs=[
            rows(4 * block, size // 4, first // block),
            rows(block, outputs),
            rows(block, outputs),
            *map(whole, cast),
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


# -- Tangents


def _tangent_kernel(x_ref, *refs, patches):
    inputs, (out_ref, tangent_ref) = [ref[...] for ref in refs[:-2]], refs[-2:]
    weights, along = Weights(*inputs[: len(inputs) // 2]), Weights(*inputs[len(inputs) // 2 :])

    def one_tile(tile, _):
        x = x_ref[pl.ds(tile * 4 * patches, 4 * patches), :]
        values, tangents = _layer_along(x, None, weights.kernel_1, weights.bias_1, along.kernel_1, along.bias_1)
        values, tangents = _layer_along(values, tangents, weights.kernel_2, weights.bias_2, along.kernel_2, along.bias_2)
        values, tangents = values.reshape(patches, -1), tangents.reshape(patches, -1)
        here = pl.ds(tile * patches, patches)
        out_ref[here, :], tangent_ref[here, :] = _layer_along(
            values, tangents, weights.kernel_3, weights.bias_3, along.kernel_3, along.bias_3
        )

    jax.lax.fori_loop(0, out_ref.shape[0] // patches, one_tile, None)


def _layer_along(
    values: jax.Array,
    tangents: jax.Array | None,
    kernel: jax.Array,
    bias: jax.Array,
    kernel_along: jax.Array,
    bias_along: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """`layer` and its tangent, for tangents of the values (None: they have none), of the kernel and of the bias."""
    out, change = layer(values, kernel, bias), dot(values, kernel_along) + bias_along[None, :]
    if tangents is not None:
        change += dot(tangents, kernel)
    return out, before(out, change)


@functools.partial(jax.custom_jvp, nondiff_argnums=(2, 3, 4))
def apply_forwards(patches: jax.Array, weights: Weights, first: int, count: int, interpret: bool = False) -> jax.Array:
    """`apply`, differentiable forwards instead, with respect to the weights."""
    return apply(patches, weights, first, count, interpret)


@apply_forwards.defjvp
def _apply_along(first: int, count: int, interpret: bool, primals: Any, tangents: Any) -> tuple[jax.Array, jax.Array]:
    patches, weights = primals
    place = {"first": first, "count": count}
    on_gpu = functools.partial(_along_on_gpu, **place, interpret=interpret)
    plainly = functools.partial(_along_plainly, **place)
    return dispatch(on_gpu, plainly, patches, weights, tangents[1], interpret=interpret)


def _along_on_gpu(
    patches: jax.Array, weights: Weights, along: Weights, first: int, count: int, interpret: bool = False
) -> tuple[jax.Array, jax.Array]:
    """What `apply` makes of patches, and its tangent along a direction of the weights, [count, F3] each."""
    size, outputs = patches.shape[1], weights.bias_3.shape[0]
    tile = divisor(math.gcd(first, count), _FORWARD_PATCHES)
    block = tile * divisor(math.gcd(first, count) // tile, _FORWARD_TILES)
    cast, along = cast_kernels(weights, patches.dtype), cast_kernels(along, patches.dtype)
    out = jax.ShapeDtypeStruct((count, outputs), patches.dtype)
    return pl.pallas_call(
        functools.partial(_tangent_kernel, patches=tile),
        out_shape=(out, out),
        grid=(count // block,),
        in_specs=[rows(4 * block, size // 4, first // block), *map(whole, (*cast, *along))],
        out_specs=(rows(block, outputs), rows(block, outputs)),
        compiler_params=_FORWARD,
        interpret=interpret,
        name="encode_patches_along",
    )(patches.reshape(-1, size // 4), *cast, *along)


def _along_plainly(patches: jax.Array, weights: Weights, along: Weights, first: int, count: int) -> tuple[jax.Array, jax.Array]:
    return jax.jvp(lambda weights: _apply_plainly(patches, weights, first, count), (weights,), (along,))
