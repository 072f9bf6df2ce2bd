"""Sections: the parts of stalks in bands of the image of fixed height, as targets that do not depend on the camera.

The rows of a resized image are divided into bands of `Settings.section` pixels. A stalk that is visible over most of a band has
one section in it, a box and an axis [6] whose top and bottom are exactly those of the band (CTPN, Tian et al. 2016, arXiv
1609.03605, turned by 90 degrees). `chains` links sections to stalks.

Edges are the targets before the division into bands, as bands do not move with an image that is augmented or cropped: for each
`STEP` rows of the image the left and right edge of a stalk, pixels, and its visible fraction, `ABSENT` where there is no stalk.
"""

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis.stalks.phenotyping.detector.anchors import decode, make_anchors
from jaxrl_vis.stalks.phenotyping.detector.detector_networks import ANCHOR_STRIDE

# Kinds of true stalks and sections: NOTHING is padding, UNCLEAR is too occluded to count as positive or negative.
NOTHING, UNCLEAR, STALK = 0, 1, 2
STEP = 8
"""Rows of the resized image per row of the edges."""
ABSENT = -1.0
"""Visible fraction of rows without the stalk. Hidden rows have 0, and rows of unknown visibility have `UNKNOWN`."""
UNKNOWN = 0.3
"""Visible fraction of rows that annotations do not cover, between `_HIDDEN` and `_SHOWN`."""
WHOLE = 0.7
"""Minimum fraction of its width that a clear section has inside the image."""
_SHOWN = 0.5  # minimum visible fraction of a section to be a target
_HIDDEN = 0.15  # visible fraction below which a band counts as background
_NARROW = 4.0  # pixels: narrower stalks are unclear


def section_anchors(shape: tuple[int, int], section: int, widths: tuple[float, ...]) -> np.ndarray:
    """Return the anchors [B, A, 6] float32 of B bands, in the order of `Detector.propose`.

    Args:
        shape: Height and width of the image, multiples of `PADDING`.
        section: Height of a band, pixels.
        widths: Widths of the anchors at each location, pixels.
    """
    anchors = make_anchors((section, shape[1]), section, widths)[: -(-shape[1] // ANCHOR_STRIDE[1]) * len(widths)]
    anchors[:, [1, 3]] = 0.0, section
    down = np.array([0, 1, 0, 1, 0, 0], np.float32) * section * np.arange(shape[0] // section)[:, None]
    return anchors[None] + down[:, None].astype(np.float32)


def decode_sections(offsets: jax.Array, anchors: jax.Array) -> jax.Array:
    """Decode box offsets [..., 6] to sections [..., 6], whose top and bottom are those of the ``anchors`` [..., 6]."""
    stalks = decode(offsets, anchors)
    return stalks.at[..., 1].set(anchors[..., 1]).at[..., 3].set(anchors[..., 3])


def true_sections(edges: jax.Array, kinds: jax.Array, size: jax.Array, section: int) -> tuple[jax.Array, jax.Array]:
    """Divide the stalks of an image into their sections.

    Args:
        edges: [T, R, 3] float32, left edge, right edge and visible fraction in every `STEP` rows, see `sections`.
        kinds: [T] int32: NOTHING, UNCLEAR or STALK.
        size: [2] int32, height and width of the image without padding.
        section: Height of a band, pixels.

    Returns:
        Sections [B, T, 6] float32, and their kinds [B, T] int32: ``NOTHING`` where the stalk is absent, hidden or outside the
        image, ``UNCLEAR`` if the section is partly hidden, partly outside the image, or narrow, or if its stalk is ``UNCLEAR``.
    """
    rows = section // STEP
    bands = edges.shape[1] // rows
    parts = edges[:, : bands * rows].reshape(edges.shape[0], bands, rows, 3).swapaxes(0, 1)
    left, right, visible = jnp.moveaxis(parts, -1, 0)
    # A straight piece through the rows of the band, by least squares.
    offset = (jnp.arange(rows) + 0.5) * STEP - 0.5 * section
    middle = 0.5 * (left + right)
    centre, wide = middle.mean(-1), (right - left).mean(-1)
    slope = (middle * offset).sum(-1) / (offset**2).sum() if rows > 1 else jnp.zeros_like(centre)
    above, below = centre - 0.5 * section * slope, centre + 0.5 * section * slope
    top = jnp.broadcast_to(jnp.arange(bands, dtype=jnp.float32)[:, None] * section, centre.shape)
    box = [jnp.minimum(above, below) - 0.5 * wide, top, jnp.maximum(above, below) + 0.5 * wide, top + section]
    stalks = jnp.stack([*box, above, below], axis=-1)

    there = (visible > 0.5 * ABSENT).any(-1)
    shown = jnp.maximum(visible, 0.0).mean(-1)
    inside = jnp.clip(jnp.minimum(centre + 0.5 * wide, size[1]) - jnp.maximum(centre - 0.5 * wide, 0.0), 0.0, None)
    inside = inside / jnp.maximum(wide, 1e-3)
    clear = (shown >= _SHOWN) & (inside >= WHOLE) & (wide >= _NARROW) & (top + 0.5 * section < size[0])
    background = ~there | (shown < _HIDDEN) | (inside <= 0.0) | (wide <= 0.0) | (kinds == NOTHING)
    return stalks, jnp.where(background, NOTHING, jnp.where(clear & (kinds == STALK), STALK, UNCLEAR)).astype(jnp.int32)
