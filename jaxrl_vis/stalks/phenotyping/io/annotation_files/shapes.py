"""Common representation of annotations that the readers return, not yet validated: boxes, outlines and unusable shapes."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

Annotation = dict[str, Any]
"""Annotation of one shape by key: label ``name``, ``source`` (for messages), ``group`` (see `merge_groups`), and ``bbox`` and
``segmentation`` as in COCO; or, instead of these two, ``problem``: reason why the shape cannot be a stalk."""


@dataclasses.dataclass
class Annotated:
    """An image with its annotations.

    Attributes:
        name: Name of the image file, as written in the annotations; if `gather` found the file, its path in the folder.
        width, height: Size in pixels; None if the annotations do not state it.
        source: The annotation file.
        annotations: Annotations of the image.
    """

    name: str
    width: Any
    height: Any
    source: Path
    annotations: list[Annotation]


_NO_WIDTH = "which has no width: draw it as a polygon or a rectangle"


def from_outline(name: str, points: np.ndarray, source: str, group: Any = None) -> Annotation:
    """Return a polygon annotation with corners [N, 2] in pixels and their bounding box; nothing is checked.

    ``source`` names it in messages; polygons with the same ``group`` are merged by `merge_groups`, None for none.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    with np.errstate(over="ignore", invalid="ignore"):
        box = [*map(float, low), *map(float, high - low)]
    return {"name": name, "bbox": box, "segmentation": [points.ravel().tolist()], "source": source, "group": group}


def from_box(name: str, box: list[float], source: str, group: Any = None) -> Annotation:
    """Return a box annotation (left, top, width, height), pixels."""
    return {"name": name, "bbox": box, "source": source, "group": group}


def shape_without_width(name: str, shape_type: str, source: str) -> Annotation:
    """Return an unusable annotation: a shape such as a point or a line, which has no width."""
    return {"name": name, "problem": f"is a {shape_type[:40]}, {_NO_WIDTH}", "source": source, "group": None}


def rotated_box(centre: tuple[float, float], size: tuple[float, float], angle: float) -> np.ndarray:
    """Return the corners [4, 2] of a box, rotated about its centre.

    Args:
        centre: x and y of the centre, pixels.
        size: Width and height, pixels.
        angle: Angle of rotation, rad, clockwise in an image whose y axis points down.
    """
    across, down = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    half = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) * size
    return np.array(centre) + half[:, :1] * across + half[:, 1:] * down


def merge_groups(annotations: list[Annotation]) -> list[Annotation]:
    """Merge polygons with the same name and group into one annotation: the visible parts of a partially occluded object.

    Modifies the annotations in place: ``group`` is removed, and the ``bbox`` of merged ones is None.

    Returns:
        The annotations, without those that were merged into an earlier one.
    """
    joined: dict[tuple[str, Any], Annotation] = {}
    result = []
    for annotation in annotations:
        group, outlines = annotation.pop("group", None), annotation.get("segmentation")
        if not isinstance(group, (int, str)) or isinstance(group, bool) or not isinstance(outlines, list):
            result.append(annotation)
            continue
        merged = joined.setdefault((annotation["name"], group), annotation)
        if merged is annotation:
            result.append(annotation)
        else:
            merged["segmentation"] = merged["segmentation"] + outlines
            merged["bbox"] = None  # computed later from all parts
    return result
