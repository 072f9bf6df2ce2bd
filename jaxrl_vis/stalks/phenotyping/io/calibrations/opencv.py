"""Calibrations of OpenCV: P1 and P2 as returned by ``cv2.stereoRectify``, or camera matrices with R and T.

OpenCV's sample ``stereo_calib`` writes both to two files, intrinsics.yml and extrinsics.yml, without the image size.
"""

import reprlib
from pathlib import Path
from typing import Any, get_args

import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.stalks.phenotyping.io.calibrations.cameras import RectifiedPair, Unit, UnrectifiedPair, parse_array, read_size

_MATRICES = (("M1", "M2"), ("K1", "K2"), ("cameraMatrix1", "cameraMatrix2"), ("camera_matrix_1", "camera_matrix_2"))
_DISTORTIONS = (("D1", "D2"), ("distCoeffs1", "distCoeffs2"), ("dist_coeffs_1", "dist_coeffs_2"))
_MAX_COEFFICIENTS = 14


def read_projections(store: dict[str, Any], path: Path) -> RectifiedPair:
    """Convert P1 and P2 to a rectified pair.

    Args:
        store: Contents of the file.
        path: The file, for messages.

    Raises:
        RequestError: A matrix is missing or malformed, or the image size or unit is invalid.
    """
    matrices = []
    for name, side in (("P1", "left"), ("P2", "right")):
        if store.get(name) is None:
            raise RequestError(f"{path} has no projection matrix of the {side} camera ({name}): rectify the pair first")
        matrix = parse_array(store[name], 12)
        if matrix is None:
            raise RequestError(f"{path}: {name} of the {side} camera must be 3 x 4 numbers")
        matrices.append(matrix.reshape(3, 4))
    return RectifiedPair(matrices[0], matrices[1], read_size(store, path), _unit(store, path))


def read_raw(store: dict[str, Any], path: Path) -> UnrectifiedPair | None:
    """Return the unrectified cameras; None unless there are two camera matrices, R and T. Distortions may be missing.

    Args:
        store: Contents of the file.
        path: The file, for messages.

    Raises:
        RequestError: The image size or unit is invalid.
    """
    matrices = [parse_array(store.get(name), 9) for name in _present(store, _MATRICES)]
    distortions = [_coefficients(store.get(name)) for name in _present(store, _DISTORTIONS)]
    rotation, translation = parse_array(store.get("R"), 9), parse_array(store.get("T"), 3)
    if len(matrices) < 2 or matrices[0] is None or matrices[1] is None or rotation is None or translation is None:
        return None
    width = max([coefficients.size for coefficients in distortions], default=0)
    padded = np.zeros((2, width))
    for row, coefficients in zip(padded, distortions):
        row[: coefficients.size] = coefficients
    both = np.stack([matrices[0], matrices[1]]).reshape(2, 3, 3)
    size, unit = read_size(store, path), _unit(store, path)
    return UnrectifiedPair(both, padded, False, rotation.reshape(3, 3), translation, size, unit, "OpenCV")


def _present(store: dict[str, Any], pairs: tuple[tuple[str, str], ...]) -> tuple[str, ...]:
    return next((names for names in pairs if all(store.get(name) is not None for name in names)), ())


def _coefficients(value: Any) -> np.ndarray:
    data = value.get("data") if isinstance(value, dict) else value
    for count in (4, 5, 8, 12, _MAX_COEFFICIENTS):
        values = parse_array(data, count)
        if values is not None:
            return values
    return np.zeros(0)


def _unit(store: dict[str, Any], path: Path) -> Unit | None:
    stated_unit = store.get("unit")
    if stated_unit is None:
        return None
    for unit in get_args(Unit):
        if stated_unit == unit:
            return unit
    unit_read = reprlib.repr(stated_unit) if isinstance(stated_unit, str) else "something that is not text"
    raise RequestError(f"{path}: unit must be m, cm or mm, not {unit_read}")
