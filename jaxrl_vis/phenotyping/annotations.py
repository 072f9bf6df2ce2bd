"""Annotations in COCO's format: boxes, and masks as runs of pixels."""

from typing import Any

import numpy as np

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
