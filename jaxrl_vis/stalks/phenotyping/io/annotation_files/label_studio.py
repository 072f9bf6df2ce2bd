"""Annotations in Label Studio's native JSON: a list of tasks, with rectangles and polygons in percent of the image size."""

import urllib.parse
from pathlib import Path
from typing import Any

import numpy as np

from jaxrl_vis.stalks.phenotyping.io.annotation_files.shapes import (
    Annotated,
    Annotation,
    from_outline,
    rotated_box,
    shape_without_width,
)


def is_label_studio(data: Any) -> bool:
    """Return True if parsed JSON is an export of Label Studio, as JSON or JSON-MIN."""
    return isinstance(data, list) and bool(data) and all(isinstance(task, dict) and _image_name(task) for task in data[:20])


def read_label_studio(path: Path, data: Any) -> list[Annotated]:
    """Convert the parsed tasks of Label Studio: one image per task, with the last annotation that was not cancelled.

    Args:
        path: The file, for messages.
        data: Its parsed contents.

    Raises:
        ValueError, KeyError, TypeError, AttributeError: The data are not a valid export.
    """
    images = []
    for number, task in enumerate(data):
        chosen = [
            one for one in task.get("annotations", [{"result": _expand_minimal_export(task)}]) if not one.get("was_cancelled")
        ]
        shapes, sizes = [], set()
        for index, result in enumerate(chosen[-1]["result"] if chosen else []):
            source = f"{path}: annotation {index + 1} of task {str(task.get('id', number + 1))[:40]}"
            sizes.add((result.get("original_width"), result.get("original_height")))
            shapes += _shapes(result, source)
        width, height = sizes.pop() if len(sizes) == 1 else (None, None)
        images.append(Annotated(_image_name(task), width, height, path, shapes))
    return images


def _image_name(task: dict[str, Any]) -> str:
    """Return the file name of a task's image: the end of its URL, after the path or the query ``?d=``."""
    values = task["data"] if isinstance(task.get("data"), dict) else task
    address = next((str(values[name]) for name in ("image", "img", "image_url") if isinstance(values.get(name), str)), "")
    return urllib.parse.unquote(address).replace("\\", "/").rpartition("/")[2].rpartition("?d=")[2]


def _expand_minimal_export(task: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the results of a JSON-MIN task in the structure of the full export."""
    shapes = [shape for value in task.values() if isinstance(value, list) for shape in value if isinstance(shape, dict)]
    return [{**shape, "value": shape} for shape in shapes]


def _shapes(result: dict[str, Any], source: str) -> list[Annotation]:
    value = result["value"]
    value_kinds = [name for name in value if name.endswith("labels") and isinstance(value[name], list)]
    scale = np.array([result.get("original_width") or np.nan, result.get("original_height") or np.nan], float) / 100.0
    shapes: list[Annotation] = []
    for kind, name in [(key, str(word)) for key in value_kinds for word in value[key]]:
        if kind == "polygonlabels":
            shapes.append(from_outline(name, np.reshape(np.array(value["points"], float), (-1, 2)) * scale, source))
        elif kind == "rectanglelabels":
            box = np.array([float(value[part]) for part in ("x", "y", "width", "height")]).reshape(2, 2) * scale
            corners = rotated_box((box[1, 0] / 2, box[1, 1] / 2), (box[1, 0], box[1, 1]), 0.0)
            turn = np.radians(float(value.get("rotation") or 0.0))  # about the top left corner
            turned = corners @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
            shapes.append(from_outline(name, box[0] + turned, source))
        elif kind == "brushlabels":
            shapes.append({"name": name, "problem": "is a mask in Label Studio's own runs: export as COCO", "source": source})
        else:
            shapes.append(shape_without_width(name, kind.removesuffix("labels"), source))
    return shapes
