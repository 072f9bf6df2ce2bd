"""Image sizes from file headers, to check them before a decoder allocates memory."""

import re
from typing import BinaryIO

from PIL.TiffImagePlugin import ImageFileDirectory_v2

PNG = b"\x89PNG\r\n\x1a\n"
_CHUNKS = (b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND")
_PFM = re.compile(rb"P[Ff]\s+(\d{1,9})\s+(\d{1,9})\s")
_PNM = re.compile(rb"P[56](?:\s|#[^\n]*\n)+(\d{1,9})(?:\s|#[^\n]*\n)+(\d{1,9})\s")
_BITMAPS = (40, 52, 56, 64, 108, 124)  # bytes of a BMP's info header
_FRAMES = set(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # JPEG start-of-frame markers, followed by the size
_ALONE = {0x01, *range(0xD0, 0xD9)}  # JPEG markers without a length
_WIDTH, _HEIGHT, _TILE_WIDTH, _TILE_HEIGHT = 256, 257, 322, 323  # TIFF tags
_FINEST_TILES = 1024  # pixels, maximum side of tiles that exceed their image


def read_header_size(file: BinaryIO) -> tuple[int, int] | None:
    """Return the height and width of a PNG, JPEG, TIFF, BMP, PGM, PPM or PFM image; None if it is none of these, or damaged.

    Args:
        file: Seekable file, at its beginning.
    """
    begin = file.read(64)
    file.seek(0)
    if begin.startswith(PNG):
        sides = int.from_bytes(begin[20:24], "big"), int.from_bytes(begin[16:20], "big")
        return sides if begin[12:16] == b"IHDR" and min(sides) > 0 else None
    if begin.startswith(b"\xff\xd8"):
        return _jpeg_size(file.read())
    if begin[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        return _tiff_size(file)
    if begin.startswith(b"BM") and len(begin) >= 26 and int.from_bytes(begin[14:18], "little") in _BITMAPS:
        width, height = (int.from_bytes(begin[place : place + 4], "little", signed=True) for place in (18, 22))
        return (abs(height), width) if width > 0 and height else None  # height is negative for top-down rows
    match = _PFM.match(begin) or _PNM.match(begin)
    return (int(match[2]), int(match[1])) if match and int(match[1]) and int(match[2]) else None


def strip_png(data: bytes) -> bytes | None:
    """Strip a PNG of all chunks but those of its pixels and their colours; return None if it is damaged.

    OpenCV allocates as much memory as any chunk claims to need, and the other chunks are not needed here.
    """
    parts, place = [PNG], len(PNG)
    while place + 12 <= len(data):
        end = place + 12 + int.from_bytes(data[place : place + 4], "big")
        kind = data[place + 4 : place + 8]
        if end > len(data):
            return None
        if kind in _CHUNKS:
            parts.append(data[place:end])
        if kind == b"IEND":
            return b"".join(parts)
        place = end
    return None


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    place = 2
    while True:
        place = data.find(b"\xff", place)  # decoders skip garbage between markers
        while 0 <= place < len(data) - 1 and data[place + 1] == 0xFF:
            place += 1
        if place < 0 or place + 9 > len(data):
            return None
        marker, length = data[place + 1], int.from_bytes(data[place + 2 : place + 4], "big")
        if marker in _FRAMES:
            sides = int.from_bytes(data[place + 5 : place + 7], "big"), int.from_bytes(data[place + 7 : place + 9], "big")
            return sides if min(sides) > 0 else None
        if marker in (0xD9, 0xDA):  # end of image, or start of scan before a frame header
            return None
        place += 2 if marker in _ALONE or marker == 0 else 2 + length


def _tiff_size(file: BinaryIO) -> tuple[int, int] | None:
    """Return the size in the first directory; None if it is missing or malformed, or if tiles are far larger than the image."""
    try:
        head = file.read(8)
        directory = ImageFileDirectory_v2(head + (file.read(8) if head[2:4] in (b"+\0", b"\0+") else b""))
        file.seek(directory.next)
        directory.load(file)
        width, height = (int(directory[tag]) for tag in (_WIDTH, _HEIGHT))
        tiles = [int(directory.get(tag, 0)) for tag in (_TILE_WIDTH, _TILE_HEIGHT)]
    except Exception:  # Pillow's readers raise SyntaxError, struct.error, KeyError, OverflowError and more
        return None
    if min(width, height) < 1 or any(tile > max(side, _FINEST_TILES) for tile, side in zip(tiles, (width, height))):
        return None
    return height, width
