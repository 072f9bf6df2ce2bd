"""Heads of auxiliary tasks: a linear layer, and a decoder from latents to an image.

A transposed 2x2 convolution with stride 2 maps every pixel to a 2x2 block, so it IS a matrix product of [pixels, channels in]
with [channels in, 4 * channels out]. As in the encoder (`networks`), images stay in nested 2x2 blocks (`blocks`), where the
output of one layer is the input of the next: no copies in between, and none at the end if the target has the same order.
"""

from typing import Any

import jax
import jax.numpy as jnp

from jaxrl_vis.learner.networks.kernels import decoder as decoder_kernel
from jaxrl_vis.learner.networks.kernels import patches as encoder_kernel_patches
from jaxrl_vis.learner.networks.kernels.passes import MIN_ROWS
from jaxrl_vis.learner.networks.matmul import product
from jaxrl_vis.types import Params

_glorot = jax.nn.initializers.glorot_uniform()

# Channels of a decoder: at every level but the finest one, and at the finest; as in the authors' release.
_CHANNELS, _FINEST_CHANNELS = 64, 16


def init_linear(key: jax.Array, inputs: int, outputs: int) -> Params:
    """Initialise the parameters of `linear`: a kernel [inputs, outputs] (Glorot) and a bias of zeros, float32.

    They are called ``output``, like all last layers, which keeps them in float32 (`Networks.compute_copy`).
    """
    return {"output": {"kernel": _glorot(key, (inputs, outputs)), "bias": jnp.zeros((outputs,))}}


def linear(params: Params, *inputs: jax.Array) -> jax.Array:
    """Apply a linear layer to concatenated inputs [B, ...]: [B, outputs] float32."""
    values = jnp.concatenate([part.astype(jnp.float32) for part in inputs], axis=-1)
    return values @ params["output"]["kernel"] + params["output"]["bias"]


def init_decoder(key: jax.Array, inputs: int, shape: tuple[int, int, int], levels: int) -> Params:
    """Initialise the parameters of `decode`: Glorot kernels and biases of zeros, float32, by layer.

    Args:
        key: [] typed key.
        inputs: Size of the vectors to decode.
        shape: C, H, W of the image; borders that do not fill a block of 2^levels pixels are cropped.
        levels: Number of transposed convolutions.
    """
    channels, height, width = shape
    sizes = [_CHANNELS] * (levels - 1) + [_FINEST_CHANNELS, channels]
    dense_key, *keys = jax.random.split(key, levels + 1)
    dense = (inputs, (height >> levels) * (width >> levels) * sizes[0])
    params = {"dense": {"kernel": _glorot(dense_key, dense), "bias": jnp.zeros(dense[1:])}}
    for level, (layer_key, before, after) in enumerate(zip(keys, sizes[:-1], sizes[1:])):
        # Initialise like a convolution: fan-in and fan-out include the window.
        kernel = _glorot(layer_key, (2, 2, before, after)).transpose(2, 0, 1, 3).reshape(before, 4 * after)
        params[f"up_{level}"] = {"kernel": kernel, "bias": jnp.zeros((after,))}
    return params


def decode(params: Params, values: jax.Array, dtype: Any) -> jax.Array:
    """Apply a dense layer and transposed convolutions with ReLUs: [B, inputs] -> [B, blocks, 4^levels * C] float32.

    Args:
        params: From `init_decoder`.
        values: [B, inputs].
        dtype: Dtype of the computation.
    """
    layers = _layers(params)
    pixels = _apply_layers(layers, values, dtype) + layers[-1]["bias"].astype(dtype)
    size = 4 ** (len(layers) - 1) * pixels.shape[-1]
    return pixels.reshape(values.shape[0], -1, size).astype(jnp.float32)


def decoding_error(params: Params, values: jax.Array, patches: jax.Array, dtype: Any) -> jax.Array:
    """Compute the mean squared error of `decode`, [] float32, with one kernel for the finest two layers.

    Args:
        params: From `init_decoder`; see `has_kernel`.
        values: [B, inputs].
        patches: [at least B, patches, 64 C'], the targets, in the order of `kernels.patches.to_patches`.
        dtype: Dtype of the computation.
    """
    *coarser, before, finer, finest = _layers(params)
    cells = _apply_layers([*coarser, before], values, dtype)
    weights = decoder_kernel.make_weights(before["bias"], finer, finest)
    pixels = cells.shape[0] * 16 * finest["bias"].shape[0]
    return decoder_kernel.squared_error(cells, patches.reshape(-1, patches.shape[-1] // 4), weights, 1.0 / pixels)


def has_kernel(batch: int, shape: tuple[int, int, int], levels: int) -> bool:
    """Return True if `decoding_error` supports ``batch`` images of shape C, H, W and a decoder of this many levels."""
    channels, height, width = shape
    cells = batch * (height >> levels) * (width >> levels) * 4 ** (levels - 2)
    is_whole = levels >= encoder_kernel_patches.LEVELS and cells % MIN_ROWS == 0
    return is_whole and decoder_kernel.supports(channels, _CHANNELS, _FINEST_CHANNELS)


def _layers(params: Params) -> list[Params]:
    """Return the layers from the coarsest to the finest."""
    return [params["dense"], *(params[f"up_{level}"] for level in range(len(params) - 1))]


def _apply_layers(layers: list[Params], values: jax.Array, dtype: Any) -> jax.Array:
    """Return the output of the last layer before its bias is added: [.., outputs of a pixel], in ``dtype``."""
    for number, layer in enumerate(layers):
        if number > 0:
            biased = values + layers[number - 1]["bias"].astype(dtype)
            values = jax.nn.relu(biased).reshape(-1, layer["kernel"].shape[0])
        values = product(values.astype(dtype), layer["kernel"].astype(dtype)).reshape(-1, layer["bias"].shape[0])
    return values
