"""Files: written so that nobody ever reads half of one, read so that whatever is wrong is one line, and kept to their owner."""

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
_MOST_BYTES = 200_000_000  # of JSON: records of the largest study have a hundredth of that
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


def user_cache() -> Path:
    """The folder for what this project keeps for a user: ``jaxrl-vis`` in the user's cache folder."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxrl-vis"


def write_atomically(path: Path, contents: str | bytes) -> None:
    """Replaces a file's contents in one step: a reader, or a power cut, sees the old contents or the new ones.

    Args:
        path: The file; folders that are missing on the way are made. What a link points to is replaced, not the link.
        contents: The new contents; text is written as UTF-8.

    Raises:
        OSError: A folder cannot be made, or the file cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as file:
        file.write(contents.encode() if isinstance(contents, str) else contents)


@contextlib.contextmanager
def replacing(path: Path, durable: bool = True, mode: int = 0o666) -> Iterator[IO[bytes]]:
    """A file to write into, which takes the place of ``path`` at the end; where something is raised, ``path`` stays as it was.

    Several processes may do so at the same time: each writes a file of its own, and the last one stays.

    Args:
        path: The file to replace, in a folder that is there.
        durable: See to it that contents and name are on the disk.
        mode: Permissions of the file, less those that the process's umask takes away.

    Raises:
        OSError: It cannot be written.
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
    """Returns whether a file's name is that of a file which `replacing` had not finished."""
    return _TEMPORARY.fullmatch(name) is not None


def sync_folder(folder: Path) -> None:
    """Sees to it that the names of a folder's files are on the disk, where the system lets us."""
    with contextlib.suppress(OSError):  # Windows opens no folder, and some file systems have no such call
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def read_json(path: Path, kind: type = dict, mend: str = "") -> Any:
    """The value of a JSON file.

    Args:
        path: The file.
        kind: What it must be: dict, list, or object for anything.
        mend: What to do about a file that cannot be used; goes to the end of the message.

    Raises:
        RequestError: It is not there, cannot be read, is not UTF-8, not JSON, nested too deep, or another kind of value.
    """
    mend = f": {mend}" if mend else ""
    check_path(path)
    try:
        text = read_text(path, _MOST_BYTES)
    except OSError as error:
        raise RequestError(f"cannot read {path} ({error.strerror or type(error).__name__}){mend}") from error
    except ValueError as error:
        raise RequestError(f"{path} {error}{mend}") from error
    try:
        value = parse_json(text)
    except ValueError as error:
        raise RequestError(f"{path} is not JSON ({' '.join(str(error).split())}){mend}") from error
    if not isinstance(value, kind):
        wanted = "a table" if kind is dict else "a list"
        raise RequestError(f"{path} must hold {wanted}, not {type(value).__name__}{mend}")
    return value


def check_path(path: Path) -> None:
    """Checks that the system can say whether ``path`` is there, and what it is.

    Raises:
        RequestError: It cannot: a name is too long or holds a NUL, or a folder on the way may not be looked into.
    """
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return
    except OSError as error:
        raise RequestError(f"{_short(path)} cannot be used ({error.strerror or type(error).__name__})") from error
    except ValueError as error:
        raise RequestError(f"{_short(path)!r} cannot be used ({error})") from error


def _short(path: Path) -> str:
    text = str(path)
    return text if len(text) <= 120 else f"{text[:80]}...{text[-30:]}"


def make_private(folder: Path) -> None:
    """Makes a folder into which nobody but its owner looks or writes; of one that is there and ours, it takes others' rights.

    Raises:
        OSError: It cannot be made.
    """
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    if os.name == "posix" and folder.stat().st_uid == os.geteuid():
        folder.chmod(0o700)


def stranger_to(status: os.stat_result) -> str | None:
    """Name who, beside this user and root, could have written a file or a folder; None for nobody, and on Windows.

    Args:
        status: From `os.stat`, or of the opened file from `os.fstat`.
    """
    if os.name != "posix":
        return None
    if status.st_uid not in (os.geteuid(), 0):
        return f"belongs to another user ({status.st_uid})"
    if status.st_mode & _OTHERS_WRITE:
        return "can be written by other users"
    return None


def read_private(path: Path) -> bytes | None:
    """The contents of a file that only this user, or root, can have written; None where it is not there, or is not such a file.

    Links are not followed.
    """
    flags = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    try:
        with os.fdopen(os.open(path, flags), "rb") as file:
            status = os.fstat(file.fileno())
            if not stat.S_ISREG(status.st_mode) or stranger_to(status) is not None:
                return None
            return file.read()
    except (OSError, ValueError):
        return None
