"""Subpixel refinement of stalk edges: the maximum image gradient near an edge of the mask.

On textures not seen in training, masks are half a pixel too wide or narrow. The image gradient along an edge of some hundred
rows is more accurate; the mask only selects the edge.
"""

import dataclasses

import numpy as np

from jaxrl_vis.stalks.phenotyping.measure.width import Strip, median

_SAMPLE_STEP = 0.25  # pixels between two samples across an edge
_BESIDE = 40  # samples on each side of the edge
_SMOOTHING = 2.0  # samples: standard deviation of the Gaussian filter
_MAX_OFFSET = 2.5  # pixels: maximum shift of an edge
_MIN_CONTRAST = 3.0  # minimum ratio of the gradient at an edge to the median gradient
_ROW_STEP = 4
_MIN_ROWS = 8


def refine_edges(strip: Strip, image: np.ndarray, corner: tuple[int, int], row: float, reach: float) -> Strip:
    """Shift the edges of a strip to the nearby maximum of the image gradient; edges without a clear maximum are unchanged.

    Args:
        strip: Edges of a mask.
        image: Greyscale image [H, W], uint8 or float32.
        corner: Image row and column of the first pixel of the mask.
        row: Row of the mask around which the image is evaluated.
        reach: Distance above and below that row, pixels.
    """
    low, high = max(row - reach + corner[0], 0.0), min(row + reach + corner[0], image.shape[0] - 1.0)
    rows = np.arange(np.ceil(low), np.floor(high) + 1.0, _ROW_STEP).astype(int)
    if rows.size < _MIN_ROWS:
        return strip
    edges = []
    for offset, slope in (strip.left, strip.right):
        column = offset + slope * (rows - corner[0] - strip.reference) + corner[1]
        edges.append((offset + _edge_shift(image, rows, column), slope))
    return dataclasses.replace(strip, left=edges[0], right=edges[1])


def _edge_shift(image: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> float:
    """Return the shift to the right, pixels, of an edge at image rows and columns [N]; 0 without a clear gradient maximum."""
    offsets = _SAMPLE_STEP * np.arange(-_BESIDE, _BESIDE + 1)
    places = columns[:, None] + offsets
    if places.min() < 0.0 or places.max() >= image.shape[1] - 1:
        return 0.0
    first = places.astype(int)
    fraction = places - first
    row = rows[:, None]
    across = np.median(image[row, first] * (1.0 - fraction) + image[row, first + 1] * fraction, axis=0)
    reach = np.arange(-8, 9)
    kernel = np.exp(-0.5 * (reach / _SMOOTHING) ** 2)
    change = np.abs(np.gradient(np.convolve(np.pad(across, 8, mode="edge"), kernel / kernel.sum(), mode="valid")))
    near = np.flatnonzero(np.abs(offsets) <= _MAX_OFFSET)
    best = int(near[np.argmax(change[near])])
    before, peak, after = change[best - 1 : best + 2]
    if peak < _MIN_CONTRAST * max(median(change), 1e-6) or before > peak or after > peak:
        return 0.0
    bend = before - 2.0 * peak + after
    return float(offsets[best] + (0.5 * _SAMPLE_STEP * (before - after) / bend if bend < 0.0 else 0.0))
