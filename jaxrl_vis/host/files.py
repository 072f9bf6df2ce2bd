"""File helpers: atomic writing, reading with one-line errors, and files private to their owner."""

import contextlib
import os
import re
import secrets
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from jaxrl_vis.errors import RequestError
from jaxrl_vis_envs.documents import parse_json, read_text

_TEMPORARY = re.compile(r"\.\d+-[0-9a-f]{16}\.tmp")
_MAX_JSON_BYTES = 200_000_000  # maximum size of a JSON file: 100 times the records of the largest study
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


def user_cache() -> Path:
    """Return the cache folder of this project: ``jaxrl-vis`` in the user's cache folder."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxrl-vis"


def write_atomically(path: Path, contents: str | bytes) -> None:
    """Replace a file's contents atomically: after a power cut, or for a concurrent reader, the file is either old or new.

    Args:
        path: The file; missing parent folders are created. A link is followed: its target is replaced.
        contents: The new contents; text is written as UTF-8.

    Raises:
        OSError: A folder cannot be created, or the file cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as file:
        file.write(contents.encode() if isinstance(contents, str) else contents)


@contextlib.contextmanager
def replacing(path: Path, durable: bool = True, mode: int = 0o666) -> Iterator[IO[bytes]]:
    """Open a temporary file that replaces ``path`` on success; on an exception, ``path`` is unchanged.

    Safe for concurrent processes: each writes a file of its own, and the last one to finish wins.

    Args:
        path: The file to replace, in an existing folder.
        durable: Sync contents and name to the disk.
        mode: Permissions of the file, before the process's umask.

    Raises:
        OSError: The file cannot be written.
    """
    path = Path(os.path.realpath(path))
    temporary = path.with_name(f".{os.getpid()}-{secrets.token_hex(8)}.tmp")  # short: a name has 255 bytes at most
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
    try:
        with os.fdopen(os.open(temporary, flags, mode), "wb") as file:
            yield file
            file.flush()
            if durable:
                os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise
    if durable:
        sync_folder(path.parent)


def is_temporary(name: str) -> bool:
    """Return True if a name is that of an unfinished file of `replacing`."""
    return _TEMPORARY.fullmatch(name) is not None


def sync_folder(folder: Path) -> None:
    """Sync the entries of a folder to the disk, if the system supports it."""
    with contextlib.suppress(OSError):  # Windows cannot open folders, and some file systems do not support fsync
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def read_json(path: Path, expected_type: type = dict, hint: str = "") -> Any:
    """Read a JSON file.

    Args:
        path: The file.
        expected_type: Expected type of the value: dict, list, or object for any.
        hint: Hint on how to fix an unusable file, appended to the message.

    Raises:
        RequestError: The file is missing, unreadable, not UTF-8, not JSON, nested too deeply, or holds a value of another type.
    """
    hint = f": {hint}" if hint else ""
    check_path(path)
    try:
        text = read_text(path, _MAX_JSON_BYTES)
    except OSError as error:
        raise RequestError(f"cannot read {path} ({error.strerror or type(error).__name__}){hint}") from error
    except ValueError as error:
        raise RequestError(f"{path} {error}{hint}") from error
    try:
        value = parse_json(text)
    except ValueError as error:
        raise RequestError(f"{path} is not JSON ({' '.join(str(error).split())}){hint}") from error
    if not isinstance(value, expected_type):
        wanted = "a table" if expected_type is dict else "a list"
        raise RequestError(f"{path} must hold {wanted}, not {type(value).__name__}{hint}")
    return value


def is_count(value: Any) -> bool:
    """Return True if a JSON value is an integer from 0 to 2^63 - 1."""
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**63


def check_path(path: Path) -> None:
    """Check that ``path`` can be looked up, whether it exists or not.

    Raises:
        RequestError: The lookup fails: a name is too long or contains a NUL, or a parent folder is not accessible.
    """
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return
    except OSError as error:
        raise RequestError(f"{_shorten(path)} cannot be used ({error.strerror or type(error).__name__})") from error
    except ValueError as error:
        raise RequestError(f"{_shorten(path)!r} cannot be used ({error})") from error


def _shorten(path: Path) -> str:
    text = str(path)
    return text if len(text) <= 120 else f"{text[:80]}...{text[-30:]}"


def make_private(folder: Path) -> None:
    """Create a folder accessible only to its owner; an existing folder of this user is restricted likewise.

    Raises:
        OSError: The folder cannot be created.
    """
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    if os.name == "posix" and folder.stat().st_uid == os.geteuid():
        folder.chmod(0o700)


def foreign_writer(status: os.stat_result) -> str | None:
    """Describe who other than this user and root may have written a file or folder; None if nobody, and on Windows.

    Args:
        status: Result of `os.stat`, or of `os.fstat` for an open file.
    """
    if os.name != "posix":
        return None
    if status.st_uid not in (os.geteuid(), 0):
        return f"belongs to another user ({status.st_uid})"
    if status.st_mode & _OTHERS_WRITE:
        return "can be written by other users"
    return None


def read_private(path: Path) -> bytes | None:
    """Read a file that only this user or root can have written.

    Symbolic links are not followed.

    Returns:
        The contents; None if the file cannot be read, or another user may have written it.
    """
    flags = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    try:
        with os.fdopen(os.open(path, flags), "rb") as file:
            status = os.fstat(file.fileno())
            if not stat.S_ISREG(status.st_mode) or foreign_writer(status) is not None:
                return None
            return file.read()
    except (OSError, ValueError):
        return None
