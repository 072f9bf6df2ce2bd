"""One writer for a run folder, where the operating system has locks and where it has none."""

import errno
import json
import os
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from jaxrl_vis.errors import RequestError
from jaxrl_vis.run.storage import lock
from jaxrl_vis.run.storage.lock import FILE_NAME, FolderGoneError, run_lock

fcntl = pytest.importorskip("fcntl")
DEAD = 2**22 + 1  # a process of this number there cannot be, on Linux


@pytest.fixture
def no_locks(monkeypatch):
    """File system without locks, on which holders count as dead after a second."""

    def refuse(*_):
        raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))

    monkeypatch.setattr(fcntl, "flock", refuse)
    monkeypatch.setattr(lock, "HEARTBEAT_S", 0.15)
    monkeypatch.setattr(lock, "LEASE_S", 1.0)


def marker(host: str, process: int) -> str:
    """Return the contents of a holder's lock file on a file system without locks."""
    return f"filelock/2\npid={process}\nhost={host}\nmode=lease\ntoken={'0' * 32}\nduration=1.0\n"


def test_without_locks_a_second_process_is_refused(tmp_path, no_locks):
    said: list[str] = []
    with run_lock(tmp_path / "run", said.append) as held:
        assert "has no locks" in said[0]
        held.check()
        text = (tmp_path / "run" / FILE_NAME).read_text()
        assert f"pid={os.getpid()}\n" in text and f"host={socket.gethostname()}" in text
        with pytest.raises(RequestError, match=rf"in use by process {os.getpid()} on \S+: wait") as refused:
            with run_lock(tmp_path / "run", said.append):
                pass
        assert "\n" not in str(refused.value)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("error", [errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP, errno.EINVAL])
def test_whatever_a_file_system_says_that_has_no_locks_is_understood(tmp_path, no_locks, monkeypatch, error):
    def refuse(*_):
        raise OSError(error, os.strerror(error))

    monkeypatch.setattr(fcntl, "flock", refuse)
    said: list[str] = []
    with run_lock(tmp_path, said.append):
        assert (tmp_path / FILE_NAME).read_text().startswith("filelock/") and len(said) == 1


def test_a_dead_process_of_this_host_is_taken_over_at_once(tmp_path, no_locks, clean_environment):
    code = f"""
import errno, fcntl, os, signal
from pathlib import Path
def refuse(*_):
    raise OSError(errno.ENOSYS, "none")
fcntl.flock = refuse
from jaxrl_vis.run.storage import lock
lock.LEASE_S, lock.HEARTBEAT_S = 1.0, 0.15
with lock.run_lock(Path({str(tmp_path)!r})):
    os.kill(os.getpid(), signal.SIGKILL)
"""
    subprocess.run([sys.executable, "-c", code], env=clean_environment, capture_output=True)
    dead = (tmp_path / FILE_NAME).read_text().split("pid=")[1].split()[0]
    said: list[str] = []
    started = time.monotonic()
    with run_lock(tmp_path, said.append) as held:
        assert time.monotonic() - started < 0.9 and f"took over {tmp_path / FILE_NAME} of process {dead} on" in said[-1]
        held.check()
    # A number that another process has by now does not keep it alive: when that started is compared, too.
    text = f"{marker(socket.gethostname(), os.getpid())}start=1\n"
    tmp_path.mkdir(exist_ok=True)
    (tmp_path / FILE_NAME).write_text(text)
    with run_lock(tmp_path, said.append):
        assert "took over" in said[-1]


def test_a_process_of_another_host_that_touches_its_file_is_refused(tmp_path, no_locks):
    path = tmp_path / FILE_NAME
    path.write_text(marker("elsewhere", 7))
    ended = threading.Event()

    def beat() -> None:
        while not ended.wait(0.1):
            os.utime(path)

    thread = threading.Thread(target=beat)
    thread.start()
    said: list[str] = []
    try:
        with pytest.raises(RequestError, match="in use by process 7 on elsewhere: wait"):
            with run_lock(tmp_path, said.append):
                pass
    finally:
        ended.set()
        thread.join()
    assert "belongs to process 7 on elsewhere: waiting up to 1 s for a sign of life" in said[-1] and path.exists()


