"""Calibrations of a pair of rectified cameras, read from the files of OpenCV and ROS, and written for OpenCV.

    OpenCV YAML or XML      P1 and P2 as cv2.stereoRectify returns them; image_width and image_height
    ROS camera_info YAML    a folder with left.yaml and right.yaml, or either of them beside the other

Millimetres of stalk come from the focal length and the baseline, so a file without them is refused rather than guessed. The one
thing that files do not say is the unit of the baseline: metres in ROS, and in OpenCV whatever the chessboard was measured in.
"""

import dataclasses
import math
import reprlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.files import write_atomically
from jaxrl_vis.stalks.phenotyping.io.file_storage import parse_storage
from jaxrl_vis.stalks.phenotyping.io.units import METRES, baseline_in_metres
from jaxrl_vis_envs.documents import read_text
from jaxrl_vis_envs.plants import Calibration

_SIDES = ("left", "right")
_NO_STORAGE = "it is neither YAML nor XML as OpenCV and ROS write it"
_MAX_BYTES = 2_000_000  # of a file
_MAX_PIXELS = 100_000  # along a side of an image


def read_calibration(path: Path, unit: str | None = None) -> Calibration:
    """Read a calibration.

    Args:
        path: A file of OpenCV or of ROS, or a folder that holds left.yaml and right.yaml.
        unit: Unit of the baseline, see `in_metres`; None for what the file says (its key ``unit``), and else metres.

    Raises:
        RequestError: There is no such file, it does not describe a pair of rectified cameras, or its baseline cannot be in that
            unit.
    """
    if path.is_dir():
        files = [_beside(path / "left.yaml", side) for side in _SIDES]
    elif _storage(path).get("P2") is None:
        files = [_beside(path, side) for side in _SIDES]
    else:
        files = [path]
    stores = [_storage(file) for file in files]
    matrices, sizes = [], []
    for place, side in enumerate(_SIDES):
        store = stores[min(place, len(stores) - 1)]
        names = (f"P{place + 1}",) if len(stores) == 1 else ("projection_matrix", "P", "p")
        matrices.append(_matrix(store, names, files[min(place, len(files) - 1)], side))
        sizes.append(_size(store, files[min(place, len(files) - 1)]))
    if sizes[0] != sizes[1]:
        raise RequestError(f"{path}: the left image has {_times(sizes[0])} pixels and the right one {_times(sizes[1])}")
    said = stores[0].get("unit")
    if said is not None and (not isinstance(said, str) or said not in METRES):
        unit_read = reprlib.repr(said) if isinstance(said, str) else "something that is no text"
        raise RequestError(f"{path}: unit must be m, cm or mm, not {unit_read}")
    return _checked(path, matrices[0], matrices[1], sizes[0], unit or said or "m")


def find_calibration(folder: Path) -> Path | None:
    """Return the file of the calibration in a folder of images; None where there is none."""
    own = [folder / name for name in ("calibration.yaml", "calibration.yml", "calibration.xml")]
    return next((path for path in own if path.exists()), None)


def check_size(calibration: Calibration, width: int, height: int, name: str) -> None:
    """Check that an image is of the size that was calibrated.

    Raises:
        RequestError: It is not.
    """
    if (width, height) != (calibration.width, calibration.height):
        wanted = _times((calibration.width, calibration.height))
        raise RequestError(f"{name} has {_times((width, height))} pixels, but the calibration is for {wanted}")


