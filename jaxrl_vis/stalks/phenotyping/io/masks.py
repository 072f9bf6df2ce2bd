"""COCO masks: run-length encodings, uncompressed or compressed to text, and polygons.

Coordinates of outlines are continuous: the first pixel spans from 0 to 1, with its centre at 0.5.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

_MAX_RUN = 1 << 48  # maximum run length, more than any image has pixels
_CHUNK_SIZE = 4_000_000  # pairs of an image row and a polygon edge that are processed together


def encode_mask(mask: np.ndarray, corner: tuple[int, int], size: tuple[int, int]) -> dict[str, Any]:
    """Encode a mask as uncompressed COCO runs, which are column-major and start with the background.

    Args:
        mask: Mask of a part of the image, [h, w] bool.
        corner: Row and column of its first pixel in the image.
        size: Height and width of the image.

    Returns:
        ``size`` and ``counts``; an empty mask has one run.
    """
    height, width = size
    column, row = np.nonzero(mask.T)
    place = (column + corner[1]) * height + row + corner[0]
    breaks = np.flatnonzero(np.diff(place) > 1)
    starts = place[np.concatenate([[0], breaks + 1])] if place.size else place
    ends = place[np.concatenate([breaks, [place.size - 1]])] + 1 if place.size else place
    edges = np.concatenate([[0], np.stack([starts, ends], axis=1).ravel(), [height * width]])
    counts = np.diff(edges).tolist()
    if counts and counts[-1] == 0:
        counts.pop()
    return {"size": [height, width], "counts": [int(count) for count in counts]}


def decode_mask(runs: dict[str, Any]) -> np.ndarray:
    """Decode uncompressed COCO runs, as from `encode_mask`, to a mask [H, W] bool.

    Raises:
        ValueError: The runs do not cover the image.
    """
    height, width = runs["size"]
    counts = check_runs(runs["counts"], height, width)
    return np.repeat(np.arange(counts.size) % 2 == 1, counts).reshape(width, height).T


def check_runs(counts: Sequence[float], height: int, width: int) -> np.ndarray:
    """Validate the runs of an image and return them as [N] int64.

    Raises:
        ValueError: They are not non-negative integers, or do not cover the image.
    """
    numbers = np.asarray(counts, np.float64)
    if numbers.ndim != 1 or (numbers < 0).any() or (numbers % 1 != 0).any() or numbers.sum() != height * width:
        raise ValueError(f"runs of {numbers.sum():.0f} pixels do not cover an image of {width} x {height}")
    return numbers.astype(np.int64)


def rasterize_polygons(outlines: list[list[float]], size: tuple[int, int]) -> np.ndarray:
    """Rasterize polygons to a mask [H, W] bool: the pixels whose centre lies inside any of them (by the even-odd rule).

    The mean number of mask pixels per row thus equals the width of a strip; filling the boundary, too, as OpenCV does, would
    make it one pixel wider.

    Args:
        outlines: Polygons, each x, y, x, y, ... of its corners, which may lie outside the image.
        size: Height and width of the image.
    """
    height, width = size
    mask = np.zeros(size, bool)
    for outline in outlines:
        here = np.reshape(np.asarray(outline, float), (-1, 2))
        ahead = np.roll(here, -1, axis=0)
        first, last = np.clip(np.ceil([here[:, 1].min() - 0.5, here[:, 1].max() - 0.5]), 0, height).astype(int)
        middles = np.arange(first, last) + 0.5
        crossings = np.zeros((len(middles), width + 1), np.int32)
        some = max(_CHUNK_SIZE // max(len(middles), 1), 1)  # edges per batch: an outline may have millions
        for start in range(0, len(here), some):
            one, other = here[start : start + some], ahead[start : start + some]
            edge, row = np.nonzero((one[:, 1:] <= middles) != (other[:, 1:] <= middles))
            fraction = (middles[row] - one[edge, 1]) / (other[edge, 1] - one[edge, 1])
            crossing = one[edge, 0] + fraction * (other[edge, 0] - one[edge, 0])
            # A pixel is inside if the number of crossings to its left is odd.
            np.add.at(crossings, (row, np.clip(np.ceil(crossing - 0.5), 0, width).astype(int)), 1)
        mask[first:last] |= np.cumsum(crossings[:, :width], axis=1) % 2 == 1
    return mask


def decode_counts(text: str) -> list[int]:
    """Decode COCO's compressed runs: 5 bits per character, and from the fourth run on the difference to the run two before.

    Raises:
        ValueError: The text ends within a number, or is malformed.
    """
    counts: list[int] = []
    value, shift = 0, 0
    for letter in text:
        bits = ord(letter) - 48
        if not 0 <= bits < 64 or shift > 50:
            raise ValueError("runs of a mask hold something that is not a number of pixels")
        value |= (bits & 0x1F) << shift
        shift += 5
        if bits & 0x20:
            continue
        if bits & 0x10:
            value -= 1 << shift
        counts.append(value + (counts[-2] if len(counts) > 2 else 0))
        if abs(counts[-1]) > _MAX_RUN:
            raise ValueError("runs of a mask hold something that is not a number of pixels")
        value, shift = 0, 0
    if shift:
        raise ValueError("runs of a mask end in the middle of a number")
    return counts


def box_around_runs(counts: np.ndarray, height: int) -> list[float]:
    """Return the bounding box (left, top, width, height) of a mask from its runs alone, without decoding it.

    Args:
        counts: Runs [N] int64 from `check_runs`, at least one foreground run of which is not empty.
        height: Height of the image.
    """
    ends = np.cumsum(counts)[1::2]
    starts = ends - counts[1::2]
    starts, ends = starts[ends > starts], ends[ends > starts]
    first, last = starts // height, (ends - 1) // height  # columns
    over = last > first  # runs over several columns touch both the first and the last row
    top = np.where(over, 0, starts % height).min()
    bottom = np.where(over, height - 1, (ends - 1) % height).max()
    left = first.min()
    return [float(left), float(top), float(last.max() - left + 1), float(bottom - top + 1)]
