"""Annotations in COCO's format, as CVAT, Roboflow, Label Studio and others export it under names of their own."""

from pathlib import Path
from typing import Any

from jaxrl_vis.stalks.phenotyping.io.annotation_files.shapes import Annotated, Annotation


def is_coco(data: Any) -> bool:
    """Return whether a file of JSON is COCO's."""
    return isinstance(data, dict) and "images" in data and "annotations" in data


def read_coco(path: Path, data: Any) -> list[tuple[Any, Annotated]]:
    """Images with their ids; those of annotations without an image are left to an image of no name.

    Raises:
        ValueError, KeyError, TypeError, AttributeError: The data are not COCO's.
    """
    names = {category["id"]: str(category["name"]) for category in data.get("categories", [])}
    images = [
        (image.get("id"), Annotated(image.get("file_name"), image.get("width"), image.get("height"), path, []))
        for image in data["images"]
    ]
    by_id: dict[Any, Annotated] = {}
    for number, image in images:
        if isinstance(number, (int, str)):
            by_id.setdefault(number, image)
    for place, annotation in enumerate(data["annotations"]):
        found: Annotation = {**annotation, "name": names.get(annotation.get("category_id"), "")}
        found["source"] = f"{path}: annotation {str(annotation.get('id', place + 1))[:60]}"
        found["iscrowd"] = int(annotation.get("iscrowd") in (1, True, "1"))
        number = annotation.get("image_id")
        if not isinstance(number, (int, str)) or number not in by_id:
            found["orphan"] = True
            (images[0][1] if images else Annotated("", None, None, path, [])).annotations.append(found)
        else:
            by_id[number].annotations.append(found)
    return images
