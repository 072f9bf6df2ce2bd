"""Checks of configuration values, each with one line that names the field, what it may be and what it was. Loads no JAX."""

import dataclasses
import math
import numbers
from collections.abc import Iterable, Sequence
from typing import Any


@dataclasses.dataclass(frozen=True)
class CheckedConfig:
    """A configuration that refuses bad values when it is made. A subclass with fields extends `__post_init__`."""

    def __post_init__(self) -> None:
        """Checks the fields of this class, and those of its bases by `super`.

        Raises:
            ValueError: A value is of the wrong type or out of range.
        """


def whole(config: Any, *fields: str, least: int = 1) -> None:
    """Refuses anything but whole numbers of at least ``least``."""
    for field in fields:
        value = getattr(config, field)
        if isinstance(value, bool) or not isinstance(value, numbers.Integral) or value < least:
            raise ValueError(f"{field} must be a whole number of at least {least}, got {value!r}")


def positive(config: Any, *fields: str) -> None:
    """Refuses anything but finite numbers above 0."""
    for field in fields:
        value = getattr(config, field)
        if not is_finite(value) or value <= 0:
            raise ValueError(f"{field} must be a finite number above 0, got {value!r}")


def not_negative(config: Any, *fields: str) -> None:
    """Refuses anything but finite numbers of at least 0."""
    for field in fields:
        value = getattr(config, field)
        if not is_finite(value) or value < 0:
            raise ValueError(f"{field} must be a finite number of at least 0, got {value!r}")


def true_or_false(config: Any, *fields: str) -> None:
    """Refuses anything but True and False."""
    for field in fields:
        value = getattr(config, field)
        if not isinstance(value, bool):
            raise ValueError(f"{field} must be True or False, got {value!r}")


def one_of(config: Any, field: str, choices: Iterable[str]) -> None:
    """Refuses what is not among ``choices``."""
    value, choices = getattr(config, field), tuple(choices)
    if value not in choices:
        raise ValueError(f"{field} must be one of {', '.join(choices)}, got {value!r}")


def vector(config: Any, field: str, size: int) -> Sequence[float]:
    """Refuses anything but ``size`` finite numbers, which it returns."""
    value = getattr(config, field)
    if not isinstance(value, Sequence) or len(value) != size or not all(map(is_finite, value)):
        raise ValueError(f"{field} must be {size} finite numbers, got {value!r}")
    return value


def is_finite(value: Any) -> bool:
    """Whether it is a real number, neither infinite nor NaN; True and False are none."""
    return isinstance(value, numbers.Real) and not isinstance(value, bool) and math.isfinite(value)
