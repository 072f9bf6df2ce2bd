"""Names of files as text, and texts as names of files.

Systems keep names as bytes. Where these are no UTF-8 (as of files that an old archive held), or where the system's language is
not set, Python gives lone surrogates, which can be neither printed nor written, and which OpenCV does not survive.
"""

import os
import unicodedata
from pathlib import Path

from jaxrl_vis.errors import RequestError

_UNPRINTABLE = ("Cc", "Cs", "Zl", "Zp")  # control characters, surrogates, ends of lines and paragraphs
_LONGEST = 200  # bytes; systems allow 255, of which what is added to it needs some


def readable(name: str) -> str:
    """A file's name as text that can be printed, in one line: as UTF-8, or else as Latin-1."""
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
    """The name of a file that is called so, whatever the system's language."""
    return os.fsdecode(text.encode("utf-8", "replace"))


def check_length(path: Path) -> None:
    """Raise a `RequestError` where a file's name is so long that files that are called after it cannot be written."""
    name = readable(path.name)
    length = len(name.encode())
    if length > _LONGEST:
        short = f"{name[:24]}...{name[-12:]}"
        raise RequestError(
            f"{readable(str(path.parent))} holds {short}, whose name has {length} bytes: rename it, to {_LONGEST} at most"
        )
