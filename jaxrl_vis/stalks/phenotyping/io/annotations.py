"""Annotations: boxes, and masks as runs of pixels. Written in COCO's format, read in that of COCO, Pascal VOC or LabelMe.

Columns and lines of boxes and outlines are continuous: the first pixel spans from 0 to 1, with its middle at 0.5.
"""

import reprlib
from collections.abc import Callable
from pathlib import Path, PureWindowsPath
from typing import Any
from xml.etree import ElementTree

import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.stalks.phenotyping.io.images import MAX_PIXELS
from jaxrl_vis.stalks.phenotyping.io.masks import box_around_runs, covering, decode_counts
from jaxrl_vis.stalks.phenotyping.io.names import readable
from jaxrl_vis_envs.documents import parse_xml, read_bytes, read_json

STALK = 1
"""Category of stalks."""
_MAX_BYTES = 10_000_000  # of a file of one image
_FARTHEST = 1e7  # pixels
_WRONG = (ValueError, KeyError, TypeError, AttributeError, OverflowError)
"""Errors that reading a file of another form raises."""


def coco(images: list[dict[str, Any]], annotations: list[dict[str, Any]], about: dict[str, Any]) -> dict[str, Any]:
    """A COCO data set of stalks.

    Args:
        images: With id, file_name, width and height.
        annotations: With image_id, bbox (left, top, width, height in pixels), area and, where there is one, segmentation; ids
            are added.
        about: Description of the data set.
    """
    numbered = [
        {"id": place + 1, "category_id": STALK, "iscrowd": 0, **annotation} for place, annotation in enumerate(annotations)
    ]
    categories = [{"id": STALK, "name": "stalk", "supercategory": "plant"}]
    return {"info": about, "images": images, "annotations": numbered, "categories": categories}


def read_annotations(folder: Path) -> dict[str, Any]:
    """The annotations of a folder, in COCO's form whatever form they are in.

    ``annotations.json`` of COCO; or one file for each image: ``*.xml`` of Pascal VOC, with boxes, or ``*.json`` of LabelMe,
    with polygons or rectangles. Where something is called a stalk, what is called otherwise is left out.

    Returns:
        ``images``, each with id, file_name, width and height; and ``annotations``, each with the image_id of one of them and a
        bbox [4] (left, top, width, height in pixels) that shows in it, and, where there is a ``segmentation``, polygons (lists
        of at least 3 corners) or runs of pixels that cover the image.

    Raises:
        RequestError: There are none, they cannot be read, or one of them is not as above; the message says which.
    """
    path = folder / "annotations.json"
    if path.exists():
        return _checked_annotations(_read_coco(path), path)
    for pattern, read in (("*.xml", _voc), ("*.json", _labelme)):
        files = sorted(folder.glob(pattern)) if folder.is_dir() else []
        if files:
            return _checked_annotations(_together(files, read), folder)
    raise RequestError(
        f"there are no annotations in {folder}: put annotations.json of COCO there, or .xml of Pascal VOC or .json of LabelMe "
        "beside each image"
    )


def _read_coco(path: Path) -> dict[str, Any]:
    try:
        data = read_json(path)
        names = {category["id"]: str(category["name"]) for category in data.get("categories", [])}
        annotations = []
        for place, annotation in enumerate(data["annotations"]):
            source = f"{path}: annotation {str(annotation.get('id', place + 1))[:60]}"
            annotations.append({**annotation, "name": names.get(annotation.get("category_id"), ""), "source": source})
        return {"images": [{**image, "source": str(path)} for image in data["images"]], "annotations": annotations}
    except OSError as error:
        raise RequestError(f"cannot read {path}: {error.strerror or error}") from error
    except _WRONG as error:
        raise RequestError(f"{path} is not COCO: it needs images and annotations{_reason(error)}") from error


_Read = Callable[[Path], tuple[str, int, int, list[dict[str, Any]]]]
"""From a file to the name of its image, width, height and annotations."""


def _together(files: list[Path], read: _Read) -> dict[str, Any]:
    """Files of one image each as one data set."""
    images, annotations = [], []
    for number, file in enumerate(files):
        try:
            name, width, height, shapes = read(file)
        except OSError as error:
            raise RequestError(f"cannot read {file}: {error.strerror or error}") from error
        except _WRONG as error:
            kind = "Pascal VOC" if file.suffix == ".xml" else "LabelMe"
            raise RequestError(f"{file} is no annotation of {kind}{_reason(error)}") from error
        images.append({"id": number, "file_name": name, "width": width, "height": height, "source": str(file)})
        annotations += [
            {"image_id": number, "source": f"{file}: annotation {place + 1}", **shape} for place, shape in enumerate(shapes)
        ]
    return {"images": images, "annotations": annotations}


