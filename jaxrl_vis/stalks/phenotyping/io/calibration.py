"""Calibrations of rectified stereo cameras: read in the formats of many programs, written in that of OpenCV.

    OpenCV       P1 and P2 as returned by cv2.stereoRectify, in YAML, XML or JSON; extrinsics.yml of its sample stereo_calib
    ROS 1 and 2  one file per camera (left.yaml and right.yaml, cam0.yaml and cam1.yaml), from the calibrators or as printed
                 camera_info messages
    others       RealSense's calibration table, calib.txt of Middlebury and of KITTI; kalibr and ZED if the cameras need no
                 rectification

Stalk diameters in millimetres depend on the focal length and the baseline, so a file without them is rejected rather than
completed by guesses. Files do not state the unit of the baseline: metres in ROS, and in OpenCV that of the chessboard.
"""

import dataclasses
import math
from pathlib import Path

import cv2
import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.files import write_atomically
from jaxrl_vis.stalks.phenotyping.io.calibrations.cameras import Size, UnrectifiedPair
from jaxrl_vis.stalks.phenotyping.io.calibrations.recognize import (
    calibration_files,
    find_pair_file,
    find_side_files,
    read_cameras,
)
from jaxrl_vis.stalks.phenotyping.io.images import image_size
from jaxrl_vis.stalks.phenotyping.io.names import readable
from jaxrl_vis.stalks.phenotyping.io.units import baseline_in_metres
from jaxrl_vis_envs.plants import Calibration

_OFF_CENTRE = 0.25  # of an image's side: maximum distance of the principal point from the image centre
_DOWN = 0.02  # of the baseline: maximum vertical offset between the cameras; 0.008 in KITTI's colour pair


def read_calibration(path: Path, unit: str | None = None, image: Path | None = None) -> Calibration:
    """Read a calibration.

    Args:
        path: A file of any of these programs, or a folder that holds one for both cameras or one for each.
        unit: Unit of the baseline, see `units.baseline_in_metres`; None for the unit that the file states or its program uses,
            by default metres.
        image: A left image of the cameras, whose size is used if the file covers several sizes or states none.

    Raises:
        RequestError: There is no such file, it does not describe a pair of rectified cameras, its image size is unknown, or its
            baseline is implausible in that unit.
    """
    cameras = read_cameras(path, image)
    pair = cameras.to_rectified() if isinstance(cameras, UnrectifiedPair) else cameras
    if pair is None:
        raise RequestError(
            f"{path} is of {cameras.program} and says how the cameras were built, not how their images were rectified: rectify "
            "them with cv2.stereoRectify, and name the P1 and P2 that it returns"
        )
    size = pair.size or _size_by_image(path, pair.left, image)
    return _check_pair(path, pair.left, pair.right, size, unit or pair.unit or "m")


def _size_by_image(path: Path, left: np.ndarray, image: Path | None) -> Size:
    """Return the width and height of an image, for a calibration that does not state the image size.

    Args:
        path: File of the calibration, for messages.
        left: Projection matrix [3, 4] of the left camera.
        image: A left image, if one is known.

    Raises:
        RequestError: There is no readable image, or its centre is far from the principal point: it was cropped or resized.
    """
    if image is None:
        raise RequestError(f"{path} does not say for which images it is: add image_width and image_height")
    try:
        height, width = image_size(image)
    except OSError as error:
        raise RequestError(
            f"{path} does not say for which images it is, and {error}: add image_width and image_height"
        ) from error
    if max(abs(left[0, 2] / width - 0.5), abs(left[1, 2] / height - 0.5)) > _OFF_CENTRE:
        raise RequestError(
            f"{path} does not say for which images it is, and its principal point ({left[0, 2]:g}, {left[1, 2]:g}) is far from "
            f"the middle of {readable(image.name)}, {width} x {height}: add image_width and image_height, as it was calibrated"
        )
    return width, height


def find_calibration(folder: Path) -> Path | None:
    """Return the calibration file in a folder of images, or that of the left camera; None if there is none."""
    files = calibration_files(folder)
    named = find_pair_file(files)
    if named is not None:
        return named
    sides = (find_side_files(file) for file in files if file.suffix.lower() in (".yaml", ".yml", ".ini"))
    return next((left for left, _ in filter(None, sides)), None)


def check_size(calibration: Calibration, width: int, height: int, name: str) -> None:
    """Check that an image has the size of the calibration.

    Args:
        calibration: The calibration.
        width, height: Size of the image, pixels.
        name: Name of the image, for messages.

    Raises:
        RequestError: The sizes differ.
    """
    if (width, height) != (calibration.width, calibration.height):
        wanted = _format_size((calibration.width, calibration.height))
        raise RequestError(f"{name} has {_format_size((width, height))} pixels, but the calibration is for {wanted}")


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


def _check_pair(path: Path, left: np.ndarray, right: np.ndarray, size: tuple[int, int], unit: str) -> Calibration:
    width, height = size
    focal = float(left[0, 0])
    if width < 1 or height < 1 or not 0.1 * width < focal < 50 * width:
        raise RequestError(f"{path}: a focal length of {focal:g} pixels does not suit an image of {_format_size(size)} pixels")
    if not math.isclose(focal, float(right[0, 0]), rel_tol=1e-6) or not math.isclose(left[1, 2], right[1, 2], abs_tol=1e-3):
        raise RequestError(
            f"{path}: the cameras differ in focal length or in lines, so they are not rectified: rectify the pair"
        )
    # The last column of a projection matrix is minus the camera's position times the focal length; OpenCV's left one is 0.
    across, down = (abs(float(left[row, 3] - right[row, 3])) for row in (0, 1))
    if down > _DOWN * across:
        raise RequestError(f"{path} has its cameras above each other: turn the pair, so that they stand side by side")
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


def _format_size(size: tuple[int, int]) -> str:
    return f"{size[0]} x {size[1]}"
