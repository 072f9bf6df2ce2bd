"""Annotations in XML: Pascal VOC (labelImg, Roboflow), the rotated boxes of roLabelImg, and CVAT for images."""

from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from jaxrl_vis.stalks.phenotyping.io.annotation_files.shapes import (
    Annotated,
    Annotation,
    from_box,
    from_outline,
    rotated_box,
    shape_without_width,
)
from jaxrl_vis.stalks.phenotyping.io.images import MAX_PIXELS
from jaxrl_vis.stalks.phenotyping.io.masks import encode_mask

_EDGES = ("xmin", "ymin", "xmax", "ymax")


def read_xml(path: Path, root: Element) -> list[Annotated]:
    """Convert a parsed Pascal VOC or CVAT file.

    Args:
        path: The file, for messages.
        root: Root element; ``annotations`` for CVAT.

    Raises:
        ValueError: The file is neither, or holds tracks of a video.
    """
    if root.tag == "annotations":
        if root.find("track") is not None:
            raise ValueError("it holds tracks of a video: export it as CVAT for images, or as COCO")
        return [_cvat_image(path, image) for image in root.iter("image")]
    return [_voc_image(path, root)]


def _text(node: Element, name: str) -> str:
    value = node.findtext(name)
    if value is None:
        raise ValueError(name)
    return value


def _voc_image(path: Path, root: Element) -> Annotated:
    annotations = []
    for index, element in enumerate(root.iter("object")):
        name, source = _text(element, "name"), f"{path}: annotation {index + 1}"
        if element.find("robndbox") is not None:
            x, y, wide, high, angle = (float(_text(element, f"robndbox/{part}")) for part in ("cx", "cy", "w", "h", "angle"))
            if not np.isfinite([x, y, wide, high, angle]).all():
                raise ValueError("robndbox")
            annotations.append(from_outline(name, rotated_box((x, y), (wide, high), angle), source))
        else:
            # Pixel indices start at 1, and the last ones are inclusive.
            left, top, right, bottom = (float(_text(element, f"bndbox/{edge}")) for edge in _EDGES)
            annotations.append(from_box(name, [left - 1.0, top - 1.0, right - left + 1.0, bottom - top + 1.0], source))
    width, height = (_integer(root.findtext(f"size/{side}")) for side in ("width", "height"))
    return Annotated(_text(root, "filename"), width, height, path, annotations)


def _integer(text: str | None) -> int | None:
    """Parse a number of pixels; return None if it is missing or 0, as labelImg writes an unknown size."""
    return int(text) or None if text is not None and text.strip() else None


def _cvat_image(path: Path, element: Element) -> Annotated:
    size = int(element.get("width") or 0), int(element.get("height") or 0)
    annotations = []
    for index, shape in enumerate(element):
        if shape.tag in ("tag", "attribute"):
            continue
        name, source = shape.get("label") or "", f"{path}: annotation {index + 1} of {element.get('name')}"
        group = shape.get("group_id") if shape.get("group_id") not in (None, "", "0") else None
        annotations.append(_cvat_shape(shape, size, name, source, group))
    return Annotated(element.get("name") or "", *size, path, annotations)


def _cvat_shape(shape: Element, size: tuple[int, int], name: str, source: str, group: str | None) -> Annotation:
    def numbers(*names: str) -> list[float]:
        values = [float(shape.get(key) or "nan") for key in names]
        if not np.isfinite(values).all():
            raise ValueError(f"{shape.tag} without {' and '.join(names)}")
        return values

    if shape.tag == "box":
        left, top, right, bottom = numbers("xtl", "ytl", "xbr", "ybr")
        angle = np.radians(float(shape.get("rotation") or 0.0))
        if angle:
            centre = ((left + right) / 2, (top + bottom) / 2)
            return from_outline(name, rotated_box(centre, (right - left, bottom - top), float(angle)), source, group)
        return from_box(name, [left, top, right - left, bottom - top], source, group)
    if shape.tag == "polygon":
        points = [list(map(float, point.split(","))) for point in (shape.get("points") or "").split(";") if point]
        return from_outline(name, np.reshape(np.array(points, float), (-1, 2)), source, group)
    if shape.tag == "mask":
        left, top, wide, high = (int(value) for value in numbers("left", "top", "width", "height"))
        return {
            "name": name,
            "segmentation": _cvat_mask(shape.get("rle") or "", (left, top, wide, high), size),
            "source": source,
        }
    return shape_without_width(name, str(shape.tag), source)


def _cvat_mask(runs: str, box: tuple[int, int, int, int], size: tuple[int, int]) -> dict[str, Any]:
    """Decode CVAT's run-length encoding, which is row-major within the box and starts with the background, to COCO runs.

    Args:
        runs: Run lengths, separated by commas.
        box: Left, top, width and height of the box, pixels.
        size: Width and height of the image.

    Raises:
        ValueError: The box reaches beyond the image, or the runs do not cover it.
    """
    left, top, wide, high = box
    if not 0 < size[0] * size[1] <= MAX_PIXELS or min(left, top) < 0 or left + wide > size[0] or top + high > size[1]:
        raise ValueError("a mask that reaches beyond its image")
    counts = np.array([int(count) for count in runs.replace(",", " ").split()], np.int64)
    if min(wide, high) < 1 or (counts < 0).any() or counts.sum() != wide * high:
        raise ValueError("a mask whose runs do not cover its box")
    mask = np.repeat(np.arange(counts.size) % 2 == 1, counts).reshape(high, wide)
    return encode_mask(mask, (top, left), (size[1], size[0]))
