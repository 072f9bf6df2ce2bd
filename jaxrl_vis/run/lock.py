"""One writer for a run folder: the file ``run.lock``, which says who holds it.

Where the file system has locks, the operating system holds it, and lets go when the holder dies, however it dies. Where it has
none (some network and FUSE file systems), the file itself is the lock: it names host and process, and its holder touches it
every `HEARTBEAT_S` in a thread of its own. A dead holder's is taken over: on this host when no such process runs any more, of
another host when the file was left untouched for `LEASE_S`, by this host's own clock. `filelock` does both.
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
# What file systems answer that have no locks: Lustre and FUSE, NFS without its lock daemon, 9p.
_NO_LOCKS = {errno.ENOSYS, errno.ENOLCK, errno.EINVAL, *(getattr(errno, name, None) for name in ("ENOTSUP", "EOPNOTSUPP"))}
_MARKER = "filelock/"  # what a file that is the lock itself begins with
_MEND = "wait for it, stop it, or choose another --run-dir"


class FolderGoneError(StorageError):
    """The run folder is not this process's any more: moved, deleted, or taken over. One line: what, and how to go on."""


class Held:
    """A run folder that this process holds.

    Args:
        folder: The folder, which is there.

    Attributes:
        is_lost: Whether another process has taken the lock over, as it has taken this one for dead.
    """

    def __init__(self, folder: Path):
        self._folder, self.is_lost = folder, False
        self._marker: tuple[Path, os.stat_result] | None = None
        can_open = hasattr(os, "O_DIRECTORY")  # Windows opens no folders
        self._descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY) if can_open else None

    def note_loss(self, _: object) -> None:
        """Takes down that the lock is lost; called from the thread that touches it."""
        self.is_lost = True

    def watch(self, path: Path) -> None:
        """Takes a file for the lock itself, which is lost when there is another one in its place."""
        self._marker = path, path.stat()

    def check(self) -> None:
        """Checks that the lock is still held.

        Raises:
            FolderGoneError: It is lost.
        """
        if self._marker is not None:
            path, status = self._marker
            with contextlib.suppress(OSError):  # not there: the folder was moved, which others find out
                self.is_lost |= not os.path.samestat(path.stat(), status)
        if self.is_lost:
            raise FolderGoneError(
                f"{self._folder / FILE_NAME} is lost: another process has taken this one for dead, as it stood still for long. "
                "What was saved before is good, and no more is saved; --resume goes on, unless another process does already"
            )

    def is_in_place(self) -> bool:
        """Returns whether the folder still lies under its name, and not another one, or none."""
        if (self._folder / FILE_NAME).exists():
            return True
        with contextlib.suppress(OSError):  # the folder may be there, and the lock's file deleted by hand
            return self._descriptor is not None and os.path.samestat(self._folder.stat(), os.fstat(self._descriptor))
        return False

    def place(self) -> Path | None:
        """Present path of the folder, if it was moved; None where it was deleted, or the system does not say."""
        if self._descriptor is None:
            return None
        with contextlib.suppress(OSError):
            place = Path(os.readlink(f"/proc/self/fd/{self._descriptor}"))
            if os.path.samestat(place.stat(), os.fstat(self._descriptor)):
                return place
        return None

    def close(self) -> None:
        """Lets go of the folder."""
        if self._descriptor is not None:
            os.close(self._descriptor)


@contextlib.contextmanager
def run_lock(folder: Path, say: Callable[[str], None] = print) -> Iterator[Held]:
    """Holds a run folder; makes it where it is missing, and removes it again if it is still empty afterwards.

    Args:
        folder: The folder.
        say: Called with one line where the file system has no locks, and where a dead holder's lock is taken over.

    Raises:
        RequestError: Another process holds the folder, or it cannot be written to.
    """
    path = folder / FILE_NAME
    try:
        folder.mkdir(parents=True, exist_ok=True)
        held = Held(folder)
    except OSError as error:
        raise _unwritable(folder, error) from error
    try:
        with contextlib.ExitStack() as stack:
            try:
                if not _lock_by_system(path, stack):
                    _lock_by_marker(path, held, say, stack)
            except OSError as error:
                raise _unwritable(folder, error) from error
            yield held
    finally:
        held.close()
        with contextlib.suppress(OSError):
            folder.rmdir()  # only an empty one goes


