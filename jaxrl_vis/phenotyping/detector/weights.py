"""Weights in a file of plain arrays: NumPy's npz, read without pickle, with the settings and their origin beside them."""

import dataclasses
import json
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.phenotyping.detector.detect import Settings

SHIPPED = Path(__file__).with_name("stalks.npz")
"""Weights that come with the package, trained on synthetic stalks."""
SCHEMA = 1
_ABOUT = "about"


def write_weights(
    path: Path, params: Mapping[str, Any], settings: Settings, about: Mapping[str, Any], half: bool = True
) -> None:
    """Writes parameters. Nobody sees half of them.

    Args:
        path: The file, .npz.
        params: Nested dictionaries of arrays.
        settings: What they go with.
        about: Where they come from; anything that JSON holds.
        half: Keep 16 bits of each number.

    Raises:
        OSError: The file cannot be written.
    """
    leaves = jax.tree_util.tree_flatten_with_path(params)[0]
    arrays = {"/".join(str(part.key) for part in names): np.asarray(leaf) for names, leaf in leaves}
    if half:
        arrays = {name: array.astype(np.float16) for name, array in arrays.items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps({"schema": SCHEMA, "settings": dataclasses.asdict(settings), **about})
    whole: dict[str, Any] = {_ABOUT: np.frombuffer(text.encode(), np.uint8), **arrays}
    temporary = path.with_name(path.name + ".tmp")
    with temporary.open("wb") as file:
        np.savez_compressed(file, **whole)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)


def read_weights(path: Path) -> tuple[dict[str, Any], Settings, dict[str, Any]]:
    """Reads what `write_weights` wrote: parameters, settings, and where they come from.

    Raises:
        RequestError: There is no such file, or it holds no weights.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        about = json.loads(arrays.pop(_ABOUT).tobytes().decode())
        known = {field.name for field in dataclasses.fields(Settings)}
        values: dict[str, Any] = {
            name: tuple(each) if isinstance(each, list) else each for name, each in about.pop("settings").items()
        }
        if about.pop("schema") != SCHEMA or not values.keys() <= known:
            raise RequestError(f"{path} holds weights of another version: train them again with `jaxrl-vis phenotype train`")
    except RequestError:
        raise
    except OSError as error:
        raise RequestError(f"cannot read the weights {path}: {error.strerror or error}") from error
    except (ValueError, KeyError, EOFError, zipfile.BadZipFile, AttributeError) as error:
        raise RequestError(f"{path} holds no weights: name a file that `jaxrl-vis phenotype train` wrote") from error
    params: dict[str, Any] = {}
    for name, array in arrays.items():
        place = params
        *folders, last = name.split("/")
        for folder in folders:
            place = place.setdefault(folder, {})
        place[last] = jnp.asarray(array, jnp.float32)
    return params, Settings(**values), about
