"""Conversion between file names and printable text.

File systems store names as bytes. If these are not UTF-8 (as from old archives), or if no locale is set, Python decodes them
with lone surrogates, which can be neither printed nor written, and which crash OpenCV.
"""

import os
import unicodedata
from pathlib import Path

from jaxrl_vis.errors import RequestError

_UNPRINTABLE = ("Cc", "Cs", "Zl", "Zp")  # control characters, surrogates, ends of lines and paragraphs
_MAX_LENGTH = 200  # bytes; file systems allow 255, and names derived from it are longer


def readable(name: str) -> str:
    """Return a file name as printable text on one line: as UTF-8, or else as Latin-1, with ``_`` for unprintable characters."""
    try:
        raw = name.encode("utf-8", "surrogateescape")
    except UnicodeEncodeError:
        raw = name.encode("utf-8", "replace")
    try:
        text = raw.decode()
    except UnicodeDecodeError:
        text = raw.decode("latin-1")
    return "".join("_" if unicodedata.category(letter) in _UNPRINTABLE else letter for letter in text)


def file_name(text: str) -> str:
    """Return the file name that a text is stored as in UTF-8, independent of the locale."""
    return os.fsdecode(text.encode("utf-8", "replace"))


def check_length(path: Path) -> None:
    """Raise a `RequestError` if a file name is so long that files named after it could not be written."""
    name = readable(path.name)
    length = len(name.encode())
    if length > _MAX_LENGTH:
        short = f"{name[:24]}...{name[-12:]}"
        raise RequestError(
            f"{readable(str(path.parent))} holds {short}, whose name has {length} bytes: rename it, to {_MAX_LENGTH} at most"
        )
