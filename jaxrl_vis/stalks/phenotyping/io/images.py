"""Reading and writing of images with 8 or 16 bits per channel, and of disparities."""

from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from jaxrl_vis.host.files import replacing
from jaxrl_vis.stalks.phenotyping.io.image_headers import PNG, read_header_size, strip_png
from jaxrl_vis.stalks.phenotyping.io.orientation import read_orientation, upright

ImageFormat = Literal["png", "tiff", "jpeg"]
SUFFIX: dict[str, str] = {"png": ".png", "tiff": ".tiff", "jpeg": ".jpg"}
_OPTIONS: dict[str, list[int]] = {
    ".png": [cv2.IMWRITE_PNG_COMPRESSION, 1],
    ".tiff": [],
    ".jpg": [cv2.IMWRITE_JPEG_QUALITY, 95],
}
MAX_PIXELS = 100_000_000
"""Maximum number of pixels of images that are read."""
_MAX_BYTES, _MAX_BESIDES = 16, 1 << 26  # of a file: per pixel, and for metadata


def write_image(path: Path, image: np.ndarray) -> None:
    """Write an image atomically.

    Args:
        path: The file; its suffix (.png, .tiff or .jpg) selects the format.
        image: [H, W, 3] (RGB) or [H, W], uint8 or uint16.

    Raises:
        OSError: The image cannot be encoded or written.
    """
    suffix = path.suffix.lower()
    ordered = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    encoded, data = cv2.imencode(suffix, ordered, _OPTIONS[suffix])
    if not encoded:
        raise OSError(f"{path}: the image could not be encoded")
    with replacing(path, durable=False) as file:
        file.write(data.tobytes())


def image_size(path: Path) -> tuple[int, int]:
    """Return the height and width of an image as returned by `read_image`, from its header, without decoding it.

    Raises:
        OSError: The file cannot be read, is not an image, or is too large. The message is one line that names the file.
    """
    size, orientation = _header(path)
    return (size[1], size[0]) if orientation > 4 else size


def _header(path: Path) -> tuple[tuple[int, int], int]:
    """Return the stored height and width of an image, and its EXIF orientation (1 to 8); raises as `image_size` does."""
    if not path.is_file():
        path.stat()
        raise _unreadable(path, "is not a regular file")
    with path.open("rb") as file:
        size = read_header_size(file)
        file.seek(0)
        orientation = read_orientation(file)
    if size is None:
        raise _unreadable(path, "is not an image, or only a part of one")
    pixels = size[0] * size[1]
    if pixels > MAX_PIXELS:
        raise _unreadable(path, f"has {size[1]} x {size[0]} pixels, more than {MAX_PIXELS // 10**6} million")
    if path.stat().st_size > _MAX_BESIDES + _MAX_BYTES * pixels:
        raise _unreadable(path, f"is larger than {size[1]} x {size[0]} pixels can be")
    return size, orientation


def read_image(path: Path) -> np.ndarray:
    """Read an image as [H, W, 3] (RGB) or [H, W], uint8 or uint16, rotated by its EXIF orientation; alpha is dropped.

    Raises:
        OSError: The file cannot be read, is not a complete image, has more than `MAX_PIXELS` pixels, or has another pixel type.
            The message is one line that names the file.
    """
    image = _decode(path)
    if image is None:
        raise _unreadable(path, "is not an image, or only a part of one")
    if image.dtype not in (np.uint8, np.uint16):
        # The value range of other types is undefined.
        raise _unreadable(path, f"holds {image.dtype} pixels: save it with 8 or 16 bits")
    if image.ndim == 2:
        return image
    return cv2.cvtColor(image[..., :3], cv2.COLOR_BGR2RGB)  # OpenCV's decoders return 1, 3 or 4 channels


def to_rgb8(image: np.ndarray) -> np.ndarray:
    """Convert an image from `read_image` to RGB [H, W, 3] uint8.

    Cameras with 10, 12 or 14 bits write 16-bit files with the upper bits zero: the bit depth is taken to be the lowest of
    these that holds all values.
    """
    if image.dtype == np.uint16:
        bits = next(bits for bits in (10, 12, 14, 16) if int(image.max()) < 1 << bits)
        image = (image >> (bits - 8)).astype(np.uint8)
    return np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image


def read_disparity(path: Path, scale: float = 256.0) -> np.ndarray:
    """Read disparities from a file of one channel: PFM, floating-point TIFF, or PNG or TIFF with 16 bits or more.

    Args:
        path: The file. Non-finite values and values up to 0 mark missing disparities.
        scale: Divisor of integer values: 256 in KITTI's files, 64 in those of ``phenotype synth``.

    Returns:
        [H, W] float32, pixels; NaN where missing.

    Raises:
        OSError: The file cannot be read, or holds no disparities. The message is one line that names the file.
    """
    image = _decode(path)
    if image is None or image.ndim != 2 or image.dtype.itemsize == 1:
        raise OSError(f"{path} holds no disparities: name a PFM, or a TIFF or PNG of 16 bits or more and one channel")
    values = image.astype(np.float32) / (1.0 if image.dtype.kind == "f" else scale)
    return np.where(np.isfinite(values) & (values > 0), values, np.nan)


def _decode(path: Path) -> np.ndarray | None:
    """Decode an image to [H, W] or [H, W, channels] (BGR order) of any dtype; return None if OpenCV cannot decode it.

    Raises:
        OSError: The file cannot be read, is not an image, or is too large.
    """
    size, orientation = _header(path)
    data: bytes | None = path.read_bytes()
    if data.startswith(PNG):
        data = strip_png(data)
    if not data:
        return None
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None
    if image is None:
        return None
    if data[:2] in (b"II", b"MM"):  # OpenCV always applies the orientation of TIFF itself
        size, orientation = image_size(path), 1
    return upright(image, orientation) if image.shape[:2] == size else None


def _unreadable(path: Path, reason: str) -> OSError:
    """Return an error whose message names the file and whose ``strerror`` does not, like errors of the operating system."""
    error = OSError(f"{path} {reason}")
    error.strerror = f"it {reason}"
    return error
