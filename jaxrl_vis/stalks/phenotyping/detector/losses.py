"""Training losses of the networks: classification and regression of boxes, and segmentation of stalk crops."""

from typing import Any

import jax
import jax.numpy as jnp
import optax

from jaxrl_vis.stalks.phenotyping.detector.anchors import encode, make_anchors
from jaxrl_vis.stalks.phenotyping.detector.boxes import box_iou, strip_overlap
from jaxrl_vis.stalks.phenotyping.detector.detect import Settings, apply_heads, normalize, pool_regions, select_proposals
from jaxrl_vis.stalks.phenotyping.detector.detector_networks import Segmenter
from jaxrl_vis.stalks.phenotyping.detector.sections import STALK, UNCLEAR
from jaxrl_vis.stalks.phenotyping.detector.stalk_crops import preprocess_crops


def assign_boxes(
    overlaps: jax.Array,
    kinds: jax.Array,
    positive_overlap: float,
    negative_overlap: float,
    best_of_stalk: jax.Array | None = None,
) -> tuple[jax.Array, ...]:
    """Assign boxes to true stalks.

    Args:
        overlaps: [K, T] overlaps of boxes and true stalks.
        kinds: [T] or [K, T] int32: NOTHING, UNCLEAR or STALK.
        positive_overlap: Minimum overlap of a positive box.
        negative_overlap: Overlap below which a box is negative.
        best_of_stalk: [K, T] maximum overlap of each true stalk with any box; None to compute it over all boxes.

    Returns:
        Index of the assigned stalk [K] int32, positives [K] bool and negatives [K] bool. Boxes between both thresholds, and
        those on unclear stalks that are not positive, are ignored. The best box of a stalk is positive from an overlap of 0.2.
    """
    unclear = jnp.where(kinds == UNCLEAR, overlaps, 0.0).max(axis=1) >= negative_overlap
    overlaps = jnp.where(kinds == STALK, overlaps, 0.0)
    best = overlaps.max(axis=1)
    # The best box of each stalk is positive even below the threshold.
    best_of_stalk = overlaps.max(axis=0) if best_of_stalk is None else best_of_stalk
    forced = (overlaps >= best_of_stalk - 1e-6) & (best_of_stalk > 0.2)
    which = jnp.where(forced.any(axis=1), jnp.argmax(jnp.where(forced, overlaps, -1.0), axis=1), jnp.argmax(overlaps, axis=1))
    positive = (best >= positive_overlap) | forced.any(axis=1)
    return which, positive, (best < negative_overlap) & ~unclear & ~positive


