"""First three layers of the encoder in one GPU kernel per direction (Pallas, by Triton).

Windows of 2x2 pixels with stride 2 never overlap, so the receptive field of three layers is a *patch* of 8x8 pixels. A tile of
R patches (from `kernels.patches`, in an order that makes windows contiguous) passes through all three without leaving the chip:

    4 R quarters of 4x4 pixels     [4 R, 16 C']  @ [16 C', 4 F1]   layer 1, its four windows at once: block-diagonal
                                   [4 R, 4 F1]   @ [4 F1, F2]      layer 2
    R patches                      [R, 4 F2]     @ [4 F2, F3]      layer 3

Layer 1 multiplies three zeros for every nonzero weight, because products 16 wide leave a GPU's matrix units idle anyway. As
separate products, the layers would spend 90 % of their time on writing and reading each other's activations. A fourth layer
would read four patches at a time, so that a tile has too few rows of it: fusing it made gradient steps a third slower.

The backward kernel recomputes all layers but the last, keeps the gradients of the weights in registers over several tiles, and
writes a partial sum for each program; these are summed in a fixed order, so a resumed run is reproduced exactly.

`networks` has the same function as plain matrix products: these are the reference, and run in processes without such a GPU. In
a process with one, images are converted to patches for any target platform, and programs for other platforms compute the
layers here, from the same patches, in plain JAX.
"""

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp

from jaxrl_vis.learner.networks import forward_mode
from jaxrl_vis.learner.networks.kernels.jvp import apply_forwards
from jaxrl_vis.learner.networks.kernels.passes import TILE, Weights, apply, dispatch, is_available
from jaxrl_vis.learner.networks.kernels.patches import LEVELS, padded_channels, prepare_on_gpu, prepare_plain

__all__ = ["LEVELS", "encode", "is_available", "make_weights", "prepare", "supports"]

_MAX_CHANNELS = 16


def supports(filters: tuple[int, ...], shape: tuple[int, ...]) -> bool:
    """Return True if the kernel supports encoders with these output channels by layer, and images of this shape [C, H, W]."""
    powers = all(16 <= size <= 64 and size & (size - 1) == 0 for size in filters[:LEVELS])
    return len(filters) >= LEVELS and powers and shape[0] <= _MAX_CHANNELS


def make_weights(params: dict[str, Any], channels: int) -> Weights:
    """Extract the first layers of an encoder (`networks`) for images of ``channels`` channels."""
    window = params["kernel_0"].reshape(2, 2, channels, -1)  # row, column, channel, filter
    window = jnp.pad(window, [(0, 0), (0, 0), (0, padded_channels(channels) - channels), (0, 0)])
    # From (channel, window's row, row, window's column, column) to (window's row, window's column, filter), where a window only
    # reads its own pixels. Written as a product with zeros and ones, which XLA fuses into one pass.
    same = jnp.eye(2, dtype=window.dtype)
    same = same[:, None, None, None, :, None, None] * same[:, None, None, :, None]
    quarter = window.transpose(2, 0, 1, 3)[:, None, :, None, :, None, None, :] * same
    finer = range(1, LEVELS)
    return Weights(
        kernels=(quarter.reshape(16 * padded_channels(channels), -1), *(params[f"kernel_{level}"] for level in finer)),
        biases=(jnp.tile(params["bias_0"], 4), *(params[f"bias_{level}"] for level in finer)),
    )


# -- Images


def prepare(
    images: jax.Array,
    mean: jax.Array,
    scale: jax.Array,
    levels: int,
    limit: float,
    dtype: Any,
    shift: jax.Array | None = None,
    interpret: bool = False,
) -> jax.Array:
    """Normalise images and convert them to patches: [B, C, H, W] uint8 -> [B, patches, 64 C'] of ``dtype``.

    Args:
        images: Planar images.
        mean, scale: [C, H, W] float32.
        levels: Total number of the encoder's layers; borders that do not fill a block of 2^levels pixels are cropped.
        limit: Maximum magnitude, to which normalised values are clipped.
        dtype: Dtype of the result.
        shift: [B, 2] int32, pixels by which to shift normalised images down and to the right, filling with 0; None for no
            shift.
        interpret: Whether to interpret the kernel without a GPU, which is slow.
    """
    settings = {"levels": levels, "limit": limit, "dtype": dtype}
    on_gpu = functools.partial(prepare_on_gpu, **settings, interpret=interpret)
    return dispatch(on_gpu, functools.partial(prepare_plain, **settings), images, mean, scale, shift, interpret=interpret)


# -- Images to features


def encode(patches: jax.Array, weights: Weights, selection: slice = slice(None), interpret: bool = False) -> jax.Array:
    """Encode the selected images by `apply`: [B, patches, 64 C'] -> [images, patches, F], same dtype.

    Images are selected here rather than sliced beforehand, because passing a slice to a kernel would copy it.
    """
    batch, of_image, size = patches.shape
    images = range(batch)[selection]
    first, count = images.start * of_image, len(images) * of_image
    rows = count
    if math.gcd(first, count) % TILE:  # a few small images
        patches = jnp.pad(patches[selection], ((0, -len(images) % TILE), (0, 0), (0, 0)))
        first, rows = 0, patches.shape[0] * of_image
    chosen = apply_forwards if forward_mode.is_active() else apply
    out: jax.Array = chosen(patches.reshape(-1, size), weights, first, rows, interpret)  # type: ignore[assignment]
    return out[:count].reshape(-1, of_image, out.shape[-1])
