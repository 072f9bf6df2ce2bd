"""Network parameters in safetensors files, described by the file's metadata."""

import json
import math
import reprlib
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar

import jax
import numpy as np
import safetensors
from safetensors.numpy import save

from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.files import write_atomically
from jaxrl_vis_envs.documents import parse_json

SUFFIX = ".safetensors"
_ABOUT = "about"
_KINDS = {"F16": np.float16, "F32": np.float32}
# An array quantised to 10 bits is stored as three: the upper 8 bits under its own name, and with these suffixes the lower 2
# bits, four per byte, and the scales of the last axis. A wheel's compression would hardly shrink 10 bits in 16-bit words.
_LOW, _SCALE = ".low", ".scale"
_BIT_SHIFTS = np.array([0, 2, 4, 6], np.uint8)
_LEVELS = 511
_MIN_QUANTIZED_SIZE = 4096  # minimum size of quantised arrays; smaller ones keep 16 bits, at negligible cost
_MAX_HEADER_BYTES = 1 << 20  # bytes; our networks have headers of some 15,000

Settings = TypeVar("Settings")


def write_parameters(
    path: Path,
    params: Mapping[str, Any],
    about: Mapping[str, Any],
    bits: Literal[10, 16, 32] = 16,
    exact: Collection[str] = (),
) -> None:
    """Write parameters to a file, atomically.

    Args:
        path: The file, .safetensors.
        params: Nested dictionaries of arrays.
        about: Description and origin, as a JSON value.
        bits: Bits per number. With 10, arrays with two or more axes and at least 4,096 numbers are quantised to integers from
            -511 to 511 with a scale per index of the last axis; the others use 16.
        exact: Names of arrays (paths such as ``detector/params/stem/kernel``) that keep 32 bits, unless they are quantised.

    Raises:
        OSError: The file cannot be written.
    """
    arrays: dict[str, np.ndarray] = {}
    for name, leaf in _flatten(params).items():
        array = np.asarray(leaf, np.float32)
        if bits == 10 and array.ndim > 1 and array.size >= _MIN_QUANTIZED_SIZE:
            arrays |= _quantize(name, array)
        else:
            arrays[name] = array.astype(np.float32 if bits == 32 or name in exact else np.float16)
    whole = {name: np.asarray(array, order="C") for name, array in arrays.items()}  # scalars stay 0-dimensional
    write_atomically(path, save(whole, {_ABOUT: json.dumps(dict(about))}))


def _quantize(name: str, array: np.ndarray) -> dict[str, np.ndarray]:
    """Quantize an array [..., C] float32 to 10 bits per number: three arrays by name."""
    scale = np.abs(array).max(axis=tuple(range(array.ndim - 1))) / np.float32(_LEVELS)
    levels = np.round(array / np.where(scale > 0, scale, 1)).astype(np.int16)
    low = np.pad((levels & 3).ravel(), (0, -levels.size % 4)).reshape(-1, 4) << _BIT_SHIFTS
    return {name: (levels >> 2).astype(np.int8), f"{name}{_LOW}": low.sum(axis=1).astype(np.uint8), f"{name}{_SCALE}": scale}


