"""One writer for a run folder: the file ``run.lock``, locked by the operating system and naming who holds it."""

import contextlib
import json
import os
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from jaxrl_vis.errors import RequestError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

FILE_NAME = "run.lock"


@contextlib.contextmanager
def run_lock(folder: Path) -> Iterator[None]:
    """Holds a run folder; makes it where it is missing, and removes it again if it is still empty afterwards.

    The operating system lets go of the lock when its holder dies, however it dies, so a dead holder's lock is taken over.

    Raises:
        RequestError: Another process holds the folder, or it cannot be written to.
    """
    path = folder / FILE_NAME
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = _locked(path)
    except OSError as error:
        raise RequestError(f"cannot write to {folder} ({error.strerror}): choose another --run-dir") from error
    try:
        file.truncate(0)
        file.write(json.dumps({"host": socket.gethostname(), "process": os.getpid()}))
        file.flush()
        yield
    finally:
        with contextlib.suppress(OSError):
            path.unlink()
        file.close()
        with contextlib.suppress(OSError):
            folder.rmdir()  # only an empty one goes


def _locked(path: Path) -> IO[str]:
    """The open lock file, locked.

    Raises:
        RequestError: Another process holds it.
        OSError: It cannot be opened.
    """
    while True:
        file = path.open("a+", encoding="utf-8")
        if fcntl is None:
            return file
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            holder = _holder(file.read())
            file.close()
            raise RequestError(
                f"{path.parent} is in use by {holder}: wait for it, stop it, or choose another --run-dir"
            ) from None
        except OSError:  # a file system without locks
            return file
        # The last holder may have removed the file between the two calls: then this lock is on a file that nobody else sees.
        with contextlib.suppress(FileNotFoundError):
            if os.fstat(file.fileno()).st_ino == path.stat().st_ino:
                return file
        file.close()


def _holder(text: str) -> str:
    try:
        record = json.loads(text)
        return f"process {record['process']} on {record['host']}"
    except (ValueError, KeyError, TypeError):
        return "another process"
