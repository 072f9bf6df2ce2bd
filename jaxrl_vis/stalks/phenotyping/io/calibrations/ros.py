"""Calibrations of ROS 1 and 2: one file per camera, from the calibrators or a printed camera_info message.

camera_calibration, image_pipeline   left.yaml and right.yaml: image_width, image_height, projection_matrix
the same in the older format         ost.txt, left.ini and right.ini: one section per camera name
rostopic echo, ros2 topic echo       width, height, P or p, binning and region of interest, one or more messages
rostopic echo -p                     a table with columns field.width, ..., field.P0, ...
ros2 topic echo --csv                rows without column names
print() of a message in Python       CameraInfo(header=..., p=array([...]), ...)
"""

import csv
import io
import re
from pathlib import Path
from typing import Any

import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.stalks.phenotyping.io.calibrations.cameras import RectifiedPair, Size, parse_array, parse_numbers, read_size

_MATRIX_NAMES = ("projection_matrix", "P", "p")
_SIDES = (("left", "right"), ("LEFT", "RIGHT"), ("Left", "Right"), ("cam0", "cam1"))
"""Keys of the two cameras in files that hold both."""
_HEADER = re.compile(r"^header:", re.MULTILINE)
_PRINTED = re.compile(r"CameraInfo\(.*?\bheight=(\d{1,9}), ?width=(\d{1,9})", re.DOTALL)
_PRINTED_MATRIX = re.compile(r"\bp=array\(\[([^\]]*)\]")
_PRINTED_NUMBER = re.compile(r"\b(binning_x|binning_y|x_offset|y_offset|height|width)=(\d{1,9})")
_REGION = ("x_offset", "y_offset", "height", "width")
_CSV_END = ("binning_x", "binning_y", *_REGION, "do_rectify")


def read_pair(stores: list[dict[str, Any]], files: list[Path], path: Path) -> RectifiedPair:
    """Combine two cameras into a rectified pair.

    Args:
        stores: Contents of the left and the right camera's file.
        files: The two files, for messages.
        path: File or folder of the pair, for messages.

    Raises:
        RequestError: A camera has no valid projection matrix, or the image sizes differ.
    """
    sides = ("left", "right")
    (left, size), (right, other) = (_camera(store, file, side) for store, file, side in zip(stores, files, sides))
    if size is not None and other is not None and size != other:
        raise RequestError(f"{path}: the left image has {_format_size(size)} pixels and the right one {_format_size(other)}")
    return RectifiedPair(left, right, size or other, "m" if any("header" in store for store in stores) else None)


def strip_preamble(text: str) -> str:
    """Return a text without everything that programs print before the first message (``header:``)."""
    match = _HEADER.search(text)
    return text if match is None else text[match.start() :]


def is_camera(store: dict[str, Any]) -> bool:
    """Return True if the contents of a file are those of one ROS camera."""
    return any(store.get(name) is not None for name in _MATRIX_NAMES)


def split_pair(store: dict[str, Any]) -> list[dict[str, Any]] | None:
    """Return both cameras of a file with a table for each, or with ``LEFT.P`` and ``RIGHT.P`` as in ORB-SLAM; else None."""
    for left, right in _SIDES:
        cameras = [store.get(left), store.get(right)]
        if not all(isinstance(camera, dict) for camera in cameras):
            cameras = [_lines_with_prefix(store, f"{name}.") for name in (left, right)]
        tables = [camera for camera in cameras if isinstance(camera, dict) and is_camera(camera)]
        if len(tables) == 2:
            return tables
    return None


def _lines_with_prefix(store: dict[str, Any], prefix: str) -> dict[str, Any]:
    return {name.removeprefix(prefix): value for name, value in store.items() if name.startswith(prefix)}


def parse_printed(text: str) -> dict[str, Any] | None:
    """Parse a message printed by Python; return None if the text is not one.

    Raises:
        ValueError: Its matrix holds something other than finite numbers.
    """
    size, matrix = _PRINTED.search(text), _PRINTED_MATRIX.search(text)
    if size is None or matrix is None:
        return None
    region: dict[str, float] = {}
    binning: dict[str, float] = {}
    for name, value in _PRINTED_NUMBER.findall(text[matrix.end() :]):
        (binning if name.startswith("binning") else region).setdefault(name, float(value))
    info = {"header": {}, "height": float(size[1]), "width": float(size[2]), "p": parse_numbers(matrix[1])}
    return {**info, **binning, "roi": region}


