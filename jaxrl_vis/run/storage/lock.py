"""Exclusive lock of a run folder: the file ``run.lock``, which names its holder.

If the file system supports locks, the operating system holds the lock and releases it when the holder ends in any manner.
Otherwise (some network and FUSE file systems), the existence of the file is the lock: it names host and process, and its holder
touches it every `HEARTBEAT_S` from a thread. The lock of a dead holder is taken over: on the same host once its process no
longer runs, from another host once the file was not touched for `LEASE_S`, by this host's own clock. `filelock` implements
both.
"""

import contextlib
import errno
import json
import os
import socket
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import filelock

from jaxrl_vis.errors import RequestError, StorageError
from jaxrl_vis.run.signals import shielded_children

FILE_NAME = "run.lock"
HEARTBEAT_S, LEASE_S = 5.0, 60.0
_POLL_S = 0.1
# Errors of file systems without locks: Lustre and FUSE, NFS without its lock daemon, 9p.
_NO_LOCKS = {errno.ENOSYS, errno.ENOLCK, errno.EINVAL, *(getattr(errno, name, None) for name in ("ENOTSUP", "EOPNOTSUPP"))}
_MARKER = "filelock/"  # first bytes of a file that is itself the lock
_HINT = "wait for it, stop it, or choose another --run-dir"


class FolderGoneError(StorageError):
    """Loss of the run folder: moved, deleted, or taken over. One line: the cause, and how to continue."""


class HeldLock:
    """Lock of a run folder held by this process.

    Args:
        folder: The folder, which must exist.

    Attributes:
        is_lost: True if another process has taken over the lock because this one seemed dead.
    """

    def __init__(self, folder: Path):
        self._folder, self.is_lost = folder, False
        self._marker: tuple[Path, os.stat_result] | None = None
        can_open = hasattr(os, "O_DIRECTORY")  # Windows cannot open folders
        self._descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY) if can_open else None

    def note_loss(self, _: object) -> None:
        """Record the loss of the lock; called from the heartbeat thread."""
        self.is_lost = True

    def watch(self, path: Path) -> None:
        """Register a file that is itself the lock, which is lost when another file takes its place."""
        self._marker = path, path.stat()

    def check(self) -> None:
        """Check that the lock is still held.

        Raises:
            FolderGoneError: The lock is lost.
        """
        if self._marker is not None:
            path, status = self._marker
            with contextlib.suppress(OSError):  # missing: the folder was moved, which other checks detect
                self.is_lost |= not os.path.samestat(path.stat(), status)
        if self.is_lost:
            raise FolderGoneError(
                f"{self._folder / FILE_NAME} is lost: another process took over, as this one did not respond for long. "
                "Earlier saves are good, nothing more is saved; --resume continues, unless another process does already"
            )

    def is_in_place(self) -> bool:
        """Return True if the folder is still the one under its name."""
        if (self._folder / FILE_NAME).exists():
            return True
        with contextlib.suppress(OSError):  # the folder may exist with its lock file deleted by hand
            return self._descriptor is not None and os.path.samestat(self._folder.stat(), os.fstat(self._descriptor))
        return False

    def current_path(self) -> Path | None:
        """Return the folder's current path; None if it was deleted, or the system does not report it."""
        if self._descriptor is None:
            return None
        with contextlib.suppress(OSError):
            current_path = Path(os.readlink(f"/proc/self/fd/{self._descriptor}"))
            if os.path.samestat(current_path.stat(), os.fstat(self._descriptor)):
                return current_path
        return None

    def close(self) -> None:
        """Close the folder."""
        if self._descriptor is not None:
            os.close(self._descriptor)


@contextlib.contextmanager
def run_lock(folder: Path, echo: Callable[[str], None] = print) -> Iterator[HeldLock]:
    """Lock a run folder and yield the lock. Create the folder if missing, and remove it if it is still empty at the end.

    Args:
        folder: The folder.
        echo: Called with one line if the file system has no locks, and if a dead holder's lock is taken over.

    Raises:
        RequestError: Another process holds the folder, or it cannot be written to.
    """
    path = folder / FILE_NAME
    try:
        folder.mkdir(parents=True, exist_ok=True)
        held = HeldLock(folder)
    except OSError as error:
        raise _unwritable(folder, error) from error
    try:
        with contextlib.ExitStack() as stack:
            try:
                if not _lock_by_system(path, stack):
                    _lock_by_marker(path, held, echo, stack)
            except OSError as error:
                raise _unwritable(folder, error) from error
            yield held
    finally:
        held.close()
        with contextlib.suppress(OSError):
            folder.rmdir()  # fails unless it is empty


