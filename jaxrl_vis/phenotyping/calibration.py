"""What is known of a pair of rectified cameras, read from the files of OpenCV and ROS, and written for OpenCV.

    OpenCV YAML or XML      P1 and P2 as cv2.stereoRectify returns them; image_width and image_height
    ROS camera_info YAML    a folder with left.yaml and right.yaml, or either of them beside the other

Millimetres of stalk come from the focal length and the baseline, so a file without them is refused rather than guessed. The one
thing that files do not say is the unit of the baseline: metres in ROS, and in OpenCV whatever the chessboard was measured in.
"""

import dataclasses
import math
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.files import write_atomically
from jaxrl_vis_envs.plants import Calibration

Unit = Literal["m", "mm"]
_METRES: dict[str, float] = {"m": 1.0, "mm": 1e-3}
_BASELINES = (0.008, 2.0)  # m: of stereo pairs that look at plants from a robot
_SIDES = ("left", "right")


def read_calibration(path: Path, unit: Unit | None = None) -> Calibration:
    """Reads a calibration.

    Args:
        path: A file of OpenCV or of ROS, or a folder that holds left.yaml and right.yaml.
        unit: Of the baseline; None for what the file says (its key ``unit``), and else metres.

    Raises:
        RequestError: There is no such file, it does not describe a pair of rectified cameras, or its baseline cannot be in that
            unit.
    """
    if path.is_dir():
        files = [_beside(path / "left.yaml", side) for side in _SIDES]
    elif _storage(path).getNode("P2").empty():
        files = [_beside(path, side) for side in _SIDES]
    else:
        files = [path]
    stores = [_storage(file) for file in files]
    matrices, sizes = [], []
    for place, side in enumerate(_SIDES):
        store = stores[min(place, len(stores) - 1)]
        names = (f"P{place + 1}",) if len(stores) == 1 else ("projection_matrix", "P")
        matrices.append(_matrix(store, names, files[min(place, len(files) - 1)], side))
        sizes.append(_size(store, files[min(place, len(files) - 1)]))
    if sizes[0] != sizes[1]:
        raise RequestError(f"{path}: the left image has {_times(sizes[0])} pixels and the right one {_times(sizes[1])}")
    node = stores[0].getNode("unit")
    said = node.string()
    if (said or not node.empty()) and said not in _METRES:
        raise RequestError(f"{path}: unit must be m or mm, not {said or 'something that is no text'}")
    return _checked(path, matrices[0], matrices[1], sizes[0], unit or said or "m")


def check_size(calibration: Calibration, width: int, height: int, name: str) -> None:
    """Checks that an image is of the size that was calibrated.

    Raises:
        RequestError: It is not.
    """
    if (width, height) != (calibration.width, calibration.height):
        wanted = _times((calibration.width, calibration.height))
        raise RequestError(f"{name} has {_times((width, height))} pixels, but the calibration is for {wanted}")


def write_calibration(path: Path, calibration: Calibration) -> None:
    """Writes a calibration as OpenCV YAML: P1, P2 and Q, with the baseline in metres.

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
        found = path
    elif other in path.stem:
        found = path.with_stem(path.stem.replace(other, side))
    else:
        raise RequestError(
            f"{path} holds neither P1 and P2 of OpenCV nor one side of a ROS camera_info (left.yaml and right.yaml): "
            "calibrate the pair, and rectify its images"
        )
    if not found.is_file():
        raise RequestError(f"there is no calibration {found}: name a file of OpenCV, or a folder with left.yaml and right.yaml")
    return found


def _storage(path: Path) -> cv2.FileStorage:
    """The file, opened. ROS writes YAML without the line by which OpenCV knows its own."""
    try:
        text = path.read_text(encoding="utf-8-sig")  # editors of Windows begin a file with a mark that OpenCV does not know
    except OSError as error:
        raise RequestError(f"there is no calibration {path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise RequestError(f"{path} is not a calibration: it is no text") from error
    if not text.lstrip().startswith(("%YAML", "<?xml", "{")):
        text = "%YAML:1.0\n---\n" + text
    try:
        store = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        root = store.root()
    except (SystemError, cv2.error) as error:
        raise RequestError(f"{path} is not a calibration: it is neither YAML nor XML that OpenCV reads") from error
    if not root.empty() and not root.isMap():
        raise RequestError(f"{path} is not a calibration: it holds a list, not names with values such as P1 and P2")
    return store


def _matrix(store: cv2.FileStorage, names: tuple[str, ...], path: Path, side: str) -> np.ndarray:
    """The projection matrix [3, 4] under the first of the names that is there."""
    node = next((store.getNode(name) for name in names if not store.getNode(name).empty()), None)
    if node is None:
        raise RequestError(
            f"{path} has no projection matrix of the {side} camera ({' or '.join(names)}): rectify the pair first"
        )
    values = _numbers(node)
    if values is None or values.size != 12 or not np.isfinite(values).all():
        raise RequestError(f"{path}: {names[0]} of the {side} camera must be 3 x 4 numbers")
    return values.reshape(3, 4)


def _numbers(node: cv2.FileNode) -> np.ndarray | None:
    """The numbers [N] float64 of a list, or of a matrix of ROS or OpenCV; None where it is none of these.

    Not by ``node.mat()``: of a matrix without rows, or with text in its data, OpenCV writes where it must not, and the program
    ends.
    """
    data = node.getNode("data") if node.isMap() else node
    each = [data.at(place) for place in range(int(data.size()))] if data.isSeq() else []
    # Of a text, OpenCV gives the greatest number that there is.
    return np.array([one.real() for one in each], float) if all(one.isReal() or one.isInt() for one in each) else None


def _size(store: cv2.FileStorage, path: Path) -> tuple[int, int]:
    """Width and height of the images that were calibrated, pixels."""
    for names in (("image_width", "image_height"), ("width", "height")):
        nodes = [store.getNode(name) for name in names]
        if not any(node.empty() for node in nodes):
            return _whole(nodes, path, " and ".join(names))
    node = store.getNode("image_size")
    if not node.empty() and node.isSeq() and node.size() == 2:
        return _whole([node.at(0), node.at(1)], path, "image_size")
    raise RequestError(f"{path} does not say for which images it is: add image_width and image_height")


def _whole(nodes: list[cv2.FileNode], path: Path, names: str) -> tuple[int, int]:
    values = [node.real() if node.isReal() or node.isInt() else math.nan for node in nodes]
    if not all(math.isfinite(value) and value >= 1 for value in values):
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
    length = -float(right[0, 3]) / focal
    if length == 0.0:
        raise RequestError(
            f"{path} has a baseline of 0, as of two cameras that were calibrated apart: calibrate them as a pair"
        )
    if length < 0.0:
        raise RequestError(f"{path} has its cameras swapped (baseline {length:g}): the first one must be the left one")
    baseline = length * _METRES[unit]
    if not _BASELINES[0] <= baseline <= _BASELINES[1]:
        other = "mm" if unit == "m" else "m"
        fits = _BASELINES[0] <= length * _METRES[other] <= _BASELINES[1]
        mend = f": it seems to be in {other}, so say --calibration-unit {other}" if fits else ""
        raise RequestError(f"{path} has a baseline of {length:g} {unit}, which is no stereo pair's{mend}")
    centre = (float(left[0, 2]), float(left[1, 2]))
    calibration = Calibration(width, height, focal, centre, baseline, float(left[0, 2] - right[0, 2]))
    return dataclasses.replace(calibration, offset=0.0) if abs(calibration.offset) < 1e-9 else calibration


def _times(size: tuple[int, int]) -> str:
    return f"{size[0]} x {size[1]}"
