"""Calibrations of Intel RealSense cameras: the table that the viewer and the calibration tool export as JSON, in millimetres.

The camera outputs rectified infrared images. The table holds their common focal length and principal point for each image size.
"""

import math
from pathlib import Path
from typing import Any

from jaxrl_vis.errors import RequestError
from jaxrl_vis.stalks.phenotyping.io.calibrations.cameras import RectifiedPair, Size, check_image_size, projection_matrix

_MODES = 64


def is_calibration_table(store: dict[str, Any]) -> bool:
    """Return True if parsed JSON is a RealSense calibration table."""
    return "baseline" in store and any(name.startswith(("rectified.", "intrinsic_left.")) for name in store)


def read_table(store: dict[str, Any], path: Path, size: Size | None) -> RectifiedPair:
    """Convert the entry of the infrared pair for one image size.

    Args:
        store: Contents of the file.
        path: The file, for messages.
        size: Width and height of the images; may be None if the table holds only one size.

    Raises:
        RequestError: The size is not in the table, or a value is missing or invalid.
    """
    modes: dict[Size, tuple[float, float, float]] = {}
    for mode in range(_MODES):
        values = [_number(store.get(f"rectified.{mode}.{name}")) for name in ("width", "height", "fx", "ppx", "ppy")]
        if None not in values and all(value and value > 0 for value in values[:3]):
            wide, high, focal, x, y = (value or 0.0 for value in values)
            modes.setdefault(check_image_size([wide, high], path, f"width and height of rectified.{mode}"), (focal, x, y))
    if not modes:
        raise RequestError(
            f"{path} is of a RealSense camera, but holds no rectified.0.fx and so on: export the whole calibration table"
        )
    if size not in modes and not (size is None and len(modes) == 1):
        there = ", ".join(f"{wide} x {high}" for wide, high in modes)
        your_images = "your images" if size is None else f"images of {size[0]} x {size[1]}"
        raise RequestError(f"{path} is of a RealSense camera, for {there}: it does not say which of them is for {your_images}")
    size = size or next(iter(modes))
    focal, x, y = modes[size]
    baseline = _number(store["baseline"])
    if baseline is None:
        raise RequestError(f"{path} is of a RealSense camera, but its baseline is not a number")
    return RectifiedPair(projection_matrix(focal, x, y), projection_matrix(focal, x, y, -focal * abs(baseline)), size, "mm")


def _number(value: Any) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError):
        return None
    return number if math.isfinite(number) else None
