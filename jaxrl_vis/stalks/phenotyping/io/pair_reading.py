"""Reading the two images of a pair and what is known of their disparities, and why some cannot be used."""

from collections.abc import Callable
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np

from jaxrl_vis.stalks.phenotyping.io.folders import PairFiles
from jaxrl_vis.stalks.phenotyping.io.images import image_size, read_disparity, read_image, rgb8
from jaxrl_vis.stalks.phenotyping.io.names import readable
from jaxrl_vis_envs.plants import Calibration

Side = Literal["left", "right"]
T = TypeVar("T")


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
    sides: tuple[Side, ...] = ("left",) if pair.right is None and not right_needed else ("left", "right")
    # Before anything is decoded: a small file may hold more pixels than there is memory for.
    sizes = [_of_side(pair, side, image_size) for side in sides]
    if sizes[0] != sizes[-1]:
        raise Unusable(f"the left image has {_size(sizes[0])} pixels and the right one {_size(sizes[-1])}")
    if calibration is not None and sizes[0] != (calibration.height, calibration.width):
        wanted = f"{calibration.width} x {calibration.height}"
        raise Unusable(f"the images have {_size(sizes[0])} pixels, but the calibration is for {wanted}")
    images = [read_side(pair, side) for side in sides]
    left, right = images[0], images[-1]
    if left.shape != right.shape:  # replaced meanwhile
        raise Unusable(f"the left image has {_size(left.shape)} pixels and the right one {_size(right.shape)}")
    if min(int(left.max()), int(right.max())) < 8:
        raise Unusable(f"the {'left' if left.max() < 8 else 'right'} image is black")
    return left, right


def read_side(pair: PairFiles, side: Side) -> np.ndarray:
    """One image of a pair, [H, W, 3] uint8.

    Raises:
        Unusable: It cannot be used.
    """
    return rgb8(_of_side(pair, side, read_image))


def _of_side(pair: PairFiles, side: Side, read: Callable[[Path], T]) -> T:
    """Result of ``read`` for one image of a pair.

    Raises:
        Unusable: There is none, or it cannot be used.
    """
    path = pair.left if side == "left" else pair.right
    if path is None:
        raise Unusable(f"there is no {side} image")
    try:
        return read(path)
    except OSError as error:
        raise Unusable(f"{readable(path.name)}: {error.strerror or 'it is not an image, or only a part of one'}") from error


def known_disparity(pair: PairFiles, left: np.ndarray, scale: float) -> np.ndarray | None:
    """Disparities of the left image [H, W, 3] that somebody computed, [H, W] float32 in pixels; None if there is no such file.

    Args:
        pair: Its files.
        left: Its left image.
        scale: Divisor of numbers of 16 bits.

    Raises:
        Unusable: They cannot be read, or are those of another image.
    """
    if pair.disparity is None:
        return None
    try:
        size = image_size(pair.disparity)
        if size == left.shape[:2]:
            return read_disparity(pair.disparity, scale)
    except OSError as error:
        raise Unusable(f"{readable(pair.disparity.name)}: {error.strerror or 'it holds no disparities'}") from error
    raise Unusable(f"the left image has {_size(left.shape)} pixels and its disparities {_size(size)}")


def _size(shape: tuple[int, ...]) -> str:
    return f"{shape[1]} x {shape[0]}"
