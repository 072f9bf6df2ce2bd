"""Training loss of networks that detect sections, see `sections`; the same terms as in `losses`, band by band."""

from typing import Any

import jax
import jax.numpy as jnp
import optax

from jaxrl_vis.stalks.phenotyping.detector.anchors import encode
from jaxrl_vis.stalks.phenotyping.detector.boxes import box_iou, strip_overlap
from jaxrl_vis.stalks.phenotyping.detector.detect import Settings, apply_heads, normalize, pool_regions, section_proposals
from jaxrl_vis.stalks.phenotyping.detector.losses import assign_boxes, focal_loss, offset_loss
from jaxrl_vis.stalks.phenotyping.detector.sections import STALK, section_anchors, true_sections

_NEAR = 64  # jittered true sections per image that the head is trained on
_JITTER = 0.15  # standard deviation, of their width


def section_loss(
    params: Any,
    images: jax.Array,
    edges: jax.Array,
    kinds: jax.Array,
    sizes: jax.Array,
    settings: Settings,
    dtype: Any,
    key: jax.Array,
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Compute the loss of the proposals and the box head on sections, averaged over images.

    Args:
        params: Parameters of the detector.
        images: [N, H, W, 3] uint8, resized and padded.
        edges: Edges of the true stalks [N, T, R, 3], see `sections`.
        kinds: [N, T] int32, see `losses.assign_boxes`.
        sizes: [N, 2] int32, height and width of the images without padding.
        settings: Settings of the networks.
        dtype: Compute dtype of the convolutions.
        key: PRNG key of the jittered true sections.

    Returns:
        Total loss, and its terms by name: ``objectness``, ``offsets``, ``head`` and ``boxes``.
    """
    network = settings.detector(dtype)
    anchors = jnp.asarray(section_anchors((images.shape[1], images.shape[2]), settings.section, settings.anchor_widths))
    features = network.apply(params, normalize(images), method="features")
    assert isinstance(features, jax.Array)
    logits, offsets = apply_heads(network, params, features, "propose")

    def image_loss(features, logits, offsets, edges, kinds, size, key):
        truth, kinds = true_sections(edges, kinds, size, settings.section)

        def assign_anchors(anchors, truth, kinds):
            which, positive, negative = assign_boxes(box_iou(anchors[:, :4], truth[:, :4]), kinds, 0.5, 0.3)
            return truth[which], positive, negative

        wanted, positive, negative = jax.vmap(assign_anchors)(anchors, truth, kinds)
        positive, negative = positive.reshape(-1), negative.reshape(-1)
        loss = focal_loss(logits, positive, negative) / jnp.maximum(positive.sum(), 1)
        placed = offset_loss(offsets, encode(wanted, anchors).reshape(-1, 6), positive)

        proposals, bands, valid = section_proposals(*jax.lax.stop_gradient((logits, offsets)), anchors, settings)
        near, near_bands, near_valid = _jittered(truth, kinds, key)
        proposals, bands = jnp.concatenate([proposals, near]), jnp.concatenate([bands, near_bands])
        valid = jnp.concatenate([valid, near_valid])

        def similarity(proposal, truth):
            return 0.5 * (box_iou(proposal[None, :4], truth[:, :4]) + strip_overlap(proposal[None], truth, 4))[0]

        alike = jax.vmap(similarity)(proposals, truth[bands])
        best = jnp.zeros(kinds.shape).at[bands].max(jnp.where(kinds[bands] == STALK, alike, 0.0))
        which, positive, negative = assign_boxes(alike, kinds[bands], 0.5, 0.45, best[bands])
        positive, negative = positive & valid, negative & valid
        judged, refined = apply_heads(network, params, pool_regions(features, proposals, settings.section), "classify")
        weight = (positive | negative).astype(jnp.float32)
        entropy = optax.sigmoid_binary_cross_entropy(judged, positive.astype(jnp.float32))
        judgement = (entropy * weight).sum() / jnp.maximum(weight.sum(), 1.0)
        refinement = offset_loss(refined, encode(truth[bands, which], proposals), positive)
        return loss, placed, 2.0 * judgement, 2.0 * refinement

    keys = jax.random.split(key, images.shape[0])
    parts = jax.vmap(image_loss)(features, logits, offsets, edges, kinds, sizes, keys)
    named = {name: part.mean() for name, part in zip(("objectness", "offsets", "head", "boxes"), parts)}
    return sum(named.values(), jnp.zeros(())), named


def _jittered(truth: jax.Array, kinds: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Sample true sections [B, T, 6] and jitter them horizontally; return them [M, 6], their bands [M], and validity [M]."""
    choice, noise = jax.random.split(key)
    clear = (kinds == STALK).reshape(-1)
    drawn, places = jax.lax.top_k(jnp.where(clear, jax.random.uniform(choice, clear.shape), -1.0), min(_NEAR, clear.size))
    stalks = truth.reshape(-1, 6)[places]
    moves = _JITTER * jax.random.normal(noise, stalks.shape) * (stalks[:, 2:3] - stalks[:, :1])
    return stalks + moves.at[:, jnp.array([1, 3])].set(0.0), places // kinds.shape[1], drawn >= 0.0
