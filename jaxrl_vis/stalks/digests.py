"""Digests that identify the inputs of results: weights, families of plants, calibrations."""

import hashlib
import json
from pathlib import Path
from typing import Any

_DIGITS = 12


def file_digest(path: Path) -> str:
    """Compute the first 12 hexadecimal digits of the SHA-256 digest of a file's contents.

    Raises:
        OSError: The file cannot be read.
    """
    return hashlib.sha256(path.read_bytes()).hexdigest()[:_DIGITS]


def value_digest(value: Any) -> str:
    """Compute the first 12 hexadecimal digits of the SHA-256 digest of a JSON-serialisable value, independent of key order."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:_DIGITS]
