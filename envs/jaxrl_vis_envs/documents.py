"""Texts that somebody else wrote, read so that none of them can exhaust the memory, the stack or anyone's patience."""

import json
import os
import stat
import tomllib
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

MOST_BYTES = 100_000_000
"""Of a file of text, where nothing less is said."""
MOST_LEVELS = 100
"""Of lists and tables within each other: what goes deeper was made to do harm, or by mistake."""
_MOST_DOTS = 200  # in a line of TOML, whose keys of n parts take the time of n * n


def read_bytes(path: Path, most: int = MOST_BYTES) -> bytes:
    """The contents of a file of at most ``most`` bytes.

    Raises:
        OSError: It cannot be read, or is no ordinary file.
        ValueError: It is larger. The message goes on where the file's name ends.
    """
    # Opened without waiting, as a pipe that nobody writes to would never open.
    with open(os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)), "rb") as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            error = OSError(f"{path} is no ordinary file")
            error.strerror = "it is no ordinary file"
            raise error
        data = file.read(most + 1)
    if len(data) > most:
        raise ValueError(f"is larger than {most / 1e6:g} MB")
    return data


def read_text(path: Path, most: int = MOST_BYTES) -> str:
    """A file of at most ``most`` bytes of UTF-8, without the mark of byte order that editors of Windows begin with.

    Raises:
        OSError: It cannot be read, or is no ordinary file.
        ValueError: It is larger, or no text. The message goes on where the file's name ends.
    """
    try:
        return read_bytes(path, most).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError("is no text in UTF-8") from error


def read_json(path: Path, most: int = MOST_BYTES) -> Any:
    """Read a JSON file of at most ``most`` bytes.

    Raises:
        OSError: It cannot be read, or is no ordinary file.
        ValueError: It is larger, not JSON, or goes deeper than `MOST_LEVELS`.
    """
    return parse_json(read_text(path, most))


def parse_json(text: str | bytes) -> Any:
    """Parse a text of JSON.

    Raises:
        ValueError: It is not JSON, or goes deeper than `MOST_LEVELS`.
    """
    return _shallow(json.loads, text)


def parse_toml(text: str) -> dict[str, Any]:
    """Parse a text of TOML.

    Raises:
        ValueError: It is not TOML, or goes deeper than `MOST_LEVELS`.
    """
    if any(line.count(".") > _MOST_DOTS for line in text.splitlines()):
        raise ValueError(f"more than {_MOST_DOTS} points in a line")
    return _shallow(tomllib.loads, text)


def _shallow(parse: Any, text: Any) -> Any:
    try:
        value = parse(text)
    except RecursionError as error:
        raise ValueError(f"nested more than {MOST_LEVELS} levels deep") from error
    level = [value]
    for _ in range(MOST_LEVELS + 1):
        level = [
            part
            for whole in level
            if isinstance(whole, dict | list)
            for part in (whole.values() if isinstance(whole, dict) else whole)
            if isinstance(part, dict | list)
        ]
        if not level:
            return value
    raise ValueError(f"nested more than {MOST_LEVELS} levels deep")


def parse_xml(text: str | bytes) -> ElementTree.Element:
    """The root of a document of XML.

    Raises:
        ValueError: It is not XML, goes deeper than `MOST_LEVELS`, or declares a document type, as those with entities do.
    """
    parser = ElementTree.XMLParser(target=_Builder())
    try:
        parser.feed(text)
        return parser.close()
    except (ElementTree.ParseError, LookupError, RecursionError) as error:  # no XML, or in an encoding that nobody knows
        raise ValueError(f"no XML: {error}") from error


class _Builder(ElementTree.TreeBuilder):
    """Builds what `parse_xml` allows."""

    def __init__(self) -> None:
        super().__init__()
        self._levels = 0

    def start(self, tag: Any, attrs: dict[Any, Any], /) -> ElementTree.Element:
        """Refuses what is too deep."""
        self._levels += 1
        if self._levels > MOST_LEVELS:
            raise ValueError(f"nested more than {MOST_LEVELS} levels deep")
        return super().start(tag, attrs)

    def end(self, tag: str, /) -> ElementTree.Element:
        """Comes back from a level."""
        self._levels -= 1
        return super().end(tag)

    def doctype(self, name: str, pubid: str, system: str) -> None:
        """Refuses a document type."""
        raise ValueError(f"declares a document type ({name})")
