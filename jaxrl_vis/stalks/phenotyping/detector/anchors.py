"""Anchors at which stalks are looked for, and codes of boxes relative to them.

A stalk in the band is a box and an axis: six numbers, left, top, right, bottom, and the columns of its middle at the box's top
and bottom. Coded relative to a box: offset of the middle (of its size), logarithm of both sizes, offsets of the axis (of its
width).
"""

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis.stalks.phenotyping.detector.detector_networks import ANCHOR_STRIDE

_MAX_LOG_SIZE = 2.0  # of a logarithm of a size, so that nothing overflows
_UNIT = np.array([0.2, 0.1, 0.3, 0.1, 0.3, 0.3], np.float32)  # about the spread of each code, so that all count alike


def make_anchors(shape: tuple[int, int], heights: float, widths: tuple[float, ...]) -> np.ndarray:
    """Anchors [K, 6] float32 of an image of ``shape`` (lines, columns), in the order of `Detector.propose`.

    Args:
        shape: Multiples of the networks' padding.
        heights: Height of all anchors, pixels: the band's.
        widths: Widths of the anchors of a place, pixels.
    """
    lines, columns = (-(-length // stride) for length, stride in zip(shape, ANCHOR_STRIDE))
    y = (np.arange(lines) + 0.5) * ANCHOR_STRIDE[0]
    x = (np.arange(columns) + 0.5) * ANCHOR_STRIDE[1]
    y, x, wide = np.meshgrid(y, x, np.asarray(widths), indexing="ij")
    half = 0.5 * heights
    return np.stack([x - wide / 2, y - half, x + wide / 2, y + half, x, x], axis=-1).reshape(-1, 6).astype(np.float32)


def encode(stalks: jax.Array, others: jax.Array) -> jax.Array:
    """Codes [..., 6] of stalks [..., 6] relative to others [..., 6]."""
    middle, size = _middle_and_size(others)
    own_middle, own_size = _middle_and_size(stalks)
    axis = (stalks[..., 4:] - others[..., 4:]) / size[..., :1]
    return jnp.concatenate([(own_middle - middle) / size, jnp.log(own_size / size), axis], axis=-1) / _UNIT


def decode(codes: jax.Array, others: jax.Array) -> jax.Array:
    """The inverse of `encode`."""
    codes = codes * _UNIT
    middle, size = _middle_and_size(others)
    half = 0.5 * size * jnp.exp(jnp.clip(codes[..., 2:4], -_MAX_LOG_SIZE, _MAX_LOG_SIZE))
    centre = middle + codes[..., :2] * size
    axis = others[..., 4:] + codes[..., 4:] * size[..., :1]
    return jnp.concatenate([centre - half, centre + half, axis], axis=-1)


def _middle_and_size(stalks: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the middles and sizes of the boxes of stalks [..., 6]: both [..., 2], across and down."""
    return 0.5 * (stalks[..., :2] + stalks[..., 2:4]), jnp.maximum(stalks[..., 2:4] - stalks[..., :2], 1e-3)
