"""Episodes in an .npz file, with the arrays of `Recordings` by name; also read by `jaxrl_vis.indicator.learn`."""

import dataclasses
import io
import json
import zipfile
from pathlib import Path

import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.files import write_atomically
from jaxrl_vis.recordings.episodes import Recordings
from jaxrl_vis_envs.documents import parse_json

FILE_NAME = "episodes.npz"
_ABOUT = "about"
_REQUIRED = ("observations", "actions")


def write(recordings: Recordings, path: Path) -> None:
    """Write episodes to one compressed file, atomically.

    Args:
        recordings: The episodes.
        path: The file.

    Raises:
        OSError: The file cannot be written.
    """
    arrays = {field.name: getattr(recordings, field.name) for field in dataclasses.fields(recordings) if field.name != _ABOUT}
    file = io.BytesIO()
    about = np.frombuffer(json.dumps(dict(recordings.about)).encode(), np.uint8)
    np.savez_compressed(file, **{name: array for name, array in arrays.items() if array is not None}, about=about)
    write_atomically(path, file.getvalue())


def read(path: Path) -> Recordings:
    """Read a file of `write`, or one of another program with ``observations`` and ``actions``.

    Floating-point arrays are converted to float32.

    Args:
        path: The file.

    Raises:
        RequestError: It is missing, damaged, or has no episodes.
    """
    names = [field.name for field in dataclasses.fields(Recordings) if field.name != _ABOUT]
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in names if name in file.files}
            about = parse_json(file[_ABOUT].tobytes().decode()) if _ABOUT in file.files else {}
        missing = [name for name in _REQUIRED if name not in arrays]
        if missing:
            raise ValueError(f"it holds no {' and no '.join(missing)}")
        if not isinstance(about, dict):
            raise ValueError(f"{_ABOUT} is not a JSON object")
        for name, array in arrays.items():
            if np.issubdtype(array.dtype, np.floating):
                arrays[name] = array.astype(np.float32)
        return Recordings(**arrays, about=about)
    except (OSError, EOFError, ValueError, KeyError, TypeError, AttributeError, zipfile.BadZipFile) as error:
        raise RequestError(
            f"{path} has no recorded episodes, observations and actions: {' '.join(str(error).split())}"
        ) from error
