"""EXIF orientation of images: 1 is upright, 3 upside down, 6 and 8 rotated by 90 degrees.

Viewers and annotation programs apply the orientation, so it is applied here. Calibrations are for images as read by OpenCV,
which applies it, too.
"""

from typing import BinaryIO

import numpy as np
from PIL import Image

from jaxrl_vis.stalks.phenotyping.io.image_headers import PNG

_TAG = 0x0112
_EXIF = b"Exif\0\0"
_ALONE = {0x01, *range(0xD0, 0xD9)}  # JPEG markers without a length


def read_orientation(file: BinaryIO) -> int:
    """Read the EXIF orientation, 1 to 8, of a JPEG, PNG or TIFF image; 1 if it is missing or invalid.

    Args:
        file: Seekable file, at its beginning.
    """
    begin = file.read(8)
    file.seek(0)
    if begin.startswith(b"\xff\xd8"):
        data = _jpeg_exif(file)
    elif begin.startswith(PNG):
        data = _png_exif(file)
    else:
        data = file.read() if begin[:4] in (b"II*\0", b"MM\0*") else b""
    exif = Image.Exif()
    try:
        exif.load(data)
        value = exif.get(_TAG, 1)
    except Exception:  # Pillow's readers raise SyntaxError, struct.error, KeyError, OverflowError and more
        return 1
    return value if isinstance(value, int) and 1 <= value <= 8 else 1


def upright(image: np.ndarray, orientation: int) -> np.ndarray:
    """Undo an EXIF orientation: rotate and flip an image [H, W, ...] to upright, as a contiguous copy if necessary."""
    if orientation > 4:
        image = np.swapaxes(image, 0, 1)
    if orientation in (3, 4, 7, 8):
        image = image[::-1]
    if orientation in (2, 3, 6, 7):
        image = image[:, ::-1]
    return np.ascontiguousarray(image)


def _jpeg_exif(file: BinaryIO) -> bytes:
    """Return the EXIF data of a JPEG; empty if there are none before its pixels."""
    file.seek(2)
    while len(head := file.read(4)) == 4 and head[0] == 0xFF and head[1] not in (0xD9, 0xDA):
        if head[1] in _ALONE or head[1] == 0xFF:
            file.seek(-3 if head[1] == 0xFF else -2, 1)
            continue
        length = int.from_bytes(head[2:4], "big") - 2
        if head[1] == 0xE1 and (data := file.read(length)).startswith(_EXIF):
            return data
        if head[1] != 0xE1:
            file.seek(length, 1)
    return b""


def _png_exif(file: BinaryIO) -> bytes:
    """Return the EXIF data of a PNG; empty if there are none."""
    file.seek(len(PNG))
    while len(head := file.read(8)) == 8 and head[4:] != b"IEND":
        length = int.from_bytes(head[:4], "big")
        if head[4:] == b"eXIf":
            return _EXIF + file.read(length)
        file.seek(length + 4, 1)
    return b""
