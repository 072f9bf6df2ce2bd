"""Annotations: boxes, and masks as runs of pixels. Written in COCO's format, read in that of COCO, Pascal VOC or LabelMe."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from jaxrl_vis.errors import RequestError

STALK = 1
"""Category of stalks."""


def encode_mask(mask: np.ndarray, corner: tuple[int, int], size: tuple[int, int]) -> dict[str, Any]:
    """A mask as COCO's uncompressed runs, which go down the columns and begin with what is outside.

    Args:
        mask: [h, w] bool, of a part of the image.
        corner: Line and column of its first pixel.
        size: Height and width of the image.

    Returns:
        ``size`` and ``counts``; an image of which all is outside has one run.
    """
    height, width = size
    column, line = np.nonzero(mask.T)
    place = (column + corner[1]) * height + line + corner[0]
    breaks = np.flatnonzero(np.diff(place) > 1)
    starts = place[np.concatenate([[0], breaks + 1])] if place.size else place
    ends = place[np.concatenate([breaks, [place.size - 1]])] + 1 if place.size else place
    edges = np.concatenate([[0], np.stack([starts, ends], axis=1).ravel(), [height * width]])
    counts = np.diff(edges).tolist()
    if counts and counts[-1] == 0:
        counts.pop()
    return {"size": [height, width], "counts": [int(count) for count in counts]}


def decode_mask(runs: dict[str, Any]) -> np.ndarray:
    """The mask [H, W] bool that `encode_mask` wrote.

    Raises:
        ValueError: The runs do not cover the image.
    """
    height, width = runs["size"]
    counts = np.asarray(runs["counts"], np.int64)
    if counts.sum() != height * width:
        raise ValueError(f"runs of {counts.sum()} pixels do not cover an image of {width} x {height}")
    return np.repeat(np.arange(counts.size) % 2 == 1, counts).reshape(width, height).T


def coco(images: list[dict[str, Any]], annotations: list[dict[str, Any]], about: dict[str, Any]) -> dict[str, Any]:
    """A COCO data set of stalks.

    Args:
        images: With id, file_name, width and height.
        annotations: With image_id, bbox (left, top, width, height in pixels), area and, where there is one, segmentation; ids
            are added.
        about: What the data set is.
    """
    numbered = [{"id": place + 1, "category_id": STALK, "iscrowd": 0, **each} for place, each in enumerate(annotations)]
    categories = [{"id": STALK, "name": "stalk", "supercategory": "plant"}]
    return {"info": about, "images": images, "annotations": numbered, "categories": categories}


def decode_counts(text: str) -> list[int]:
    """The runs that COCO's tools write as text: five bits a character, and from the third run on the difference to the last but
    one.

    Raises:
        ValueError: The text ends in the middle of a number.
    """
    counts: list[int] = []
    place = 0
    while place < len(text):
        value, shift, more = 0, 0, True
        while more:
            if place >= len(text):
                raise ValueError("runs of a mask end in the middle of a number")
            bits = ord(text[place]) - 48
            value |= (bits & 0x1F) << shift
            more, shift, place = bool(bits & 0x20), shift + 5, place + 1
            if not more and bits & 0x10:
                value -= 1 << shift
        counts.append(value + (counts[-2] if len(counts) > 2 else 0))
    return counts


def read_annotations(folder: Path) -> dict[str, Any]:
    """The annotations of a folder, in COCO's form whatever form they are in.

    ``annotations.json`` of COCO; or one file for each image: ``*.xml`` of Pascal VOC, with boxes, or ``*.json`` of LabelMe,
    with polygons or rectangles. Where something is called a stalk, what is called otherwise is left out.

    Raises:
        RequestError: There are none, or they cannot be read.
    """
    path = folder / "annotations.json"
    if path.exists():
        return _kept(_coco_of(path), path)
    for pattern, read in (("*.xml", _voc), ("*.json", _labelme)):
        files = sorted(folder.glob(pattern)) if folder.is_dir() else []
        if files:
            return _kept(_together(files, read), folder)
    raise RequestError(
        f"there are no annotations in {folder}: put annotations.json of COCO there, or .xml of Pascal VOC or .json of LabelMe "
        "beside each image"
    )


def _coco_of(path: Path) -> dict[str, Any]:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        names = {each["id"]: str(each["name"]) for each in data.get("categories", [])}
        annotations = [{**each, "name": names.get(each.get("category_id"), "")} for each in data["annotations"]]
        for each in annotations:
            segmentation = each.get("segmentation")
            if isinstance(segmentation, dict) and isinstance(segmentation.get("counts"), str):
                each["segmentation"] = {**segmentation, "counts": decode_counts(segmentation["counts"])}
        return {"images": list(data["images"]), "annotations": annotations}
    except OSError as error:
        raise RequestError(f"cannot read {path}: {error.strerror or error}") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise RequestError(f"{path} is not COCO: it needs images and annotations") from error


_Read = Callable[[Path], tuple[str, int, int, list[dict[str, Any]]]]
"""From a file to the name of its image, width, height and annotations."""


def _together(files: list[Path], read: _Read) -> dict[str, Any]:
    """Files of one image each as one data set."""
    images, annotations = [], []
    for number, file in enumerate(files):
        try:
            name, width, height, found = read(file)
        except OSError as error:
            raise RequestError(f"cannot read {file}: {error.strerror or error}") from error
        except (ValueError, KeyError, TypeError, AttributeError, ElementTree.ParseError) as error:
            kind = "Pascal VOC" if file.suffix == ".xml" else "LabelMe"
            raise RequestError(f"{file} is no annotation of {kind}") from error
        images.append({"id": number, "file_name": name, "width": width, "height": height})
        annotations += [{"image_id": number, **each} for each in found]
    return {"images": images, "annotations": annotations}


def _voc(path: Path) -> tuple[str, int, int, list[dict[str, Any]]]:
    root = ElementTree.parse(path).getroot()

    def text(node: ElementTree.Element, name: str) -> str:
        value = node.findtext(name)
        if value is None:
            raise ValueError(name)
        return value

    found = []
    for each in root.iter("object"):
        # Pixels count from 1, and the last ones belong to the box.
        left, top, right, bottom = (float(text(each, f"bndbox/{name}")) for name in ("xmin", "ymin", "xmax", "ymax"))
        box = [left - 1.0, top - 1.0, right - left + 1.0, bottom - top + 1.0]
        found.append({"name": text(each, "name"), "bbox": box})
    return text(root, "filename"), int(text(root, "size/width")), int(text(root, "size/height")), found


def _labelme(path: Path) -> tuple[str, int, int, list[dict[str, Any]]]:
    data = json.loads(path.read_text(encoding="utf-8"))
    found = []
    for shape in data["shapes"]:
        points = np.asarray(shape["points"], float).reshape(-1, 2)
        kind = shape.get("shape_type", "polygon")
        if kind not in ("polygon", "rectangle") or len(points) < (2 if kind == "rectangle" else 3):
            continue
        low, high = points.min(axis=0), points.max(axis=0)
        outline = points if kind == "polygon" else np.array([low, (high[0], low[1]), high, (low[0], high[1])])
        box = [*map(float, low), *map(float, high - low)]
        found.append({"name": str(shape["label"]), "bbox": box, "segmentation": [outline.ravel().tolist()]})
    # The path is as its writer's machine spelled it.
    return (
        str(data["imagePath"]).replace("\\", "/").rpartition("/")[2],
        int(data["imageWidth"]),
        int(data["imageHeight"]),
        found,
    )


def _kept(data: dict[str, Any], path: Path) -> dict[str, Any]:
    """What is called a stalk, if anything is, and else all."""
    named = [each for each in data["annotations"] if "stalk" in each.get("name", "").lower()]
    data = {**data, "annotations": named or data["annotations"]}
    if not data["images"] or not data["annotations"]:
        raise RequestError(f"{path} annotates nothing: name a folder with annotated images")
    return data