def _lock_by_system(path: Path, stack: contextlib.ExitStack) -> bool:
    """Lock the file through the operating system until the end of ``stack``, and write this host and process into it.

    Returns:
        True if this process holds the lock. False if the file must itself serve as the lock (`_lock_by_marker`): the file
        system does not support locks, or another process has found that it does not and uses the file in this way.

    Raises:
        RequestError: Another process holds the lock.
        OSError: The file cannot be opened.
    """
    if _read(path).startswith(_MARKER) or not _has_locks(path.parent):
        return False
    lock = filelock.FileLock(path, thread_local=False, fallback_to_soft=False)
    try:
        lock.acquire(blocking=False)
    except filelock.Timeout:
        raise _in_use(path, _read(path)) from None
    if _read(path).startswith(_MARKER):  # by a faster process, which found no locks here
        lock.release()
        return False
    stack.callback(_release, lock, path, path.stat())
    with contextlib.suppress(OSError):  # on Windows a locked file cannot be written
        path.write_text(json.dumps({"host": socket.gethostname(), "process": os.getpid()}), encoding="utf-8")
    return True


def _has_locks(folder: Path) -> bool:
    """Return True if files in a folder can be locked; tested on an anonymous file, because a lock file would appear held."""
    with tempfile.TemporaryFile(dir=folder) as file:
        try:
            filelock.lock_descriptor(file.fileno(), blocking=False)
        except OSError as error:
            if error.errno in _NO_LOCKS:
                return False
            raise
    return True


def _release(lock: filelock.BaseFileLock, path: Path, status: os.stat_result) -> None:
    """Delete the lock file, unless it was replaced, and release the lock; on Windows in the reverse order."""
    if os.name == "nt":
        lock.release()
    with contextlib.suppress(OSError):
        if os.path.samestat(path.stat(), status):
            path.unlink()
    lock.release()


def _lock_by_marker(path: Path, lock: HeldLock, echo: Callable[[str], None], stack: contextlib.ExitStack) -> None:
    """Use the file itself as the lock until the end of ``stack``.

    Raises:
        RequestError: Another process holds it.
        OSError: It cannot be written.
    """
    if not _read(path).startswith(_MARKER):
        echo(f"the file system of {path.parent} has no locks: {FILE_NAME} is the lock itself, touched every {HEARTBEAT_S:g} s")
    lease = filelock.SoftFileLease(
        path,
        lease_duration=LEASE_S,
        heartbeat_interval=HEARTBEAT_S,
        on_compromise=lock.note_loss,
        thread_local=False,
    )
    last_touch: tuple[float, int] | None = None
    last_touch_at = 0.0
    while True:
        before = _read(path)
        if before and not before.startswith(_MARKER) and _is_alive_or_elsewhere(before):
            raise _in_use(path, before, f"if that has ended, delete {path}, else ")
        try:
            with shielded_children():
                lease.acquire(blocking=False)
            break
        except filelock.Timeout:
            now, text = _touch_time(path), _read(path)
            if last_touch is None and now is not None:
                echo(f"{path} belongs to {_holder(text)}: waiting up to {LEASE_S:g} s for a sign of life")
                last_touch, last_touch_at = now, time.monotonic()
            elif now is not None and now != last_touch and text:  # a new file is empty until its holder writes into it
                raise _in_use(path, text) from None
            elif now is not None and not text and time.monotonic() - last_touch_at > LEASE_S:  # `filelock` keeps these
                raise _in_use(path, text, f"if there is none, delete {path}, else ") from None
            time.sleep(_POLL_S)
        except filelock.LeaseSettingsMismatch:
            raise _in_use(path, _read(path)) from None
    stack.callback(lease.release)
    lock.watch(path)
    if before:
        echo(f"took over {path} of {_holder(before)}, which is dead")


def _touch_time(path: Path) -> tuple[float, int] | None:
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_mtime, status.st_ino


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace")[:1000]
    except OSError:
        return ""


def _owner(text: str) -> tuple[str, int] | None:
    """Parse host and process from a lock file of either form; None if it has another form."""
    with contextlib.suppress(ValueError, KeyError, TypeError):
        if not text.startswith(_MARKER):
            record = json.loads(text)
            return str(record["host"]), int(record["process"])
        fields = {key: value for key, _, value in (line.partition("=") for line in text.splitlines()[1:])}
        return fields["host"].partition("?")[0], int(fields["pid"])  # the part after it names the container
    return None


def _holder(text: str) -> str:
    owner = _owner(text)
    return "another process" if owner is None else f"process {owner[1]} on {owner[0]}"


def _is_alive_or_elsewhere(text: str) -> bool:
    """Return True if the process named by a system lock may still run; used where that lock is not available."""
    owner = _owner(text)
    if owner is None:
        return False
    host, process = owner
    if host != socket.gethostname():
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True


def _in_use(path: Path, text: str, hint: str = "") -> RequestError:
    return RequestError(f"{path.parent} is in use by {_holder(text)}: {hint}{_HINT}")


def _unwritable(folder: Path, error: OSError) -> RequestError:
    return RequestError(f"cannot write to {folder} ({error.strerror or error}): choose another --run-dir")
