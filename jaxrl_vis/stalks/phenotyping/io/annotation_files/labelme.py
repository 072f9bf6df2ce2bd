"""Annotations of LabelMe and X-AnyLabeling: one JSON file per image, with polygons, (rotated) rectangles and masks."""

import base64
import binascii
import io
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from jaxrl_vis.stalks.phenotyping.io.annotation_files.shapes import Annotated, Annotation, from_outline, shape_without_width
from jaxrl_vis.stalks.phenotyping.io.image_headers import read_header_size, strip_png
from jaxrl_vis.stalks.phenotyping.io.images import MAX_PIXELS
from jaxrl_vis.stalks.phenotyping.io.masks import encode_mask

_CORNERS = {"polygon": 3, "rectangle": 2, "rotation": 4}


def is_labelme(data: Any) -> bool:
    """Return True if parsed JSON is a LabelMe file."""
    return isinstance(data, dict) and "shapes" in data


def read_labelme(path: Path, data: Any) -> list[Annotated]:
    """Convert a parsed LabelMe file to a list of its one image.

    Args:
        path: The file, for messages.
        data: Its parsed contents.

    Raises:
        ValueError, KeyError, TypeError, AttributeError: The data are not a valid LabelMe file.
    """
    size = int(data["imageWidth"]), int(data["imageHeight"])
    annotations = [_shape(shape, size, f"{path}: annotation {index + 1}") for index, shape in enumerate(data["shapes"])]
    # The path may have Windows separators.
    return [Annotated(str(data["imagePath"]).replace("\\", "/").rpartition("/")[2], *size, path, annotations)]


def _shape(shape: dict[str, Any], size: tuple[int, int], source: str) -> Annotation:
    name, kind = str(shape["label"]), str(shape.get("shape_type") or "polygon")
    points = np.asarray(shape["points"], float).reshape(-1, 2)
    if kind == "mask":
        return {"name": name, "segmentation": _mask(shape, points, size), "source": source}
    if kind not in _CORNERS:
        return shape_without_width(name, kind, source)
    if len(points) < _CORNERS[kind]:
        return {"name": name, "problem": f"is a {kind} of {len(points)} points", "source": source}
    if kind == "rectangle":
        low, high = points.min(axis=0), points.max(axis=0)
        points = np.array([low, (high[0], low[1]), high, (low[0], high[1])])
    return from_outline(name, points, source, shape.get("group_id"))


def _mask(shape: dict[str, Any], points: np.ndarray, size: tuple[int, int]) -> dict[str, Any]:
    """Decode a mask, stored as a base64 PNG of the box between two corner pixels (inclusive), to COCO runs.

    Raises:
        ValueError: The mask is not a PNG, or reaches beyond the image.
    """
    if len(points) != 2 or not np.isfinite(points).all() or np.abs(points).max() > 1e7:
        raise ValueError("a mask without its box")
    left, top = (int(edge) for edge in points[0])
    try:
        data = base64.b64decode(shape["mask"], validate=True)
    except binascii.Error as error:
        raise ValueError("a mask that is not base64") from error
    shown = read_header_size(io.BytesIO(data))
    if shown is None or shown[0] * shown[1] > MAX_PIXELS:
        raise ValueError("a mask that is not a PNG")
    if not 0 < size[0] * size[1] <= MAX_PIXELS or min(left, top) < 0 or left + shown[1] > size[0] or top + shown[0] > size[1]:
        raise ValueError("a mask that reaches beyond its image")
    plain = strip_png(data)
    mask = cv2.imdecode(np.frombuffer(plain, np.uint8), cv2.IMREAD_UNCHANGED) if plain else None
    if mask is None or mask.shape != shown:
        raise ValueError("a mask that is not a PNG")
    return encode_mask(mask > 0, (top, left), (size[1], size[0]))