def _reason(error: Exception) -> str:
    """Message of a reader's error, where it has one in words."""
    words = " ".join(str(error).split()) if isinstance(error, ValueError) else ""
    return f" ({words[:200]})" if words else ""


def _voc(path: Path) -> tuple[str, int, int, list[dict[str, Any]]]:
    root = parse_xml(read_bytes(path, _MAX_BYTES))

    def text(node: ElementTree.Element, name: str) -> str:
        value = node.findtext(name)
        if value is None:
            raise ValueError(name)
        return value

    annotations = []
    for element in root.iter("object"):
        # Pixels count from 1, and the last ones belong to the box.
        left, top, right, bottom = (float(text(element, f"bndbox/{name}")) for name in ("xmin", "ymin", "xmax", "ymax"))
        box = [left - 1.0, top - 1.0, right - left + 1.0, bottom - top + 1.0]
        annotations.append({"name": text(element, "name"), "bbox": box})
    return text(root, "filename"), int(text(root, "size/width")), int(text(root, "size/height")), annotations


def _labelme(path: Path) -> tuple[str, int, int, list[dict[str, Any]]]:
    data = read_json(path, _MAX_BYTES)
    annotations = []
    for shape in data["shapes"]:
        points = np.asarray(shape["points"], float).reshape(-1, 2)
        kind = shape.get("shape_type", "polygon")
        if kind not in ("polygon", "rectangle") or len(points) < (2 if kind == "rectangle" else 3):
            continue
        low, high = points.min(axis=0), points.max(axis=0)
        outline = points if kind == "polygon" else np.array([low, (high[0], low[1]), high, (low[0], high[1])])
        with np.errstate(over="ignore", invalid="ignore"):
            box = [*map(float, low), *map(float, high - low)]
        annotations.append({"name": str(shape["label"]), "bbox": box, "segmentation": [outline.ravel().tolist()]})
    # The path is as its writer's machine spelled it.
    return (
        str(data["imagePath"]).replace("\\", "/").rpartition("/")[2],
        int(data["imageWidth"]),
        int(data["imageHeight"]),
        annotations,
    )


def _checked_annotations(data: dict[str, Any], path: Path) -> dict[str, Any]:
    """Return the annotations that are called a stalk, or all if none is; checked."""
    named = [annotation for annotation in data["annotations"] if "stalk" in annotation.get("name", "").lower()]
    data = {**data, "annotations": named or data["annotations"]}
    if not data["images"] or not data["annotations"]:
        raise RequestError(f"{path} annotates nothing: name a folder with annotated images")
    images = [_checked_image(image, place) for place, image in enumerate(data["images"])]
    twice = len(images) - len({image["id"] for image in images})
    if twice:
        raise RequestError(f"{path}: {twice} images have the id of another one, so nobody can tell whose annotations are whose")
    sizes = {image["id"]: (image["height"], image["width"]) for image in images}
    annotations = []
    for annotation in data["annotations"]:
        try:
            annotations.append(_checked_annotation(annotation, sizes))
        except ValueError as error:
            raise RequestError(f"{annotation['source']} {error}: mend it, or delete it") from error
    return {"images": images, "annotations": annotations}


def _checked_image(image: dict[str, Any], place: int) -> dict[str, Any]:
    """Return the entry of an image, with its width and height as whole numbers.

    Raises:
        RequestError: Something is missing.
    """
    if not isinstance(image.get("id"), (int, str)) or not isinstance(image.get("file_name"), str):
        raise RequestError(f"{image['source']}: image number {place + 1} needs an id and a file_name")
    name = image["file_name"]
    if not _is_inside(name):
        raise RequestError(
            f"{image['source']}: image number {place + 1} has the file_name {reprlib.repr(name)}: name a file in that folder"
        )
    sides = _numbers([image.get("width"), image.get("height")])
    if sides is None or min(sides) < 1 or any(side % 1 for side in sides):
        said = f"{reprlib.repr(image.get('width'))} and {reprlib.repr(image.get('height'))}"
        raise RequestError(f"{image['source']}: image {name} needs a width and a height in pixels, not {said}")
    if sides[0] * sides[1] > MAX_PIXELS:
        most = f"more than {MAX_PIXELS // 10**6} million pixels"
        raise RequestError(f"{image['source']}: image {name} is said to have {sides[0]:g} x {sides[1]:g}, {most}")
    return {**image, "width": int(sides[0]), "height": int(sides[1])}


