"""Box overlap, non-maximum suppression and RoIAlign as pure functions of arrays with static shapes.

A box is (left, top, right, bottom) in continuous coordinates: the first pixel spans 0 to 1. NMS and RoIAlign are tested against
outputs of torchvision.ops, recorded in tests/stalks/data/torchvision_boxes.npz by tests/stalks/make_torchvision_boxes.py.
"""

import jax
import jax.numpy as jnp

_SAMPLES = 2  # sampling points per grid cell of a region and direction, which are averaged


def area(boxes: jax.Array) -> jax.Array:
    """Compute the areas [...] of boxes [..., 4]; 0 for inverted boxes."""
    return jnp.prod(jnp.maximum(boxes[..., 2:] - boxes[..., :2], 0.0), axis=-1)


def box_iou(first: jax.Array, second: jax.Array) -> jax.Array:
    """Compute the intersection over union [N, M] of boxes [N, 4] and [M, 4]; 0 if both are empty."""
    low = jnp.maximum(first[:, None, :2], second[None, :, :2])
    high = jnp.minimum(first[:, None, 2:], second[None, :, 2:])
    common = jnp.prod(jnp.maximum(high - low, 0.0), axis=-1)
    union = area(first)[:, None] + area(second)[None, :] - common
    return jnp.where(union > 0.0, common / jnp.where(union > 0.0, union, 1.0), 0.0)


