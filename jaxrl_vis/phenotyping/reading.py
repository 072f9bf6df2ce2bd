"""Reading the two images of a pair and what is known of their disparities, and why some cannot be used."""

from typing import Literal

import numpy as np

from jaxrl_vis.phenotyping.folders import PairFiles
from jaxrl_vis.phenotyping.images import read_disparity, read_image, rgb8
from jaxrl_vis_envs.plants import Calibration


class Unusable(Exception):
    """A pair that cannot be used. The message says why."""


def read_pair(pair: PairFiles, calibration: Calibration | None, right_needed: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Both images of a pair, [H, W, 3] uint8.

    Args:
        pair: Its files.
        calibration: For which it must be; None if nothing is known of the cameras.
        right_needed: If not, the left image stands in for a right one that is missing.

    Raises:
        Unusable: They are not a pair of images that can be used.
    """
    left = read_side(pair, "left")
    right = left if pair.right is None and not right_needed else read_side(pair, "right")
    if left.shape != right.shape:
        raise Unusable(f"the left image has {_size(left)} pixels and the right one {_size(right)}")
    if calibration is not None and left.shape[:2] != (calibration.height, calibration.width):
        wanted = f"{calibration.width} x {calibration.height}"
        raise Unusable(f"the images have {_size(left)} pixels, but the calibration is for {wanted}")
    if min(int(left.max()), int(right.max())) < 8:
        raise Unusable(f"the {'left' if left.max() < 8 else 'right'} image is black")
    return left, right


def read_side(pair: PairFiles, side: Literal["left", "right"]) -> np.ndarray:
    """One image of a pair, [H, W, 3] uint8.

    Raises:
        Unusable: It cannot be used.
    """
    path = pair.left if side == "left" else pair.right
    if path is None:
        raise Unusable(f"there is no {side} image")
    try:
        return rgb8(read_image(path))
    except OSError as error:
        raise Unusable(f"{path.name}: {error.strerror or 'it is not an image, or only a part of one'}") from error


def known_disparity(pair: PairFiles, left: np.ndarray, scale: float) -> np.ndarray | None:
    """Disparities of the left image [H, W, 3] that somebody computed, [H, W] float32 in pixels; None if there is no such file.

    Args:
        pair: Its files.
        left: Its left image.
        scale: What numbers of 16 bits are divided by.

    Raises:
        Unusable: They cannot be read, or are those of another image.
    """
    if pair.disparity is None:
        return None
    try:
        disparity = read_disparity(pair.disparity, scale)
    except OSError as error:
        raise Unusable(f"{pair.disparity.name}: {error.strerror or 'it holds no disparities'}") from error
    if disparity.shape != left.shape[:2]:
        raise Unusable(f"the left image has {_size(left)} pixels and its disparities {_size(disparity)}")
    return disparity


def _size(image: np.ndarray) -> str:
    return f"{image.shape[1]} x {image.shape[0]}"