def _lock_by_system(path: Path, stack: contextlib.ExitStack) -> bool:
    """Locks the file until the end of ``stack``; False where the file system has no locks, or the holder has found none.

    Raises:
        RequestError: Another process holds it.
        OSError: It cannot be opened.
    """
    if _read(path).startswith(_MARKER) or not _has_locks(path.parent):
        return False
    lock = filelock.FileLock(path, thread_local=False, fallback_to_soft=False)
    try:
        lock.acquire(blocking=False)
    except filelock.Timeout:
        raise _in_use(path, _read(path)) from None
    if _read(path).startswith(_MARKER):  # by a process that was faster, and finds no locks here
        lock.release()
        return False
    stack.callback(_release, lock, path, path.stat())
    with contextlib.suppress(OSError):  # on Windows nobody writes into a locked file
        path.write_text(json.dumps({"host": socket.gethostname(), "process": os.getpid()}), encoding="utf-8")
    return True


def _has_locks(folder: Path) -> bool:
    """Returns whether files there can be locked, tried on one that nobody else sees: a lock file would look held."""
    with tempfile.TemporaryFile(dir=folder) as file:
        try:
            filelock.lock_descriptor(file.fileno(), blocking=False)
        except OSError as error:
            if error.errno in _NO_LOCKS:
                return False
            raise
    return True


def _release(lock: filelock.BaseFileLock, path: Path, status: os.stat_result) -> None:
    """Deletes a lock file, if it is not another one by now, and lets go of it; on Windows the other way round."""
    if os.name == "nt":
        lock.release()
    with contextlib.suppress(OSError):
        if os.path.samestat(path.stat(), status):
            path.unlink()
    lock.release()


def _lock_by_marker(path: Path, held: Held, say: Callable[[str], None], stack: contextlib.ExitStack) -> None:
    """Makes the file the lock until the end of ``stack``.

    Raises:
        RequestError: Another process holds it.
        OSError: It cannot be written.
    """
    if not _read(path).startswith(_MARKER):
        say(f"the file system of {path.parent} has no locks: {FILE_NAME} is the lock itself, touched every {HEARTBEAT_S:g} s")
    lease = filelock.SoftFileLease(
        path,
        lease_duration=LEASE_S,
        heartbeat_interval=HEARTBEAT_S,
        on_compromise=held.note_loss,
        thread_local=False,
    )
    seen: tuple[float, int] | None = None
    seen_at = 0.0
    while True:
        before = _read(path)
        if before and not before.startswith(_MARKER) and _is_alive_or_elsewhere(before):
            raise _in_use(path, before, f"if that has ended, delete {path}, else ")
        try:
            with shielded_children():
                lease.acquire(blocking=False)
            break
        except filelock.Timeout:
            now, text = _touched(path), _read(path)
            if seen is None and now is not None:
                say(f"{path} is that of {_holder(text)}: waiting up to {LEASE_S:g} s for a sign of life of it")
                seen, seen_at = now, time.monotonic()
            elif now is not None and now != seen and text:  # empty until its holder, who has just made it, writes into it
                raise _in_use(path, text) from None
            elif now is not None and not text and time.monotonic() - seen_at > LEASE_S:  # which `filelock` never takes over
                raise _in_use(path, text, f"if there is none, delete {path}, else ") from None
            time.sleep(_POLL_S)
        except filelock.LeaseSettingsMismatch:
            raise _in_use(path, _read(path)) from None
    stack.callback(lease.release)
    held.watch(path)
    if before:
        say(f"took over {path} of {_holder(before)}, which is dead")


def _touched(path: Path) -> tuple[float, int] | None:
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
    """Host and process of what a lock file says, in either form."""
    with contextlib.suppress(ValueError, KeyError, TypeError):
        if not text.startswith(_MARKER):
            record = json.loads(text)
            return str(record["host"]), int(record["process"])
        fields = {key: value for key, _, value in (line.partition("=") for line in text.splitlines()[1:])}
        return fields["host"].partition("?")[0], int(fields["pid"])  # after it: which of its containers
    return None


def _holder(text: str) -> str:
    owner = _owner(text)
    return "another process" if owner is None else f"process {owner[1]} on {owner[0]}"


def _is_alive_or_elsewhere(text: str) -> bool:
    """Returns whether the process that a system's lock names may still run, asked where that lock cannot be."""
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


def _in_use(path: Path, text: str, mend: str = "") -> RequestError:
    return RequestError(f"{path.parent} is in use by {_holder(text)}: {mend}{_MEND}")


def _unwritable(folder: Path, error: OSError) -> RequestError:
    return RequestError(f"cannot write to {folder} ({error.strerror or error}): choose another --run-dir")
