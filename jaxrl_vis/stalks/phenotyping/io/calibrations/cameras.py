"""Contents of calibrations before validation: rectified and unrectified camera pairs."""

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
"""Maximum width or height of a calibrated image, pixels."""
_SAME = 1e-6  # tolerance: absolute for rotations and distortions, relative for focal lengths and translations


@dataclasses.dataclass(frozen=True)
class RectifiedPair:
    """Projection matrices of two rectified cameras.

    Attributes:
        left, right: Projection matrices [3, 4] float64.
        size: Width and height of the images; None if the file does not state it.
        unit: Unit of the baseline; None if the file does not state it.
    """

    left: np.ndarray
    right: np.ndarray
    size: Size | None
    unit: Unit | None = None


@dataclasses.dataclass(frozen=True)
class UnrectifiedPair:
    """Two unrectified cameras, whose images must be rectified before stereo matching.

    Attributes:
        matrices: Camera matrices, [2, 3, 3] float64.
        distortions: Distortion coefficients of each camera, [2, N] float64, in OpenCV's order.
        fisheye: If true, the coefficients are those of OpenCV's fisheye model (equidistant).
        rotation, translation: Transform from the left to the right camera's frame, [3, 3] and [3] float64.
        size: Width and height of the images; None if the file does not state it.
        unit: Unit of the translation; None if the file does not state it.
        program: Name of the program or camera make that wrote the file.
    """

    matrices: np.ndarray
    distortions: np.ndarray
    fisheye: bool
    rotation: np.ndarray
    translation: np.ndarray
    size: Size | None
    unit: Unit | None
    program: str

    def to_rectified(self) -> RectifiedPair | None:
        """Return the projection matrices if the cameras are rectified as mounted; None otherwise.

        They are if they have no distortion, equal focal lengths, no rotation, and a translation along x only.
        """
        one, other = self.matrices
        focal = one[0, 0]
        equal = [one[1, 1], other[0, 0], other[1, 1]]
        straight = np.abs(self.rotation - np.eye(3)).max() < _SAME and not np.abs(self.distortions).max(initial=0.0) > _SAME
        horizontal = np.abs(self.translation[1:]).max() <= _SAME * max(abs(self.translation[0]), _SAME)
        if not (straight and horizontal and np.allclose(equal, focal, rtol=_SAME) and abs(one[1, 2] - other[1, 2]) < 1e-3):
            return None
        left, right = (np.pad(matrix, ((0, 0), (0, 1))) for matrix in (one, other))
        right[0, 3] = focal * self.translation[0]
        return RectifiedPair(left, right, self.size, self.unit)


def camera_matrix(focal_x: float, focal_y: float, x: float, y: float) -> np.ndarray:
    """Return the camera matrix [3, 3] float64 of focal lengths and a principal point (x, y), pixels."""
    return np.array([[focal_x, 0.0, x], [0.0, focal_y, y], [0.0, 0.0, 1.0]])


def projection_matrix(focal: float, x: float, y: float, shift: float = 0.0) -> np.ndarray:
    """Return the projection matrix [3, 4] float64 of a rectified camera.

    Args:
        focal: Focal length, pixels.
        x, y: Principal point, pixels.
        shift: For the right camera, minus the focal length times the baseline, in pixels times the unit of the baseline.
    """
    return np.array([[focal, 0.0, x, shift], [0.0, focal, y, 0.0], [0.0, 0.0, 1.0, 0.0]])


def parse_array(value: Any, count: int) -> np.ndarray | None:
    """Convert a list, nested list, or table with ``data`` to float64 [count]; None unless it holds ``count`` finite floats."""
    data = value.get("data") if isinstance(value, dict) else value
    rows = data if isinstance(data, list) else []
    flat = [number for row in rows for number in row] if rows and all(isinstance(row, list) for row in rows) else rows
    if len(flat) != count or not all(isinstance(number, float) and math.isfinite(number) for number in flat):
        return None
    return np.array(flat)


def read_size(store: Mapping[str, Any], path: Path) -> Size | None:
    """Return the image size under any of the names that programs use; None if there is none.

    Args:
        store: Contents of the file.
        path: The file, for messages.

    Raises:
        RequestError: The size is invalid.
    """
    for names in (("image_width", "image_height"), ("width", "height")):
        values = [store.get(name) for name in names]
        if None not in values:
            return check_image_size(values, path, " and ".join(names))
    for name in ("image_size", "imageSize", "resolution"):
        value = store.get(name)
        data = value.get("data") if isinstance(value, dict) else value
        if isinstance(data, list) and len(data) == 2:
            return check_image_size(data, path, name)
    return None


def check_image_size(values: list[Any], path: Path, names: str) -> Size:
    """Convert a width and height to integers.

    Args:
        values: The two values as parsed.
        path: The file, for messages.
        names: Names of the values, for messages.

    Raises:
        RequestError: They are not floats with integer values from 1 to `MAX_SIDE`.
    """
    if not all(isinstance(value, float) and 1 <= value <= MAX_SIDE and value.is_integer() for value in values):
        raise RequestError(f"{path}: {names} must be numbers of pixels, without quotation marks")
    return int(values[0]), int(values[1])


def parse_numbers(text: str) -> list[float]:
    """Parse numbers separated by white space or commas.

    Raises:
        ValueError: One is not a number, or not finite.
    """
    values = [float(word) for word in text.replace(",", " ").split()]
    if not all(map(math.isfinite, values)):
        raise ValueError("a number that is not finite")
    return values