def non_maximum_suppression(
    overlaps: jax.Array, scores: jax.Array, threshold: float, valid: jax.Array | None = None
) -> jax.Array:
    """Apply greedy non-maximum suppression.

    In descending order of score, each kept box removes those that overlap it by more than the threshold.

    Args:
        overlaps: [N, N] float32, symmetric.
        scores: [N] float32; ties are broken by the lower index.
        threshold: Maximum overlap of two boxes that are both kept.
        valid: [N] bool, False for padding; None if all are valid.

    Returns:
        [N] bool, True for the boxes that are kept.
    """
    order = jnp.argsort(-scores, stable=True)
    there = jnp.ones(scores.shape, bool) if valid is None else valid[order]
    places = jnp.arange(scores.shape[0])
    better = (overlaps[order][:, order] > threshold) & (places[:, None] < places[None, :])  # [i, j]: i may remove j

    # Fixed-point iteration over all boxes at once: a box is kept unless a kept box of higher score suppresses it. Each round
    # settles at least the next box in order and never changes a settled one, so it converges to the sequential result, usually
    # in a few rounds instead of N steps.
    def is_unsettled(state: tuple[jax.Array, jax.Array]) -> jax.Array:
        selected, before = state
        return (selected != before).any()

    def step(state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        selected, _ = state
        return there & ~(better & selected[:, None]).any(axis=0), selected

    selected, _ = jax.lax.while_loop(is_unsettled, step, step((there, ~there)))
    return jnp.zeros(scores.shape, bool).at[order].set(selected)


def strip_overlap(first: jax.Array, second: jax.Array, heights: int = 8) -> jax.Array:
    """Compute the overlap [N, M] of stalks: intersection over union of their slanted strips instead of their boxes.

    The boxes of two parallel leaning stalks can overlap by half although the stalks are apart; their strips do not. Strips are
    compared at equal fractions of the height of each box, and the result is scaled by the vertical overlap of the boxes as a
    fraction of the shorter one.

    Args:
        first, second: Stalks [N, 6] and [M, 6]: boxes, and x coordinates of the axis at the top and bottom of the box.
        heights: Number of heights at which strips are compared.
    """
    (low, high), (other_low, other_high) = _edges(first, heights), _edges(second, heights)
    common = jnp.minimum(high[:, None], other_high[None]) - jnp.maximum(low[:, None], other_low[None])
    common = jnp.maximum(common, 0.0).sum(-1)
    union = (high - low).sum(-1)[:, None] + (other_high - other_low).sum(-1)[None] - common
    across = common / jnp.maximum(union, 1e-6)
    shared = jnp.minimum(first[:, None, 3], second[None, :, 3]) - jnp.maximum(first[:, None, 1], second[None, :, 1])
    shorter = jnp.minimum((first[:, 3] - first[:, 1])[:, None], (second[:, 3] - second[:, 1])[None])
    return across * jnp.clip(shared / jnp.maximum(shorter, 1e-6), 0.0, 1.0)


def _edges(stalks: jax.Array, heights: int) -> tuple[jax.Array, jax.Array]:
    """Return the x coordinates of the left and right edges of the strips of stalks [N, 6], both [N, heights]."""
    middle = stalks[:, 4:5] + (stalks[:, 5:] - stalks[:, 4:5]) * (jnp.arange(heights) + 0.5) / heights
    half = strip_half_width(stalks)[:, None]
    return middle - half, middle + half


def strip_half_width(stalks: jax.Array) -> jax.Array:
    """Return half the horizontal width [N] of the strips of stalks [N, 6]: that of the box without the shift of the axis."""
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
    """Pool the features of each box to a grid of fixed size, by bilinear interpolation (RoIAlign).

    Args:
        features: Feature map [H, W, C].
        boxes: [N, 4].
        size: Height and width of the grid.
        scale: Factor from box coordinates to feature coordinates; (vertical, horizontal) if they differ.
        samples: Sampling points per grid cell and direction, which are averaged.
        aligned: Shift boxes by half a feature, so that the centre of the first feature lies at 0.5. If False, boxes are
            enlarged to at least one feature in width and height.
        lean: [N], horizontal shift of the bottom of a box relative to its top, in box coordinates: the box is sheared about its
            centre, and the rows of the grid stay level. None for upright boxes.

    Returns:
        Pooled features [N, size[0], size[1], C].
    """
    height, width = features.shape[:2]
    vertical, horizontal = scale if isinstance(scale, tuple) else (scale, scale)
    shift = 0.5 if aligned else 0.0
    scaled = boxes * jnp.array([horizontal, vertical, horizontal, vertical], boxes.dtype) - shift

    def weights(low: jax.Array, high: jax.Array, cells: int, length: int) -> jax.Array:
        """Return interpolation weights [..., cells, length] of features in the cells between ``low`` and ``high`` [...]."""
        extent = high - low if aligned else jnp.maximum(high - low, 1.0)
        fraction = (jnp.arange(cells * samples) + 0.5) / (cells * samples)
        place = low[..., None] + extent[..., None] * fraction
        inside = (place >= -1.0) & (place <= length)
        place = jnp.clip(place, 0.0, length - 1.0)
        weight = jnp.maximum(1.0 - jnp.abs(place[..., None] - jnp.arange(length)), 0.0) * inside[..., None]
        return weight.reshape(*low.shape, cells, samples, length).mean(axis=-2)

    rows = weights(scaled[:, 1], scaled[:, 3], size[0], height)
    # Interpolation is separable. Rows go first, as stalks are taller than wide: this reduces the work most.
    tall = jnp.einsum("nih,hwc->niwc", rows, features)
    if lean is None:
        return jnp.einsum("njw,niwc->nijc", weights(scaled[:, 0], scaled[:, 2], size[1], width), tall)
    moved = (lean * horizontal)[:, None] * ((jnp.arange(size[0]) + 0.5) / size[0] - 0.5)
    columns = weights(scaled[:, :1] + moved, scaled[:, 2:3] + moved, size[1], width)
    return jnp.einsum("nijw,niwc->nijc", columns, tall)


def roi_rows(features: jax.Array, top: jax.Array, bottom: jax.Array, cells: int, scale: float) -> jax.Array:
    """Interpolate the rows of regions that span the whole width, the first half of `roi_align` with ``aligned``.

    Args:
        features: Feature map [H, W, C].
        top, bottom: First and last rows [B] of the regions, in box coordinates.
        cells: Number of rows of the grid.
        scale: Factor from box coordinates to feature coordinates.

    Returns:
        Features [B, cells, W, C] of the rows.
    """
    fraction = (jnp.arange(cells * _SAMPLES) + 0.5) / (cells * _SAMPLES)
    low, high = top * scale - 0.5, bottom * scale - 0.5
    place = low[:, None] + (high - low)[:, None] * fraction
    inside = (place >= -1.0) & (place <= features.shape[0])
    place = jnp.clip(place, 0.0, features.shape[0] - 1.0)
    weight = jnp.maximum(1.0 - jnp.abs(place[..., None] - jnp.arange(features.shape[0])), 0.0) * inside[..., None]
    return jnp.einsum("bih,hwc->biwc", weight.reshape(len(top), cells, _SAMPLES, -1).mean(axis=2), features)


def roi_columns(
    rows: jax.Array,
    of_region: jax.Array,
    left: jax.Array,
    right: jax.Array,
    lean: jax.Array,
    cells: int,
    scale: float,
) -> jax.Array:
    """Pool rows of `roi_rows` to the grids of regions, the second half of `roi_align`.

    Args:
        rows: Features [B, h, W, C].
        of_region: Index into ``rows`` of each region, [N] int32.
        left, right: Columns [N] of the regions at half their height, in box coordinates.
        lean: [N], horizontal shift of the bottom of a region relative to its top.
        cells: Number of columns of the grid.
        scale: Factor from box coordinates to feature coordinates.

    Returns:
        Pooled features [N, h, cells, C].
    """
    _, height, width, channels = rows.shape
    fraction = (jnp.arange(cells * _SAMPLES) + 0.5) / (cells * _SAMPLES)
    moved = (lean * scale)[:, None] * ((jnp.arange(height) + 0.5) / height - 0.5)
    place = (left * scale - 0.5)[:, None, None] + moved[..., None] + ((right - left) * scale)[:, None, None] * fraction
    inside = (place >= -1.0) & (place <= width)
    place = jnp.clip(place, 0.0, width - 1.0)
    first = jnp.floor(place).astype(jnp.int32)
    part = (place - first)[..., None]
    row = jnp.arange(height)[None, :, None]
    band = of_region[:, None, None]
    values = rows[band, row, first] * (1.0 - part) + rows[band, row, jnp.minimum(first + 1, width - 1)] * part
    return (values * inside[..., None]).reshape(-1, height, cells, _SAMPLES, channels).mean(axis=3)
