"""Boxes: overlap, non-maximum suppression and RoIAlign as pure functions of arrays with static shapes.

A box is (left, top, right, bottom) in continuous coordinates: the first pixel spans 0 to 1. Both operators return the numbers
of torchvision.ops, recorded in tests/stalks/data/torchvision_boxes.npz by tests/stalks/make_torchvision_boxes.py.
"""

import jax
import jax.numpy as jnp


def area(boxes: jax.Array) -> jax.Array:
    """Areas [...] of boxes [..., 4]; 0 for those that are turned inside out."""
    return jnp.prod(jnp.maximum(boxes[..., 2:] - boxes[..., :2], 0.0), axis=-1)


def overlap(first: jax.Array, second: jax.Array) -> jax.Array:
    """Intersection over union [N, M] of boxes [N, 4] and [M, 4]; 0 where both are empty."""
    low = jnp.maximum(first[:, None, :2], second[None, :, :2])
    high = jnp.minimum(first[:, None, 2:], second[None, :, 2:])
    common = jnp.prod(jnp.maximum(high - low, 0.0), axis=-1)
    union = area(first)[:, None] + area(second)[None, :] - common
    return jnp.where(union > 0.0, common / jnp.where(union > 0.0, union, 1.0), 0.0)


def suppress(overlaps: jax.Array, scores: jax.Array, threshold: float, valid: jax.Array | None = None) -> jax.Array:
    """Greedy non-maximum suppression: the best goes first, and removes what overlaps it by more than a threshold.

    Args:
        overlaps: [N, N] float32, symmetric.
        scores: [N] float32; of equal ones, the first goes first.
        threshold: Greatest overlap of two that are both kept.
        valid: [N] bool, which of them there are; all if not given.

    Returns:
        [N] bool: which are kept.
    """
    order = jnp.argsort(-scores, stable=True)
    there = jnp.ones(scores.shape, bool) if valid is None else valid[order]
    places = jnp.arange(scores.shape[0])
    better = (overlaps[order][:, order] > threshold) & (places[:, None] < places[None, :])  # [i, j]: i may remove j

    # All at once, again and again: who is removed by those that are kept. What is right stays right, and each round makes at
    # least the next one right; a few rounds do where one at a time takes as many steps as there are boxes.
    def unsettled(state: tuple[jax.Array, jax.Array]) -> jax.Array:
        selected, before = state
        return (selected != before).any()

    def again(state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        selected, _ = state
        return there & ~(better & selected[:, None]).any(axis=0), selected

    selected, _ = jax.lax.while_loop(unsettled, again, again((there, ~there)))
    return jnp.zeros(scores.shape, bool).at[order].set(selected)


def band_overlap(first: jax.Array, second: jax.Array, lines: int = 8) -> jax.Array:
    """Return the overlap of stalks, [N, M]: intersection over union of the strips that they are, not of their boxes.

    Boxes of two parallel stalks that lean overlap by half, though the stalks stand apart; strips do not. Both are compared at
    the same heights of the band.

    Args:
        first, second: [N, 6] and [M, 6] stalks: boxes, and columns of a stalk's middle at the top and at the bottom of its box.
        lines: At how many heights.
    """
    (low, high), (other_low, other_high) = _edges(first, lines), _edges(second, lines)
    common = jnp.minimum(high[:, None], other_high[None]) - jnp.maximum(low[:, None], other_low[None])
    common = jnp.maximum(common, 0.0).sum(-1)
    union = (high - low).sum(-1)[:, None] + (other_high - other_low).sum(-1)[None] - common
    across = common / jnp.maximum(union, 1e-6)
    shared = jnp.minimum(first[:, None, 3], second[None, :, 3]) - jnp.maximum(first[:, None, 1], second[None, :, 1])
    least = jnp.minimum((first[:, 3] - first[:, 1])[:, None], (second[:, 3] - second[:, 1])[None])
    return across * jnp.clip(shared / jnp.maximum(least, 1e-6), 0.0, 1.0)


def _edges(stalks: jax.Array, lines: int) -> tuple[jax.Array, jax.Array]:
    """Columns of both edges of the strips of stalks [N, 6] at some heights, both [N, lines]."""
    middle = stalks[:, 4:5] + (stalks[:, 5:] - stalks[:, 4:5]) * (jnp.arange(lines) + 0.5) / lines
    half = strip_half_width(stalks)[:, None]
    return middle - half, middle + half


def strip_half_width(stalks: jax.Array) -> jax.Array:
    """Half the width [N] of the strips of stalks [N, 6]: a box is wider by what its stalk leans."""
    wide = stalks[:, 2] - stalks[:, 0]
    return 0.5 * jnp.maximum(wide - jnp.abs(stalks[:, 5] - stalks[:, 4]), 0.1 * wide)


def roi_align(
    features: jax.Array,
    boxes: jax.Array,
    size: tuple[int, int],
    scale: float | tuple[float, float] = 1.0,
    samples: int = 2,
    aligned: bool = False,
    lean: jax.Array | None = None,
) -> jax.Array:
    """Features of each box on a grid of its own, by bilinear interpolation.

    Args:
        features: [H, W, C].
        boxes: [N, 4].
        size: Lines and columns of the grid.
        scale: From the boxes' coordinates to those of the features; (vertical, horizontal) where they differ.
        samples: Points in each direction of a cell of the grid, of which the mean is taken.
        aligned: The middle of the first feature lies at 0.5, as of the first pixel. If not, a box is at least one
            feature wide and tall.
        lean: [N], by how much more a box's bottom is moved to the right than its top, about its middle: a box that leans, of
            which each line of the grid stays level. None for upright boxes.

    Returns:
        [N, size[0], size[1], C].
    """
    height, width = features.shape[:2]
    vertical, horizontal = scale if isinstance(scale, tuple) else (scale, scale)
    shift = 0.5 if aligned else 0.0
    scaled = boxes * jnp.array([horizontal, vertical, horizontal, vertical], boxes.dtype) - shift

    def weights(low: jax.Array, high: jax.Array, cells: int, length: int) -> jax.Array:
        """Return the weights of ``length`` features in each cell: [..., cells, length] for low and high [...]."""
        extent = high - low if aligned else jnp.maximum(high - low, 1.0)
        share = (jnp.arange(cells * samples) + 0.5) / (cells * samples)
        place = low[..., None] + extent[..., None] * share
        inside = (place >= -1.0) & (place <= length)
        place = jnp.clip(place, 0.0, length - 1.0)
        weight = jnp.maximum(1.0 - jnp.abs(place[..., None] - jnp.arange(length)), 0.0) * inside[..., None]
        return weight.reshape(*low.shape, cells, samples, length).mean(axis=-2)

    lines = weights(scaled[:, 1], scaled[:, 3], size[0], height)
    # Interpolation is separable. The lines go first: a stalk is taller than it is wide, so that leaves less to do.
    tall = jnp.einsum("nih,hwc->niwc", lines, features)
    if lean is None:
        return jnp.einsum("njw,niwc->nijc", weights(scaled[:, 0], scaled[:, 2], size[1], width), tall)
    moved = (lean * horizontal)[:, None] * ((jnp.arange(size[0]) + 0.5) / size[0] - 0.5)
    columns = weights(scaled[:, :1] + moved, scaled[:, 2:3] + moved, size[1], width)
    return jnp.einsum("nijw,niwc->nijc", columns, tall)
