"""Digests that tell apart what results were computed from: weights, families of plants, calibrations."""

import hashlib
import json
from pathlib import Path
from typing import Any

_DIGITS = 12


def file_digest(path: Path) -> str:
    """Return 12 hexadecimal digits of the SHA-256 digest of a file's contents.

    Raises:
        OSError: The file cannot be read.
    """
    return hashlib.sha256(path.read_bytes()).hexdigest()[:_DIGITS]


def value_digest(value: Any) -> str:
    """Return 12 hexadecimal digits of the SHA-256 digest of a value that JSON can hold; the order of keys does not matter."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:_DIGITS]
