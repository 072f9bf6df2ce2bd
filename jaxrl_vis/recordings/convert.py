"""Reading (with the format inferred from the path) and writing of recorded episodes."""

from pathlib import Path

from jaxrl_vis.errors import RequestError, StorageError
from jaxrl_vis.host.files import check_path
from jaxrl_vis.recordings import lerobot, lerobot_reader, npz
from jaxrl_vis.recordings.episodes import Recordings
from jaxrl_vis.report.outputs import check_writable

LEROBOT, NPZ = "lerobot", "npz"


def holds_recordings(path: Path) -> bool:
    """Return True if ``path`` is an .npz file, a folder that contains one, or a LeRobot dataset."""
    check_path(path)
    return path.suffix == ".npz" or (path / npz.FILE_NAME).is_file() or lerobot_reader.is_dataset(path)


def read(path: Path | str) -> Recordings:
    """Read recorded episodes from an .npz file, from a folder that contains one, or from a LeRobot dataset.

    Args:
        path: The file or folder.

    Raises:
        RequestError: There are no recordings, or they are damaged.
    """
    path = Path(path)
    if lerobot_reader.is_dataset(path):
        return lerobot_reader.read(path)
    return npz.read(_npz_file(path))


def _npz_file(path: Path) -> Path:
    """Return the path of the .npz file: ``path`` itself, or the file in this folder."""
    return path if path.suffix == ".npz" else path / npz.FILE_NAME


def check_out(out: Path, kind: str) -> None:
    """Check that episodes can be written to ``out``. Call it before recording them.

    Raises:
        RequestError: The file exists, the folder is not empty, ``out`` is not writable, or a package is missing.
    """
    if kind == LEROBOT:
        lerobot.check_packages()
        if out.is_dir() and any(out.iterdir()):
            raise RequestError(f"--out {out} is not empty: name a new folder")
    elif (file := _npz_file(out)).exists():
        raise RequestError(f"--out {file} is there already: name a new file")
    check_writable(out, "--out", folder=out.suffix != ".npz")


def write(recordings: Recordings, out: Path | str, kind: str) -> Path:
    """Write episodes, and return the file or folder.

    Args:
        recordings: The episodes.
        out: A new folder; or an .npz file.
        kind: `LEROBOT` or `NPZ`.

    Raises:
        RequestError: See `check_out`.
        StorageError: They cannot be written.
    """
    path = Path(out) if kind == LEROBOT else _npz_file(Path(out))
    try:
        (lerobot if kind == LEROBOT else npz).write(recordings, path)
    except OSError as error:
        raise StorageError(f"cannot write {path} ({error.strerror or error}): nothing is left of it there") from error
    return path
