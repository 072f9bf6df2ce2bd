"""The size of the largest array that a compiled program keeps between its operations, read from the program itself.

The compiler's own figure (`Compiled.memory_analysis`) is the size of all of them together.
"""

import math
import re
from typing import Any

import numpy as np

_HEAD = re.compile(r"(ENTRY )?%?([\w.\-]+) \(.*\{$")
_ARRAY = re.compile(r"\s+(ROOT )?%?[\w.\-]+ = (\w+)\[([\d,]*)\]\S* ([\w\-]+)\(")
# These only name memory that something else has written, or that belongs to the program.
_NO_MEMORY = {"parameter", "get-tuple-element", "bitcast", "constant"}
_BITS = re.compile(r"[a-z]+(\d+)")


def largest_temporary(compiled: Any) -> int:
    """Bytes of the largest array that an operation of the program writes and that is not a result of the program.

    Operations within a fusion write nothing. A result counts where it is copied from another array.

    Args:
        compiled: From ``jax.jit(...).lower(...).compile()``.
    """
    program = compiled.as_text()
    inner = set(re.findall(r"(?:calls|to_apply)=%?([\w.\-]+)", program))
    largest, entry, skip = 0, False, False
    for line in program.splitlines():
        if head := _HEAD.match(line):
            entry, skip = bool(head[1]), head[2] in inner
        elif not skip and (found := _ARRAY.match(line)) and found[4] not in _NO_MEMORY and not (entry and found[1]):
            largest = max(largest, math.prod(int(length) for length in found[3].split(",") if length) * _bytes(found[2]))
    return largest


def _bytes(dtype: str) -> int:
    """The size of one number, given XLA's name for its type."""
    bits = _BITS.match(dtype)
    return int(np.ceil(int(bits[1]) / 8)) if bits else 1