def write_calibration(path: Path, calibration: Calibration) -> None:
    """Write a calibration as OpenCV YAML: P1, P2 and Q, with the baseline in metres.

    Raises:
        OSError: The file cannot be written.
    """
    f, (x, y), baseline = calibration.focal, calibration.centre, calibration.baseline
    left = np.array([[f, 0, x, 0], [0, f, y, 0], [0, 0, 1, 0]], float)
    right = left + np.array([[0, 0, -calibration.offset, -f * baseline], [0] * 4, [0] * 4], float)
    q = np.array([[1, 0, 0, -x], [0, 1, 0, -y], [0, 0, 0, f], [0, 0, 1 / baseline, -calibration.offset / baseline]], float)
    store = cv2.FileStorage(".yaml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    store.write("image_width", calibration.width)
    store.write("image_height", calibration.height)
    store.write("unit", "m")
    for name, matrix in (("P1", left), ("P2", right), ("Q", q)):
        store.write(name, matrix)
    write_atomically(path, store.releaseAndGetString())


def _beside(path: Path, side: str) -> Path:
    """The file of one side: ``path``, with the other side's name in it replaced."""
    other = _SIDES[1 - _SIDES.index(side)]
    if side in path.stem:
        file = path
    elif other in path.stem:
        file = path.with_stem(path.stem.replace(other, side))
    else:
        raise RequestError(
            f"{path} holds neither P1 and P2 of OpenCV nor one side of a ROS camera_info (left.yaml and right.yaml): "
            "calibrate the pair, and rectify its images"
        )
    if not file.is_file():
        raise RequestError(f"there is no calibration {file}: name a file of OpenCV, or a folder with left.yaml and right.yaml")
    return file


def _storage(path: Path) -> dict[str, Any]:
    """Contents of the file, by name."""
    try:
        store = parse_storage(read_text(path, _MAX_BYTES))
    except OSError as error:
        raise RequestError(f"there is no calibration {path}: {error.strerror or error}") from error
    except ValueError as error:
        why = " ".join(str(error).split())
        raise RequestError(
            f"{path} is not a calibration: it is neither YAML nor XML as OpenCV and ROS write it ({why})"
        ) from error
    if isinstance(store, list):
        raise RequestError(f"{path} is not a calibration: it holds a list, not names with values such as P1 and P2")
    if not isinstance(store, dict):
        raise RequestError(f"{path} is not a calibration: {_NO_STORAGE}")
    return store


def _matrix(store: dict[str, Any], names: tuple[str, ...], path: Path, side: str) -> np.ndarray:
    """The projection matrix [3, 4] under the first of the names that is there."""
    value = next((store[name] for name in names if store.get(name) is not None), None)
    if value is None:
        raise RequestError(
            f"{path} has no projection matrix of the {side} camera ({' or '.join(names)}): rectify the pair first"
        )
    data = value.get("data") if isinstance(value, dict) else value
    rows = data if isinstance(data, list) else []
    numbers = [number for row in rows for number in row] if rows and all(isinstance(row, list) for row in rows) else rows
    if len(numbers) != 12 or not all(isinstance(number, float) and math.isfinite(number) for number in numbers):
        raise RequestError(f"{path}: {names[0]} of the {side} camera must be 3 x 4 numbers")
    return np.array(numbers).reshape(3, 4)


def _size(store: dict[str, Any], path: Path) -> tuple[int, int]:
    """Width and height of the images that were calibrated, pixels."""
    both = store.get("image_size")
    for names in (("image_width", "image_height"), ("width", "height")):
        values = [store.get(name) for name in names]
        if None not in values:
            return _whole(values, path, " and ".join(names))
    if isinstance(both, list) and len(both) == 2:
        return _whole(both, path, "image_size")
    raise RequestError(f"{path} does not say for which images it is: add image_width and image_height")


def _whole(values: list[Any], path: Path, names: str) -> tuple[int, int]:
    if not all(isinstance(value, float) and 1 <= value <= _MAX_PIXELS and value.is_integer() for value in values):
        raise RequestError(f"{path}: {names} must be numbers of pixels, without quotation marks")
    return int(values[0]), int(values[1])


def _checked(path: Path, left: np.ndarray, right: np.ndarray, size: tuple[int, int], unit: str) -> Calibration:
    width, height = size
    focal = float(left[0, 0])
    if width < 1 or height < 1 or not 0.1 * width < focal < 50 * width:
        raise RequestError(f"{path}: a focal length of {focal:g} pixels does not suit an image of {_times(size)} pixels")
    if not math.isclose(focal, float(right[0, 0]), rel_tol=1e-6) or not math.isclose(left[1, 2], right[1, 2], abs_tol=1e-3):
        raise RequestError(
            f"{path}: the cameras differ in focal length or in lines, so they are not rectified: rectify the pair"
        )
    if not math.isclose(left[1, 3], right[1, 3], abs_tol=1e-3 * focal):
        raise RequestError(f"{path} has its cameras above each other: turn the pair, so that they stand side by side")
    # Each camera's last column is its place along the baseline; OpenCV puts the left one at 0.
    length = float(left[0, 3] - right[0, 3]) / focal
    if abs(length) < 1e-9:
        raise RequestError(
            f"{path} has a baseline of 0, as of two cameras that were calibrated apart: calibrate them as a pair"
        )
    if length < 0.0:
        raise RequestError(f"{path} has its cameras swapped (baseline {length:g}): the first one must be the left one")
    baseline = baseline_in_metres(path, length, unit)
    centre = (float(left[0, 2]), float(left[1, 2]))
    calibration = Calibration(width, height, focal, centre, baseline, float(left[0, 2] - right[0, 2]))
    return dataclasses.replace(calibration, offset=0.0) if abs(calibration.offset) < 1e-9 else calibration


def _times(size: tuple[int, int]) -> str:
    return f"{size[0]} x {size[1]}"
