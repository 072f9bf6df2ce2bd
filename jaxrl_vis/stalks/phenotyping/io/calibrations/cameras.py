"""Contents of calibrations before they are checked: pairs of rectified cameras, and pairs as they were built."""

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

from jaxrl_vis.errors import RequestError

Unit = Literal["m", "cm", "mm"]
Size = tuple[int, int]
"""Width and height of an image, pixels."""
MAX_SIDE = 100_000
"""Greatest width or height of an image that was calibrated, pixels."""
_SAME = 1e-6  # of rotations and distortions, and of focal lengths relative to each other


@dataclasses.dataclass(frozen=True)
class RectifiedPair:
    """Projection matrices of two rectified cameras.

    Attributes:
        left, right: [3, 4] float64.
        size: Width and height of the images; None where the file does not say it.
        unit: Unit of the last column; None where the file does not say it.
    """

    left: np.ndarray
    right: np.ndarray
    size: Size | None
    unit: Unit | None = None


@dataclasses.dataclass(frozen=True)
class RawPair:
    """Two cameras as they are, whose images must be rectified before depths can be had from them.

    Attributes:
        matrices: Camera matrices, [2, 3, 3] float64.
        distortions: Coefficients of each camera, [2, N] float64, in OpenCV's order.
        fisheye: If true, the coefficients are those of OpenCV's fisheye model (equidistant).
        rotation, translation: [3, 3] and [3] float64: from coordinates of the left camera to those of the right one.
        size: Width and height of the images; None where the file does not say it.
        unit: Unit of the translation; None where the file does not say it.
        program: Name of the program or make of camera that the file is of.
    """

    matrices: np.ndarray
    distortions: np.ndarray
    fisheye: bool
    rotation: np.ndarray
    translation: np.ndarray
    size: Size | None
    unit: Unit | None
    program: str

    def if_rectified(self) -> RectifiedPair | None:
        """Return the projection matrices where the cameras are rectified as they stand; None where they are not."""
        one, other = self.matrices
        focal = one[0, 0]
        equal = [one[1, 1], other[0, 0], other[1, 1]]
        straight = np.abs(self.rotation - np.eye(3)).max() < _SAME and not np.abs(self.distortions).max(initial=0.0) > _SAME
        beside = np.abs(self.translation[1:]).max() <= _SAME * max(abs(self.translation[0]), _SAME)
        if not (straight and beside and np.allclose(equal, focal, rtol=_SAME) and abs(one[1, 2] - other[1, 2]) < 1e-3):
            return None
        left, right = (np.pad(matrix, ((0, 0), (0, 1))) for matrix in (one, other))
        right[0, 3] = focal * self.translation[0]
        return RectifiedPair(left, right, self.size, self.unit)


def camera_matrix(focal_x: float, focal_y: float, x: float, y: float) -> np.ndarray:
    """The camera matrix [3, 3] float64 of focal lengths and a principal point, pixels."""
    return np.array([[focal_x, 0.0, x], [0.0, focal_y, y], [0.0, 0.0, 1.0]])


def projection(focal: float, x: float, y: float, shift: float = 0.0) -> np.ndarray:
    """The projection matrix [3, 4] float64 of a rectified camera; ``shift`` is minus its focal length times the baseline."""
    return np.array([[focal, 0.0, x, shift], [0.0, focal, y, 0.0], [0.0, 0.0, 1.0, 0.0]])


def numbers(value: Any, count: int) -> np.ndarray | None:
    """Exactly ``count`` finite numbers [count] float64, in a list, in lists of them, or under ``data``; None if not so."""
    data = value.get("data") if isinstance(value, dict) else value
    rows = data if isinstance(data, list) else []
    flat = [number for row in rows for number in row] if rows and all(isinstance(row, list) for row in rows) else rows
    if len(flat) != count or not all(isinstance(number, float) and math.isfinite(number) for number in flat):
        return None
    return np.array(flat)


def named_size(store: Mapping[str, Any], path: Path) -> Size | None:
    """Width and height under one of the names that programs give them; None where there are none.

    Raises:
        RequestError: They are there, but are no numbers of pixels.
    """
    for names in (("image_width", "image_height"), ("width", "height")):
        values = [store.get(name) for name in names]
        if None not in values:
            return whole(values, path, " and ".join(names))
    for name in ("image_size", "imageSize", "resolution"):
        value = store.get(name)
        data = value.get("data") if isinstance(value, dict) else value
        if isinstance(data, list) and len(data) == 2:
            return whole(data, path, name)
    return None


def whole(values: list[Any], path: Path, names: str) -> Size:
    """Two numbers of pixels.

    Raises:
        RequestError: They are none.
    """
    if not all(isinstance(value, float) and 1 <= value <= MAX_SIDE and value.is_integer() for value in values):
        raise RequestError(f"{path}: {names} must be numbers of pixels, without quotation marks")
    return int(values[0]), int(values[1])


def plain_numbers(text: str) -> list[float]:
    """Numbers of a text that are parted by white space or commas.

    Raises:
        ValueError: One is none, or not finite.
    """
    found = [float(word) for word in text.replace(",", " ").split()]
    if not all(map(math.isfinite, found)):
        raise ValueError("a number that is not finite")
    return found
