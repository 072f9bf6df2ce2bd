"""Export of detections as annotations for manual correction in labelling programs."""

import json
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

import jaxrl_vis
from jaxrl_vis.host.files import write_atomically
from jaxrl_vis.stalks.phenotyping.detector.finder import Detection
from jaxrl_vis.stalks.phenotyping.io.annotations import make_coco

_TOLERANCE = 0.8  # pixels, maximum deviation of the simplified outline from the mask


def outline(detection: Detection) -> list[float]:
    """Return the outline of a detection's mask within its box as x, y, x, y, ... in pixels; the first pixel spans 0 to 1.

    It encloses the outermost pixels of each row, as a stalk is a single strip. If the mask has fewer than two rows there, it is
    the box.
    """
    left, top, right, bottom = (edge + 0.5 for edge in detection.box)
    y = np.arange(detection.mask.shape[0]) + detection.corner[0] + 0.5
    mask = (np.asarray(detection.mask, float) >= 0.5) & ((y >= top) & (y <= bottom))[:, None]
    rows = np.flatnonzero(mask.any(axis=1))
    if rows.size < 2:
        return [left, top, right, top, right, bottom, left, bottom]
    first = mask[rows].argmax(axis=1) + detection.corner[1]
    last = mask.shape[1] - mask[rows][:, ::-1].argmax(axis=1) + detection.corner[1]
    sides = [_simplify_outline(np.stack([side, y[rows]], axis=1)) for side in (first, last)]
    # Use the outer corners of the first and the last pixels instead of their centres.
    for side in sides:
        side[0, 1] -= 0.5
        side[-1, 1] += 0.5
    return np.concatenate([sides[0], sides[1][::-1]]).round(1).ravel().tolist()


def _simplify_outline(points: np.ndarray) -> np.ndarray:
    """Simplify a polyline [K, 2] by the Douglas-Peucker algorithm."""
    return cv2.approxPolyDP(points.astype(np.float32)[:, None], _TOLERANCE, closed=False)[:, 0].astype(float)


def write_coco(path: Path, detected: Sequence[tuple[Path, tuple[int, int], list[Detection]]], about: str) -> None:
    """Write the detections in several images in COCO format.

    Args:
        path: The file; images are named relative to its folder.
        detected: File, size (height, width) and detections of each image.
        about: Description of the data set.

    Raises:
        OSError: The file cannot be written.
    """
    images, annotations = [], []
    for number, (image, (height, width), detections) in enumerate(detected, start=1):
        name = image.relative_to(path.parent).as_posix()
        images.append({"id": number, "file_name": name, "width": width, "height": height})
        for detection in detections:
            corners = np.reshape(outline(detection), (-1, 2))
            low, high = corners.min(axis=0), corners.max(axis=0)
            ahead = np.roll(corners, -1, axis=0)
            area = 0.5 * abs(float((corners[:, 0] * ahead[:, 1] - corners[:, 1] * ahead[:, 0]).sum()))
            annotations.append(
                {
                    "image_id": number,
                    "bbox": [*low.tolist(), *(high - low).round(1).tolist()],
                    "area": round(area, 1),
                    "segmentation": [corners.ravel().tolist()],
                    "score": round(detection.score, 3),
                }
            )
    document = make_coco(images, annotations, {"description": about, "version": jaxrl_vis.__version__})
    write_atomically(path, json.dumps(document) + "\n")


def write_labelme(image: Path, size: tuple[int, int], detections: list[Detection]) -> None:
    """Write the detections in one image as a LabelMe .json file beside it.

    Args:
        image: File of the image.
        size: Height and width, pixels.
        detections: The detections.

    Raises:
        OSError: The file cannot be written.
    """
    shapes = [
        {
            "label": "stalk",
            "points": np.reshape(outline(detection), (-1, 2)).tolist(),
            "group_id": None,
            "description": f"score {detection.score:.2f}",
            "shape_type": "polygon",
            "flags": {},
        }
        for detection in detections
    ]
    document = {
        "version": "5.5.0",
        "flags": {},
        "shapes": shapes,
        "imagePath": image.name,
        "imageData": None,
        "imageHeight": size[0],
        "imageWidth": size[1],
    }
    write_atomically(image.with_suffix(".json"), json.dumps(document) + "\n")
