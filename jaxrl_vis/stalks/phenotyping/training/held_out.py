"""Scores of networks on annotated images that they did not learn from."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from jaxrl_vis.stalks.phenotyping.detector.detect import Settings, detect
from jaxrl_vis.stalks.phenotyping.detector.finder import segment
from jaxrl_vis.stalks.phenotyping.detector.losses import STALK, UNCLEAR
from jaxrl_vis.stalks.phenotyping.evaluation.scoring import IOU, average_precision, overlaps_with
from jaxrl_vis.stalks.phenotyping.training.detector_training import image_batch
from jaxrl_vis.stalks.phenotyping.training.examples import Example

_SNIPS = 8  # that go through the network together
LEAST_SCORE = 0.5
"""Lowest score of a find that counts."""


@dataclasses.dataclass(frozen=True)
class Finds:
    """Finds in one image.

    Attributes:
        stalks: [K, 6] float32, pixels of the reduced image.
        scores: [K] float32.
        right: [K] bool, True for finds of an annotated stalk.
        ignored: [K] bool, True for finds in a region of stalks that nobody told apart.
        labels: Number of stalks that are annotated.
    """

    stalks: np.ndarray
    scores: np.ndarray
    right: np.ndarray
    ignored: np.ndarray
    labels: int


@dataclasses.dataclass(frozen=True)
class Score:
    """Score of networks on several images.

    Attributes:
        images, labels: Numbers of images, and of annotated stalks.
        finds, right: Numbers of finds with a score of `LEAST_SCORE` or more, and of those that are annotated stalks.
        precision, recall, f1: Of these; not a number where there is nothing to divide by.
        ap50: Average precision at an overlap of 0.5, of all finds.
        soft: 2 x (sum of the scores of right finds) / (sum of all scores + labels): as F1, but it changes evenly.
    """

    images: int
    labels: int
    finds: int
    right: int
    precision: float
    recall: float
    f1: float
    ap50: float
    soft: float


def find_in(params: Any, examples: Sequence[Example], shape: tuple[int, int], settings: Settings, dtype: Any) -> list[Finds]:
    """Find stalks in the reduced images of examples.

    Args:
        params: Parameters of the detector.
        examples: Images with their stalks.
        shape: Lines and columns that images are padded to.
        settings: Settings of the networks.
        dtype: In which convolutions are computed.
    """
    finds = []
    for example in examples:
        image = image_batch([example], shape)[0][0]
        there = jax.device_get(detect(params, image, settings, dtype))
        stalks, scores = there.stalks[there.valid], there.scores[there.valid]
        matched = match_finds(stalks, scores, example.stalks, example.kinds)
        finds.append(Finds(stalks, scores, *matched, int((example.kinds == STALK).sum())))
    return finds


def match_finds(stalks: np.ndarray, scores: np.ndarray, truth: np.ndarray, kinds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Match finds with true stalks, the best first, a stalk once, at an overlap of boxes of 0.5.

    Args:
        stalks: [K, 6] finds.
        scores: [K].
        truth: [T, 6] stalks of the image.
        kinds: [T] int32: `losses.NOTHING`, ``UNCLEAR`` or ``STALK``.

    Returns:
        Which finds are stalks [K] bool, and which lie on unclear ones and count neither way [K] bool.
    """
    clear, unclear = truth[kinds == STALK], truth[kinds == UNCLEAR]
    right, free = np.zeros(len(stalks), bool), np.ones(len(clear), bool)
    for place in np.argsort(-scores, kind="stable"):
        fitting = np.where(free, overlaps_with(stalks[place, :4], clear[:, :4]), 0.0)
        if fitting.size and fitting.max() >= IOU:
            right[place], free[int(fitting.argmax())] = True, False
    beside = np.array([bool((overlaps_with(stalk[:4], unclear[:, :4]) >= IOU).any()) for stalk in stalks], bool)
    return right, beside & ~right


def mask_overlap(params: Any, examples: Sequence[Example], settings: Settings, dtype: Any) -> float:
    """Overlap (intersection over union) of masks with the annotated ones, mean over snips; not a number where there are none.

    Args:
        params: Parameters of the segmentation.
        examples: Images with snips and their masks.
        settings: Settings of the networks.
        dtype: In which convolutions are computed.
    """
    overlaps = []
    for example in examples:
        for first in range(0, len(example.snips), _SNIPS):
            snips, masks = (values[first : first + _SNIPS] for values in (example.snips, example.masks))
            filled = np.pad(snips, ((0, _SNIPS - len(snips)), (0, 0), (0, 0), (0, 0)), mode="edge")
            full = (settings.snip_lines, settings.snip_columns)
            made = np.asarray(segment(params, filled, settings, dtype, full))[: len(snips)] >= 0.5
            common, either = (made & masks).sum((1, 2)), (made | masks).sum((1, 2))
            overlaps += (common / np.maximum(either, 1)).tolist()
    return float(np.mean(overlaps)) if overlaps else float("nan")


def score(finds: Sequence[Finds]) -> Score:
    """Score finds in several images together."""
    labels = sum(each.labels for each in finds)
    scores = np.concatenate([each.scores[~each.ignored] for each in finds] or [np.zeros(0)])
    right = np.concatenate([each.right[~each.ignored] for each in finds] or [np.zeros(0, bool)])
    counted = scores >= LEAST_SCORE
    hits, count = int(right[counted].sum()), int(counted.sum())
    nothing = float("nan")
    return Score(
        images=len(finds),
        labels=labels,
        finds=count,
        right=hits,
        precision=hits / count if count else nothing,
        recall=hits / labels if labels else nothing,
        f1=2.0 * hits / (count + labels) if count + labels else nothing,
        ap50=average_precision(np.stack([scores, right], axis=1), labels) if labels else nothing,
        soft=float(2.0 * scores[right].sum() / max(scores.sum() + labels, 1e-9)),
    )