def _is_inside(name: str) -> bool:
    """Return whether a file's name, as it stands in annotations, leads to nowhere but into their folder, on any system."""
    path = PureWindowsPath(name)  # which knows both separators
    steps = path.parts
    return bool(steps) and not path.anchor and ".." not in steps and name == readable(name)


def _checked_annotation(annotation: dict[str, Any], sizes: dict[int | str, tuple[int, int]]) -> dict[str, Any]:
    """An annotation with a box and, where it has any, a segmentation that fit its image.

    Args:
        annotation: As it was read.
        sizes: Height and width of each image, by its id.

    Raises:
        ValueError: They do not. The message continues after the annotation's name.
    """
    number = annotation.get("image_id")
    if not isinstance(number, (int, str)) or number not in sizes:
        raise ValueError(f"has the image_id {reprlib.repr(number)}, which no image has")
    height, width = sizes[number]
    segmentation = _checked_segmentation(annotation.get("segmentation"), (height, width))
    if annotation.get("bbox") is not None:
        box = _numbers(annotation["bbox"])
    elif segmentation:
        box = _box_around(segmentation)
    else:
        raise ValueError("has neither a bbox nor a segmentation")
    if box is None or len(box) != 4:
        raise ValueError("has a bbox that is not 4 numbers (left, top, width, height)")
    if max(map(abs, box)) > _FARTHEST:
        raise ValueError("has a bbox that lies nowhere near an image")
    left, top, wide, tall = box
    if not (wide > 0 and tall > 0):
        raise ValueError(f"has a box of {wide:g} x {tall:g} pixels")
    if left >= width or top >= height or left + wide <= 0 or top + tall <= 0:
        raise ValueError(f"has a box from ({left:g}, {top:g}) on, outside its image of {width} x {height} pixels")
    return {**annotation, "bbox": box, "segmentation": segmentation}


def _checked_segmentation(segmentation: Any, size: tuple[int, int]) -> dict[str, Any] | list[list[float]] | None:
    """Runs, as numbers, that cover an image of ``size`` (height, width), or polygons; None where there is nothing.

    Raises:
        ValueError: It is neither.
    """
    if not segmentation:
        return None
    if isinstance(segmentation, dict):
        said, counts = _numbers(segmentation.get("size")), segmentation.get("counts")
        if said is None or len(said) != 2 or not isinstance(counts, (str, list)):
            raise ValueError("has a mask without size (height, width) and counts")
        if tuple(said) != size:
            raise ValueError(f"has a mask of {said[1]:g} x {said[0]:g} pixels, but its image has {size[1]} x {size[0]}")
        try:
            numbers = decode_counts(counts) if isinstance(counts, str) else _numbers(counts)
            if numbers is None:
                raise ValueError("counts are not numbers")
            runs = covering(numbers, *size)
        except (ValueError, OverflowError) as error:
            raise ValueError(f"has a mask that cannot be read ({error})") from error
        if not runs[1::2].any():
            raise ValueError("has a mask without a pixel")
        return {"size": list(size), "counts": runs.tolist()}
    outlines = [_numbers(outline) for outline in segmentation] if isinstance(segmentation, list) else [None]
    corners = [outline for outline in outlines if outline is not None and len(outline) >= 6 and len(outline) % 2 == 0]
    if len(corners) < len(outlines):
        raise ValueError("has a polygon that is not column, line, column, line, ... of 3 corners or more")
    if any(abs(corner) > _FARTHEST for outline in corners for corner in outline):
        raise ValueError("has a polygon that lies nowhere near an image")
    return corners


def _numbers(values: Any) -> list[float] | None:
    """A list of finite numbers; None where it is anything else."""
    try:
        numbers = np.asarray(values, float)
    except (ValueError, TypeError, OverflowError):
        return None
    return numbers.tolist() if numbers.ndim == 1 and np.isfinite(numbers).all() else None


def _box_around(segmentation: dict[str, Any] | list[list[float]]) -> list[float]:
    """The box (left, top, width, height) around what was checked."""
    if isinstance(segmentation, dict):
        return box_around_runs(np.array(segmentation["counts"], np.int64), segmentation["size"][0])
    corners = np.concatenate([np.reshape(outline, (-1, 2)) for outline in segmentation])
    low, high = corners.min(axis=0), corners.max(axis=0)
    return [*map(float, low), *map(float, high - low)]
