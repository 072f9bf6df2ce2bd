"""From a reduced image to stalks: proposals, their features, and the head's judgement, all of static shape."""

import dataclasses
import functools
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis.stalks.phenotyping.detector.anchors import decode, make_anchors
from jaxrl_vis.stalks.phenotyping.detector.boxes import band_overlap, roi_align, strip_half_width, suppress
from jaxrl_vis.stalks.phenotyping.detector.detector_networks import PADDING, STRIDE, Detector

GRID = (14, 7)
"""Lines and columns of a region's features."""


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings that are fixed with the weights, and stored beside them.

    Attributes:
        density: Pixels per metre at the row that an image is resized to before stalks are looked for; 0 for networks that
            learned from images of unknown cameras, which are reduced to `width`.
        width, lines: Size of such an image of the cameras of `density`, pixels. Images of unknown cameras are reduced to the
            width; narrower ones stay as they are.
        full_width: Width in pixels of the images in which snips have `snip_lines` and `snip_columns`; in images with fewer
            pixels per metre they are smaller in proportion.
        snip_lines, snip_columns: Size of a snip.
        band_lines: Height of the band in an image that was reduced, pixels.
        anchor_widths: Widths of the boxes that are proposed, pixels there.
        channels, hidden: Sizes of the detector; see `networks.Detector`.
        segmenter: Channels of the segmentation.
        candidates: Number of the boxes with the best scores that are looked through for proposals. Most are copies of easy
            stalks: among 480, two thirds of the stalks that were missed on crowded images had none.
        proposals: Number of proposals that are judged.
        most: Greatest number of stalks in an image.
        proposal_threshold: Overlap of strips above which only one is proposed.
        threshold: Overlap of strips above which two detections are one stalk.
        least_score: Lowest score of a detection.
    """

    density: float = 677.5
    width: int = 844
    lines: int = 676
    full_width: int = 3376
    snip_lines: int = 640
    snip_columns: int = 128
    band_lines: float = 135.0
    anchor_widths: tuple[float, ...] = (12.0, 24.0, 48.0)
    channels: tuple[int, int, int, int] = (24, 48, 64, 64)
    hidden: int = 128
    segmenter: tuple[int, ...] = (16, 32, 48, 64)
    candidates: int = 1920
    proposals: int = 160
    most: int = 64
    proposal_threshold: float = 0.7
    threshold: float = 0.4
    least_score: float = 0.05

    def resizing(self, width: int, density: float | None) -> float:
        """Factor by which an image is resized before stalks are looked for.

        Args:
            width: Width of the image, pixels.
            density: Pixels per metre at the row; None if nothing is known of the camera, which then is taken to see as wide a
                part of the row as those that the networks learned from.
        """
        return self.density / density if density and self.density else self.width / width

    def detector(self, dtype: Any = jnp.float32) -> Detector:
        """The network that these settings describe."""
        return Detector(self.channels, self.hidden, len(self.anchor_widths), dtype)


@dataclasses.dataclass(frozen=True)
class Found:
    """Stalks in a reduced image, the best first; padded. Registered as a pytree.

    Attributes:
        stalks: [..., K, 6] float32, box and columns of the axis at its top and bottom, pixels.
        scores: [..., K] float32, 0 to 1.
        valid: [..., K] bool.
        pooled: [2 C] float32, mean and standard deviation over the image of the backbone's C features; None where nobody asked.
    """

    stalks: jax.Array
    scores: jax.Array
    valid: jax.Array
    pooled: jax.Array | None = None


jax.tree_util.register_dataclass(Found, ["stalks", "scores", "valid", "pooled"], [])


def padded_shape(shape: tuple[int, int]) -> tuple[int, int]:
    """Lines and columns, each up to the next multiple that the networks take."""
    lines, columns = (-(-length // PADDING) * PADDING for length in shape)
    return lines, columns


def normalise(images: jax.Array) -> jax.Array:
    """Images [..., 3] uint8 around 0, with dark parts spread: flash light falls off quickly."""
    return 2.0 * jnp.sqrt(images.astype(jnp.float32) / 255.0) - 1.0


def region_features(features: jax.Array, stalks: jax.Array) -> jax.Array:
    """Features [R, *GRID, C] along stalks [R, 6] of an image whose features are [H, W, C].

    A region follows the axis, so that a stalk that leans stands upright in it: in a clump, two that lean differently have about
    the same box. It holds some of what is beside the stalk, too, as a head judges by that.
    """
    tall = jnp.maximum(stalks[:, 3] - stalks[:, 1], 1e-3)
    more = 0.08 * tall
    slope = (stalks[:, 5] - stalks[:, 4]) / tall
    half = 1.5 * strip_half_width(stalks) + 6.0
    top, bottom = stalks[:, 4] - more * slope, stalks[:, 5] + more * slope
    box = [0.5 * (top + bottom) - half, stalks[:, 1] - more, 0.5 * (top + bottom) + half, stalks[:, 3] + more]
    scale = (1.0 / STRIDE[0], 1.0 / STRIDE[1])
    return roi_align(features, jnp.stack(box, axis=-1), GRID, scale, samples=2, aligned=True, lean=bottom - top)


def best_proposals(
    logits: jax.Array, codes: jax.Array, anchors: jax.Array, settings: Settings, shape: tuple[int, int]
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The best proposals of one image that are no copies of each other.

    Args:
        logits: [K] of the anchors.
        codes: [K, 6].
        anchors: [K, 6].
        settings: Number of proposals, and the overlap of copies.
        shape: Lines and columns of the image; what reaches beyond it is cut off.

    Returns:
        Stalks [P, 6], scores [P] float32 and which there are [P] bool, P = settings.proposals.
    """
    count = min(settings.candidates, logits.shape[0])
    scores, places = jax.lax.top_k(logits, count)
    stalks = within(decode(codes[places], anchors[places]), shape)
    size = stalks[:, 2:4] - stalks[:, :2]
    selected = suppress(band_overlap(stalks, stalks), scores, settings.proposal_threshold)
    selected &= (size[:, 0] > 2.0) & (size[:, 1] > 8.0)
    scores = jnp.where(selected, scores, -jnp.inf)
    best, places = jax.lax.top_k(scores, min(settings.proposals, count))
    return stalks[places], best, jnp.isfinite(best)


