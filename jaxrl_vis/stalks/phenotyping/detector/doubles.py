"""Removal of duplicate detections of a stalk by the overlap of their masks.

In a clump, the boxes of two detections of one stalk can differ as much as those of two crossing stalks, so the detector keeps
both. Masks of duplicates agree, while those of different stalks overlap little, as a mask holds only the visible part.
"""

from collections.abc import Sequence

import numpy as np

MAX_SHARED = 0.6
"""Maximum overlap of two stalks' masks, as a fraction of the smaller one: duplicates exceed it, touching stalks do not."""

PlacedMask = tuple[np.ndarray, tuple[int, int]]
"""Mask [h, w] of a part of the image, and the image row and column of its first pixel."""


def suppress_duplicates(masks: Sequence[PlacedMask], scores: np.ndarray, max_shared: float = MAX_SHARED) -> np.ndarray:
    """Apply greedy non-maximum suppression by mask overlap.

    Args:
        masks: N masks, float32 from 0 to 1 (thresholded at 0.5) or bool, with their positions.
        scores: Scores [N] of the detections; ties are broken by the lower index.
        max_shared: Overlap as a fraction of the smaller mask above which two detections are duplicates.

    Returns:
        [N] bool, True for the detections to keep.
    """
    inside = [np.asarray(mask) >= 0.5 for mask, _ in masks]
    sizes = [int(np.count_nonzero(mask)) for mask in inside]
    selected: list[int] = []
    for place in np.argsort(-np.asarray(scores), kind="stable").tolist():
        corner = masks[place][1]
        shared = (_shared_pixels(inside[place], corner, inside[other], masks[other][1]) for other in selected)
        smaller = (min(sizes[place], sizes[other]) for other in selected)
        if not any(common > max_shared * size for common, size in zip(shared, smaller)):
            selected.append(place)
    return np.isin(np.arange(len(masks)), selected)


def _shared_pixels(first: np.ndarray, corner: tuple[int, int], second: np.ndarray, other: tuple[int, int]) -> int:
    """Count the pixels that two masks have in common."""
    low = np.maximum(corner, other)
    high = np.minimum(np.add(corner, first.shape), np.add(other, second.shape))
    if (high <= low).any():
        return 0
    parts = [
        mask[low[0] - top : high[0] - top, low[1] - left : high[1] - left]
        for mask, (top, left) in ((first, corner), (second, other))
    ]
    return int(np.count_nonzero(parts[0] & parts[1]))
