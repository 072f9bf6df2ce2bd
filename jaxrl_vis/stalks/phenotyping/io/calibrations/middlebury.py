"""Calibrations of the Middlebury stereo data sets (2014 and 2021): calib.txt, in millimetres."""

import re
from pathlib import Path

import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.stalks.phenotyping.io.calibrations.cameras import RectifiedPair, check_image_size, parse_numbers

_LINE = re.compile(r"^\s*([A-Za-z]\w*)\s*=\s*(.*?)\s*$", re.MULTILINE)


def is_middlebury(text: str) -> bool:
    """Return True if a text is a Middlebury calibration."""
    return re.search(r"^\s*cam0\s*=\s*\[", text, re.MULTILINE) is not None


def read_middlebury(text: str, path: Path) -> RectifiedPair:
    """Parse the rectified pair.

    Args:
        text: Contents of the file.
        path: The file, for messages.

    Raises:
        RequestError: A value is missing or invalid, or ``doffs`` contradicts the principal points.
    """
    values = dict(_LINE.findall(text))
    try:
        cameras = [np.reshape(parse_numbers(values[name].strip("[]").replace(";", " ")), (3, 3)) for name in ("cam0", "cam1")]
        baseline, doffs = float(values["baseline"]), float(values["doffs"])
        size = check_image_size([float(values["width"]), float(values["height"])], path, "width and height")
    except (KeyError, ValueError) as error:
        raise RequestError(
            f"{path} is a calib.txt of Middlebury, but cam0, cam1, doffs, baseline, width or height is missing or not a number"
        ) from error
    if not abs(cameras[1][0, 2] - cameras[0][0, 2] - doffs) < 0.5:
        raise RequestError(
            f"{path}: doffs is {doffs:g}, but the principal points of cam0 and cam1 say otherwise: mend one of them"
        )
    left, right = (np.pad(camera, ((0, 0), (0, 1))) for camera in cameras)
    right[0, 3] = -cameras[0][0, 0] * baseline
    return RectifiedPair(left, right, size, "mm")
