"""Readers of untrusted text files, with limits on size, nesting and parsing time."""

import json
import os
import stat
import tomllib
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

MAX_BYTES = 100_000_000
"""Default size limit of a text file."""
MAX_DEPTH = 100
"""Maximum nesting depth: deeper documents are malicious or broken."""
_MAX_DOTS = 200  # per line of TOML; parsing a dotted key of n parts takes O(n^2) time


def read_bytes(path: Path, max_bytes: int = MAX_BYTES) -> bytes:
    """Read a file of at most ``max_bytes`` bytes.

    Raises:
        OSError: The file cannot be read or is not a regular file.
        ValueError: It is larger. The message is a predicate, to be appended to the file's name.
    """
    # Opened without blocking: opening a pipe without a writer would never return.
    with open(os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)), "rb") as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            error = OSError(f"{path} is not a regular file")
            error.strerror = "it is not a regular file"
            raise error
        data = file.read(max_bytes + 1)
    if len(data) > max_bytes:
        raise ValueError(f"is larger than {max_bytes / 1e6:g} MB")
    return data


def read_text(path: Path, max_bytes: int = MAX_BYTES) -> str:
    """Read a UTF-8 file of at most ``max_bytes`` bytes; drop a byte order mark.

    Raises:
        OSError: The file cannot be read or is not a regular file.
        ValueError: It is larger or not UTF-8. The message is a predicate, to be appended to the file's name.
    """
    try:
        return read_bytes(path, max_bytes).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError("is not UTF-8 text") from error


def read_json(path: Path, max_bytes: int = MAX_BYTES) -> Any:
    """Read a JSON file of at most ``max_bytes`` bytes.

    Raises:
        OSError: The file cannot be read or is not a regular file.
        ValueError: It is larger, not UTF-8, not JSON, or nested deeper than `MAX_DEPTH`.
    """
    return parse_json(read_text(path, max_bytes))


def parse_json(text: str | bytes) -> Any:
    """Parse JSON.

    Raises:
        ValueError: It is not JSON, or nested deeper than `MAX_DEPTH`.
    """
    return _parse_with_max_depth(json.loads, text)


def parse_toml(text: str) -> dict[str, Any]:
    """Parse TOML.

    Raises:
        ValueError: It is not TOML, is nested deeper than `MAX_DEPTH`, or has a line with more than 200 dots.
    """
    if any(line.count(".") > _MAX_DOTS for line in text.splitlines()):
        raise ValueError(f"more than {_MAX_DOTS} dots in a line")
    return _parse_with_max_depth(tomllib.loads, text)


def _parse_with_max_depth(parse: Any, text: Any) -> Any:
    try:
        value = parse(text)
    except RecursionError as error:
        raise ValueError(f"nested more than {MAX_DEPTH} levels deep") from error
    level = [value]
    for _ in range(MAX_DEPTH + 1):
        level = [
            part
            for container in level
            if isinstance(container, dict | list)
            for part in (container.values() if isinstance(container, dict) else container)
            if isinstance(part, dict | list)
        ]
        if not level:
            return value
    raise ValueError(f"nested more than {MAX_DEPTH} levels deep")


def parse_xml(text: str | bytes) -> ElementTree.Element:
    """Parse XML and return the root element.

    Raises:
        ValueError: It is not XML, is nested deeper than `MAX_DEPTH`, or declares a document type, which entities require.
    """
    parser = ElementTree.XMLParser(target=_Builder())
    try:
        parser.feed(text)
        return parser.close()
    except (ElementTree.ParseError, LookupError, RecursionError) as error:  # not XML, or an unknown encoding
        raise ValueError(f"not XML: {error}") from error


class _Builder(ElementTree.TreeBuilder):
    """Tree builder that enforces the limits of `parse_xml`."""

    def __init__(self) -> None:
        super().__init__()
        self._levels = 0

    def start(self, tag: Any, attrs: dict[Any, Any], /) -> ElementTree.Element:
        """Open an element, or raise ValueError if it is nested too deep."""
        self._levels += 1
        if self._levels > MAX_DEPTH:
            raise ValueError(f"nested more than {MAX_DEPTH} levels deep")
        return super().start(tag, attrs)

    def end(self, tag: str, /) -> ElementTree.Element:
        """Close an element."""
        self._levels -= 1
        return super().end(tag)

    def doctype(self, name: str, pubid: str, system: str) -> None:
        """Reject a document type."""
        raise ValueError(f"declares a document type ({name})")