def _restore(high: np.ndarray, low: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Restore an array [..., C] float32 from the results of `_quantize`.

    Args:
        high: [..., C] int8, upper 8 bits.
        low: [ceil(numbers / 4)] uint8, lower 2 bits, four numbers in each byte.
        scale: [C] float32.
    """
    lower = ((low[:, None] >> _BIT_SHIFTS) & 3).ravel()[: high.size].reshape(high.shape)
    return (4 * high.astype(np.float32) + lower.astype(np.float32)) * scale


def _flatten(params: Any) -> dict[str, Any]:
    """Return the leaves of nested dictionaries by path: ``detector/params/stem/kernel``."""
    return {"/".join(str(part.key) for part in names): leaf for names, leaf in jax.tree_util.tree_flatten_with_path(params)[0]}


def read_parameters(
    path: Path, command: str, declare: Callable[[dict[str, Any]], tuple[Settings, Any]]
) -> tuple[dict[str, Any], Settings, dict[str, Any]]:
    """Read a file of `write_parameters`. Names, shapes and dtypes are compared with the network's before any array is read.

    Args:
        path: The file.
        command: Command that creates such files, for messages.
        declare: Maps the file's description to settings and the parameters' shapes (nested dictionaries of objects with a
            ``shape``); it may remove entries. It raises a RequestError that names the file, or a KeyError or ValueError if the
            description is not that of a network.

    Returns:
        Parameters, float32 on the default device; settings; and the rest of the description.

    Raises:
        RequestError: The file is missing, or holds no parameters, those of another network, or numbers that are not finite.
    """
    try:
        about = read_about(path, command)
        with safetensors.safe_open(path, framework="numpy") as file:
            settings, shapes = declare(about)
            names = set(file.keys())
            wanted = {name: tuple(leaf.shape) for name, leaf in _flatten(shapes).items()}
            quantized = {name for name in wanted.keys() & names if file.get_slice(name).get_dtype() == "I8"}
            kinds = dict.fromkeys(wanted, ("F16", "F32"))
            for name in quantized:
                wanted |= {f"{name}{_LOW}": (-(-math.prod(wanted[name]) // 4),), f"{name}{_SCALE}": wanted[name][-1:]}
                kinds |= {name: ("I8",), f"{name}{_LOW}": ("U8",), f"{name}{_SCALE}": ("F32",)}
            if names != wanted.keys():
                raise RequestError(_other_network(path, f"{min(names ^ wanted.keys())} is missing or too many", command))
            for name, shape in wanted.items():
                part = file.get_slice(name)
                if tuple(part.get_shape()) != shape or part.get_dtype() not in kinds[name]:
                    raise RequestError(_other_network(path, f"{name} is not {shape} numbers of 10, 16 or 32 bits", command))
            arrays = {name: file.get_tensor(name) for name in wanted}
    except OSError as error:
        raise RequestError(f"cannot read the weights {path}: {error.strerror or error}") from error
    except (ValueError, KeyError, safetensors.SafetensorError) as error:
        if isinstance(error, RequestError):
            raise
        raise RequestError(f"{path} holds no weights: name a file that `{command}` wrote") from error
    # With NumPy, because JAX would compile a program for each shape.
    for name in quantized:
        arrays[name] = _restore(arrays[name], arrays.pop(f"{name}{_LOW}"), arrays.pop(f"{name}{_SCALE}"))
    unsound = next((name for name, array in arrays.items() if not np.isfinite(array).all()), None)
    if unsound is not None:
        raise RequestError(f"{path} holds numbers that are not finite ({unsound}): train the weights again with `{command}`")
    params: dict[str, Any] = {}
    for name, array in arrays.items():
        place = params
        *folders, last = name.split("/")
        for folder in folders:
            place = place.setdefault(folder, {})
        place[last] = array.astype(np.float32)
    return jax.device_put(params), settings, about


def read_about(path: Path, command: str) -> dict[str, Any]:
    """Read the description in a file of `write_parameters`.

    Args:
        path: The file.
        command: Command that creates such files, for messages.

    Raises:
        RequestError: The file is missing, or has none.
    """
    try:
        _check_header(path)
        with safetensors.safe_open(path, framework="numpy") as file:
            about = parse_json((file.metadata() or {})[_ABOUT])
        if not isinstance(about, dict):
            raise ValueError(f"{_ABOUT} is not a JSON object")
        return about
    except OSError as error:
        raise RequestError(f"cannot read the weights {path}: {error.strerror or error}") from error
    except (ValueError, KeyError, safetensors.SafetensorError) as error:
        raise RequestError(f"{path} holds no weights: name a file that `{command}` wrote") from error


def _check_header(path: Path) -> None:
    """Raise a ValueError if the header's size is inconsistent with the file or larger than that of any of our networks."""
    size = path.stat().st_size
    if not path.is_file():
        raise ValueError("not a regular file")  # opening a pipe would block
    with path.open("rb") as file:
        if not 2 <= int.from_bytes(file.read(8), "little") <= min(_MAX_HEADER_BYTES, size - 8):
            raise ValueError("no header")


def check_range(path: Path, name: str, values: tuple[float, ...], low: float, high: float, step: int = 1) -> None:
    """Check a setting of a network before it is used.

    Args:
        path: File that the setting was read from.
        name: Name of the setting.
        values: One number, or several.
        low, high: Bounds of each number, inclusive.
        step: Divisor of each number, for whole numbers.

    Raises:
        RequestError: A number is out of range or not divisible by ``step``, or there are none or more than 16.
    """
    unfit = next((value for value in values if not low <= value <= high or (step > 1 and value % step)), None)
    if unfit is not None or not 1 <= len(values) <= 16:
        kind = f"multiples of {step} " if step > 1 else ""
        shown = f"{len(values)} numbers" if unfit is None else reprlib.repr(unfit)  # a number may have hundreds of digits
        raise RequestError(f"{path}: {name} of its network must be {kind}from {low:g} to {high:g}, 16 at most, not {shown}")


def _other_network(path: Path, reason: str, command: str) -> str:
    return f"{path} holds weights of another network ({reason}): train them again with `{command}`"
