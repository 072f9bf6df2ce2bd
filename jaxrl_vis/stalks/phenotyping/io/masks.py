"""Masks as COCO keeps them: runs of pixels, as numbers or packed into text, and polygons.

Columns and lines of outlines are continuous: the first pixel spans from 0 to 1, with its middle at 0.5.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

_LARGEST = 1 << 48  # number of a run: more than there are pixels
_AT_ONCE = 4_000_000  # pairs of a line and an edge of an outline


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
    counts = covering(runs["counts"], height, width)
    return np.repeat(np.arange(counts.size) % 2 == 1, counts).reshape(width, height).T


def covering(counts: Sequence[float], height: int, width: int) -> np.ndarray:
    """Runs [N] int64 that are known to cover the image.

    Raises:
        ValueError: They do not.
    """
    numbers = np.asarray(counts, np.float64)
    if numbers.ndim != 1 or (numbers < 0).any() or (numbers % 1 != 0).any() or numbers.sum() != height * width:
        raise ValueError(f"runs of {numbers.sum():.0f} pixels do not cover an image of {width} x {height}")
    return numbers.astype(np.int64)


def outlined_mask(outlines: list[list[float]], size: tuple[int, int]) -> np.ndarray:
    """The mask [H, W] bool of polygons: those pixels whose middle lies inside one of them.

    As many pixels belong to a strip as it is wide, on the mean over its lines; to fill up to and with the boundary, as OpenCV
    does, would make it a pixel wider.

    Args:
        outlines: Polygons: column, line, column, line, ... of their corners, which may lie beyond the image.
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
        some = max(_AT_ONCE // max(len(middles), 1), 1)  # edges at a time: an outline may have millions
        for start in range(0, len(here), some):
            one, other = here[start : start + some], ahead[start : start + some]
            edge, line = np.nonzero((one[:, 1:] <= middles) != (other[:, 1:] <= middles))
            share = (middles[line] - one[edge, 1]) / (other[edge, 1] - one[edge, 1])
            crossing = one[edge, 0] + share * (other[edge, 0] - one[edge, 0])
            # Right of an odd number of crossings is inside.
            np.add.at(crossings, (line, np.clip(np.ceil(crossing - 0.5), 0, width).astype(int)), 1)
        mask[first:last] |= np.cumsum(crossings[:, :width], axis=1) % 2 == 1
    return mask


def decode_counts(text: str) -> list[int]:
    """The runs that COCO's tools write as text: five bits a character, and from the third run on the difference to the last but
    one.

    Raises:
        ValueError: The text ends in the middle of a number, or holds what is no number of pixels.
    """
    counts: list[int] = []
    value, shift = 0, 0
    for letter in text:
        bits = ord(letter) - 48
        if not 0 <= bits < 64 or shift > 50:
            raise ValueError("runs of a mask hold what is no number of pixels")
        value |= (bits & 0x1F) << shift
        shift += 5
        if bits & 0x20:
            continue
        if bits & 0x10:
            value -= 1 << shift
        counts.append(value + (counts[-2] if len(counts) > 2 else 0))
        if abs(counts[-1]) > _LARGEST:
            raise ValueError("runs of a mask hold what is no number of pixels")
        value, shift = 0, 0
    if shift:
        raise ValueError("runs of a mask end in the middle of a number")
    return counts


def box_around_runs(counts: np.ndarray, height: int) -> list[float]:
    """The box (left, top, width, height) around a mask, from its runs [N] int64 alone: the image need not fit into memory.

    Args:
        counts: As `covering` gives them; at least one of what is inside is longer than 0.
        height: Height of the image.
    """
    ends = np.cumsum(counts)[1::2]
    starts = ends - counts[1::2]
    starts, ends = starts[ends > starts], ends[ends > starts]
    first, last = starts // height, (ends - 1) // height  # columns
    over = last > first  # what goes on in the next column reaches the last line of its first, and the first of its last
    top = np.where(over, 0, starts % height).min()
    bottom = np.where(over, height - 1, (ends - 1) % height).max()
    left = first.min()
    return [float(left), float(top), float(last.max() - left + 1), float(bottom - top + 1)]
