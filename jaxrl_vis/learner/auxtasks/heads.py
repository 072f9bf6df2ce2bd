"""The two kinds of heads that auxiliary tasks have: one linear layer, and a decoder from latents to an image.

A transposed 2x2 convolution with stride 2 makes a 2x2 block of every pixel, so it IS a matrix product of [pixels, channels in]
with [channels in, 4 * channels out]. As in the encoder (`networks`), images stay in nested 2x2 blocks (`blocks`), where what
comes out of one layer is what goes into the next: no copy in between, and none at the end if the target has that order, too.
"""

from typing import Any

import jax
import jax.numpy as jnp

from jaxrl_vis.types import Params

_glorot = jax.nn.initializers.glorot_uniform()

# Channels of a decoder: at every level but the finest one, and there; as in the authors' release.
_CHANNELS, _FINEST_CHANNELS = 64, 16


def init_linear(key: jax.Array, inputs: int, outputs: int) -> Params:
    """Parameters of `linear`; like all last layers, named so that it stays in float32 (`Networks.compute_copy`)."""
    return {"output": {"kernel": _glorot(key, (inputs, outputs)), "bias": jnp.zeros((outputs,))}}


def linear(params: Params, *inputs: jax.Array) -> jax.Array:
    """One linear layer on inputs [B, ...] side by side: [B, outputs] float32."""
    values = jnp.concatenate([part.astype(jnp.float32) for part in inputs], axis=-1)
    return values @ params["output"]["kernel"] + params["output"]["bias"]


def init_decoder(key: jax.Array, inputs: int, shape: tuple[int, int, int], levels: int) -> Params:
    """Parameters of `decode`.

    Args:
        key: [] a typed key.
        inputs: Size of what is decoded.
        shape: C, H, W of the image; what does not fill a block of 2^levels pixels is left out.
        levels: Transposed convolutions.
    """
    channels, height, width = shape
    sizes = [_CHANNELS] * (levels - 1) + [_FINEST_CHANNELS, channels]
    dense_key, *keys = jax.random.split(key, levels + 1)
    dense = (inputs, (height >> levels) * (width >> levels) * sizes[0])
    params = {"dense": {"kernel": _glorot(dense_key, dense), "bias": jnp.zeros(dense[1:])}}
    for level, (layer_key, before, after) in enumerate(zip(keys, sizes[:-1], sizes[1:])):
        # Initialised as the convolution that it is: fan-in and fan-out count the window too.
        kernel = _glorot(layer_key, (2, 2, before, after)).transpose(2, 0, 1, 3).reshape(before, 4 * after)
        params[f"up_{level}"] = {"kernel": kernel, "bias": jnp.zeros((after,))}
    return params


def decode(params: Params, values: jax.Array, dtype: Any) -> jax.Array:
    """A dense layer and transposed convolutions, with ReLU in between: [B, inputs] -> [B, blocks, 4^levels * C] float32.

    Args:
        params: From `init_decoder`.
        values: [B, inputs].
        dtype: What is computed in.
    """
    batch, levels = values.shape[0], len(params) - 1
    layers = [params["dense"], *(params[f"up_{level}"] for level in range(levels))]
    for level, layer in enumerate(layers):
        values = values if level == 0 else jax.nn.relu(values)
        product = values.astype(dtype) @ layer["kernel"].astype(dtype)
        values = product.reshape(-1, layer["bias"].shape[0]) + layer["bias"].astype(dtype)
        if level == 0:
            values = values.reshape(-1, layers[1]["kernel"].shape[0])
    size = 4**levels * values.shape[-1]
    return values.reshape(batch, -1, size).astype(jnp.float32)
