"""Duplicate detections of a stalk, recognised by their masks.

In a clump the boxes of two detections of one stalk can be as different as those of two stalks that cross, so the detector keeps
both. The masks of duplicates agree, as both show the one stalk that is there; those of two stalks share little, as a mask holds
only the visible part.
"""

from collections.abc import Sequence

import numpy as np

MAX_SHARED = 0.6
"""Greatest share of the smaller mask's pixels in two stalks: duplicates share more, and stalks that touch share less."""

Piece = tuple[np.ndarray, tuple[int, int]]
"""A mask [h, w] in a part of the image, and line and column of its first pixel there."""


def without_duplicates(pieces: Sequence[Piece], scores: np.ndarray, most_shared: float = MAX_SHARED) -> np.ndarray:
    """Return the detections to keep: the best goes first, and removes those whose masks it shares.

    Args:
        pieces: N masks, float32 from 0 to 1 or bool, and where they are.
        scores: [N] of the detections; of equal ones, the first goes first.
        most_shared: Share of the smaller of two masks above which they show the same stalk.

    Returns:
        [N] bool.
    """
    inside = [np.asarray(mask) >= 0.5 for mask, _ in pieces]
    sizes = [int(np.count_nonzero(mask)) for mask in inside]
    selected: list[int] = []
    for place in np.argsort(-np.asarray(scores), kind="stable").tolist():
        corner = pieces[place][1]
        shared = (_shared(inside[place], corner, inside[other], pieces[other][1]) for other in selected)
        least = (min(sizes[place], sizes[other]) for other in selected)
        if not any(common > most_shared * size for common, size in zip(shared, least)):
            selected.append(place)
    return np.isin(np.arange(len(pieces)), selected)


def _shared(first: np.ndarray, corner: tuple[int, int], second: np.ndarray, other: tuple[int, int]) -> int:
    """Pixels that are in both of two masks."""
    low = np.maximum(corner, other)
    high = np.minimum(np.add(corner, first.shape), np.add(other, second.shape))
    if (high <= low).any():
        return 0
    parts = [
        mask[low[0] - top : high[0] - top, low[1] - left : high[1] - left]
        for mask, (top, left) in ((first, corner), (second, other))
    ]
    return int(np.count_nonzero(parts[0] & parts[1]))
