"""A head's layers after its first one as one GPU kernel each way (Pallas, by Triton).

Three layers of 256 for a batch of 512 are so little work that as separate products, sums of parts, biases and rectifiers most
of their time is that of waiting for each other. Here a program takes some rows of the batch through all layers:

    values [R, H]    @ [H, H], bias, rectifier    hidden layers; a few columns at a time, so that their weights are on the way
                     ...                          while those before are multiplied
    hidden [R, H]    @ [H, O], bias               the output, as in float32

The way back writes the gradients before each rectifier. What the weights' gradients are made of, all rows of the batch, no
program has: they are products of their own, which nothing waits for but the optimiser.

The first layer is not in here. It is the widest, its inputs come in parts, and heads of the same latents share a product.
"""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plgpu

from jaxrl_vis.learner import tangents
from jaxrl_vis.learner.encoder_kernel_passes import LEAST_ROWS, before, dispatch, dot, layer, rows, whole
from jaxrl_vis_envs.compilation import accelerator, runs_gpu_kernels, tracing_for

# Rows of a program, columns at a time, and how it is run.
_ROWS, _COLUMNS, _PARAMS = 16, 64, plgpu.CompilerParams(num_warps=4, num_stages=3)
_WIDEST = 512


class Weights(NamedTuple):
    """The layers as the kernels multiply them.

    Attributes:
        kernels: [H, H] each.
        biases: [H] each.
        output: [O, H] float32.
        output_bias: [O] float32.
    """

    kernels: tuple[jax.Array, ...]
    biases: tuple[jax.Array, ...]
    output: jax.Array
    output_bias: jax.Array


def is_available() -> bool:
    """Whether this process has a GPU that the kernels run on; `jaxrl_vis_envs.compilation` says how to choose."""
    if accelerator() != "cuda":
        return False
    with tracing_for("cuda"):
        return runs_gpu_kernels(probe)


def supports(hidden_sizes: Sequence[int], batch: int) -> bool:
    """Whether the kernels can take heads with hidden layers of these sizes, and this many rows."""
    width, *others = hidden_sizes
    is_power = _COLUMNS <= width <= _WIDEST and width & (width - 1) == 0
    return bool(others) and is_power and all(size == width for size in others) and batch % _ROWS == 0


def make_weights(params: dict[str, Any]) -> Weights:
    """Of a head (`networks`), without its first layer."""
    hidden = [params[f"hidden_{level}"] for level in range(1, len(params) - 1)]
    return Weights(
        kernels=tuple(each["kernel"] for each in hidden),
        biases=tuple(each["bias"] for each in hidden),
        output=params["output"]["kernel"].T,
        output_bias=params["output"]["bias"],
    )


def probe() -> None:
    """Compiles small instances of both kernels for the device that is the default; raises what that raises."""
    size = (_COLUMNS, _COLUMNS)
    weights = Weights((jnp.zeros(size),), (jnp.zeros(size[0]),), jnp.zeros((1, size[0])), jnp.zeros(1))

    def both(values: jax.Array, weights: Weights) -> Any:
        return _backward_on_gpu(*_forward_on_gpu(values, weights), weights)

    jax.jit(both).lower(jnp.zeros((_ROWS, size[0]), jnp.bfloat16), weights).compile()


def apply(values: jax.Array, weights: Weights, interpret: bool = False) -> jax.Array:
    """The layers of a head after its first one: [B, H] -> [B, O] float32.

    Args:
        values: What the first layer makes, rectified, in the dtype of the products; B a multiple of 16.
        weights: From `make_weights`.
        interpret: Run the kernels without a GPU, slowly.
    """
    if tangents.are_wanted():
        return _forward_plainly(values, weights)[0]
    return _apply(values, weights, interpret)


# -- Forward


