"""Anchor boxes, and encoding of stalks as box offsets (regression targets) relative to them.

A stalk in the band is a box and an axis, six numbers: left, top, right, bottom, and the x coordinates of its centre line at the
top and bottom of the box. Its offsets from a reference box are those of the centre (relative to the reference's size), the
logarithms of the width and height ratios, and those of the axis (relative to the reference's width).
"""

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis.stalks.phenotyping.detector.detector_networks import ANCHOR_STRIDE

_MAX_LOG_SIZE = 2.0  # clip of the log size ratio, against overflow
_UNIT = np.array([0.2, 0.1, 0.3, 0.1, 0.3, 0.3], np.float32)  # approximate standard deviations of the offsets


def make_anchors(shape: tuple[int, int], height: float, widths: tuple[float, ...]) -> np.ndarray:
    """Return the anchors [K, 6] float32 of an image, in the order of `Detector.propose`.

    Args:
        shape: Height and width of the image, multiples of `PADDING`.
        height: Height of all anchors (that of the band), pixels.
        widths: Widths of the anchors at each location, pixels.
    """
    rows, columns = (-(-length // stride) for length, stride in zip(shape, ANCHOR_STRIDE))
    y = (np.arange(rows) + 0.5) * ANCHOR_STRIDE[0]
    x = (np.arange(columns) + 0.5) * ANCHOR_STRIDE[1]
    y, x, wide = np.meshgrid(y, x, np.asarray(widths), indexing="ij")
    half = 0.5 * height
    return np.stack([x - wide / 2, y - half, x + wide / 2, y + half, x, x], axis=-1).reshape(-1, 6).astype(np.float32)


def encode(stalks: jax.Array, anchors: jax.Array) -> jax.Array:
    """Encode stalks [..., 6] as box offsets [..., 6] relative to the reference boxes ``anchors`` [..., 6].

    Offsets are divided by their approximate standard deviations, so that the losses weight all six alike.
    """
    middle, size = _middle_and_size(anchors)
    own_middle, own_size = _middle_and_size(stalks)
    axis = (stalks[..., 4:] - anchors[..., 4:]) / size[..., :1]
    return jnp.concatenate([(own_middle - middle) / size, jnp.log(own_size / size), axis], axis=-1) / _UNIT


def decode(offsets: jax.Array, anchors: jax.Array) -> jax.Array:
    """Decode box offsets [..., 6] to stalks [..., 6]; inverse of `encode`, up to the clipping of sizes."""
    offsets = offsets * _UNIT
    middle, size = _middle_and_size(anchors)
    half = 0.5 * size * jnp.exp(jnp.clip(offsets[..., 2:4], -_MAX_LOG_SIZE, _MAX_LOG_SIZE))
    centre = middle + offsets[..., :2] * size
    axis = anchors[..., 4:] + offsets[..., 4:] * size[..., :1]
    return jnp.concatenate([centre - half, centre + half, axis], axis=-1)


def _middle_and_size(stalks: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the centres (x, y) and sizes (width, height) of the boxes of stalks [..., 6], both [..., 2]."""
    return 0.5 * (stalks[..., :2] + stalks[..., 2:4]), jnp.maximum(stalks[..., 2:4] - stalks[..., :2], 1e-3)