def detector_loss(
    params: Any, images: jax.Array, truth: jax.Array, kinds: jax.Array, settings: Settings, dtype: Any, key: jax.Array
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Compute the loss of the proposals and the box head, averaged over images.

    Args:
        params: Parameters of the detector.
        images: [N, H, W, 3] uint8, resized and padded.
        truth: True stalks [N, T, 6].
        kinds: [N, T] int32, see `assign_boxes`.
        settings: Settings of the networks.
        dtype: Compute dtype of the convolutions.
        key: PRNG key of the jittered true boxes that the head is trained on besides the proposals.

    Returns:
        Total loss, and its terms by name: ``objectness``, ``offsets``, ``head`` and ``boxes``.
    """
    network = settings.detector(dtype)
    shape = (images.shape[1], images.shape[2])
    anchors = jnp.asarray(make_anchors(shape, settings.band_height, settings.anchor_widths))
    features = network.apply(params, normalize(images), method="features")
    assert isinstance(features, jax.Array)
    logits, offsets = apply_heads(network, params, features, "propose")

    def image_loss(features, logits, offsets, truth, kinds, key):
        which, positive, negative = assign_boxes(box_iou(anchors[:, :4], truth[:, :4]), kinds, 0.5, 0.3)
        loss = focal_loss(logits, positive, negative) / jnp.maximum(positive.sum(), 1)
        placed = offset_loss(offsets, encode(truth[which], anchors), positive)

        proposals, _, valid = select_proposals(*jax.lax.stop_gradient((logits, offsets)), anchors, settings, shape)
        size = jnp.concatenate([truth[:, 2:4] - truth[:, :2]] * 2 + [truth[:, 2:3] - truth[:, :1]] * 2, axis=-1)
        near = truth + 0.15 * jax.random.normal(key, truth.shape) * size
        proposals = jnp.concatenate([proposals, near])
        valid = jnp.concatenate([valid, kinds == STALK])
        # In a clump, a box between two stalks overlaps both by half, but its strip overlaps neither.
        alike = 0.5 * (box_iou(proposals[:, :4], truth[:, :4]) + strip_overlap(proposals, truth))
        which, positive, negative = assign_boxes(alike, kinds, 0.5, 0.45)
        positive, negative = positive & valid, negative & valid
        judged, refined = apply_heads(network, params, pool_regions(features, proposals), "classify")
        weight = (positive | negative).astype(jnp.float32)
        entropy = optax.sigmoid_binary_cross_entropy(judged, positive.astype(jnp.float32))
        judgement = (entropy * weight).sum() / jnp.maximum(weight.sum(), 1.0)
        refinement = offset_loss(refined, encode(truth[which], proposals), positive)
        return loss, placed, 2.0 * judgement, 2.0 * refinement

    keys = jax.random.split(key, images.shape[0])
    parts = jax.vmap(image_loss)(features, logits, offsets, truth, kinds, keys)
    named = {name: part.mean() for name, part in zip(("objectness", "offsets", "head", "boxes"), parts)}
    return sum(named.values(), jnp.zeros(())), named


def focal_loss(logits: jax.Array, positive: jax.Array, negative: jax.Array) -> jax.Array:
    """Sum the focal loss (alpha 0.5, gamma 2) of logits [K] over ``positive`` and ``negative`` anchors.

    Both are [K] bool; anchors that are neither are ignored. Source: Lin et al. (2017), arXiv 1708.02002.
    """
    loss = optax.sigmoid_focal_loss(logits, positive.astype(jnp.float32), alpha=0.5, gamma=2.0)
    return (loss * (positive | negative)).sum()


def offset_loss(offsets: jax.Array, targets: jax.Array, positive: jax.Array) -> jax.Array:
    """Compute the Huber loss of box offsets [K, 6], summed over the six and averaged over the positive boxes.

    ``targets`` [K, 6] are clipped to -20 to 20; ``positive`` [K] bool is True for positive boxes. The loss is 0 without these.
    """
    loss = optax.huber_loss(offsets, jnp.clip(targets, -20.0, 20.0), delta=1.0).sum(axis=-1)
    return (loss * positive).sum() / jnp.maximum(positive.sum(), 1)


def segmenter_loss(params: Any, crops: jax.Array, masks: jax.Array, settings: Settings, dtype: Any) -> jax.Array:
    """Compute the scalar cross-entropy and Dice loss of the segmentation of stalk crops, see `mask_loss`.

    Args:
        params: Parameters of the segmentation network.
        crops: Stalk crops [N, h, w, 3] uint8.
        masks: True masks [N, h, w] bool.
        settings: Settings of the networks.
        dtype: Compute dtype of the convolutions.
    """
    logits = Segmenter(settings.segmenter, dtype).apply(params, preprocess_crops(crops))
    assert isinstance(logits, jax.Array)
    return mask_loss(logits, masks)


def mask_loss(logits: jax.Array, masks: jax.Array) -> jax.Array:
    """Compute the scalar cross-entropy plus 0.3 times Dice loss of logits [N, h, w] against masks [N, h, w] bool."""
    wanted = masks.astype(jnp.float32)
    entropy = optax.sigmoid_binary_cross_entropy(logits, wanted).mean()
    chances = jax.nn.sigmoid(logits)
    common, total = (chances * wanted).sum((1, 2)), (chances + wanted).sum((1, 2))
    return entropy + 0.3 * (1.0 - (2.0 * common + 1.0) / (total + 1.0)).mean()
