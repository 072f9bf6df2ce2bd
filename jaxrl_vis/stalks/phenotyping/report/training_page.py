"""Page that compares networks before and after training on held-out images, as one HTML file."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from jaxrl_vis.host.files import write_atomically
from jaxrl_vis.stalks.phenotyping.detector.sections import STALK
from jaxrl_vis.stalks.phenotyping.report.qc import html_image, html_table
from jaxrl_vis.stalks.phenotyping.report.qc_style import SCRIPT, STYLE
from jaxrl_vis.stalks.phenotyping.training.examples import Example
from jaxrl_vis.stalks.phenotyping.training.held_out import MIN_SCORE, ImageDetections, Score

_ANNOTATED, _RIGHT, _FALSE = (255, 225, 60), (70, 235, 100), (255, 105, 75)
_MAX_IMAGES = 60  # images shown
_COLUMNS = {
    "weights": "weights",
    "images": "images",
    "labels": "annotated",
    "true_positives": "found",
    "false": "false detections",
    "precision": "precision",
    "recall": "recall",
    "f1": "F1",
    "ap50": "AP50",
    "masks": "overlap of masks",
}


def write_page(
    path: Path,
    facts: Sequence[str],
    examples: Sequence[Example],
    detections: Mapping[str, Sequence[ImageDetections]],
    scores: Mapping[str, Score],
    overlaps: Mapping[str, float],
) -> None:
    """Write the page.

    Args:
        path: The file, .html.
        facts: Lines of HTML about the training.
        examples: Held-out images; the first 60 are shown.
        detections: Detections in each image, by name of the weights.
        scores: Scores of these detections, by name of the weights.
        overlaps: Mean overlap of masks, by name of the weights; NaN or missing if unknown.

    Raises:
        OSError: The file cannot be written.
    """
    rows = []
    for name, score in scores.items():
        values = dataclasses.asdict(score) | {
            "masks": overlaps.get(name, math.nan),
            "false": score.detections - score.true_positives,
        }
        texts = {key: f"{value:.2f}" if isinstance(value, float) else value for key, value in values.items()}
        rows.append({"weights": name, **{key: "" if text == "nan" else text for key, text in texts.items()}})
    figures = []
    for index, example in enumerate(examples[:_MAX_IMAGES]):
        shown = {name: draw_detections(example, of_set[index]) for name, of_set in detections.items()}
        pictures = "".join(html_image(image, f"image {index + 1}, {name}", "pair") for name, image in shown.items())
        figures.append(f"<figure>{pictures}<figcaption>{' | '.join(shown)}</figcaption></figure>")
    parts = [
        '<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>Training on own images</title>',
        f'<meta name="viewport" content="width=device-width"><style>{STYLE}</style></head><body>',
        "<h1>Networks before and after training, on images that were held out</h1>",
        *(f"<p>{fact}</p>" for fact in facts),
        html_table(_COLUMNS, rows),
        f"<p>Yellow: annotated. Green: found, with a score of {MIN_SCORE:g} or more. Red: found where nothing is annotated."
        "</p>",
        *figures,
        f"<script>{SCRIPT}</script></body></html>\n",
    ]
    write_atomically(path, "".join(parts))


def draw_detections(example: Example, detections: ImageDetections) -> np.ndarray:
    """Draw the annotations and the detections of at least `MIN_SCORE` on a copy of an example's image, RGB [h, w, 3] uint8."""
    canvas = example.image.copy()
    for stalk in example.stalks[example.kinds == STALK]:
        _draw_box(canvas, stalk, _ANNOTATED)
    for stalk, score, right in zip(detections.stalks, detections.scores, detections.is_correct):
        if score >= MIN_SCORE:
            colour = _RIGHT if right else _FALSE
            _draw_box(canvas, stalk, colour)
            place = (round(float(stalk[0])), max(round(float(stalk[1])) - 4, 12))
            cv2.putText(canvas, f"{score:.2f}", place, cv2.FONT_HERSHEY_SIMPLEX, 0.4, colour, 1, cv2.LINE_AA)
    return canvas


def _draw_box(canvas: np.ndarray, stalk: np.ndarray, colour: tuple[int, int, int]) -> None:
    left, top, right, bottom = (round(float(edge)) for edge in stalk[:4])
    cv2.rectangle(canvas, (left, top), (right, bottom), colour, 1, cv2.LINE_AA)
