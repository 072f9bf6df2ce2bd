"""Validation of dataclass fields against their annotations, for values read from JSON or from a command line.

Supported annotations are bool, int, float, str, Path, a Literal of strings, a str annotated with `Names`, any of these made
optional, and variable-length tuples of them. Numbers may be annotated with `Bounds`.
"""

import dataclasses
import functools
import itertools
import math
import numbers
import operator
import types
import typing
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn

from jaxrl_vis.errors import RequestError, nearest

_MAX_LENGTH = 200  # maximum number of characters of a value quoted in a message
_TRUTH = {"true": True, "false": False}
_KINDS = {bool: "true or false", int: "a whole number", float: "a finite number", str: "a word", Path: "a path"}


@dataclasses.dataclass(frozen=True)
class Names:
    """Annotation of a string that names a component: a built-in one, or ``module:Name``.

    Attributes:
        known: Names of the built-in components.
    """

    known: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class Bounds:
    """Range of a number, or of every number of a tuple.

    Attributes:
        low: Minimum value.
        high: Maximum value; None if unbounded.
        exclusive: Whether ``low`` itself is excluded.
    """

    low: float
    high: float | None = None
    exclusive: bool = False

    def check(self, label: str, value: Any) -> None:
        """Check a value; None is in range.

        Raises:
            RequestError: The value is out of range. The message begins with ``label``.
        """
        if isinstance(value, tuple):
            if any(self._refuses(item) for item in value):
                raise RequestError(f"{label} must all {self._rule(min(value))}, not {' '.join(map(str, value))}")
        elif value is not None and self._refuses(value):
            raise RequestError(f"{label} {self._must(value)}, not {value}")

    def _refuses(self, value: float) -> bool:
        is_low = value <= self.low if self.exclusive else value < self.low
        return is_low or (self.high is not None and value > self.high)

    def _must(self, value: float) -> str:
        if (self.low, self.high) == (0.0, 1.0):
            return "is a share and must lie in [0, 1]"
        return f"must {self._rule(value)}"

    def _rule(self, value: float) -> str:
        if self.high is not None and value > self.high:
            return f"be at most {self.high:g}" if isinstance(self.high, float) else f"be at most {self.high}"
        return "be positive" if self.exclusive and self.low == 0.0 else f"be at least {self.low:g}"


@dataclasses.dataclass(frozen=True)
class Field:
    """Field of a dataclass, or of a group of fields in it.

    Attributes:
        name: Name of the field.
        hint: Annotation without metadata other than `Names`, as accepted by `check` and `read`.
        extras: Metadata of `typing.Annotated`.
        default: Default value; `dataclasses.MISSING` if there is none.
        record: Dataclass that declares the field.
        group: Field of the outer dataclass that holds ``record``; empty for a field of the outer dataclass itself.
    """

    name: str
    hint: Any
    extras: tuple[Any, ...]
    default: Any
    record: type
    group: str = ""


def describe(record: type, group: str = "") -> list[Field]:
    """List the fields of a dataclass, with groups (fields that are dataclasses themselves) replaced by their fields.

    Keyword-only fields, such as those of a mixin, come last.
    """
    annotated = typing.get_type_hints(record, include_extras=True)
    described = []
    for field in sorted(dataclasses.fields(record), key=lambda field: bool(field.kw_only)):
        hint = annotated[field.name]
        if dataclasses.is_dataclass(hint) and isinstance(hint, type):
            described += describe(hint, field.name)
        else:
            described.append(Field(field.name, _plain(hint), _extras(hint), field.default, record, group))
    return described


def hints(record: type) -> dict[str, Any]:
    """Return annotations by field name, without `typing.Annotated` metadata other than `Names`; groups are flattened."""
    return {field.name: field.hint for field in describe(record)}


def _plain(hint: Any) -> Any:
    if typing.get_origin(hint) is Annotated:
        names = _names(hint)
        return Annotated[str, names] if names else _plain(typing.get_args(hint)[0])
    if typing.get_origin(hint) is tuple and typing.get_args(hint)[1:] == (...,):
        return tuple[_plain(typing.get_args(hint)[0]), ...]
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return functools.reduce(operator.or_, map(_plain, typing.get_args(hint)))
    return hint


def _extras(hint: Any) -> tuple[Any, ...]:
    """Collect the metadata of an annotation, including that of an optional value and of a tuple's items."""
    inner = typing.get_args(hint)[:1] if typing.get_origin(hint) is Annotated else typing.get_args(hint)
    if typing.get_origin(hint) is Literal:
        return ()
    nested = itertools.chain.from_iterable(_extras(part) for part in inner)
    return (*getattr(hint, "__metadata__", ()), *nested)


def check_bounds(field: Field, value: Any) -> None:
    """Check a value of the right type against its field's `Bounds`.

    Raises:
        RequestError: The value is out of range. The message names the field.
    """
    for extra in field.extras:
        if isinstance(extra, Bounds):
            extra.check(field.name, value)


