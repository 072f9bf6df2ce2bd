"""Run the readers of untrusted files in a separate process, so that crashes in C libraries are reported.

    worker = Worker()
    outcome = worker.read("calibration", {"rig.yaml": b"..."})

A reader is a function of a folder. Times are CPU times, so that the load of the machine does not matter, and memory is the peak
of the call above the memory in use before.
"""

import contextlib
import dataclasses
import os
import pickle
import resource
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

SECONDS, MEGABYTES = 1.0, 200.0
_PATIENCE = 60  # s of the clock after which a call is taken to hang


@dataclasses.dataclass(frozen=True)
class Outcome:
    """Outcome of a call.

    Attributes:
        kind: ``value``, ``refused`` (one of the reader's own errors), or ``fault``.
        parsed: True if the parser accepted the file.
        text: Message of the error; of a fault, the traceback.
        seconds, megabytes: CPU time, s, and peak memory, MB, of the call.
    """

    kind: str
    parsed: bool
    text: str = ""
    seconds: float = 0.0
    megabytes: float = 0.0


@dataclasses.dataclass(frozen=True)
class Reader:
    """Reader of a kind of file.

    Attributes:
        read: Function that reads the files in a folder, and checks the result.
        parsed: Function that returns True if the parser accepts the files in a folder.
        expected_errors: Errors that it may raise for bad files.
    """

    read: Callable[[Path], Any]
    parsed: Callable[[Path], bool]
    expected_errors: tuple[type[Exception], ...]


def call(reader: Reader, folder: Path) -> Outcome:
    """Call a reader in this process, and return the outcome."""
    import traceback

    parsed = reader.parsed(folder)
    before = _reset_peak()
    started = time.process_time()
    try:
        reader.read(folder)
        kind, text = "value", ""
    except BaseException as error:
        seconds = time.process_time() - started
        expected = reader.expected_errors
        is_expected = type(error) in expected or isinstance(error, tuple(set(expected) - {ValueError}))
        text = str(error)
        kind = "refused" if is_expected else "fault"
        if is_expected and (len(text.splitlines()) != 1 or len(text) > 2000):
            kind, text = "fault", f"not one line: {text[:300]!r}"
        elif not is_expected:
            text = traceback.format_exc()[-3000:]
    else:
        seconds = time.process_time() - started
    return Outcome(kind, parsed, text, seconds, max(_peak() - before, 0.0))


def _reset_peak() -> float:
    """Reset the peak memory if the system supports it, and return the memory in use, MB; else return the peak so far."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
        return _peak()
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _peak() -> float:
    with contextlib.suppress(OSError, StopIteration):
        lines = Path("/proc/self/status").read_text().splitlines()
        return int(next(line.split()[1] for line in lines if line.startswith("VmHWM"))) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def write_files(folder: Path, files: Mapping[str, bytes]) -> None:
    """Create a folder with these files, replacing an existing one."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True, exist_ok=True)
    for name, data in files.items():
        path = folder / name
        with contextlib.suppress(FileExistsError, NotADirectoryError, IsADirectoryError):  # two that cannot both be there
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)


class Worker:
    """Process that calls readers; started at the first call, and again after a crash."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._folder = Path(tempfile.mkdtemp(prefix="readers-"))

    def close(self) -> None:
        """Kill the process, and remove its folder."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
        self._process = None
        shutil.rmtree(self._folder, ignore_errors=True)

    def read(self, name: str, files: Mapping[str, bytes]) -> Outcome:
        """Return the outcome of reading files, given by name.

        A crash of the process is a fault, or a refusal if MuJoCo's own parser crashed; the next call starts a new process.
        """
        if os.environ.get("JAXRL_VIS_READERS_HERE"):  # so that coverage sees them
            write_files(self._folder / "files", files)
            return dataclasses.replace(call(readers()[name], self._folder / "files"), seconds=0.0, megabytes=0.0)
        if self._process is None:
            self._process = subprocess.Popen(
                [sys.executable, __file__, str(self._folder)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=(self._folder / "stderr").open("wb"),
                env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "OPENCV_LOG_LEVEL": "OFF"},
            )
        process = self._process
        assert process.stdin is not None and process.stdout is not None
        message = pickle.dumps((name, dict(files)))
        try:
            process.stdin.write(struct.pack("<Q", len(message)) + message)
            process.stdin.flush()
            size = process.stdout.read(8)
            if len(size) == 8:
                return pickle.loads(process.stdout.read(struct.unpack("<Q", size)[0]))
        except BrokenPipeError:
            pass
        code = process.wait()
        self._process = None
        said = (self._folder / "stderr").read_bytes()[-2000:].decode(errors="replace")
        parsed = not (self._folder / "loading").exists()
        why = "hung" if code == -signal.SIGALRM else f"ended with {code}"
        # What MuJoCo's own parser does is not ours.
        return Outcome("fault" if parsed else "refused", parsed, f"the process {why}: {said}")


def serve(folder: Path) -> None:
    """Serve calls until standard input ends.

    Write the files of each call below ``folder``, read them, and write the outcome to standard output.
    """
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # libraries print
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    known, warm = readers(), set()
    while len(size := sys.stdin.buffer.read(8)) == 8:
        name, files = pickle.loads(sys.stdin.buffer.read(struct.unpack("<Q", size)[0]))
        write_files(folder / "files", files)
        signal.alarm(_PATIENCE)
        if name not in warm:
            call(known[name], folder / "files")  # which imports what it needs
            warm.add(name)
        outcome = pickle.dumps(call(known[name], folder / "files"))
        signal.alarm(0)
        answers.write(struct.pack("<Q", len(outcome)) + outcome)
        answers.flush()


def readers() -> dict[str, Reader]:
    """Return all readers by kind of file."""
    import readers_of_files
    import readers_of_runs

    return {**readers_of_files.READERS, **readers_of_runs.READERS}


if __name__ == "__main__":
    import readers_worker  # by its name: what is pickled says where it is from

    readers_worker.serve(Path(sys.argv[1]))
