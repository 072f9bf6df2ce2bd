"""Parameters of networks in a file of plain arrays: NumPy's npz, read without pickle, with what they are beside them."""

import json
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxrl_vis.errors import RequestError

_ABOUT = "about"


def write_parameters(path: Path, params: Mapping[str, Any], about: Mapping[str, Any], half: bool = True) -> None:
    """Writes parameters. Nobody sees half of them.

    Args:
        path: The file, .npz.
        params: Nested dictionaries of arrays.
        about: What they are and where they come from; anything that JSON holds.
        half: Keep 16 bits of each number.

    Raises:
        OSError: The file cannot be written.
    """
    leaves = jax.tree_util.tree_flatten_with_path(params)[0]
    arrays = {"/".join(str(part.key) for part in names): np.asarray(leaf) for names, leaf in leaves}
    if half:
        arrays = {name: array.astype(np.float16) for name, array in arrays.items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    whole: dict[str, Any] = {_ABOUT: np.frombuffer(json.dumps(dict(about)).encode(), np.uint8), **arrays}
    temporary = path.with_name(path.name + ".tmp")
    with temporary.open("wb") as file:
        np.savez_compressed(file, **whole)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)


def read_parameters(path: Path, command: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Reads what `write_parameters` wrote: parameters, float32, and what was said about them.

    Args:
        path: The file.
        command: What makes such files, for messages.

    Raises:
        RequestError: There is no such file, or it holds no parameters.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        about = json.loads(arrays.pop(_ABOUT).tobytes().decode())
        if not isinstance(about, dict):
            raise ValueError
    except OSError as error:
        raise RequestError(f"cannot read the weights {path}: {error.strerror or error}") from error
    except (ValueError, KeyError, EOFError, zipfile.BadZipFile, AttributeError) as error:
        raise RequestError(f"{path} holds no weights: name a file that `{command}` wrote") from error
    params: dict[str, Any] = {}
    for name, array in arrays.items():
        place = params
        *folders, last = name.split("/")
        for folder in folders:
            place = place.setdefault(folder, {})
        place[last] = array.astype(np.float32)  # by NumPy: JAX would compile a program for each shape
    return jax.device_put(params), about
