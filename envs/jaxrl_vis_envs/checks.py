"""Validation of configuration values. Errors are one line: the field, its allowed values and its value. Imports no JAX."""

import dataclasses
import math
import numbers
from collections.abc import Iterable, Sequence
from typing import Any


@dataclasses.dataclass(frozen=True)
class CheckedConfig:
    """Configuration that validates itself on construction. A subclass with fields extends `__post_init__`."""

    def __post_init__(self) -> None:
        """Check the fields of this class; subclasses call ``super().__post_init__()`` first.

        Raises:
            ValueError: A value has the wrong type or is out of range.
        """


def integers(config: Any, *fields: str, minimum: int = 1) -> None:
    """Check that fields are integers of at least ``minimum``; raise ValueError otherwise."""
    for field in fields:
        value = getattr(config, field)
        if isinstance(value, bool) or not isinstance(value, numbers.Integral) or value < minimum:
            raise ValueError(f"{field} must be a whole number of at least {minimum}, got {value!r}")


def positive(config: Any, *fields: str) -> None:
    """Check that fields are finite numbers above 0; raise ValueError otherwise."""
    for field in fields:
        value = getattr(config, field)
        if not is_finite(value) or value <= 0:
            raise ValueError(f"{field} must be a finite number above 0, got {value!r}")


def not_negative(config: Any, *fields: str) -> None:
    """Check that fields are finite numbers of at least 0; raise ValueError otherwise."""
    for field in fields:
        value = getattr(config, field)
        if not is_finite(value) or value < 0:
            raise ValueError(f"{field} must be a finite number of at least 0, got {value!r}")


def boolean(config: Any, *fields: str) -> None:
    """Check that fields are bools; raise ValueError otherwise."""
    for field in fields:
        value = getattr(config, field)
        if not isinstance(value, bool):
            raise ValueError(f"{field} must be True or False, got {value!r}")


def choice(config: Any, field: str, choices: Iterable[str]) -> None:
    """Check that a field is among ``choices``; raise ValueError otherwise."""
    value, choices = getattr(config, field), tuple(choices)
    if value not in choices:
        raise ValueError(f"{field} must be one of {', '.join(choices)}, got {value!r}")


def vector(config: Any, field: str, size: int) -> Sequence[float]:
    """Check that a field is a sequence of ``size`` finite numbers, and return it; raise ValueError otherwise."""
    value = getattr(config, field)
    if not isinstance(value, Sequence) or len(value) != size or not all(map(is_finite, value)):
        raise ValueError(f"{field} must be {size} finite numbers, got {value!r}")
    return value


def is_finite(value: Any) -> bool:
    """Return True if ``value`` is a real, finite number and not a bool."""
    return isinstance(value, numbers.Real) and not isinstance(value, bool) and math.isfinite(value)