def parse_csv(text: str) -> dict[str, Any] | None:
    """Parse a message printed as CSV, with column names (ROS 1) or without (ROS 2); return None if the text is not one.

    Raises:
        ValueError: A cell is not a number.
    """
    lines = [line for line in text[:200_000].splitlines() if line.strip()]
    try:
        rows = list(csv.reader(io.StringIO("\n".join(lines[:2]))))
    except csv.Error:
        return None
    if len(rows) == 2 and "field.P0" in rows[0]:
        cells = dict(zip(rows[0], rows[1]))
        matrix = [float(cells[f"field.P{index}"]) for index in range(12) if f"field.P{index}" in cells]
        rest = {name: float(cells[f"field.{name}"]) for name in ("height", "width", *_CSV_END[:2]) if f"field.{name}" in cells}
        region = {name: float(cells[f"field.roi.{name}"]) for name in _REGION if f"field.roi.{name}" in cells}
        return {"header": {}, **rest, "P": matrix, "roi": region}
    # sec, nsec, frame, height, width, model, d, k [9], r [9], p [12], binning, region
    if rows and len(rows[0]) >= 6 + 30 + len(_CSV_END) and rows[0][-1].strip().lower() in ("true", "false", "0", "1"):
        row, end = rows[0], len(rows[0]) - len(_CSV_END)
        tail = dict(zip(_CSV_END[:-1], map(float, row[end:-1])))
        region = {name: tail[name] for name in _REGION}
        matrix = [float(cell) for cell in row[end - 12 : end]]
        return {"header": {}, "height": float(row[3]), "width": float(row[4]), "p": matrix, **tail, "roi": region} | {
            "height": float(row[3]),
            "width": float(row[4]),
        }
    return None


def parse_ini(text: str) -> list[dict[str, Any]] | None:
    """Parse the cameras of a file in the calibrator's older format (oST); return None if the text is not one.

    Raises:
        ValueError: A size or matrix holds something other than finite numbers.
    """
    if not re.search(r"^\[image\]", text, re.MULTILINE):
        return None
    sections: list[tuple[str, dict[str, str]]] = []
    name = ""
    for line in (line.strip() for line in text.splitlines()):
        if line.startswith("["):
            sections.append((line.strip("[]"), {}))
            name = ""
        elif sections and line and not line.startswith("#"):
            if re.fullmatch(r"[a-z][a-z _]*", line):
                name = line
            elif name:
                sections[-1][1][name] = f"{sections[-1][1].get(name, '')} {line}"
    size: dict[str, Any] = {}
    cameras = []
    for title, values in sections:
        if title == "image":
            size = {f"image_{side}": (parse_numbers(values.get(side, "")) or [None])[0] for side in ("width", "height")}
        elif "projection" in values:
            cameras.append({**size, "camera_name": title, "projection_matrix": parse_numbers(values["projection"])})
    return cameras


def _camera(store: dict[str, Any], path: Path, side: str) -> tuple[np.ndarray, Size | None]:
    """Return a camera's projection matrix [3, 4] and image size (None if not stated) after cropping to its ROI and binning.

    Args:
        store: Contents of the camera's file.
        path: The file, for messages.
        side: ``left`` or ``right``, for messages.

    Raises:
        RequestError: The matrix is missing, malformed or all zero, or a size is invalid.
    """
    name = next((name for name in _MATRIX_NAMES if store.get(name) is not None), None)
    if name is None:
        raise RequestError(
            f"{path} has no projection matrix of the {side} camera ({' or '.join(_MATRIX_NAMES)}): rectify the pair first"
        )
    matrix = parse_array(store[name], 12)
    if matrix is None:
        raise RequestError(f"{path}: {name} of the {side} camera must be 3 x 4 numbers")
    matrix = matrix.reshape(3, 4)
    if not matrix.any():
        raise RequestError(f"{path} is of a camera that was never calibrated (its {name} is all 0): calibrate the pair")
    size = read_size(store, path)
    if size is None:
        return matrix, None
    roi = store.get("roi")
    region = roi if isinstance(roi, dict) else {}
    x, y, high, wide = (_integer_field(region.get(name), path, f"roi.{name}") for name in _REGION)
    if high and wide:
        matrix[:2, 2] -= (x, y)
        size = (wide, high)
    steps = [max(_integer_field(store.get(f"binning_{axis}"), path, f"binning_{axis}"), 1) for axis in "xy"]
    matrix[0] /= steps[0]
    matrix[1] /= steps[1]
    return matrix, (max(size[0] // steps[0], 1), max(size[1] // steps[1], 1))


def _integer_field(value: Any, path: Path, name: str) -> int:
    if value is None:
        return 0
    if not isinstance(value, float) or not value.is_integer() or not 0 <= value <= 100_000:
        raise RequestError(f"{path}: {name} must be a number of pixels")
    return int(value)


def _format_size(size: Size) -> str:
    return f"{size[0]} x {size[1]}"
