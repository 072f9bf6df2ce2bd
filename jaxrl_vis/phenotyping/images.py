"""Reading and writing images of any bit depth that cameras deliver."""

from pathlib import Path
from typing import Literal

import cv2
import numpy as np

ImageFormat = Literal["png", "tiff", "jpeg"]
SUFFIX: dict[str, str] = {"png": ".png", "tiff": ".tiff", "jpeg": ".jpg"}
_OPTIONS: dict[str, list[int]] = {
    ".png": [cv2.IMWRITE_PNG_COMPRESSION, 1],
    ".tiff": [],
    ".jpg": [cv2.IMWRITE_JPEG_QUALITY, 95],
}


def write_image(path: Path, image: np.ndarray) -> None:
    """Writes an image: [H, W, 3] or [H, W], uint8 or uint16; the suffix says how. Nobody sees half of it.

    Raises:
        OSError: It cannot be written.
    """
    suffix = path.suffix.lower()
    ordered = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    encoded, data = cv2.imencode(suffix, ordered, _OPTIONS[suffix])
    if not encoded:
        raise OSError(f"{path}: the image could not be encoded")
    temporary = path.with_name(path.name + ".tmp")
    temporary.write_bytes(data.tobytes())
    temporary.replace(path)


def read_image(path: Path) -> np.ndarray:
    """An image as [H, W, 3] or [H, W], uint8 or uint16.

    Raises:
        OSError: It cannot be read, or is no whole image. One line that names it.
    """
    data = np.fromfile(path, np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    if image is None:
        raise OSError(f"{path} is not an image, or only a part of one")
    return image if image.ndim == 2 else cv2.cvtColor(image[..., :3], cv2.COLOR_BGR2RGB)
