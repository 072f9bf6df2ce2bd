"""Detection of stalks in a downscaled image: proposals, region features and classification, all of static shape."""

import dataclasses
import functools
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis.stalks.phenotyping.detector.anchors import decode, make_anchors
from jaxrl_vis.stalks.phenotyping.detector.boxes import (
    non_maximum_suppression,
    roi_align,
    roi_columns,
    roi_rows,
    strip_half_width,
    strip_overlap,
)
from jaxrl_vis.stalks.phenotyping.detector.detector_networks import ANCHOR_STRIDE, PADDING, STRIDE, Detector
from jaxrl_vis.stalks.phenotyping.detector.sections import decode_sections, section_anchors

# Relative difference of resolutions up to which a camera counts as one of training, where images were reduced by exactly four:
# with 0.988 to 1.024 times that factor, F1 on 12 images of the shifted family was 0.952 instead of 0.969.
_SAME_CAMERA = 0.06
SECTION = 32
"""Height of sections, pixels: for stalks 6 to 60 pixels wide, short enough to lie between leaves, and to be straight."""
_SECTIONS = 384
GRID = (14, 7)
"""Height and width of the pooled features of a region."""


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of the networks, stored with their weights.

    Attributes:
        pixels_per_metre: Resolution, at the row of plants, to which images are resized before detection; 0 for networks trained
            on images of unknown cameras, which are resized to `width`.
        width, height: Width and height of a resized image of the training cameras, pixels. Images of unknown cameras are
            downscaled to the width; narrower ones are not enlarged unless `pixels_per_metre` is 0.
        full_width: Image width in pixels at which stalk crops measure `crop_height` x `crop_width`; at fewer pixels per metre
            they shrink in proportion.
        crop_height, crop_width: Height and width of a stalk crop, pixels.
        band_height: Height of the band in the resized image, pixels.
        section: Height of the sections that the networks detect in the resized image, pixels, 16 or 32 (see `sections`); 0 for
            networks that detect the parts of stalks in the band.
        anchor_widths: Widths of the anchors in the resized image, pixels.
        channels, hidden: Sizes of the detector; see `detector_networks.Detector`.
        segmenter: Channels of each level of the segmentation network.
        candidates: Number of top-scoring boxes that enter the suppression of proposals, with sections in equal parts for all
            bands. Most are duplicates of easy stalks: with 480, two thirds of the stalks missed in crowded images had no
            candidate.
        proposals: Number of proposals passed to the box head.
        max_stalks: Maximum number of stalks in an image, or of their sections.
        proposal_threshold: Strip overlap above which proposals are suppressed as duplicates.
        threshold: Strip overlap above which detections are suppressed as duplicates.
        min_score: Minimum score of a detection.
    """

    pixels_per_metre: float = 677.5
    width: int = 844
    height: int = 676
    full_width: int = 3376
    crop_height: int = 640
    crop_width: int = 128
    band_height: float = 135.0
    anchor_widths: tuple[float, ...] = (12.0, 24.0, 48.0)
    channels: tuple[int, int, int, int] = (24, 48, 64, 64)
    hidden: int = 128
    segmenter: tuple[int, ...] = (16, 32, 48, 64)
    candidates: int = 1920
    proposals: int = 160
    max_stalks: int = 64
    proposal_threshold: float = 0.7
    threshold: float = 0.4
    min_score: float = 0.05
    section: int = 0

    def scale_for(self, width: int, pixels_per_metre: float | None) -> float:
        """Return the factor by which an image is resized before detection.

        Cameras whose resolution is within 6 % of that of the training cameras get exactly the factor of these.

        Args:
            width: Width of the image, pixels.
            pixels_per_metre: Resolution of the image at the row of plants; None if the camera is unknown, which is then assumed
                to show as wide a stretch of the row as the training cameras. Ignored if that of the settings is 0.
        """
        if not pixels_per_metre or not self.pixels_per_metre:
            return self.width / width
        factor, usual = self.pixels_per_metre / pixels_per_metre, self.width / self.full_width
        return usual if abs(factor / usual - 1.0) <= _SAME_CAMERA else factor

    def for_sections(self) -> "Settings":
        """Return these settings for networks that detect sections: with default anchors, and more detections per image."""
        usual = Settings()
        return dataclasses.replace(
            self,
            section=SECTION,
            anchor_widths=usual.anchor_widths,
            candidates=usual.candidates,
            proposals=_SECTIONS,
            max_stalks=_SECTIONS,
        )

    def detector(self, dtype: Any = jnp.float32) -> Detector:
        """Return the detector of these settings, with convolutions in ``dtype``."""
        rows = max(self.section // ANCHOR_STRIDE[0], 1)
        return Detector(self.channels, self.hidden, len(self.anchor_widths), rows, dtype)


@dataclasses.dataclass(frozen=True)
class DetectorOutput:
    """Stalks detected in a resized image, in descending order of score and padded. Registered as a pytree.

    Attributes:
        stalks: [..., K, 6] float32, boxes, and x coordinates of the axis at the top and bottom of the box, pixels.
        scores: [..., K] float32, 0 to 1.
        valid: [..., K] bool, False for padding.
        pooled: [2 C] float32, mean and standard deviation over the image of the C backbone channels; None if not computed.
    """

    stalks: jax.Array
    scores: jax.Array
    valid: jax.Array
    pooled: jax.Array | None = None


jax.tree_util.register_dataclass(DetectorOutput, ["stalks", "scores", "valid", "pooled"], [])


def padded_shape(shape: tuple[int, int]) -> tuple[int, int]:
    """Round a height and width up to multiples of `PADDING`."""
    height, width = (-(-length // PADDING) * PADDING for length in shape)
    return height, width


def normalize(images: jax.Array) -> jax.Array:
    """Map images [..., 3] uint8 to float32 in [-1, 1]; a square root expands dark tones, as flash light falls off quickly."""
    return 2.0 * jnp.sqrt(images.astype(jnp.float32) / 255.0) - 1.0


def pool_regions(features: jax.Array, stalks: jax.Array, section: int = 0) -> jax.Array:
    """Pool features [H, W, C] of an image along stalks [R, 6] to [R, *GRID, C].

    A region follows the axis, so that a leaning stalk stands upright in it: in a clump, two stalks that lean differently have
    nearly the same box. It includes some context on all sides, which the box head needs, and with sections the bands above and
    below.

    Args:
        features: Features of the image.
        stalks: Boxes and axes.
        section: Height of the sections that ``stalks`` are; 0 for other stalks.
    """
    tall = jnp.maximum(stalks[:, 3] - stalks[:, 1], 1e-3)
    more = (1.0 if section else 0.08) * tall
    slope = (stalks[:, 5] - stalks[:, 4]) / tall
    half = 1.5 * strip_half_width(stalks) + 6.0
    top, bottom = stalks[:, 4] - more * slope, stalks[:, 5] + more * slope
    box = [0.5 * (top + bottom) - half, stalks[:, 1] - more, 0.5 * (top + bottom) + half, stalks[:, 3] + more]
    scale, boxes = (1.0 / STRIDE[0], 1.0 / STRIDE[1]), jnp.stack(box, axis=-1)
    if section:
        # Regions of a band have the same rows: these are interpolated once.
        tops = section * jnp.arange(-(-features.shape[0] * STRIDE[0] // section), dtype=jnp.float32)
        rows = roi_rows(features, tops - section, tops + 2 * section, GRID[0], scale[0])
        bands = jnp.round(stalks[:, 1] / section).astype(jnp.int32)
        return roi_columns(rows, bands, boxes[:, 0], boxes[:, 2], bottom - top, GRID[1], scale[1])
    return roi_align(features, boxes, GRID, scale, samples=2, aligned=True, lean=bottom - top)


def select_proposals(
    logits: jax.Array, offsets: jax.Array, anchors: jax.Array, settings: Settings, shape: tuple[int, int]
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Select the best proposals of one image after non-maximum suppression.

    Args:
        logits: Objectness logits [K] of the anchors.
        offsets: Box offsets [K, 6].
        anchors: [K, 6].
        settings: Number of proposals and the suppression threshold.
        shape: Height and width of the image, to which proposals are clipped.

    Returns:
        Proposals [P, 6], their logits [P] float32 (-inf for padding), and their validity [P] bool, False for padding. P is
        ``settings.proposals``, or less if there are fewer candidates.
    """
    count = min(settings.candidates, logits.shape[0])
    scores, places = jax.lax.top_k(logits, count)
    stalks = clip_to_image(decode(offsets[places], anchors[places]), shape)
    size = stalks[:, 2:4] - stalks[:, :2]
    selected = non_maximum_suppression(strip_overlap(stalks, stalks), scores, settings.proposal_threshold)
    selected &= (size[:, 0] > 2.0) & (size[:, 1] > 8.0)
    scores = jnp.where(selected, scores, -jnp.inf)
    best, places = jax.lax.top_k(scores, min(settings.proposals, count))
    return stalks[places], best, jnp.isfinite(best)