def within(stalks: jax.Array, shape: tuple[int, int]) -> jax.Array:
    """Stalks [N, 6] with their boxes cut off where an image of ``shape`` ends, and the axis where the box does."""
    left, top, right, bottom, above, below = jnp.moveaxis(stalks, -1, 0)
    slope = (below - above) / jnp.maximum(bottom - top, 1e-3)
    first, last = jnp.clip(top, 0.0, shape[0]), jnp.clip(bottom, 0.0, shape[0])
    axis = above + slope * (first - top), below + slope * (last - bottom)
    return jnp.stack([jnp.clip(left, 0.0, shape[1]), first, jnp.clip(right, 0.0, shape[1]), last, *axis], axis=-1)


def heads(
    network: Detector, params: Any, features: jax.Array, method: Literal["propose", "classify"]
) -> tuple[jax.Array, jax.Array]:
    """Logits and codes from one of the detector's heads."""
    logits, codes = network.apply(params, features, method=method)
    assert isinstance(logits, jax.Array) and isinstance(codes, jax.Array)
    return logits, codes


def judge(
    network: Detector, params: Any, features: jax.Array, proposals: jax.Array, valid: jax.Array, settings: Settings
) -> Found:
    """Judge proposals [P, 6] of one image with features [H, W, C]: stalks, without duplicates."""
    logits, codes = heads(network, params, region_features(features, proposals), "classify")
    stalks, scores = decode(codes, proposals), jax.nn.sigmoid(logits)
    valid = valid & (scores >= settings.least_score)
    selected = suppress(band_overlap(stalks, stalks), jnp.where(valid, scores, -1.0), settings.threshold, valid)
    best, places = jax.lax.top_k(jnp.where(selected, scores, -1.0), min(settings.most, scores.shape[0]))
    return Found(stalks[places], jnp.maximum(best, 0.0), best > 0.0)


@functools.partial(jax.jit, static_argnums=(2, 3))
def detect(params: Any, image: jax.Array, settings: Settings, dtype: Any = jnp.float32) -> Found:
    """Stalks in one image.

    Args:
        params: Parameters of the detector.
        image: [H, W, 3] uint8, reduced, padded to multiples of the networks' padding.
        settings: Beside the weights.
        dtype: In which convolutions are computed.
    """
    network = settings.detector(dtype)
    shape = (image.shape[0], image.shape[1])
    anchors = jnp.asarray(make_anchors(shape, settings.band_lines, settings.anchor_widths))
    features = network.apply(params, normalise(image)[None], method="features")
    assert isinstance(features, jax.Array)
    logits, codes = heads(network, params, features, "propose")
    proposals, _, valid = best_proposals(logits[0], codes[0], anchors, settings, shape)
    found = judge(network, params, features[0], proposals, valid, settings)
    return dataclasses.replace(found, pooled=_pooled(features[0], image))


def _pooled(features: jax.Array, image: jax.Array) -> jax.Array:
    """Mean and standard deviation [2 C] float32 of features [h, w, C] where an image [H, W, 3] shows anything."""
    values = features.astype(jnp.float32)
    lit = image.any(axis=-1).reshape(values.shape[0], STRIDE[0], values.shape[1], STRIDE[1]).any(axis=(1, 3))
    weights = (lit / jnp.maximum(lit.sum(), 1))[..., None]
    mean = (weights * values).sum(axis=(0, 1))
    return jnp.concatenate([mean, jnp.sqrt((weights * (values - mean) ** 2).sum(axis=(0, 1)))])


def initial(settings: Settings, key: jax.Array) -> Any:
    """Parameters of a detector that has learned nothing."""
    images = jax.ShapeDtypeStruct((1, 2 * PADDING, 2 * PADDING, 3), jnp.float32)
    regions = jax.ShapeDtypeStruct((1, *GRID, settings.channels[2]), jnp.float32)
    # Lazily: parameters are drawn, and the network itself is not run, of which each operation would be compiled by itself.
    return settings.detector().lazy_init(key, images, regions)


def pad(image: np.ndarray) -> np.ndarray:
    """An image [h, w, 3] with lines and columns added below and on the right, in which there is nothing."""
    lines, columns = padded_shape(image.shape[:2])
    return np.pad(image, ((0, lines - image.shape[0]), (0, columns - image.shape[1]), (0, 0)))
