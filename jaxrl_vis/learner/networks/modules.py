"""Modules of the networks: encoder of images, dense layer, head. The only file of the learner that uses flax.

The encoder is a stack of 2x2 convolutions with stride 2. Such windows never overlap, so each layer IS a matrix product of
[pixels, 4 * channels in] with [4 * channels in, channels out]. If the pixels are put into nested 2x2 blocks once,

    [B, C, H, W]  ->  [B, H/16, W/16, 2*2, 2*2, 2*2, 2*2 * C]      (four layers; the finest block last)

every layer is one reshape and one matrix product over the last axis, with no copy between layers. Pixels are reordered in the
uint8 image, where it is cheapest. Borders that do not fill a block are cropped, as by a convolution without padding.
"""

from collections.abc import Sequence
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from jaxrl_vis.learner.networks.matmul import product

_glorot = nn.initializers.glorot_uniform()


def _zero_init(key: jax.Array, shape: tuple[int, ...], dtype: Any = jnp.float32) -> jax.Array:
    """Sample a kernel uniformly from [-1e-12, 1e-12], so that outputs are close to 0."""
    return jax.random.uniform(key, shape, dtype, -1e-12, 1e-12)


# Inputs at most this wide are multiplied element by element: a GPU's matrix units would pad them.
_NARROW = 16


class Encoder(nn.Module):
    """Encoder of images in nested blocks: [B, blocks, 4^levels * C] -> [B, latent] of ``dtype``.

    Attributes:
        filters: Output channels of each convolution; their number is ``levels``.
        latent_size: Size of the latent, the output of the last, dense layer.
        dtype: Dtype of the computation.
    """

    filters: Sequence[int]
    latent_size: int
    dtype: Any

    @nn.compact
    def __call__(self, *pieces: jax.Array, first_layer: int = 0) -> jax.Array:
        """Apply the layers from ``first_layer`` on; concatenate the latents of all ``pieces``.

        Args:
            pieces: Arrays [B, blocks, 4^(levels - first_layer) * channels], the input of that layer.
            first_layer: Index of the first convolution to apply; results of earlier ones are in ``pieces``.
        """
        pieces = tuple(blocks.astype(self.dtype) for blocks in pieces)
        count, size = pieces[0].shape[1:]
        channels = size // 4 ** (len(self.filters) - first_layer)
        for level, filters in list(enumerate(self.filters))[first_layer:]:
            # Initialise like a convolution: the fan-out includes the window.
            kernel = self.param(
                f"kernel_{level}",
                lambda key, shape: _glorot(key, (2, 2, shape[0] // 4, shape[1])).reshape(shape),
                (4 * channels, filters),
            )
            bias = self.param(f"bias_{level}", nn.initializers.zeros, (filters,)).astype(self.dtype)
            kernel = kernel.astype(self.dtype)
            pieces = tuple(nn.relu(product(values.reshape(-1, 4 * channels), kernel) + bias) for values in pieces)
            channels = filters
        # Concatenate the pieces here, where they are smallest.
        features = [values.reshape(-1, count * channels) for values in pieces]
        features = jnp.concatenate(features) if len(features) > 1 else features[0]
        return Dense(self.latent_size, self.dtype, name="latent")(features)


class Dense(nn.Module):
    """Dense layer [B, inputs] -> [B, size], like `flax.linen.Dense`.

    Inputs may be passed as parts, arrays [B, part] or [parts, B, part], which are not concatenated in memory.

    Attributes:
        size: Number of outputs.
        dtype: Dtype of the computation and the output.
        bias_init, kernel_init: Initialisers; by default zeros and Glorot's uniform distribution.
    """

    size: int
    dtype: Any
    bias_init: nn.initializers.Initializer = nn.initializers.zeros
    kernel_init: nn.initializers.Initializer = _glorot

    @nn.compact
    def __call__(self, *inputs: jax.Array) -> jax.Array:
        """Apply the layer to the concatenation of ``inputs`` along the last axis: [B, size]."""
        inputs = tuple(values if values.ndim == 3 else values[None] for values in inputs)
        width = sum(values.shape[0] * values.shape[-1] for values in inputs)
        kernel = self.param("kernel", self.kernel_init, (width, self.size)).astype(self.dtype)
        total, first = self.param("bias", self.bias_init, (self.size,)).astype(self.dtype), 0
        for values in inputs:
            blocks, _, block_size = values.shape
            rows = kernel[first : first + blocks * block_size].reshape(blocks, block_size, self.size)
            values = values.astype(self.dtype)
            if block_size <= _NARROW:
                total = total + jnp.sum(values[..., None] * rows[:, None], axis=(0, 2))
            else:
                total = total + jnp.sum(product(values, rows), axis=0)
            first += blocks * block_size
        return total


class Head(nn.Module):
    """Multilayer perceptron with ReLUs on latents: inputs as for `Dense` -> [B, outputs] float32.

    Attributes:
        hidden_sizes: Sizes of the hidden layers.
        outputs: Number of outputs.
        output_bias: Initial bias of the outputs.
        dtype: Dtype of the hidden layers; the last layer is float32.
        stabilized: Whether hidden layers are normalised (layer normalisation) and outputs are initially close to
            ``output_bias`` (Zheng et al., 2024, arXiv 2306.03346).
    """

    hidden_sizes: Sequence[int]
    outputs: int
    output_bias: float
    dtype: Any
    stabilized: bool = False

    @nn.compact
    def __call__(self, *inputs: jax.Array) -> jax.Array:
        """Apply the layers to the concatenation of ``inputs`` along the last axis: [B, outputs] float32."""
        for layer, size in enumerate(self.hidden_sizes):
            values = Dense(size, self.dtype, name=f"hidden_{layer}")(*inputs)
            if self.stabilized:
                values = nn.LayerNorm(dtype=self.dtype, name=f"normalization_{layer}")(values)
            inputs = (nn.relu(values),)
        # The last layer stays in float32: near Q = -50 the spacing of bfloat16 numbers is 0.25.
        bias = nn.initializers.constant(self.output_bias)
        kernel = _zero_init if self.stabilized else _glorot
        return Dense(self.outputs, jnp.float32, bias, kernel, name="output")(*inputs)
