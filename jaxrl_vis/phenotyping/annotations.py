"""Annotations: boxes, and masks as runs of pixels. Written in COCO's format, read in that of COCO, Pascal VOC or LabelMe.

Columns and lines of boxes and outlines are continuous: the first pixel spans from 0 to 1, with its middle at 0.5.
"""

import json
from collections.abc import Callable, Sequence
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
    counts = _covering(runs["counts"], height, width)
    return np.repeat(np.arange(counts.size) % 2 == 1, counts).reshape(width, height).T


def _covering(counts: Sequence[float], height: int, width: int) -> np.ndarray:
    """Runs [N] int64 that are known to cover the image.

    Raises:
        ValueError: They do not.
    """
    numbers = np.asarray(counts, np.int64)
    if numbers.ndim != 1 or (numbers < 0).any() or numbers.sum() != height * width:
        raise ValueError(f"runs of {numbers.sum()} pixels do not cover an image of {width} x {height}")
    return numbers


def outlined_mask(outlines: list[list[float]], size: tuple[int, int]) -> np.ndarray:
    """The mask [H, W] bool of polygons: those pixels whose middle lies inside one of them.

    As many pixels belong to a strip as it is wide, on the mean over its lines; to fill up to and with the boundary, as OpenCV
    does, would make it a pixel wider.

    Args:
        outlines: Of each polygon column, line, column, line, ... of its corners, which may lie beyond the image.
        size: Height and width of the image.
    """
    height, width = size
    mask = np.zeros(size, bool)
    for outline in outlines:
        here = np.reshape(np.asarray(outline, float), (-1, 2))
        ahead = np.roll(here, -1, axis=0)
        first, last = np.clip(np.ceil([here[:, 1].min() - 0.5, here[:, 1].max() - 0.5]), 0, height).astype(int)
        middles = np.arange(first, last) + 0.5
        edge, line = np.nonzero((here[:, 1:] <= middles) != (ahead[:, 1:] <= middles))
        share = (middles[line] - here[edge, 1]) / (ahead[edge, 1] - here[edge, 1])
        crossing = here[edge, 0] + share * (ahead[edge, 0] - here[edge, 0])
        # Right of an odd number of crossings is inside.
        crossings = np.zeros((len(middles), width + 1), np.int32)
        np.add.at(crossings, (line, np.clip(np.ceil(crossing - 0.5), 0, width).astype(int)), 1)
        mask[first:last] |= np.cumsum(crossings[:, :width], axis=1) % 2 == 1
    return mask


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

    Returns:
        ``images``, each with id, file_name, width and height; and ``annotations``, each with the image_id of one of them and a
        bbox [4] (left, top, width, height in pixels) that shows in it, and, where there is a ``segmentation``, polygons (lists
        of at least 3 corners) or runs of pixels that cover the image.

    Raises:
        RequestError: There are none, they cannot be read, or one of them is not as above; the message says which.
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
        data = json.loads(path.read_text(encoding="utf-8-sig"))
        names = {each["id"]: str(each["name"]) for each in data.get("categories", [])}
        annotations = []
        for place, each in enumerate(data["annotations"]):
            source = f"{path}: annotation {each.get('id', place + 1)}"
            annotations.append({**each, "name": names.get(each.get("category_id"), ""), "source": source})
        return {"images": [{**each, "source": str(path)} for each in data["images"]], "annotations": annotations}
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
        images.append({"id": number, "file_name": name, "width": width, "height": height, "source": str(file)})
        annotations += [
            {"image_id": number, "source": f"{file}: annotation {place + 1}", **each} for place, each in enumerate(found)
        ]
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
    data = json.loads(path.read_text(encoding="utf-8-sig"))
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
    """What is called a stalk, if anything is, and else all; checked."""
    named = [each for each in data["annotations"] if "stalk" in each.get("name", "").lower()]
    data = {**data, "annotations": named or data["annotations"]}
    if not data["images"] or not data["annotations"]:
        raise RequestError(f"{path} annotates nothing: name a folder with annotated images")
    images = [_checked_image(each, place) for place, each in enumerate(data["images"])]
    sizes = {each["id"]: (each["height"], each["width"]) for each in images}
    annotations = []
    for each in data["annotations"]:
        try:
            annotations.append(_checked_annotation(each, sizes))
        except ValueError as error:
            raise RequestError(f"{each['source']} {error}: mend it, or delete it") from error
    return {"images": images, "annotations": annotations}


def _checked_image(image: dict[str, Any], place: int) -> dict[str, Any]:
    """What is known of an image, with its width and height as whole numbers.

    Raises:
        RequestError: Something is missing.
    """
    if not isinstance(image.get("id"), (int, str)) or not isinstance(image.get("file_name"), str):
        raise RequestError(f"{image['source']}: image number {place + 1} needs an id and a file_name")
    sides = _numbers([image.get("width"), image.get("height")])
    if sides is None or min(sides) < 1:
        said = f"{image.get('width')} and {image.get('height')}"
        raise RequestError(f"{image['source']}: image {image['file_name']} needs a width and a height in pixels, not {said}")
    return {**image, "width": int(sides[0]), "height": int(sides[1])}


def _checked_annotation(annotation: dict[str, Any], sizes: dict[int | str, tuple[int, int]]) -> dict[str, Any]:
    """An annotation with a box and, where it has any, a segmentation that fit its image.

    Args:
        annotation: As it was read.
        sizes: Height and width of each image, by its id.

    Raises:
        ValueError: They do not. The message goes on where the annotation's name ends.
    """
    number = annotation.get("image_id")
    if not isinstance(number, (int, str)) or number not in sizes:
        raise ValueError(f"has the image_id {number!r}, which no image has")
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
            runs = _covering(numbers, *size)
        except (ValueError, OverflowError) as error:
            raise ValueError(f"has a mask that cannot be read ({error})") from error
        if not runs[1::2].any():
            raise ValueError("has a mask without a pixel")
        return {"size": list(size), "counts": runs.tolist()}
    outlines = [_numbers(each) for each in segmentation] if isinstance(segmentation, list) else [None]
    corners = [each for each in outlines if each is not None and len(each) >= 6 and len(each) % 2 == 0]
    if len(corners) < len(outlines):
        raise ValueError("has a polygon that is not column, line, column, line, ... of 3 corners or more")
    return corners


def _numbers(values: Any) -> list[float] | None:
    """A list of finite numbers; None where it is anything else."""
    try:
        numbers = np.asarray(values, float)
    except (ValueError, TypeError):
        return None
    return numbers.tolist() if numbers.ndim == 1 and np.isfinite(numbers).all() else None


def _box_around(segmentation: dict[str, Any] | list[list[float]]) -> list[float]:
    """The box (left, top, width, height) around what was checked."""
    if isinstance(segmentation, dict):
        line, column = np.nonzero(decode_mask(segmentation))
        low, high = np.array([column.min(), line.min()]), np.array([column.max(), line.max()]) + 1
    else:
        corners = np.concatenate([np.reshape(each, (-1, 2)) for each in segmentation])
        low, high = corners.min(axis=0), corners.max(axis=0)
    return [*map(float, low), *map(float, high - low)]
