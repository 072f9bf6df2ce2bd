"""Annotations, boxes and run-length encoded masks: written in COCO format, read in the formats of many programs.

Coordinates of boxes and outlines are continuous: the first pixel spans from 0 to 1, with its centre at 0.5.
"""

import reprlib
from collections.abc import Sequence
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.stalks.phenotyping.io.annotation_files.gather import gather
from jaxrl_vis.stalks.phenotyping.io.annotation_files.labels import select_stalks
from jaxrl_vis.stalks.phenotyping.io.images import MAX_PIXELS
from jaxrl_vis.stalks.phenotyping.io.masks import box_around_runs, check_runs, decode_counts
from jaxrl_vis.stalks.phenotyping.io.names import readable

STALK = 1
"""COCO category id of stalks."""
_MAX_COORDINATE = 1e7  # pixels


def make_coco(images: list[dict[str, Any]], annotations: list[dict[str, Any]], about: dict[str, Any]) -> dict[str, Any]:
    """Return a COCO data set of stalks.

    Args:
        images: Images with id, file_name, width and height.
        annotations: Annotations with image_id, bbox (left, top, width, height in pixels), area and, optionally, segmentation;
            id, category_id and iscrowd are added.
        about: The ``info`` of the data set.
    """
    numbered = [
        {"id": index + 1, "category_id": STALK, "iscrowd": 0, **annotation} for index, annotation in enumerate(annotations)
    ]
    categories = [{"id": STALK, "name": "stalk", "supercategory": "plant"}]
    return {"info": about, "images": images, "annotations": numbered, "categories": categories}


def read_annotations(folder: Path, labels: Sequence[str] = ()) -> dict[str, Any]:
    """Read and validate the annotations in a folder, in any supported format, and return them in COCO format.

    If the folder holds ``annotations.json`` (COCO), only that is read. Otherwise all annotation files in it and its subfolders
    are: COCO under any name; XML of Pascal VOC, roLabelImg or CVAT; JSON of LabelMe or Label Studio; text files of YOLO.

    Args:
        folder: The folder.
        labels: Labels that count as stalks, see `labels.select_stalks`; annotations with other labels are left out.

    Returns:
        ``images``, each with id, file_name, width, height and source (the annotation file); ``annotations``, each with an
        image_id, a bbox [4] (left, top, width, height in pixels) that intersects the image, and a ``segmentation``: polygons of
        at least 3 corners, runs that cover the image, or None. If ``iscrowd`` is 1, the annotation is a region of stalks that
        were not separated. ``summary`` states in one line what counts as a stalk.

    Raises:
        RequestError: There are no annotations, they cannot be read, or one is invalid; the message says which.
    """
    images, annotations = [], []
    for number, image in gather(folder):
        key = "/".join(map(str, number)) if isinstance(number, tuple) else number
        source = str(image.source)
        images.append({"id": key, "file_name": image.name, "width": image.width, "height": image.height, "source": source})
        for annotation in image.annotations:
            # Annotations of no image keep what they say, which the check names.
            annotations.append({**annotation, "image_id": annotation.get("image_id") if annotation.get("orphan") else key})
    path = folder / "annotations.json" if (folder / "annotations.json").exists() else folder
    return _check_annotations({"images": images, "annotations": annotations}, path, labels)


def _check_annotations(data: dict[str, Any], path: Path, labels: Sequence[str]) -> dict[str, Any]:
    """Select and validate the annotations of stalks.

    Raises:
        RequestError: There are none, ids of images repeat, or an image or annotation is invalid.
    """
    if not data["images"] or not data["annotations"]:
        raise RequestError(f"{path} annotates nothing: name a folder with annotated images")
    stalks, summary = select_stalks(data["annotations"], labels, str(path))
    images = [_check_image(image, index) for index, image in enumerate(data["images"])]
    twice = len(images) - len({image["id"] for image in images})
    if twice:
        raise RequestError(f"{path}: {twice} images have the id of another one, so nobody can tell whose annotations are whose")
    sizes = {image["id"]: (image["height"], image["width"]) for image in images}
    annotations = []
    for annotation in stalks:
        try:
            if annotation.get("problem"):
                raise ValueError(annotation["problem"])
            annotations.append(_check_annotation(annotation, sizes))
        except ValueError as error:
            raise RequestError(f"{annotation['source']} {error}: mend it, or delete it") from error
    if all(annotation.get("iscrowd") for annotation in annotations):
        raise RequestError(f"{path} annotates no single stalk, but regions of many (iscrowd): annotate some one by one")
    return {"images": images, "annotations": annotations, "summary": summary}


def _check_image(image: dict[str, Any], index: int) -> dict[str, Any]:
    """Return the entry of an image, with its width and height as integers.

    Args:
        image: The entry as read.
        index: Index of the entry, for messages.

    Raises:
        RequestError: Its id, name or size is missing or invalid.
    """
    if not isinstance(image.get("id"), (int, str)) or not isinstance(image.get("file_name"), str):
        raise RequestError(f"{image['source']}: image number {index + 1} needs an id and a file_name")
    name = image["file_name"]
    if not _is_inside(name):
        raise RequestError(
            f"{image['source']}: image number {index + 1} has the file_name {reprlib.repr(name)}: name a file in that folder"
        )
    sides = _finite_numbers([image.get("width"), image.get("height")])
    if sides is None or min(sides) < 1 or any(side % 1 for side in sides):
        size_read = f"{reprlib.repr(image.get('width'))} and {reprlib.repr(image.get('height'))}"
        raise RequestError(f"{image['source']}: image {name} needs a width and a height in pixels, not {size_read}")
    if sides[0] * sides[1] > MAX_PIXELS:
        limit = f"more than {MAX_PIXELS // 10**6} million pixels"
        raise RequestError(f"{image['source']}: image {name} is said to have {sides[0]:g} x {sides[1]:g}, {limit}")
    return {**image, "width": int(sides[0]), "height": int(sides[1])}


