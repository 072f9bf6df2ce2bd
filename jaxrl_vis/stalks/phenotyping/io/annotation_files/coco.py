"""Annotations in COCO format, as exported by CVAT, Roboflow, Label Studio and others under various file names."""

from pathlib import Path
from typing import Any

from jaxrl_vis.stalks.phenotyping.io.annotation_files.shapes import Annotated, Annotation


def is_coco(data: Any) -> bool:
    """Return True if parsed JSON is a COCO data set."""
    return isinstance(data, dict) and "images" in data and "annotations" in data


def read_coco(path: Path, data: Any) -> list[tuple[Any, Annotated]]:
    """Convert a parsed COCO data set.

    Annotations whose ``image_id`` no image has are marked ``orphan`` and added to the first image; if there are no images, they
    are dropped.

    Args:
        path: The file, for messages.
        data: Its parsed contents.

    Returns:
        Id and contents of each image, in the order of the file.

    Raises:
        ValueError, KeyError, TypeError, AttributeError: The data are not valid COCO.
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
    for index, annotation in enumerate(data["annotations"]):
        parsed: Annotation = {**annotation, "name": names.get(annotation.get("category_id"), "")}
        parsed["source"] = f"{path}: annotation {str(annotation.get('id', index + 1))[:60]}"
        parsed["iscrowd"] = int(annotation.get("iscrowd") in (1, True, "1"))
        number = annotation.get("image_id")
        if not isinstance(number, (int, str)) or number not in by_id:
            parsed["orphan"] = True
            (images[0][1] if images else Annotated("", None, None, path, [])).annotations.append(parsed)
        else:
            by_id[number].annotations.append(parsed)
    return images
