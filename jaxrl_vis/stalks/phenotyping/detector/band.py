"""The band of stalks that is detected and measured, between two heights above the ground: its rows in an image."""

from collections.abc import Callable

import numpy as np

from jaxrl_vis.stalks.phenotyping.detector.chains import Chain, best_rows, covered_fraction, cut_chain
from jaxrl_vis.stalks.phenotyping.measure.borders import Frame

_COVERED = 0.3  # minimum fraction of the band that the sections of a stalk cover
_MIN_OVERLAP = 0.75  # minimum overlap (IoU) of the rows of a box with those of the band, below which the box is moved

Band = Callable[[float], tuple[float, float, bool]]
"""Function that returns the first and last row of the band in a column of an image, pixels, and True if they are those above a
detected ground plane, False if they are those of the usual cameras; (0, 0) is the centre of the first pixel. Networks that
detect sections need it to cut stalks to the band; others recognise the band by its position in the image, so their boxes are
moved if cameras look down or are mounted higher than in training."""


def to_image_coordinates(stalks: np.ndarray, scale: tuple[float, float]) -> np.ndarray:
    """Convert stalks [N, 6] from coordinates of the resized image to those of the original; ``scale`` as from `resize`."""
    return stalks * np.array([scale[1], scale[0], scale[1], scale[0], scale[1], scale[1]], np.float32)


def cut_to_band(chains: list[Chain], scale: tuple[float, float], band: Band | None) -> tuple[np.ndarray, np.ndarray]:
    """Return boxes and axes [N, 6] in the original image, and scores [N], of the parts of chains in the band.

    Chains whose sections cover less than 0.3 of the band are left out.

    Args:
        chains: Chains in the resized image.
        scale: Vertical and horizontal factors from coordinates of the resized image to those of the original.
        band: Rows of the band in the original image; None for the part of each chain with the highest scores, see `best_rows`.
    """
    stalks, scores = [], []
    for chain in chains:
        rows = best_rows(chain)
        if band is not None:
            column = float(np.median(chain.sections[:, 4:])) * scale[1] - 0.5
            top, bottom, _ = band(column)
            rows = (top + 0.5) / scale[0], (bottom + 0.5) / scale[0]
        if rows[1] - rows[0] > 1.0 and covered_fraction(chain, *rows) >= _COVERED:
            stalks.append(cut_chain(chain, *rows))
            scores.append(chain.score)
    return to_image_coordinates(np.array(stalks, np.float32).reshape(-1, 6), scale), np.array(scores, np.float32)


def move_to_band(stalks: np.ndarray, band: Band) -> np.ndarray:
    """Move the boxes of stalks [N, 6] that overlap too little with the rows of the band along their axes to these rows.

    Boxes and axes are in continuous image coordinates. All other boxes, which are more accurate than the band's rows, remain
    unchanged, and so do all boxes without a ground plane.
    """
    moved = stalks.copy()
    for place, (left, top, right, bottom, above, below) in enumerate(stalks.tolist()):
        *rows, is_on_ground = band(0.5 * (above + below) - 0.5)
        first, last = (row + 0.5 for row in rows)
        shared = min(bottom, last) - max(top, first)
        if not is_on_ground or last <= first or shared >= _MIN_OVERLAP * (max(bottom, last) - min(top, first)):
            continue
        slope = (below - above) / max(bottom - top, 1.0)
        axis = above + slope * (first - top), above + slope * (last - top)
        half = 0.5 * max(right - left - abs(below - above), 1.0)
        moved[place] = min(axis) - half, first, max(axis) + half, last, *axis
    return moved


def in_frame(band: Band, frame: Frame) -> Band:
    """Convert the rows of the band from coordinates of the whole image to those of a frame."""
    down, over = frame.rows[0], frame.columns[0]

    def inside(column: float) -> tuple[float, float, bool]:
        top, bottom, is_on_ground = band(column + over)
        return top - down, bottom - down, is_on_ground

    return inside
