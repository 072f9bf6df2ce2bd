"""Annotations as readers hand them over, before they are checked: boxes, outlines, and what is neither."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

Annotation = dict[str, Any]
"""``name``, ``source``, and ``bbox`` and ``segmentation`` as in COCO; or ``problem``: why a stalk may not be like that."""


@dataclasses.dataclass
class Annotated:
    """One image and what is annotated in it.

    Attributes:
        name: Of the image's file, as the annotations have it.
        width, height: Pixels; None where they do not say it.
        source: The file that says so.
        annotations: Of it.
    """

    name: str
    width: Any
    height: Any
    source: Path
    annotations: list[Annotation]


Reader = Callable[[Path, Any], list[Annotated]]
"""From a file and what was parsed of it to images."""
_NO_WIDTH = "which has no width: draw it as a polygon or a rectangle"


def outlined(name: str, points: np.ndarray, source: str, group: Any = None) -> Annotation:
    """An annotation by its corners [N, 2], or more than two numbers that are none."""
    low, high = points.min(axis=0), points.max(axis=0)
    with np.errstate(over="ignore", invalid="ignore"):
        box = [*map(float, low), *map(float, high - low)]
    return {"name": name, "bbox": box, "segmentation": [points.ravel().tolist()], "source": source, "group": group}


def boxed(name: str, box: list[float], source: str, group: Any = None) -> Annotation:
    """An annotation by its box (left, top, width, height)."""
    return {"name": name, "bbox": box, "source": source, "group": group}


def without_width(name: str, kind: str, source: str) -> Annotation:
    """An annotation of a kind of shape that says nothing of widths."""
    return {"name": name, "problem": f"is a {kind[:40]}, {_NO_WIDTH}", "source": source, "group": None}


def turned_box(centre: tuple[float, float], size: tuple[float, float], angle: float) -> np.ndarray:
    """Corners [4, 2] of a box of some width and height that is turned clockwise about its centre, radians."""
    across, down = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    half = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) * size
    return np.array(centre) + half[:, :1] * across + half[:, 1:] * down


def together(annotations: list[Annotation]) -> list[Annotation]:
    """Annotations in which polygons of one name and one group are one: the parts of what is partly hidden."""
    joined: dict[tuple[str, Any], Annotation] = {}
    result = []
    for annotation in annotations:
        group, outlines = annotation.pop("group", None), annotation.get("segmentation")
        if not isinstance(group, (int, str)) or isinstance(group, bool) or not isinstance(outlines, list):
            result.append(annotation)
            continue
        whole = joined.setdefault((annotation["name"], group), annotation)
        if whole is annotation:
            result.append(annotation)
        else:
            whole["segmentation"] = whole["segmentation"] + outlines
            whole["bbox"] = None  # the one around all of them
    return result
