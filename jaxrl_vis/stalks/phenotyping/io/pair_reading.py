"""Reading and validation of the images of a stereo pair and of precomputed disparities."""

import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np

from jaxrl_vis.stalks.phenotyping.io.folders import PairFiles
from jaxrl_vis.stalks.phenotyping.io.images import image_size, read_disparity, read_image, to_rgb8
from jaxrl_vis.stalks.phenotyping.io.names import readable
from jaxrl_vis_envs.plants import Calibration

Side = Literal["left", "right"]
T = TypeVar("T")


class UnusablePairError(Exception):
    """Raised for a pair that cannot be used; the message states the reason."""


def read_pair(pair: PairFiles, calibration: Calibration | None, right_needed: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Read the left and right image of a pair, RGB [H, W, 3] uint8.

    Args:
        pair: Files of the pair.
        calibration: Calibration whose size the images must have; None to accept any size.
        right_needed: If false and the pair has no right image, the left one is returned in both places.

    Raises:
        UnusablePairError: An image is missing, unreadable or black, or the sizes do not match.
    """
    sides: tuple[Side, ...] = ("left",) if pair.right is None and not right_needed else ("left", "right")
    # Checked before decoding: a small file may hold more pixels than fit into memory.
    sizes = [_read_side_file(pair, side, image_size) for side in sides]
    if sizes[0] != sizes[-1]:
        raise UnusablePairError(
            f"the left image has {_format_size(sizes[0])} pixels and the right one {_format_size(sizes[-1])}"
        )
    if calibration is not None and sizes[0] != (calibration.height, calibration.width):
        wanted = f"{calibration.width} x {calibration.height}"
        raise UnusablePairError(f"the images have {_format_size(sizes[0])} pixels, but the calibration is for {wanted}")
    with ThreadPoolExecutor() as threads:
        images = list(threads.map(functools.partial(read_side, pair), sides))
    left, right = images[0], images[-1]
    if left.shape != right.shape:  # the file was replaced in the meantime
        raise UnusablePairError(
            f"the left image has {_format_size(left.shape)} pixels and the right one {_format_size(right.shape)}"
        )
    if min(int(left.max()), int(right.max())) < 8:
        raise UnusablePairError(f"the {'left' if left.max() < 8 else 'right'} image is black")
    return left, right


def read_side(pair: PairFiles, side: Side) -> np.ndarray:
    """Read one image of a pair, RGB [H, W, 3] uint8.

    Raises:
        UnusablePairError: It is missing or unreadable.
    """
    return to_rgb8(_read_side_file(pair, side, read_image))


def _read_side_file(pair: PairFiles, side: Side, read: Callable[[Path], T]) -> T:
    """Return the result of ``read`` for the file of one image of a pair.

    Raises:
        UnusablePairError: There is no file, or ``read`` raises an `OSError`.
    """
    path = pair.left if side == "left" else pair.right
    if path is None:
        raise UnusablePairError(f"there is no {side} image")
    try:
        return read(path)
    except OSError as error:
        raise UnusablePairError(
            f"{readable(path.name)}: {error.strerror or 'it is not an image, or only a part of one'}"
        ) from error


def read_known_disparity(pair: PairFiles, left: np.ndarray, scale: float) -> np.ndarray | None:
    """Read precomputed disparities of the left image, [H, W] float32 in pixels, NaN where missing; None if there is no file.

    Args:
        pair: Files of the pair.
        left: Left image, [H, W, 3].
        scale: Divisor of integer values, see `read_disparity`.

    Raises:
        UnusablePairError: The file cannot be read, or its size is not that of the image.
    """
    if pair.disparity is None:
        return None
    try:
        size = image_size(pair.disparity)
        if size == left.shape[:2]:
            return read_disparity(pair.disparity, scale)
    except OSError as error:
        raise UnusablePairError(f"{readable(pair.disparity.name)}: {error.strerror or 'it holds no disparities'}") from error
    raise UnusablePairError(f"the left image has {_format_size(left.shape)} pixels and its disparities {_format_size(size)}")


def _format_size(shape: tuple[int, ...]) -> str:
    return f"{shape[1]} x {shape[0]}"
