"""Families from JSON or TOML files. Imports no JAX."""

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

_MAX_BYTES = 100_000  # a file with every field of a family has about 3,000


def read(path: Path | str, families: Mapping[str, Family] = FAMILIES) -> Family:
    """Read a family from a file with the fields of `Family`, parts as tables; missing fields are taken from the family
    ``base``.

    Args:
        path: TOML, if it has that suffix, otherwise JSON.
        families: Valid values of ``base``, which defaults to ``training``.

    Raises:
        ValueError: The file cannot be read, or contains an unknown key or a bad value. The message is one line that names it.
    """
    path = Path(path)
    try:
        text = read_text(path, _MAX_BYTES)
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
        raise ValueError(f"{path}: base must be one of {', '.join(families)}, got {_format(base)}")
    name = values.get("name", path.stem)
    try:
        # Independent random numbers, so that a file that repeats a family's values still gives other plots.
        stream = 10_000 + zlib.crc32(_convert("name", "a word", name).encode("utf-8", "surrogateescape"))
        return _substitute("", dataclasses.replace(families[base], name=name, stream=stream), values)
    except (ValueError, OverflowError) as error:
        raise ValueError(f"{path}: {' '.join(str(error).split())}") from error


def _substitute(prefix: str, record: Any, values: dict[str, Any]) -> Any:
    """Return a dataclass with the values of a table substituted."""
    known = {field.name: getattr(record, field.name) for field in dataclasses.fields(record)}
    changes = {}
    for name, value in values.items():
        label = f"{prefix}{name}"
        if name not in known:
            raise ValueError(f"unknown key {_format(label)}{nearest(name[:100], known)}")
        if dataclasses.is_dataclass(known[name]):
            if not isinstance(value, dict):
                raise ValueError(f"{label} must be a table, got {_format(value)}")
            changes[name] = _substitute(f"{label}.", known[name], value)
        else:
            changes[name] = _convert(label, known[name], value)
    return dataclasses.replace(record, **changes)


def _convert(label: str, example: Any, value: Any) -> Any:
    """Convert a value to the kind of the example."""
    if isinstance(example, tuple):
        if not isinstance(value, list | tuple) or len(value) != 2 or not all(map(is_number, value)):
            raise ValueError(f"{label} must be a range of two numbers, [low, high], got {_format(value)}")
        return (float(value[0]), float(value[1]))
    if isinstance(example, str):
        if not isinstance(value, str) or not value:
            raise ValueError(f"{label} must be a word, got {_format(value)}")
        return value
    if not is_number(value):
        raise ValueError(f"{label} must be a number, got {_format(value)}")
    if isinstance(example, int):
        if not float(value).is_integer():
            raise ValueError(f"{label} must be a whole number, got {_format(value)}")
        return int(value)
    return float(value)


def _format(value: Any) -> str:
    """Format a value for a message."""
    try:
        return reprlib.repr(value)
    except ValueError:
        return "a number of thousands of digits"
