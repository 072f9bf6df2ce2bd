"""Checks of output paths before the work that produces the output."""

import tempfile
from pathlib import Path

from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.files import check_path

FIGURE_SUFFIXES = (".png", ".pdf", ".svg")


def check_writable(path: Path, option: str = "", folder: bool = False) -> None:
    """Check that a file, or files in a folder, can be written, and leave nothing behind.

    Missing parent folders are allowed: writers create them.

    Args:
        path: The file or the folder.
        option: The command-line option, for the message.
        folder: Whether ``path`` is a folder.

    Raises:
        RequestError: The path cannot be written.
    """
    label = f"{option} {path}".strip()
    check_path(path)
    try:
        if path.exists() and path.is_dir() != folder:
            raise RequestError(f"{label} is a {'file: name a folder' if folder else 'folder: name a file'}")
        if path.is_file():
            with path.open("ab"):
                return
        if path.exists() and not folder:
            return  # a device or a pipe
        parent = next(candidate for candidate in (path, *path.absolute().parents) if candidate.exists())
        if not parent.is_dir():
            raise RequestError(f"cannot write {label}: {parent} is a file, not a folder")
        with tempfile.TemporaryFile(dir=parent):
            pass
    except OSError as error:
        raise RequestError(f"cannot write {label}: {error.strerror or error}") from error


def check_figure(out: Path) -> None:
    """Check that ``--out`` names a figure that can be written.

    Raises:
        RequestError: Its suffix is not one of `FIGURE_SUFFIXES`, or it cannot be written.
    """
    if out.suffix.lower() not in FIGURE_SUFFIXES:
        *others, last = FIGURE_SUFFIXES
        raise RequestError(f"--out {out}: a figure is a file that ends in {', '.join(others)} or {last}")
    check_writable(out, "--out")
