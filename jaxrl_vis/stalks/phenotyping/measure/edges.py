"""Edges of stalks to a fraction of a pixel: the places near a mask's edge at which the image changes most.

A network's masks end half a pixel too far in or out on textures that it has not learned from. Averaged along an edge of some
hundred lines, the image itself says better where it is; the mask says which of its edges is meant.
"""

import dataclasses

import numpy as np

from jaxrl_vis.stalks.phenotyping.measure.width import Strip, median

_SAMPLE_STEP = 0.25  # pixels between two samples across an edge
_BESIDE = 40  # samples on either side
_SMOOTHING = 2.0  # samples: standard deviation
_FURTHEST = 2.5  # pixels that an edge may be moved by
_MIN_CONTRAST = 3.0  # by how much an edge stands out of the usual change of brightness
_LINES_APART = 4
_MIN_LINES = 8


def refine_edges(strip: Strip, image: np.ndarray, corner: tuple[int, int], line: float, reach: float) -> Strip:
    """A strip whose edges lie where the image changes most; those that nothing near stands out from stay.

    Args:
        strip: The edges of a mask.
        image: [H, W] grey.
        corner: Line and column of the mask's first pixel in the image.
        line: Line of the mask, around which the image is looked at.
        reach: Distance above and below that, pixels.
    """
    low, high = max(line - reach + corner[0], 0.0), min(line + reach + corner[0], image.shape[0] - 1.0)
    lines = np.arange(np.ceil(low), np.floor(high) + 1.0, _LINES_APART).astype(int)
    if lines.size < _MIN_LINES:
        return strip
    edges = []
    for offset, slope in (strip.left, strip.right):
        column = offset + slope * (lines - corner[0] - strip.reference) + corner[1]
        edges.append((offset + _shift(image, lines, column), slope))
    return dataclasses.replace(strip, left=edges[0], right=edges[1])


def _shift(image: np.ndarray, lines: np.ndarray, columns: np.ndarray) -> float:
    """By how many pixels an edge in [N] lines and columns is moved to the right."""
    beside = _SAMPLE_STEP * np.arange(-_BESIDE, _BESIDE + 1)
    places = columns[:, None] + beside
    if places.min() < 0.0 or places.max() >= image.shape[1] - 1:
        return 0.0
    first = places.astype(int)
    share = places - first
    row = lines[:, None]
    across = np.median(image[row, first] * (1.0 - share) + image[row, first + 1] * share, axis=0)
    reach = np.arange(-8, 9)
    kernel = np.exp(-0.5 * (reach / _SMOOTHING) ** 2)
    change = np.abs(np.gradient(np.convolve(np.pad(across, 8, mode="edge"), kernel / kernel.sum(), mode="valid")))
    near = np.flatnonzero(np.abs(beside) <= _FURTHEST)
    best = int(near[np.argmax(change[near])])
    before, most, after = change[best - 1 : best + 2]
    if most < _MIN_CONTRAST * max(median(change), 1e-6) or before > most or after > most:
        return 0.0
    bend = before - 2.0 * most + after
    return float(beside[best] + (0.5 * _SAMPLE_STEP * (before - after) / bend if bend < 0.0 else 0.0))
