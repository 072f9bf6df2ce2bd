"""Black borders around images, as rectification leaves them and letterboxes add them: they are no part of the scene.

A camera's noise makes even a night sky uneven; what was filled in is one value, up to a side that is straight or evenly bent.
Only that is a border, so dark parts of an image stay what they are.
"""

import dataclasses
from typing import Any

import cv2
import numpy as np

_DARK = 12  # values up to here may be of a border: JPEG lets edges ring
_FILLED = 1.0  # mean of a border a little way inside it
_RINGING = 16  # pixels: how far from its side JPEG changes a border
_MIN_LINES = 0.08  # of the image's lines: a shorter side is none
_BEND = 2.5  # pixels: how far a border's side lies from an even curve
_MIN_AGREEING = 0.9  # of a side's lines
_THINNEST = 8.0  # pixels: width of a border where it begins within the image
_INSIDE = 2  # pixels by which an image ends before its border begins


@dataclasses.dataclass(frozen=True)
class Frame:
    """The part of an image that shows a scene.

    Attributes:
        lines, columns: First of each that shows anything, and one past the last.
        shown: [H, W] bool, True inside it; None where that is all of these lines and columns.
    """

    lines: tuple[int, int]
    columns: tuple[int, int]
    shown: np.ndarray | None = None


def find_frame(image: np.ndarray) -> Frame:
    """Find the part of an image [H, W, 3] or [H, W] uint8 that is not a border."""
    channels = image.shape[2] if image.ndim == 3 else 1
    dark = cv2.inRange(image, (0,) * channels, (_DARK,) * channels) > 0
    lit = ~dark
    lines, columns = (_extent(image, lit.any(axis=1 - axis), axis) for axis in (0, 1))
    part = image[slice(*lines), slice(*columns)]
    outside = _wedges(part, dark[slice(*lines), slice(*columns)])
    if not outside.any():
        return Frame(lines, columns)
    shown = np.zeros(dark.shape, bool)
    shown[slice(*lines), slice(*columns)] = ~outside
    return Frame(lines, columns, shown)


def _extent(image: np.ndarray, lit: Any, axis: int) -> tuple[int, int]:
    """Return the first line or column of an image that is lit, and one past the last; all of them where no border is beside."""
    size = lit.size
    if not lit.any():
        return 0, size
    first, last = int(lit.argmax()), size - int(lit[::-1].argmax())
    if not _is_filled(np.take(image, range(max(first - _RINGING, min(first, 1))), axis)):
        first = 0
    if not _is_filled(np.take(image, range(min(last + _RINGING, max(last, size - 1)), size), axis)):
        last = size
    return first, last


def _is_filled(part: np.ndarray) -> bool:
    return bool(part.size) and float(part.mean()) <= _FILLED


def _wedges(image: np.ndarray, dark: np.ndarray) -> np.ndarray:
    """Return True for the pixels [H, W] of borders that are not as long as the image's sides."""
    outside = np.zeros(dark.shape, bool)
    for turns in range(4):
        seen, filled = np.rot90(dark, turns), np.rot90(image, turns)
        reach = _side(seen, filled)
        if reach is not None:
            wedge = np.arange(seen.shape[1]) < reach[:, None]
            outside |= np.rot90(wedge, -turns)
    return outside


def _side(dark: np.ndarray, image: np.ndarray) -> np.ndarray | None:
    """Columns [H] that a border takes from the left of each line; None where there is no border."""
    if np.count_nonzero(dark[:, 0]) < _MIN_LINES * dark.shape[0]:
        return None
    depth = np.where(dark.all(axis=1), 0, np.argmin(dark, axis=1))
    there = np.flatnonzero(depth > _INSIDE)
    if there.size < max(_MIN_LINES * dark.shape[0], _RINGING):
        return None
    # Of the lines between its ends: a border is one piece.
    first, last = int(there[0]), int(there[-1]) + 1
    place = np.linspace(-1.0, 1.0, last - first)
    reach = depth[first:last].astype(float)
    heavy = reach > 0
    curve = np.zeros_like(reach)
    for _ in range(4):
        if heavy.sum() < _RINGING:
            return None
        curve = np.polyval(np.polyfit(place[heavy], reach[heavy], 2), place)
        # A dark thing beside the border makes it look wider, and nothing makes it look narrower.
        heavy = np.abs(reach - curve) <= max(_BEND, float(np.quantile(np.abs(reach - curve), 0.5)))
    # A border goes on to the image's other sides, or grows from nothing.
    ends = [curve[end] for end, whole in ((0, first == 0), (-1, last == dark.shape[0])) if not whole]
    if np.mean(np.abs(reach - curve) <= _BEND) < _MIN_AGREEING or max(ends, default=0.0) > _THINNEST:
        return None
    columns = np.zeros(dark.shape[0])
    columns[first:last] = np.maximum(curve, 0.0) + _INSIDE
    inner = np.arange(dark.shape[1]) < (columns - _INSIDE - _RINGING / 2)[:, None]
    if inner.any() and float(image[inner].mean()) > _FILLED:
        return None
    return columns


def fill_borders(image: np.ndarray, frame: Frame) -> np.ndarray:
    """Return the lines and columns of an image [H, W, 3] that show a scene, with borders beside it as bright as its sides."""
    part = image[slice(*frame.lines), slice(*frame.columns)]
    if frame.shown is None:
        return part
    shown = frame.shown[slice(*frame.lines), slice(*frame.columns)]
    # Every pixel of a border gets the value of the nearest one that shows something.
    _, labels = cv2.distanceTransformWithLabels((~shown).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    labels = labels.astype(np.int64)
    line, column = np.nonzero(shown)
    sources = np.zeros((int(labels.max()) + 1, 2), np.int64)
    sources[labels[line, column]] = np.stack([line, column], axis=1)
    hidden = np.nonzero(~shown)
    nearest = sources[labels[hidden]]
    filled = part.copy()
    filled[hidden] = part[nearest[:, 0], nearest[:, 1]]
    return filled