def _is_inside(name: str) -> bool:
    """Return True if a file name in annotations is a relative path within their folder on any operating system."""
    path = PureWindowsPath(name)  # splits at both separators
    steps = path.parts
    return bool(steps) and not path.anchor and ".." not in steps and name == readable(name)


def _check_annotation(annotation: dict[str, Any], sizes: dict[int | str, tuple[int, int]]) -> dict[str, Any]:
    """Return an annotation with a validated ``bbox`` and ``segmentation`` (None if it has none).

    A missing box is computed from the segmentation.

    Args:
        annotation: The annotation as read.
        sizes: Height and width of each image, by id.

    Raises:
        ValueError: The box or segmentation is missing, malformed or outside the image. The message is a predicate that follows
            the annotation's name.
    """
    number = annotation.get("image_id")
    if number is None:
        raise ValueError("has no image_id")
    if not isinstance(number, (int, str)) or number not in sizes:
        raise ValueError(f"has the image_id {reprlib.repr(number)}, which no image has")
    height, width = sizes[number]
    segmentation = _check_segmentation(annotation.get("segmentation"), (height, width))
    if annotation.get("bbox") is not None:
        box = _finite_numbers(annotation["bbox"])
    elif segmentation:
        box = _box_around(segmentation)
    else:
        raise ValueError("has neither a bbox nor a segmentation")
    if box is None or len(box) != 4:
        raise ValueError("has a bbox that is not 4 numbers (left, top, width, height)")
    if max(map(abs, box)) > _MAX_COORDINATE:
        raise ValueError("has a bbox that lies nowhere near an image")
    left, top, wide, tall = box
    if not (wide > 0 and tall > 0):
        raise ValueError(f"has a box of {wide:g} x {tall:g} pixels")
    if left >= width or top >= height or left + wide <= 0 or top + tall <= 0:
        raise ValueError(f"has a box from ({left:g}, {top:g}) on, outside its image of {width} x {height} pixels")
    return {**annotation, "bbox": box, "segmentation": segmentation}


def _check_segmentation(segmentation: Any, size: tuple[int, int]) -> dict[str, Any] | list[list[float]] | None:
    """Return uncompressed runs that cover an image of ``size`` (height, width), or polygons; None if there is neither.

    Raises:
        ValueError: The segmentation is malformed, of another size or empty.
    """
    if not segmentation:
        return None
    if isinstance(segmentation, dict):
        stated_size, counts = _finite_numbers(segmentation.get("size")), segmentation.get("counts")
        if stated_size is None or len(stated_size) != 2 or not isinstance(counts, (str, list)):
            raise ValueError("has a mask without size (height, width) and counts")
        if tuple(stated_size) != size:
            raise ValueError(
                f"has a mask of {stated_size[1]:g} x {stated_size[0]:g} pixels, but its image has {size[1]} x {size[0]}"
            )
        try:
            numbers = decode_counts(counts) if isinstance(counts, str) else _finite_numbers(counts)
            if numbers is None:
                raise ValueError("counts are not numbers")
            runs = check_runs(numbers, *size)
        except (ValueError, OverflowError) as error:
            raise ValueError(f"has a mask that cannot be read ({error})") from error
        if not runs[1::2].any():
            raise ValueError("has a mask without a pixel")
        return {"size": list(size), "counts": runs.tolist()}
    outlines = [_finite_numbers(outline) for outline in segmentation] if isinstance(segmentation, list) else [None]
    corners = [outline for outline in outlines if outline is not None and len(outline) >= 6 and len(outline) % 2 == 0]
    if len(corners) < len(outlines):
        raise ValueError("has a polygon that is not column, line, column, line, ... of 3 corners or more")
    if any(abs(corner) > _MAX_COORDINATE for outline in corners for corner in outline):
        raise ValueError("has a polygon that lies nowhere near an image")
    return corners


def _finite_numbers(values: Any) -> list[float] | None:
    """Return a list of finite numbers as floats; None if ``values`` is anything else."""
    try:
        numbers = np.asarray(values, float)
    except (ValueError, TypeError, OverflowError):
        return None
    return numbers.tolist() if numbers.ndim == 1 and np.isfinite(numbers).all() else None


def _box_around(segmentation: dict[str, Any] | list[list[float]]) -> list[float]:
    """Return the bounding box (left, top, width, height) of a validated segmentation."""
    if isinstance(segmentation, dict):
        return box_around_runs(np.array(segmentation["counts"], np.int64), segmentation["size"][0])
    corners = np.concatenate([np.reshape(outline, (-1, 2)) for outline in segmentation])
    low, high = corners.min(axis=0), corners.max(axis=0)
    return [*map(float, low), *map(float, high - low)]