def _each_columns(width: int, make: Any) -> None:
    """Calls a function for some columns of ``width`` after the other; all are written when this returns."""
    jax.lax.fori_loop(0, width // _COLUMNS, lambda number, _: make(pl.ds(number * _COLUMNS, _COLUMNS)), None)


def _written(ref: Any, interpret: bool) -> jax.Array:
    """What the threads of this program have written."""
    if not interpret:
        plgpu.debug_barrier()
    return ref[...]


def _places(ref: Any, shape: tuple[int, ...], axis: int) -> tuple[tuple[jax.Array, ...], jax.Array]:
    """Where numbers of a larger array belong, and which of them belong anywhere: ``axis`` of ``ref`` is shorter."""
    places = tuple(jax.lax.broadcasted_iota(jnp.int32, shape, number) for number in range(len(shape)))
    return places, places[axis] < ref.shape[axis]


def _padded(ref: Any, axis: int = 0) -> jax.Array:
    """An array whose ``axis`` runs over outputs, with zeros up to as many as a product must have."""
    shape = list(ref.shape)
    shape[axis] = max(LEAST_ROWS, pl.next_power_of_2(shape[axis]))
    places, is_output = _places(ref, tuple(shape), axis)
    return plgpu.load(ref.at[places], mask=is_output, other=0.0)


def _parts(weights: jax.Array, dtype: Any) -> list[jax.Array]:
    """Arrays of ``dtype`` whose sum is ``weights``: of bfloat16, three hold what a float32 does."""
    parts, rest = [], weights
    for _ in range(1 if dtype == weights.dtype else 3):
        parts.append(rest.astype(dtype))
        rest = rest - parts[-1].astype(weights.dtype)
    return parts


def _forward_kernel(values_ref, *refs, layers, interpret):
    kernels, biases, (output, output_bias) = refs[:layers], refs[layers : 2 * layers], refs[2 * layers : 2 * layers + 2]
    *hidden_refs, out_ref = refs[2 * layers + 2 :]
    values = values_ref[...]
    for kernel, bias, hidden in zip(kernels, biases, hidden_refs, strict=True):

        def make(columns, values=values, kernel=kernel, bias=bias, hidden=hidden):
            hidden[:, columns] = layer(values, kernel[:, columns], bias[columns])

        _each_columns(values.shape[1], make)
        values = _written(hidden, interpret)
    out = _padded(output_bias)[None, :]
    for part in _parts(_padded(output), values.dtype):
        out += dot(values, part, (1, 1))
    place, is_output = _places(out_ref, out.shape, axis=1)
    plgpu.store(out_ref.at[place], out, mask=is_output)


def _cast(weights: Weights, dtype: Any) -> Weights:
    """Kernels of hidden layers in the dtype of the products; all else in float32."""
    return weights._replace(kernels=tuple(kernel.astype(dtype) for kernel in weights.kernels))


def _forward_on_gpu(values: jax.Array, weights: Weights, interpret: bool = False) -> tuple[jax.Array, list[jax.Array]]:
    """The output [B, O] float32, and what each hidden layer makes of the values."""
    (batch, width), outputs, layers = values.shape, weights.output.shape[0], len(weights.kernels)
    given = jax.tree.leaves(_cast(weights, values.dtype))
    *hidden, out = pl.pallas_call(
        functools.partial(_forward_kernel, layers=layers, interpret=interpret),
        out_shape=[
            *[jax.ShapeDtypeStruct(values.shape, values.dtype)] * layers,
            jax.ShapeDtypeStruct((batch, outputs), jnp.float32),
        ],
        grid=(batch // _ROWS,),
        in_specs=[rows(_ROWS, width), *map(whole, given)],
        out_specs=[*[rows(_ROWS, width)] * layers, rows(_ROWS, outputs)],
        compiler_params=_PARAMS,
        interpret=interpret,
        name="head_forward",
    )(values, *given)
    return out, hidden


def _forward_plainly(values: jax.Array, weights: Weights) -> tuple[jax.Array, list[jax.Array]]:
    weights, hidden = _cast(weights, values.dtype), []
    for kernel, bias in zip(weights.kernels, weights.biases, strict=True):
        values = layer(values, kernel, bias)
        hidden.append(values)
    return dot(values.astype(jnp.float32), weights.output, (1, 1)) + weights.output_bias, hidden


# -- Backward


def _backward_kernel(gradient_ref, *refs, layers, interpret):
    hidden, kernels, output = refs[:layers], refs[layers : 2 * layers], refs[2 * layers]
    *found, sums_ref = refs[2 * layers + 1 :]
    outputs, width = output.shape
    last, of_output, first = hidden[-1][...], _padded(gradient_ref, axis=1), layers * width
    # Products of float32 are rounded on the way in, to more digits than what becomes of them has.
    of_kernel = dot(of_output, last.astype(jnp.float32), (0, 0))
    (number, column), is_output = _places(output, of_kernel.shape, axis=0)
    plgpu.store(sums_ref.at[first + number * width + column], of_kernel, mask=is_output)
    number = jax.lax.iota(jnp.int32, of_output.shape[1])
    plgpu.store(sums_ref.at[first + outputs * width + number], jnp.sum(of_output, axis=0), mask=number < outputs)
    values = dot(of_output, _padded(output))
    found[-1][...] = values = before(last, values)
    sums_ref[pl.ds(first - width, width)] = jnp.sum(values.astype(jnp.float32), axis=0)
    for level in reversed(range(layers)):

        def make(columns, level=level, values=values):
            gradient = dot(values, kernels[level][columns, :], (1, 1))
            if level:  # what comes in, the first layer has rectified
                gradient = before(hidden[level - 1][:, columns], gradient)
                place = pl.ds((level - 1) * width + columns.start, columns.size)
                sums_ref[place] = jnp.sum(gradient.astype(jnp.float32), axis=0)
            found[level][:, columns] = gradient.astype(values.dtype)

        _each_columns(width, make)
        if level:
            values = _written(found[level], interpret)


def _backward_on_gpu(
    gradient: jax.Array, hidden: list[jax.Array], weights: Weights, interpret: bool = False
) -> tuple[list[jax.Array], Weights]:
    """Gradients [B, H] of the values and before the rectifier of each hidden layer, and those of all weights but kernels."""
    (batch, outputs), width, layers = gradient.shape, weights.output.shape[1], len(hidden)
    cast = _cast(weights, hidden[0].dtype)
    given, total = (*cast.kernels, cast.output), (layers + outputs) * width + outputs
    *found, partial_sums = pl.pallas_call(
        functools.partial(_backward_kernel, layers=layers, interpret=interpret),
        out_shape=[
            *[jax.ShapeDtypeStruct(hidden[0].shape, hidden[0].dtype)] * (layers + 1),
            # All sums in one row, so that one reduction adds up the programs.
            jax.ShapeDtypeStruct((batch // _ROWS, total), jnp.float32),
        ],
        grid=(batch // _ROWS,),
        in_specs=[rows(_ROWS, outputs), *[rows(_ROWS, width)] * layers, *map(whole, given)],
        out_specs=[*[rows(_ROWS, width)] * (layers + 1), pl.BlockSpec((None, total), lambda program: (program, 0))],
        compiler_params=_PARAMS,
        interpret=interpret,
        name="head_backward",
    )(gradient, *hidden, *given)
    of_biases, of_output, of_output_bias = jnp.split(jnp.sum(partial_sums, axis=0), [layers * width, total - outputs])
    return found, Weights((), tuple(of_biases.reshape(layers, width)), of_output.reshape(outputs, width), of_output_bias)


def _backward_plainly(gradient: jax.Array, hidden: list[jax.Array], weights: Weights) -> tuple[list[jax.Array], Weights]:
    last, kernels = hidden[-1], _cast(weights, hidden[-1].dtype).kernels
    found = [before(last, dot(gradient, weights.output))]
    for level in reversed(range(len(kernels))):
        passed = dot(found[0], kernels[level], (1, 1))
        found.insert(0, before(hidden[level - 1], passed) if level else passed.astype(last.dtype))
    of_biases = tuple(jnp.sum(slope, axis=0, dtype=jnp.float32) for slope in found[1:])
    return found, Weights((), of_biases, dot(gradient, last.astype(jnp.float32), (0, 0)), jnp.sum(gradient, axis=0))


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def _apply(values: jax.Array, weights: Weights, interpret: bool) -> jax.Array:
    return _apply_forward(values, weights, interpret)[0]


def _apply_forward(values: jax.Array, weights: Weights, interpret: bool):
    on_gpu = functools.partial(_forward_on_gpu, interpret=interpret)
    out, hidden = dispatch(on_gpu, _forward_plainly, values, weights, interpret=interpret, probe=probe)
    return out, (values, hidden, weights)


def _apply_backward(interpret: bool, residuals: Any, gradient: jax.Array):
    values, hidden, weights = residuals
    on_gpu = functools.partial(_backward_on_gpu, interpret=interpret)
    (of_values, *slopes), others = dispatch(
        on_gpu, _backward_plainly, gradient, hidden, weights, interpret=interpret, probe=probe
    )
    products = [dot(read, slope, (0, 0)) for read, slope in zip((values, *hidden[:-1]), slopes, strict=True)]
    found = others._replace(kernels=tuple(products))
    return of_values, jax.tree.map(lambda leaf, like: leaf.astype(like.dtype), found, weights)


_apply.defvjp(_apply_forward, _apply_backward)