def test_a_process_of_another_host_that_does_not_is_taken_over(tmp_path, no_locks):
    path = tmp_path / FILE_NAME
    path.write_text(marker("elsewhere", 7))
    os.utime(path, (time.time() + 10**6, time.time() + 10**6))  # by whatever clock
    said: list[str] = []
    started = time.monotonic()
    with run_lock(tmp_path, said.append):
        assert time.monotonic() - started > 0.9 and "took over" in said[-1] and "process 7 on elsewhere" in said[-1]
        assert f"pid={os.getpid()}\n" in path.read_text()


@pytest.mark.parametrize(
    "leftover", [None, marker("elsewhere", 7), marker(socket.gethostname(), DEAD)], ids=["new", "old", "dead"]
)
def test_of_two_that_start_at_once_one_wins(tmp_path, no_locks, leftover):
    if leftover is not None:
        (tmp_path / FILE_NAME).write_text(leftover)
    outcomes: list[str] = []
    everybody = threading.Barrier(4)

    def start() -> None:
        everybody.wait()
        try:
            with run_lock(tmp_path, lambda _: None):
                outcomes.append("won")
                everybody.wait(20)
        except RequestError as error:
            outcomes.append(str(error))
            everybody.wait(20)

    threads = [threading.Thread(target=start) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert outcomes.count("won") == 1 and sum("in use by process" in outcome for outcome in outcomes) == 3


def test_a_file_without_words_is_waited_for(tmp_path, no_locks):
    """A holder creates its file and then writes into it, unless it dies in between."""
    path = tmp_path / FILE_NAME
    path.touch()
    writing = threading.Timer(0.3, path.write_text, [marker("elsewhere", 7)])
    writing.start()
    with pytest.raises(RequestError, match="in use by process 7 on elsewhere: wait"), run_lock(tmp_path, lambda _: None):
        pass
    writing.join()
    path.write_text("")
    with pytest.raises(RequestError, match=f"in use by another process: if there is none, delete {path}, else wait"):
        with run_lock(tmp_path, lambda _: None):
            pass
    path.unlink()
    with run_lock(tmp_path, lambda _: None):
        pass


def test_whoever_was_taken_for_dead_saves_nothing_any_more(tmp_path, no_locks):
    with run_lock(tmp_path, lambda _: None) as held:
        held.check()
        other = tmp_path / "other"
        other.write_text(marker("elsewhere", 7))
        other.replace(tmp_path / FILE_NAME)
        with pytest.raises(FolderGoneError, match="another process took over"):
            held.check()
    assert "elsewhere" in (tmp_path / FILE_NAME).read_text()  # and does not take the other's away


def test_locks_of_both_kinds_see_each_other(tmp_path, no_locks, monkeypatch):
    """A file system may have locks for one host only, and a folder's last holder may have been an earlier version."""
    said: list[str] = []
    with run_lock(tmp_path, said.append):
        monkeypatch.undo()  # for this process there are locks
        monkeypatch.setattr(lock, "HEARTBEAT_S", 0.15)
        monkeypatch.setattr(lock, "LEASE_S", 1.0)
        with pytest.raises(RequestError, match=f"in use by process {os.getpid()}"), run_lock(tmp_path, said.append):
            pass
    (tmp_path / FILE_NAME).unlink(missing_ok=True)

    def refuse(*_):
        raise OSError(errno.ENOSYS, "none")

    with run_lock(tmp_path, said.append):
        assert json.loads((tmp_path / FILE_NAME).read_text()) == {"host": socket.gethostname(), "process": os.getpid()}
        with monkeypatch.context() as patched:
            patched.setattr(fcntl, "flock", refuse)
            with pytest.raises(RequestError, match=f"in use by process {os.getpid()}.*if that has ended, delete"):
                with run_lock(tmp_path, said.append):
                    pass


def test_a_lock_of_the_system_leaves_another_ones_file_alone(tmp_path):
    """The file is another run's if the folder was moved, and another run started under its name."""
    with run_lock(tmp_path):
        (tmp_path / FILE_NAME).unlink()
        Path(tmp_path / FILE_NAME).write_text("another")
    assert (tmp_path / FILE_NAME).read_text() == "another"
