"""Detection of black borders around images, as left by rectification or added as letterboxes.

Sensor noise makes even a night sky uneven, while a border is filled with one value and ends at a straight or evenly curved
side. Only such regions count as borders, so dark parts of the scene are kept.
"""

import dataclasses
from typing import Any

import cv2
import numpy as np

_DARK = 12  # maximum value in a border: JPEG edges ring
_FILLED = 1.0  # maximum mean value of a border, away from its side
_RINGING = 16  # pixels: reach of JPEG ringing into a border
_MIN_LENGTH = 0.08  # minimum length of a border's side, as a fraction of the image's
_MAX_RESIDUAL = 2.5  # pixels: maximum distance of a border's side from a smooth curve
_MIN_AGREEING = 0.9  # minimum fraction of a side's rows that lie on the curve
_MAX_END_WIDTH = 8.0  # pixels: maximum width of a border at an end within the image
_WIDENING = 2  # pixels by which a detected border is widened


@dataclasses.dataclass(frozen=True)
class Frame:
    """Part of an image that shows the scene, without black borders.

    Attributes:
        rows, columns: Half-open ranges of the rows and columns of its bounding box.
        shown: [H, W] bool, True for pixels of the scene; None if these are the whole bounding box.
    """

    rows: tuple[int, int]
    columns: tuple[int, int]
    shown: np.ndarray | None = None


def find_frame(image: np.ndarray) -> Frame:
    """Find the part of an image [H, W, 3] or [H, W] uint8 that is not a border."""
    channels = image.shape[2] if image.ndim == 3 else 1
    dark = cv2.inRange(image, (0,) * channels, (_DARK,) * channels) > 0
    lit = ~dark
    rows, columns = (_extent(image, lit.any(axis=1 - axis), axis) for axis in (0, 1))
    part = image[slice(*rows), slice(*columns)]
    outside = _border_wedges(part, dark[slice(*rows), slice(*columns)])
    if not outside.any():
        return Frame(rows, columns)
    shown = np.zeros(dark.shape, bool)
    shown[slice(*rows), slice(*columns)] = ~outside
    return Frame(rows, columns, shown)


def _extent(image: np.ndarray, lit: Any, axis: int) -> tuple[int, int]:
    """Return the half-open range of rows (axis 0) or columns (axis 1) without the borders at both ends.

    ``lit`` is True for rows or columns with any pixel that is not dark.
    """
    size = lit.size
    if not lit.any():
        return 0, size
    first, last = int(lit.argmax()), size - int(lit[::-1].argmax())
    if not _is_filled(np.take(image, range(max(first - _RINGING, min(first, 1))), axis)):
        first = 0
    if not _is_filled(np.take(image, range(min(last + _RINGING, max(last, size - 1)), size), axis)):
        last = size
    return first, last


def _is_filled(border: np.ndarray) -> bool:
    return bool(border.size) and float(border.mean()) <= _FILLED


def _border_wedges(image: np.ndarray, dark: np.ndarray) -> np.ndarray:
    """Return a mask [H, W] bool of the borders that do not extend along a whole side of the image.

    Args:
        image: [H, W, 3] or [H, W] uint8.
        dark: [H, W] bool, True where all channels are dark.
    """
    outside = np.zeros(dark.shape, bool)
    for turns in range(4):
        turned, filled = np.rot90(dark, turns), np.rot90(image, turns)
        reach = _border_width(turned, filled)
        if reach is not None:
            wedge = np.arange(turned.shape[1]) < reach[:, None]
            outside |= np.rot90(wedge, -turns)
    return outside


def _border_width(dark: np.ndarray, image: np.ndarray) -> np.ndarray | None:
    """Return the width [H] float64 of a border at the left of each row, pixels, 0 beyond its ends; None if there is no border.

    Args:
        dark: [H, W] bool, True where all channels are dark.
        image: [H, W, 3] or [H, W] uint8.
    """
    beside = np.flatnonzero(dark[:, 0])
    if beside.size < _MIN_LENGTH * dark.shape[0]:
        return None
    rows = dark[beside]
    depth = np.zeros(dark.shape[0], int)
    depth[beside] = np.where(rows.all(axis=1), 0, rows.argmin(axis=1))
    there = np.flatnonzero(depth > _WIDENING)
    if there.size < max(_MIN_LENGTH * dark.shape[0], _RINGING):
        return None
    # Consider all rows between its ends, as a border is contiguous.
    first, last = int(there[0]), int(there[-1]) + 1
    place = np.linspace(-1.0, 1.0, last - first)
    reach = depth[first:last].astype(float)
    heavy = reach > 0
    curve = np.zeros_like(reach)
    for _ in range(4):
        if heavy.sum() < _RINGING:
            return None
        curve = np.polyval(np.polyfit(place[heavy], reach[heavy], 2), place)
        # Dark objects next to the border make it look wider; nothing makes it look narrower.
        heavy = np.abs(reach - curve) <= max(_MAX_RESIDUAL, float(np.quantile(np.abs(reach - curve), 0.5)))
    # A border extends to the adjacent sides of the image, or tapers off.
    ends = [curve[end] for end, complete in ((0, first == 0), (-1, last == dark.shape[0])) if not complete]
    if np.mean(np.abs(reach - curve) <= _MAX_RESIDUAL) < _MIN_AGREEING or max(ends, default=0.0) > _MAX_END_WIDTH:
        return None
    columns = np.zeros(dark.shape[0])
    columns[first:last] = np.maximum(curve, 0.0) + _WIDENING
    inner = np.arange(dark.shape[1]) < (columns - _WIDENING - _RINGING / 2)[:, None]
    if inner.any() and float(image[inner].mean()) > _FILLED:
        return None
    return columns


def fill_borders(image: np.ndarray, frame: Frame) -> np.ndarray:
    """Crop an image [H, W, 3] to the bounding box of its frame, and fill remaining borders with the nearest scene pixels.

    Returns:
        [h, w, 3], a view of the image if no border remains.
    """
    part = image[slice(*frame.rows), slice(*frame.columns)]
    if frame.shown is None:
        return part
    hidden = (~frame.shown[slice(*frame.rows), slice(*frame.columns)]).astype(np.uint8)
    # Each border pixel gets the value of the nearest pixel of the scene, which is beside the border.
    _, nearest = cv2.distanceTransformWithLabels(hidden, cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    labels = np.asarray(nearest, np.int32).ravel()
    beside, inside = np.flatnonzero(cv2.dilate(hidden, np.ones((3, 3))) > hidden), np.flatnonzero(hidden)
    sources = np.zeros(int(labels.max()) + 1, int)
    sources[labels[beside]] = beside
    filled = part.copy()
    pixels = filled.reshape(-1, filled.shape[-1])
    pixels[inside] = pixels[sources[labels[inside]]]
    return filled
