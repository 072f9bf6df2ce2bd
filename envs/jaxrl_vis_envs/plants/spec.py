"""Families from files. Loads no JAX."""

import dataclasses
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jaxrl_vis_envs.documents import parse_json, parse_toml, read_text
from jaxrl_vis_envs.names import nearest
from jaxrl_vis_envs.plants.family import TRAINING, Family, is_number
from jaxrl_vis_envs.plants.shifts import FAMILIES

_MOST_BYTES = 1_000_000


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
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise ValueError(f"{path} cannot be read: it {error}") from error
    kind, parse = ("TOML", parse_toml) if path.suffix.lower() == ".toml" else ("JSON", parse_json)
    try:
        values = parse(text)
    except ValueError as error:
        raise ValueError(f"{path} is not {kind} (write .toml or .json): {' '.join(str(error).split())}") from error
    if not isinstance(values, dict):
        raise ValueError(f'{path} must hold one table of a family\'s fields, like {{"stalks": {{"lean_most": 15}}}}')
    base = values.pop("base", TRAINING.name)
    if not isinstance(base, str) or base not in families:
        raise ValueError(f"{path}: base must be one of {', '.join(families)}, got {base!r}")
    # Its own random numbers, so that a file that repeats a family's values still draws other plots.
    name = values.get("name", path.stem)
    start = dataclasses.replace(families[base], name=name, stream=10_000 + zlib.crc32(str(name).encode()))
    try:
        return _changed("", start, values)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _changed(where: str, record: Any, values: dict[str, Any]) -> Any:
    """A dataclass with the values of a table in place of its own."""
    known = {field.name: getattr(record, field.name) for field in dataclasses.fields(record)}
    changes = {}
    for name, value in values.items():
        label = f"{where}{name}"
        if name not in known:
            raise ValueError(f"unknown key {label!r}{nearest(name, known)}")
        if dataclasses.is_dataclass(known[name]):
            if not isinstance(value, dict):
                raise ValueError(f"{label} must be a table, got {value!r}")
            changes[name] = _changed(f"{label}.", known[name], value)
        else:
            changes[name] = _like(label, known[name], value)
    return dataclasses.replace(record, **changes)


def _like(label: str, example: Any, value: Any) -> Any:
    """A value of the kind that the example is of."""
    if isinstance(example, tuple):
        if not isinstance(value, list | tuple) or len(value) != 2 or not all(map(is_number, value)):
            raise ValueError(f"{label} must be a range of two numbers, [low, high], got {value!r}")
        return (float(value[0]), float(value[1]))
    if isinstance(example, str):
        if not isinstance(value, str) or not value:
            raise ValueError(f"{label} must be a word, got {value!r}")
        return value
    if not is_number(value):
        raise ValueError(f"{label} must be a number, got {value!r}")
    if isinstance(example, int):
        if not float(value).is_integer():
            raise ValueError(f"{label} must be a whole number, got {value!r}")
        return int(value)
    return float(value)
