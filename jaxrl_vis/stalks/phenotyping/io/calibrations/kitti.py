"""Calibrations of KITTI: calib.txt of the odometry and object data, and calib_cam_to_cam.txt of the raw data, in metres.

Cameras 0 and 1 are the greyscale pair, 2 and 3 the colour pair; image folders are named by camera (image_2, image_02).
"""

import re
from pathlib import Path

import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.stalks.phenotyping.io.calibrations.cameras import RectifiedPair, Size, check_image_size, parse_numbers

# Two or more numbers without brackets: a list in brackets or a single number is YAML.
_LINE = re.compile(r"^(P|P_rect_0|S_rect_0)([0-3]):[ \t]*([-+.\d]\S*[ \t]+\S.*)$", re.MULTILINE)
_FOLDER = re.compile(r"image_?0?([0-3])$")


def is_kitti(text: str) -> bool:
    """Return True if a text is a KITTI calibration."""
    return any(name != "S_rect_0" for name, _, _ in _LINE.findall(text))


def read_kitti(text: str, path: Path, image: Path | None) -> RectifiedPair:
    """Parse the rectified pair that belongs to the images.

    Args:
        text: Contents of the file.
        path: The file, for messages.
        image: A left image, whose parent folders identify its pair; None if unknown.

    Raises:
        RequestError: The pair is missing or ambiguous, or a matrix or size is invalid.
    """
    matrices: dict[int, np.ndarray] = {}
    sizes: dict[int, Size] = {}
    for name, number, rest in _LINE.findall(text):
        try:
            values = parse_numbers(rest)
        except ValueError as error:
            raise RequestError(f"{path}: {name}{number} holds something that is not a number") from error
        if name == "S_rect_0":
            sizes[int(number)] = check_image_size((values + [0.0, 0.0])[:2], path, f"{name}{number}")
        elif len(values) != 12:
            raise RequestError(f"{path}: {name}{number} must be 3 x 4 numbers")
        else:
            matrices[int(number)] = np.reshape(values, (3, 4))
    pairs = [left for left in (0, 2) if left in matrices and left + 1 in matrices]
    named = [match for part in (image.parts[:-1] if image else ()) if (match := _FOLDER.search(part))]
    if named:
        left = int(named[-1][1]) // 2 * 2
        pairs = [left] if left in pairs else []
    if len(pairs) != 1:
        raise RequestError(
            f"{path} is of KITTI and holds {'P0, P1 and P2, P3' if pairs else 'no such pair'}: put the images into image_0 and "
            "image_1, or image_2 and image_3, or leave only the two lines that are theirs"
        )
    left = pairs[0]
    return RectifiedPair(matrices[left], matrices[left + 1], sizes.get(left), "m")