def _names(hint: Any) -> Names | None:
    """Return the `Names` in the annotation of a single value; None if it has none."""
    return next((extra for extra in getattr(hint, "__metadata__", ()) if isinstance(extra, Names)), None)


def _is_own(name: Any) -> bool:
    """Return True if ``name`` is a string of the form ``module:Name``."""
    if not isinstance(name, str):
        return False
    module, colon, part = name.partition(":")
    return bool(colon) and all(word.isidentifier() for word in (*module.split("."), part))


def unwrap(hint: Any) -> tuple[Any, bool, bool]:
    """Unwrap optional and tuple annotations.

    Returns:
        The annotation of a single value, True if None is allowed, and True if the field holds several values.
    """
    optional = several = False
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        (hint,) = (part for part in typing.get_args(hint) if part is not types.NoneType)
        optional = True
    if typing.get_origin(hint) is tuple:
        hint, several = typing.get_args(hint)[0], True
    return hint, optional, several


def names_components(hint: Any) -> bool:
    """Return True if a field with this annotation names one or several components."""
    return _names(unwrap(hint)[0]) is not None


def is_known(hint: Any) -> bool:
    """Return True if values with this annotation can be checked and parsed."""
    try:
        base, _, _ = unwrap(hint)
    except (ValueError, IndexError):  # a union of several kinds, an empty tuple
        return False
    return base in _KINDS or typing.get_origin(base) is Literal or _names(base) is not None


def choices(hint: Any) -> tuple[str, ...]:
    """Return the strings that a Literal or `Names` lists, possibly optional or in a tuple; empty for other annotations."""
    hint, _, _ = unwrap(hint)
    if names := _names(hint):
        return names.known
    return typing.get_args(hint) if typing.get_origin(hint) is Literal else ()


def check(label: str, hint: Any, value: Any) -> Any:
    """Check a value and convert it to its field's type: lists to tuples, integers to floats.

    Args:
        label: Name of the field in error messages.
        hint: Its annotation.
        value: Any value.

    Raises:
        RequestError: The value does not match the annotation.
    """
    base, optional, several = unwrap(hint)
    if value is None and optional:
        return None
    if several:
        if not isinstance(value, list | tuple):
            raise RequestError(f"{label} must be a list, not {_quote(value)}")
        return tuple(check(label, base, item) for item in value)
    if names := _names(base):
        if value not in names.known and not _is_own(value):
            raise RequestError(f"{label} cannot be {_quote(value)}{nearest(str(value)[:_MAX_LENGTH], names.known)}")
        return value
    if typing.get_origin(base) is Literal:
        if value not in typing.get_args(base):
            raise RequestError(f"{label} cannot be {_quote(value)}{nearest(str(value)[:_MAX_LENGTH], typing.get_args(base))}")
        return value
    if isinstance(value, bool):  # which is an int as well
        if base is bool:
            return value
    elif base is int and isinstance(value, numbers.Integral):
        return int(value)
    elif base is float and isinstance(value, numbers.Real) and _is_finite(value):
        return float(value)
    elif base in (str, Path) and isinstance(value, base):
        return value
    _refuse(label, base, value)


def read(label: str, hint: Any, words: Sequence[str]) -> Any:
    """Parse the command-line arguments of an option.

    Args:
        label: Name of the option in error messages.
        hint: Annotation of its field.
        words: Arguments of the option: exactly one, or any number if the field is a tuple.

    Raises:
        RequestError: The arguments cannot be parsed.
    """
    base, optional, several = unwrap(hint)
    if several:
        return tuple(read(label, base, [word]) for word in words)
    (word,) = words
    if optional and word.lower() == "none":
        return None
    try:
        value = _TRUTH.get(word.lower(), word) if base is bool else base(word) if base in (int, float, Path) else word
        if base is Path:
            value.exists()
    except ValueError:
        _refuse(label, base, word)
    except OSError as error:  # a name that is too long, a folder without permission
        raise RequestError(f"{label} {word[:60]}{'...' if len(word) > 60 else ''}: {error.strerror or error}") from error
    return check(label, base, value)


def _is_finite(value: Any) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer beyond the range of floats
        return False


def _refuse(label: str, base: Any, value: Any) -> NoReturn:
    raise RequestError(f"{label} must be {_KINDS[base]}, not {_quote(value)}{_suggestion(base, value)}")


def _quote(value: Any) -> str:
    """Format a value for a one-line message."""
    text = repr(value)
    return text if len(text) <= _MAX_LENGTH else f"{text[:_MAX_LENGTH]}..."


def _suggestion(base: Any, value: Any) -> str:
    """Return a hint with the integer spelling of a whole number written otherwise, such as 1e6; empty if not applicable."""
    try:
        number = float(value) if base is int and not isinstance(value, bool) else math.nan
    except (TypeError, ValueError, OverflowError):
        return ""
    return f": write {int(number)}" if number.is_integer() and abs(number) < 2**53 else ""
