"""Size of the largest array that a compiled program stores between its operations, parsed from the program text.

`Compiled.memory_analysis` reports only the total size of these arrays.
"""

import math
import re
from typing import Any

import numpy as np

_HEAD = re.compile(r"(ENTRY )?%?([\w.\-]+) \(.*\{$")
_ARRAY = re.compile(r"\s+(ROOT )?%?[\w.\-]+ = (\w+)\[([\d,]*)\]\S* ([\w\-]+)\(")
# Operations that only refer to memory written by another operation or belonging to the program.
_NO_MEMORY = {"parameter", "get-tuple-element", "bitcast", "constant"}
_BITS = re.compile(r"[a-z]+(\d+)")


def largest_temporary(compiled: Any) -> int:
    """Return the bytes of the largest array that an operation writes and that is not a result of the program.

    Operations within a fusion write nothing. A result counts if it is copied from another array.

    Args:
        compiled: Program from ``jax.jit(...).lower(...).compile()``.
    """
    program = compiled.as_text()
    inner = set(re.findall(r"(?:calls|to_apply)=%?([\w.\-]+)", program))
    largest, entry, skip = 0, False, False
    for line in program.splitlines():
        if head := _HEAD.match(line):
            entry, skip = bool(head[1]), head[2] in inner
        elif not skip and (array := _ARRAY.match(line)) and array[4] not in _NO_MEMORY and not (entry and array[1]):
            largest = max(largest, math.prod(int(length) for length in array[3].split(",") if length) * _bytes(array[2]))
    return largest


def _bytes(dtype: str) -> int:
    """Return the number of bytes of a scalar, given XLA's name of its type."""
    bits = _BITS.match(dtype)
    return int(np.ceil(int(bits[1]) / 8)) if bits else 1
