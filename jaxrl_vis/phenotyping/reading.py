"""Reading the two images of a pair, and why some cannot be used."""

import numpy as np

from jaxrl_vis.phenotyping.folders import PairFiles
from jaxrl_vis.phenotyping.images import read_image
from jaxrl_vis_envs.plants import Calibration


class Unusable(Exception):
    """A pair that cannot be used. The message says why."""


def read_pair(pair: PairFiles, calibration: Calibration | None) -> tuple[np.ndarray, np.ndarray]:
    """Both images of a pair, [H, W, 3] uint8.

    Args:
        pair: Its files.
        calibration: For which it must be; None if nothing is known of the cameras.

    Raises:
        Unusable: They are not a pair of images that can be used.
    """
    images = []
    for side, path in (("left", pair.left), ("right", pair.right)):
        if path is None:
            raise Unusable(f"there is no {side} image")
        try:
            image = read_image(path)
        except OSError as error:
            raise Unusable(f"{path.name}: {error.strerror or 'it is not an image, or only a part of one'}") from error
        image = (image >> 8).astype(np.uint8) if image.dtype == np.uint16 else image
        images.append(np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image)
    left, right = images
    if left.shape != right.shape:
        sizes = [f"{image.shape[1]} x {image.shape[0]}" for image in images]
        raise Unusable(f"the left image has {sizes[0]} pixels and the right one {sizes[1]}")
    if calibration is not None and left.shape[:2] != (calibration.height, calibration.width):
        wanted = f"{calibration.width} x {calibration.height}"
        raise Unusable(f"the images have {left.shape[1]} x {left.shape[0]} pixels, but the calibration is for {wanted}")
    if min(int(left.max()), int(right.max())) < 8:
        raise Unusable(f"the {'left' if left.max() < 8 else 'right'} image is black")
    return left, right
