"""Network parameters in safetensors files, described by the file's metadata."""

import json
import reprlib
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np
import safetensors
from safetensors.numpy import save

from jaxrl_vis.errors import RequestError
from jaxrl_vis.files import write_atomically
from jaxrl_vis_envs.documents import parse_json

SUFFIX = ".safetensors"
_ABOUT = "about"
_KINDS = {"F16": np.float16, "F32": np.float32}
_LONGEST_HEADER = 1 << 20  # bytes; those of our networks are about 15,000

Settings = TypeVar("Settings")


def write_parameters(path: Path, params: Mapping[str, Any], about: Mapping[str, Any], half: bool = True) -> None:
    """Writes parameters atomically.

    Args:
        path: The file, .safetensors.
        params: Nested dictionaries of arrays.
        about: Description and provenance of the parameters; any JSON value.
        half: Store 16 bits per number.

    Raises:
        OSError: The file cannot be written.
    """
    kind = np.float16 if half else np.float32
    _write(path, {name: np.asarray(leaf).astype(kind) for name, leaf in _named(params).items()}, about)


def _write(path: Path, arrays: Mapping[str, np.ndarray], about: Mapping[str, Any]) -> None:
    """Writes named arrays without conversion."""
    whole = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    write_atomically(path, save(whole, {_ABOUT: json.dumps(dict(about))}))


def _named(params: Any) -> dict[str, Any]:
    """Returns the leaves of nested dictionaries by path: ``detector/params/stem/kernel``."""
    return {"/".join(str(part.key) for part in names): leaf for names, leaf in jax.tree_util.tree_flatten_with_path(params)[0]}


def read_parameters(
    path: Path, command: str, declare: Callable[[dict[str, Any]], tuple[Settings, Any]]
) -> tuple[dict[str, Any], Settings, dict[str, Any]]:
    """Reads a file of `write_parameters`. Names, shapes and types are compared with the network's before any array is read.

    Args:
        path: The file.
        command: Command that creates such files, for messages.
        declare: Maps the file's description to settings and the parameters' shapes (nested dictionaries of objects with a
            ``shape``); it may remove entries. It raises a RequestError that names the file, or a KeyError or ValueError if the
            description is not that of a network.

    Returns:
        Parameters, float32; settings; and the rest of the description.

    Raises:
        RequestError: The file is missing, or holds no parameters or those of another network.
    """
    try:
        if path.suffix.lower() == ".npz" and path.is_file():
            raise RequestError(
                f"{path} was written by an earlier version: convert it with `python -m jaxrl_vis.parameters {path} "
                f"{path.with_suffix(SUFFIX)}`, and pass the result"
            )
        _check_header(path)
        with safetensors.safe_open(path, framework="numpy") as file:
            about = parse_json((file.metadata() or {})[_ABOUT])
            if not isinstance(about, dict):
                raise ValueError(f"{_ABOUT} is no table")
            settings, shapes = declare(about)
            names = set(file.keys())
            wanted = {name: tuple(leaf.shape) for name, leaf in _named(shapes).items()}
            if names != wanted.keys():
                raise RequestError(_other_network(path, f"{min(names ^ wanted.keys())} is missing or too many", command))
            for name, shape in wanted.items():
                part = file.get_slice(name)
                if tuple(part.get_shape()) != shape or part.get_dtype() not in _KINDS:
                    raise RequestError(_other_network(path, f"{name} is not {shape} numbers of 16 or 32 bits", command))
            arrays = {name: file.get_tensor(name) for name in wanted}
    except OSError as error:
        raise RequestError(f"cannot read the weights {path}: {error.strerror or error}") from error
    except (ValueError, KeyError, safetensors.SafetensorError) as error:
        if isinstance(error, RequestError):
            raise
        raise RequestError(f"{path} holds no weights: name a file that `{command}` wrote") from error
    unsound = next((name for name, array in arrays.items() if not np.isfinite(array).all()), None)
    if unsound is not None:
        raise RequestError(f"{path} holds numbers that are not finite ({unsound}): train the weights again with `{command}`")
    params: dict[str, Any] = {}
    for name, array in arrays.items():
        place = params
        *folders, last = name.split("/")
        for folder in folders:
            place = place.setdefault(folder, {})
        place[last] = array.astype(np.float32)  # in NumPy: JAX would compile a program per shape
    return jax.device_put(params), settings, about


def _check_header(path: Path) -> None:
    """Raises a ValueError if the header's size is inconsistent with the file or larger than that of any of our networks."""
    size = path.stat().st_size
    if not path.is_file():
        raise ValueError("not a regular file")  # opening a pipe would block
    with path.open("rb") as file:
        if not 2 <= int.from_bytes(file.read(8), "little") <= min(_LONGEST_HEADER, size - 8):
            raise ValueError("no header")


def check_range(path: Path, name: str, values: tuple[float, ...], low: float, high: float, step: int = 1) -> None:
    """Checks a setting of a network before it is used.

    Args:
        path: File that the setting was read from.
        name: Name of the setting.
        values: One number, or several.
        low, high: Bounds of each number, inclusive.
        step: Divisor of each number, for whole numbers.

    Raises:
        RequestError: The setting is out of range.
    """
    unfit = next((value for value in values if not low <= value <= high or (step > 1 and value % step)), None)
    if unfit is not None or not 1 <= len(values) <= 16:
        kind = f"multiples of {step} " if step > 1 else ""
        shown = f"{len(values)} numbers" if unfit is None else reprlib.repr(unfit)  # a number may have hundreds of digits
        raise RequestError(f"{path}: {name} of its network must be {kind}from {low:g} to {high:g}, 16 at most, not {shown}")


def _other_network(path: Path, why: str, command: str) -> str:
    return f"{path} holds weights of another network ({why}): train them again with `{command}`"


def convert(old: Path, new: Path) -> None:
    """Converts a .npz file of an earlier version to the current format, bit for bit.

    Raises:
        OSError: A file cannot be read or written.
        ValueError: The file holds no weights.
    """
    with np.load(old, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    about = json.loads(arrays.pop(_ABOUT).tobytes())
    if {array.dtype for array in arrays.values()} - {np.dtype(kind) for kind in _KINDS.values()}:
        raise ValueError("weights have 16 or 32 bits")
    _write(new, arrays, about)


if __name__ == "__main__":
    try:
        convert(*map(Path, sys.argv[1:]))
    except Exception as error:  # the old file may contain anything
        sys.exit(f"cannot convert {' '.join(sys.argv[1:])}: {' '.join(str(error).split())}")
