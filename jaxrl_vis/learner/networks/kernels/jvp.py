"""Kernel that computes the encoder's first layers and their tangents along a direction of the weights.

It has an equivalent in plain JAX, as in `kernels.passes`, and is used by weightings that need dot products of gradients
(`networks.forward_mode`).
"""

import functools
import math
from typing import Any

import jax

from jaxrl_vis.learner.networks.kernels.passes import (
    FORWARD,
    FORWARD_TILES,
    TILE,
    Weights,
    apply,
    apply_plain,
    as_quarters,
    cast_kernels,
    dispatch,
    dot,
    layer,
    layer_inputs,
    load_weights,
    rectifier_gradient,
    rows,
    tile_quarters,
    tile_rows,
    whole_block,
)
from jaxrl_vis.learner.networks.kernels.patches import divisor
from jaxrl_vis_envs.compiling.gpu_kernels import kernel_call


def _tangent_kernel(x_ref, *refs):
    inputs, (out_ref, tangent_ref) = refs[:-2], refs[-2:]
    weights, tangent_weights = load_weights(inputs[: len(inputs) // 2]), load_weights(inputs[len(inputs) // 2 :])

    def process_tile(tile, _):
        values, tangents = x_ref[tile_quarters(tile), :], None
        for level, parameters in enumerate(zip(*weights, *tangent_weights, strict=True)):
            tangents = None if tangents is None else layer_inputs(tangents, level)
            values, tangents = _layer_jvp(layer_inputs(values, level), tangents, *parameters)
        assert tangents is not None  # there is a layer
        out_ref[tile_rows(tile), :], tangent_ref[tile_rows(tile), :] = values, tangents

    jax.lax.fori_loop(0, out_ref.shape[0] // TILE, process_tile, None)


def _layer_jvp(
    values: jax.Array,
    tangents: jax.Array | None,
    kernel: jax.Array,
    bias: jax.Array,
    kernel_along: jax.Array,
    bias_along: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Return the result of `layer` and its tangent, given tangents of the values (None for zero), kernel and bias."""
    out, change = layer(values, kernel, bias), dot(values, kernel_along) + bias_along[None, :]
    if tangents is not None:
        change += dot(tangents, kernel)
    return out, rectifier_gradient(out, change)


@functools.partial(jax.custom_jvp, nondiff_argnums=(2, 3, 4))
def apply_forwards(patches: jax.Array, weights: Weights, first: int, count: int, interpret: bool = False) -> jax.Array:
    """Compute `apply`, with the same arguments, but differentiable in forward mode with respect to the weights."""
    return apply(patches, weights, first, count, interpret)


@apply_forwards.defjvp
def _apply_along(first: int, count: int, interpret: bool, primals: Any, tangents: Any) -> tuple[jax.Array, jax.Array]:
    patches, weights = primals
    rows = {"first": first, "count": count}
    on_gpu = functools.partial(_gpu_jvp, **rows, interpret=interpret)
    plain = functools.partial(_plain_jvp, **rows)
    return dispatch(on_gpu, plain, patches, weights, tangents[1], interpret=interpret)


def _gpu_jvp(
    patches: jax.Array, weights: Weights, tangent_weights: Weights, first: int, count: int, interpret: bool = False
) -> tuple[jax.Array, jax.Array]:
    """Return the result of `apply` for patches, and its tangent along a direction of the weights, [count, F] each."""
    outputs = weights.biases[-1].shape[0]
    block = TILE * divisor(math.gcd(first, count) // TILE, FORWARD_TILES)
    data, data_spec = as_quarters(patches, first, block)
    cast = jax.tree.leaves([cast_kernels(tree, patches.dtype) for tree in (weights, tangent_weights)])
    out = jax.ShapeDtypeStruct((count, outputs), patches.dtype)
    return kernel_call(
        _tangent_kernel,
        out_shape=(out, out),
        grid=(count // block,),
        in_specs=[data_spec, *map(whole_block, cast)],
        out_specs=(rows(block, outputs), rows(block, outputs)),
        compiler_params=FORWARD,
        interpret=interpret,
        name="encode_patches_along",
    )(data, *cast)


def _plain_jvp(
    patches: jax.Array, weights: Weights, tangent_weights: Weights, first: int, count: int
) -> tuple[jax.Array, jax.Array]:
    return jax.jvp(lambda weights: apply_plain(patches, weights, first, count), (weights,), (tangent_weights,))
