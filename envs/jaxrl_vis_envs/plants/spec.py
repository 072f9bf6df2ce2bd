"""Families from files. Loads no JAX."""

import dataclasses
import reprlib
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jaxrl_vis_envs.documents import parse_json, parse_toml, read_text
from jaxrl_vis_envs.names import nearest
from jaxrl_vis_envs.plants.family import TRAINING, Family, is_number
from jaxrl_vis_envs.plants.shifts import FAMILIES

_MOST_BYTES = 100_000  # of a file; one with every field of a family has some 3,000


def read(path: Path | str, families: Mapping[str, Family] = FAMILIES) -> Family:
    """A family from a file: the fields of `Family`, parts as tables; what is missing is as in the family called ``base``.

    Args:
        path: JSON or, by its suffix, TOML.
        families: What ``base`` may name; ``training`` if it is not there.

    Raises:
        ValueError: The file cannot be read, or holds an unknown key or a bad value. One line that says which.
    """
    path = Path(path)
    try:
        text = read_text(path, _MOST_BYTES)
        values = parse_toml(text) if path.suffix.lower() == ".toml" else parse_json(text)
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        kind = "TOML" if path.suffix.lower() == ".toml" else "JSON"
        raise ValueError(f"{path} is not {kind} (write .toml or .json): {' '.join(str(error).split())}") from error
    if not isinstance(values, dict):
        raise ValueError(f'{path} must hold one table of a family\'s fields, like {{"stalks": {{"lean_most": 15}}}}')
    base = values.pop("base", TRAINING.name)
    if not isinstance(base, str) or base not in families:
        raise ValueError(f"{path}: base must be one of {', '.join(families)}, got {_said(base)}")
    name = values.get("name", path.stem)
    try:
        # Its own random numbers, so that a file that repeats a family's values still draws other plots.
        stream = 10_000 + zlib.crc32(_like("name", "a word", name).encode("utf-8", "surrogateescape"))
        return _changed("", dataclasses.replace(families[base], name=name, stream=stream), values)
    except (ValueError, OverflowError) as error:
        raise ValueError(f"{path}: {' '.join(str(error).split())}") from error


def _changed(where: str, record: Any, values: dict[str, Any]) -> Any:
    """A dataclass with the values of a table in place of its own."""
    known = {field.name: getattr(record, field.name) for field in dataclasses.fields(record)}
    changes = {}
    for name, value in values.items():
        label = f"{where}{name}"
        if name not in known:
            raise ValueError(f"unknown key {_said(label)}{nearest(name[:100], known)}")
        if dataclasses.is_dataclass(known[name]):
            if not isinstance(value, dict):
                raise ValueError(f"{label} must be a table, got {_said(value)}")
            changes[name] = _changed(f"{label}.", known[name], value)
        else:
            changes[name] = _like(label, known[name], value)
    return dataclasses.replace(record, **changes)


def _like(label: str, example: Any, value: Any) -> Any:
    """A value of the kind that the example is of."""
    if isinstance(example, tuple):
        if not isinstance(value, list | tuple) or len(value) != 2 or not all(map(is_number, value)):
            raise ValueError(f"{label} must be a range of two numbers, [low, high], got {_said(value)}")
        return (float(value[0]), float(value[1]))
    if isinstance(example, str):
        if not isinstance(value, str) or not value:
            raise ValueError(f"{label} must be a word, got {_said(value)}")
        return value
    if not is_number(value):
        raise ValueError(f"{label} must be a number, got {_said(value)}")
    if isinstance(example, int):
        if not float(value).is_integer():
            raise ValueError(f"{label} must be a whole number, got {_said(value)}")
        return int(value)
    return float(value)


def _said(value: Any) -> str:
    """A value in a message."""
    try:
        return reprlib.repr(value)
    except ValueError:
        return "a number of thousands of digits"
