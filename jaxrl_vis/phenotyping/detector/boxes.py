"""Boxes: overlap, non-maximum suppression and RoIAlign as pure functions of arrays with static shapes.

A box is (left, top, right, bottom) in continuous coordinates: the first pixel spans 0 to 1. Both operators give the numbers of
torchvision.ops (tests/data/torchvision_boxes.npz holds what it gave; tests/make_torchvision_boxes.py recorded it).
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
        kept, before = state
        return (kept != before).any()

    def again(state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        kept, _ = state
        return there & ~(better & kept[:, None]).any(axis=0), kept

    kept, _ = jax.lax.while_loop(unsettled, again, again((there, ~there)))
    return jnp.zeros(scores.shape, bool).at[order].set(kept)


def nms(boxes: jax.Array, scores: jax.Array, threshold: float, valid: jax.Array | None = None) -> jax.Array:
    """Non-maximum suppression of boxes [N, 4] by intersection over union; see `suppress`."""
    return suppress(overlap(boxes, boxes), scores, threshold, valid)


def band_overlap(boxes: jax.Array, axes: jax.Array, lines: int = 8) -> jax.Array:
    """How much of each other stalks cover, [N, N]: intersection over union of the strips that they are, not of their boxes.

    Boxes of two parallel stalks that lean overlap by half, though the stalks stand apart; strips do not. Both are compared at
    the same heights of the band.

    Args:
        boxes: [N, 4].
        axes: [N, 2], columns of a stalk's middle at the top and at the bottom of its box.
        lines: At how many heights.
    """
    share = (jnp.arange(lines) + 0.5) / lines
    middle = axes[:, :1] + (axes[:, 1:] - axes[:, :1]) * share  # [N, lines]
    wide = boxes[:, 2] - boxes[:, 0]
    half = 0.5 * jnp.maximum(wide - jnp.abs(axes[:, 1] - axes[:, 0]), 0.1 * wide)[:, None]
    low, high = middle - half, middle + half
    common = jnp.maximum(jnp.minimum(high[:, None], high[None]) - jnp.maximum(low[:, None], low[None]), 0.0).sum(-1)
    union = (high - low).sum(-1)[:, None] + (high - low).sum(-1)[None] - common
    across = common / jnp.maximum(union, 1e-6)
    shared = jnp.minimum(boxes[:, None, 3], boxes[None, :, 3]) - jnp.maximum(boxes[:, None, 1], boxes[None, :, 1])
    least = jnp.minimum(boxes[:, None, 3] - boxes[:, None, 1], boxes[None, :, 3] - boxes[None, :, 1])
    return across * jnp.clip(shared / jnp.maximum(least, 1e-6), 0.0, 1.0)


def roi_align(
    features: jax.Array,
    boxes: jax.Array,
    size: tuple[int, int],
    scale: float | tuple[float, float] = 1.0,
    samples: int = 2,
    aligned: bool = False,
) -> jax.Array:
    """Features of each box on a grid of its own, by bilinear interpolation.

    Args:
        features: [H, W, C].
        boxes: [N, 4].
        size: Lines and columns of the grid.
        scale: From the boxes' coordinates to those of the features; (vertical, horizontal) where they differ.
        samples: Points in each direction of a cell of the grid, of which the mean is taken.
        aligned: Whether the middle of the first feature lies at 0.5, as of the first pixel. If not, a box is at least one
            feature wide and tall.

    Returns:
        [N, size[0], size[1], C].
    """
    height, width = features.shape[:2]
    vertical, horizontal = scale if isinstance(scale, tuple) else (scale, scale)
    shift = 0.5 if aligned else 0.0
    scaled = boxes * jnp.array([horizontal, vertical, horizontal, vertical], boxes.dtype) - shift

    def weights(low: jax.Array, high: jax.Array, cells: int, length: int) -> jax.Array:
        """How much each of ``length`` features counts in each cell: [N, cells, length]."""
        extent = high - low if aligned else jnp.maximum(high - low, 1.0)
        share = (jnp.arange(cells * samples) + 0.5) / (cells * samples)
        place = low[:, None] + extent[:, None] * share
        seen = (place >= -1.0) & (place <= length)
        place = jnp.clip(place, 0.0, length - 1.0)
        each = jnp.maximum(1.0 - jnp.abs(place[..., None] - jnp.arange(length)), 0.0) * seen[..., None]
        return each.reshape(boxes.shape[0], cells, samples, length).mean(axis=2)

    lines = weights(scaled[:, 1], scaled[:, 3], size[0], height)
    columns = weights(scaled[:, 0], scaled[:, 2], size[1], width)
    # Interpolation is separable. The lines go first: a stalk is taller than it is wide, so that leaves less to do.
    tall = jnp.einsum("nih,hwc->niwc", lines, features)
    return jnp.einsum("njw,niwc->nijc", columns, tall)
