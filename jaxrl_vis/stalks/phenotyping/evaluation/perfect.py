"""Detections from ground-truth boxes and masks of synthetic pairs, to evaluate everything downstream of the networks."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from jaxrl_vis.stalks.phenotyping.detector.finder import Detection, upper_segment


def perfect_detections(stalks: Iterable[Mapping[str, Any]], instance: np.ndarray, min_visible: float = 0.3) -> list[Detection]:
    """Return the detections of the visible stalks of an image, from left to right, with score 1.

    Stalks with fewer than 50 visible pixels in the band, or whose pixels span fewer than five rows, are left out.

    Args:
        stalks: Stalks with ``stalk``, ``band_box`` and ``band_visible``, as in `truth.StalkInView` or plot.json.
        instance: Index of the stalk that each pixel shows, negative if none, [H, W] int.
        min_visible: Minimum visible fraction of a stalk's part in the band.
    """
    detections = []
    height, width = instance.shape
    for stalk in stalks:
        if stalk["band_box"] is None or stalk["band_visible"] < min_visible:
            continue
        left, top, right, bottom = stalk["band_box"]
        first, last = max(round(left) - 3, 0), min(round(right) + 4, width)
        upper, lower = max(round(top), 0), min(round(bottom) + 1, height)
        mask = instance[upper:lower, first:last] == stalk["stalk"]
        row, column = np.nonzero(mask)
        if row.size < 50 or np.ptp(row) < 4:
            continue
        slope, offset = np.polyfit(row + upper, column + first, 1)
        axis = (float(offset + slope * top), float(offset + slope * bottom))
        above = _upper_mask(np.array([left, top, right, bottom, *axis]) + 0.5, instance, stalk["stalk"])
        detections.append(Detection((left, top, right, bottom), axis, 1.0, mask, (upper, first), above))
    return sorted(detections, key=lambda detection: sum(detection.axis))


def _upper_mask(stalk: np.ndarray, instance: np.ndarray, index: int) -> tuple[np.ndarray, tuple[int, int]] | None:
    """Return the true mask of a stalk around the upper height, and its corner; None if that is outside the image.

    Args:
        stalk: Left, top, right, bottom of the band's box, and columns of the axis at its top and bottom, [6].
        instance: Index of the stalk that each pixel shows, [H, W] int.
        index: Index of the stalk.
    """
    left, top, right, bottom = upper_segment(stalk)[:4]
    margin = right - left  # margin, as the stalk may bend
    first, last = max(round(left - margin), 0), min(round(right + margin), instance.shape[1])
    if top <= 0 or last <= first:
        return None
    rows = slice(round(top), round(bottom))
    return instance[rows, first:last] == index, (rows.start, first)