def section_proposals(
    logits: jax.Array, offsets: jax.Array, anchors: jax.Array, settings: Settings
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Select the best proposals of sections of one image after non-maximum suppression in each band.

    Args:
        logits: Objectness logits [K] of the anchors.
        offsets: Box offsets [K, 6].
        anchors: [B, A, 6], see `section_anchors`.
        settings: Number of proposals and the suppression threshold.

    Returns:
        Proposals [P, 6], their bands [P] int32, and their validity [P] bool, False for padding; P as for `select_proposals`.
    """
    bands, anchors_per_band = anchors.shape[:2]
    count = min(max(settings.candidates // bands, 1), anchors_per_band)
    scores, places = jax.lax.top_k(logits.reshape(bands, anchors_per_band), count)

    def select_in_band(scores, places, offsets, anchors):
        stalks = decode_sections(offsets[places], anchors[places])
        selected = non_maximum_suppression(strip_overlap(stalks, stalks, 4), scores, settings.proposal_threshold)
        return stalks, jnp.where(selected & (stalks[:, 2] - stalks[:, 0] > 2.0), scores, -jnp.inf)

    stalks, scores = jax.vmap(select_in_band)(scores, places, offsets.reshape(bands, anchors_per_band, 6), anchors)
    best, places = jax.lax.top_k(scores.reshape(-1), min(settings.proposals, bands * count))
    return stalks.reshape(-1, 6)[places], places // count, jnp.isfinite(best)


def clip_to_image(stalks: jax.Array, shape: tuple[int, int]) -> jax.Array:
    """Clip the boxes of stalks [N, 6] to an image of ``shape`` (height, width), and their axes to the clipped boxes."""
    left, top, right, bottom, above, below = jnp.moveaxis(stalks, -1, 0)
    slope = (below - above) / jnp.maximum(bottom - top, 1e-3)
    first, last = jnp.clip(top, 0.0, shape[0]), jnp.clip(bottom, 0.0, shape[0])
    axis = above + slope * (first - top), below + slope * (last - bottom)
    return jnp.stack([jnp.clip(left, 0.0, shape[1]), first, jnp.clip(right, 0.0, shape[1]), last, *axis], axis=-1)


def apply_heads(
    network: Detector, params: Any, features: jax.Array, method: Literal["propose", "classify"]
) -> tuple[jax.Array, jax.Array]:
    """Apply one of the heads of the detector, and return its logits and box offsets.

    Args:
        network: Detector.
        params: Parameters of the detector.
        features: Features [N, h, w, C] of images for ``propose``, pooled features [R, h, w, C] of regions for ``classify``.
        method: Head, a method of `Detector`.

    Returns:
        Logits [N, K] float32 and box offsets [N, K, 6] float32 of the anchors, or [R] and [R, 6] of the regions.
    """
    logits, offsets = network.apply(params, features, method=method)
    assert isinstance(logits, jax.Array) and isinstance(offsets, jax.Array)
    return logits, offsets


def classify_proposals(
    network: Detector, params: Any, features: jax.Array, proposals: jax.Array, valid: jax.Array, settings: Settings
) -> DetectorOutput:
    """Score and refine proposals of one image, and remove duplicates.

    Args:
        network: Detector.
        params: Parameters of the detector.
        features: Features [h, w, C] of the image.
        proposals: [P, 6], pixels.
        valid: [P] bool, False for padding.
        settings: Thresholds, the maximum number of stalks, and the height of sections.

    Returns:
        At most ``settings.max_stalks`` stalks or sections, without pooled features.
    """
    regions = pool_regions(features, proposals, settings.section)
    logits, offsets = apply_heads(network, params, regions, "classify")
    scores = jax.nn.sigmoid(logits)
    stalks = (decode_sections if settings.section else decode)(offsets, proposals)
    valid = valid & (scores >= settings.min_score)
    selected = non_maximum_suppression(strip_overlap(stalks, stalks), jnp.where(valid, scores, -1.0), settings.threshold, valid)
    best, places = jax.lax.top_k(jnp.where(selected, scores, -1.0), min(settings.max_stalks, scores.shape[0]))
    return DetectorOutput(stalks[places], jnp.maximum(best, 0.0), best > 0.0)


@functools.partial(jax.jit, static_argnums=(2, 3))
def detect(params: Any, image: jax.Array, settings: Settings, dtype: Any = jnp.float32) -> DetectorOutput:
    """Detect the stalks in one image, or their sections.

    Args:
        params: Parameters of the detector.
        image: [H, W, 3] uint8, resized, and padded to multiples of `PADDING`.
        settings: Settings of the networks; static under jit.
        dtype: Compute dtype of the convolutions; static under jit.

    Returns:
        Stalks in pixels of ``image``, down to ``settings.min_score``, with pooled features.
    """
    network = settings.detector(dtype)
    shape = (image.shape[0], image.shape[1])
    features = network.apply(params, normalize(image)[None], method="features")
    assert isinstance(features, jax.Array)
    logits, offsets = apply_heads(network, params, features, "propose")
    if settings.section:
        anchors = jnp.asarray(section_anchors(shape, settings.section, settings.anchor_widths))
        proposals, _, valid = section_proposals(logits[0], offsets[0], anchors, settings)
    else:
        anchors = jnp.asarray(make_anchors(shape, settings.band_height, settings.anchor_widths))
        proposals, _, valid = select_proposals(logits[0], offsets[0], anchors, settings, shape)
    detected = classify_proposals(network, params, features[0], proposals, valid, settings)
    return dataclasses.replace(detected, pooled=_pool_features(features[0], image))


def _pool_features(features: jax.Array, image: jax.Array) -> jax.Array:
    """Compute mean and standard deviation [2 C] float32 of features [h, w, C] where the image [H, W, 3] is not black."""
    values = features.astype(jnp.float32)
    lit = image.any(axis=-1).reshape(values.shape[0], STRIDE[0], values.shape[1], STRIDE[1]).any(axis=(1, 3))
    weights = (lit / jnp.maximum(lit.sum(), 1))[..., None]
    mean = (weights * values).sum(axis=(0, 1))
    return jnp.concatenate([mean, jnp.sqrt((weights * (values - mean) ** 2).sum(axis=(0, 1)))])


def init_detector(settings: Settings, key: jax.Array) -> Any:
    """Initialise the parameters of a detector at random, as nested dictionaries of float32 arrays."""
    images = jax.ShapeDtypeStruct((1, 2 * PADDING, 2 * PADDING, 3), jnp.float32)
    regions = jax.ShapeDtypeStruct((1, *GRID, settings.channels[2]), jnp.float32)
    # Lazily: this avoids running the network, whose operations would be compiled one by one.
    return settings.detector().lazy_init(key, images, regions)


def pad_image(image: np.ndarray) -> np.ndarray:
    """Pad an image [h, w, 3] with zeros at the bottom and on the right, to multiples of `PADDING` in height and width."""
    height, width = padded_shape(image.shape[:2])
    return np.pad(image, ((0, height - image.shape[0]), (0, width - image.shape[1]), (0, 0)))
