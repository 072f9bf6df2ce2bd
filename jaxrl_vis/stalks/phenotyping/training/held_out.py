"""Evaluation of the networks on held-out annotated images."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis.stalks.phenotyping.detector.detect import Settings, detect
from jaxrl_vis.stalks.phenotyping.detector.finder import segment
from jaxrl_vis.stalks.phenotyping.detector.sections import STALK, UNCLEAR, true_sections
from jaxrl_vis.stalks.phenotyping.evaluation.scoring import IOU, average_precision, iou_with_boxes
from jaxrl_vis.stalks.phenotyping.training.detector_training import batch_images
from jaxrl_vis.stalks.phenotyping.training.edges import stack_edges
from jaxrl_vis.stalks.phenotyping.training.examples import Example

_CROPS = 8  # stalk crops per batch
MIN_SCORE = 0.5
"""Minimum score of a detection to be counted."""


@dataclasses.dataclass(frozen=True)
class ImageDetections:
    """Detections in one image, matched with its annotations.

    Attributes:
        stalks: Boxes and axes [K, 6] float32, pixels of the resized image; of sections, if the networks detect these.
        scores: [K] float32.
        is_correct: [K] bool, True for true positives.
        ignored: [K] bool, True for detections of unclear stalks or in crowd regions, which are not counted.
        labels: Number of annotated stalks, or of their sections.
    """

    stalks: np.ndarray
    scores: np.ndarray
    is_correct: np.ndarray
    ignored: np.ndarray
    labels: int


@dataclasses.dataclass(frozen=True)
class Score:
    """Metrics of the networks on several images.

    Attributes:
        images, labels: Numbers of images and of annotated stalks.
        detections, true_positives: Numbers of detections with a score of at least `MIN_SCORE`, and of true ones among them.
        precision, recall, f1: Metrics of these detections; NaN if the denominator is 0.
        ap50: Average precision of all detections at an intersection over union of 0.5; NaN without labels.
        soft: Soft F1, 2 x (sum of the scores of true positives) / (sum of all scores + labels), which is continuous in the
            scores.
    """

    images: int
    labels: int
    detections: int
    true_positives: int
    precision: float
    recall: float
    f1: float
    ap50: float
    soft: float


def detect_in_examples(
    params: Any, examples: Sequence[Example], shape: tuple[int, int], settings: Settings, dtype: Any
) -> list[ImageDetections]:
    """Detect stalks in the images of examples and match them with the true ones.

    Args:
        params: Parameters of the detector.
        examples: Images with true stalks.
        shape: Height and width to which images are padded.
        settings: Settings of the networks.
        dtype: Compute dtype of the convolutions.

    Returns:
        Detections down to `Settings.min_score` in each image, in the same order.
    """
    detections = []
    for example in examples:
        image = batch_images([example], shape)[0][0]
        there = jax.device_get(detect(params, image, settings, dtype))
        stalks, scores = there.stalks[there.valid], there.scores[there.valid]
        truth, kinds = true_targets(example, shape, settings)
        matched = match_to_annotations(stalks, scores, truth, kinds)
        detections.append(ImageDetections(stalks, scores, *matched, int((kinds == STALK).sum())))
    return detections


def true_targets(example: Example, shape: tuple[int, int], settings: Settings) -> tuple[np.ndarray, np.ndarray]:
    """Return the targets of detection in an example: stalks [T, 6], or sections [B T, 6] of B bands, and their kinds.

    Args:
        example: Image with true stalks.
        shape: Height and width to which it is padded.
        settings: Settings of the networks.
    """
    if not settings.section:
        return example.stalks, example.kinds
    edges, kinds = stack_edges([example.edges], shape[0])
    size = np.array(example.image.shape[:2], np.int32)
    stalks, kinds = true_sections(jnp.asarray(edges[0]), jnp.asarray(kinds[0]), jnp.asarray(size), settings.section)
    return np.asarray(stalks).reshape(-1, 6), np.asarray(kinds).reshape(-1)


def match_to_annotations(
    stalks: np.ndarray, scores: np.ndarray, truth: np.ndarray, kinds: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Match detections with true stalks greedily by score, one to one, at a box IoU of at least 0.5.

    Args:
        stalks: Detections [K, 6].
        scores: Scores [K] of the detections.
        truth: True stalks [T, 6] of the image.
        kinds: [T] int32: `sections.NOTHING`, ``UNCLEAR`` or ``STALK``.

    Returns:
        True positives [K] bool, and detections of unclear stalks, which are ignored [K] bool.
    """
    clear, unclear = truth[kinds == STALK], truth[kinds == UNCLEAR]
    is_correct, free = np.zeros(len(stalks), bool), np.ones(len(clear), bool)
    for place in np.argsort(-scores, kind="stable"):
        fitting = np.where(free, iou_with_boxes(stalks[place, :4], clear[:, :4]), 0.0)
        if fitting.size and fitting.max() >= IOU:
            is_correct[place], free[int(fitting.argmax())] = True, False
    on_unclear = np.array([bool((iou_with_boxes(stalk[:4], unclear[:, :4]) >= IOU).any()) for stalk in stalks], bool)
    return is_correct, on_unclear & ~is_correct


def mask_overlap(params: Any, examples: Sequence[Example], settings: Settings, dtype: Any) -> float:
    """Compute the mean intersection over union of predicted and true masks over stalk crops; NaN without crops.

    Args:
        params: Parameters of the segmentation network.
        examples: Examples with stalk crops and true masks.
        settings: Settings of the networks.
        dtype: Compute dtype of the convolutions.
    """
    overlaps = []
    for example in examples:
        for first in range(0, len(example.crops), _CROPS):
            crops, masks = (values[first : first + _CROPS] for values in (example.crops, example.masks))
            filled = np.pad(crops, ((0, _CROPS - len(crops)), (0, 0), (0, 0), (0, 0)), mode="edge")
            full = (settings.crop_height, settings.crop_width)
            made = np.asarray(segment(params, filled, settings, dtype, full))[: len(crops)] >= 0.5
            common, either = (made & masks).sum((1, 2)), (made | masks).sum((1, 2))
            overlaps += (common / np.maximum(either, 1)).tolist()
    return float(np.mean(overlaps)) if overlaps else float("nan")


def score_detections(detections: Sequence[ImageDetections]) -> Score:
    """Compute the metrics of the detections in several images, pooled; ignored detections are left out."""
    labels = sum(image.labels for image in detections)
    scores = np.concatenate([image.scores[~image.ignored] for image in detections] or [np.zeros(0)])
    is_correct = np.concatenate([image.is_correct[~image.ignored] for image in detections] or [np.zeros(0, bool)])
    counted = scores >= MIN_SCORE
    hits, count = int(is_correct[counted].sum()), int(counted.sum())
    nothing = float("nan")
    return Score(
        images=len(detections),
        labels=labels,
        detections=count,
        true_positives=hits,
        precision=hits / count if count else nothing,
        recall=hits / labels if labels else nothing,
        f1=2.0 * hits / (count + labels) if count + labels else nothing,
        ap50=average_precision(np.stack([scores, is_correct], axis=1), labels) if labels else nothing,
        soft=float(2.0 * scores[is_correct].sum() / max(scores.sum() + labels, 1e-9)),
    )
