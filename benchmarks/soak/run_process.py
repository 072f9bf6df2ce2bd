"""One process of a run, and the contents of its folder."""

import contextlib
import dataclasses
import json
import os
import resource
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

ITERATIONS, STEPS = 240, 200  # environment steps of an iteration: 4 environments, 50 steps each
OPTIONS = [
    *("Reacher", "--preset", "debug", "--env-steps", str(ITERATIONS * STEPS), "--updates-per-iteration", "20"),
    *("--eval-interval", "10", "--checkpoint-interval", "4", "--replay-transitions", "4000"),
]


PRECEDENCE = ("light", "recent", "full")
"""Tiers of checkpoints; among those of the same iteration, a run resumes from the last in this order."""


class Broken(AssertionError):
    """Violation of a guarantee."""


LAST_OUTPUT = threading.local()
"""Thread-local output of the last process that ended, in its attribute ``lines``."""


def environment() -> dict[str, str]:
    """Return the environment variables of a run of the checkout on the CPU; traced programs are cached, as for any user."""
    root = Path(__file__).parents[2]
    paths = os.pathsep.join(filter(None, (str(root), str(root / "envs"), os.environ.get("PYTHONPATH"))))
    variables = {name: value for name, value in os.environ.items() if name != "JAXRL_VIS_KEEP_PROGRAMS"}
    return {**variables, "JAX_PLATFORMS": "cpu", "PYTHONPATH": paths}


def read_rows(folder: Path, name: str = "metrics.jsonl") -> list[dict[str, Any]]:
    """Read the rows of a run's metrics, without times and the run's id; invalid lines are omitted."""
    rows = []
    file = folder / name
    for line in file.read_bytes().splitlines() if file.exists() else []:
        try:
            row = json.loads(line)
        except ValueError:
            continue
        if isinstance(row, dict):
            rows.append({name: value for name, value in row.items() if not name.startswith("time/") and name != "run_id"})
    return rows


def list_checkpoints(folder: Path) -> list[tuple[int, str, Path]]:
    """List the complete checkpoints (iteration, tier, file or folder); a run resumes from the last one, if it is intact."""
    places = [path for path in folder.glob("checkpoints/*/*") if path.parent.name in PRECEDENCE]
    names = [(path.name.removesuffix(".state"), path) for path in places]
    there = [(int(name), path.parent.name, path) for name, path in names if name.isdigit()]
    return sorted(there, key=lambda checkpoint: (checkpoint[0], PRECEDENCE.index(checkpoint[1])))


@dataclasses.dataclass
class RunProcess:
    """One process of a run.

    Attributes:
        folder: The run folder.
        popen: The process.
        lines: Lines printed so far, stdout and stderr.
    """

    folder: Path
    popen: subprocess.Popen
    lines: list[str] = dataclasses.field(default_factory=list)

    @classmethod
    def start(
        cls,
        folder: Path,
        variables: dict[str, str] | None = None,
        options: Sequence[str] | None = None,
        file_bytes: int | None = None,
    ) -> "RunProcess":
        """Start or resume the run in ``folder`` (`OPTIONS` by default); ``file_bytes`` limits the size of each file."""
        resume_option = ["--resume"] if folder.exists() else []
        command = [
            sys.executable,
            "-m",
            "jaxrl_vis",
            "train",
            *(OPTIONS if options is None else options),
            "--run-dir",
            str(folder),
            *resume_option,
        ]
        return cls.start_command(command, folder, variables, file_bytes)

    @classmethod
    def start_command(
        cls, command: Sequence[str], folder: Path, variables: dict[str, str] | None = None, file_bytes: int | None = None
    ) -> "RunProcess":
        """Start any command in the parent of ``folder``, in a session of its own.

        Args:
            command: The command.
            folder: Run folder of the command.
            variables: Additional environment variables.
            file_bytes: Maximum size of a file that the process writes, bytes; None for no limit.
        """

        def prepare() -> None:
            for number in (signal.SIGINT, signal.SIGHUP):  # ignored if the soak was started in the background
                signal.signal(number, signal.SIG_DFL)
            if file_bytes is not None:
                resource.setrlimit(resource.RLIMIT_FSIZE, (file_bytes, resource.RLIM_INFINITY))

        process = subprocess.Popen(
            command, env=environment() | (variables or {}), cwd=folder.parent, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            text=True, errors="replace", start_new_session=True, preexec_fn=prepare,
        )  # fmt: skip
        part = cls(folder, process)
        part.reader.start()
        return part

    def __post_init__(self) -> None:
        self.reader = threading.Thread(target=self._read, daemon=True)

    def _read(self) -> None:
        assert self.popen.stdout is not None
        for line in self.popen.stdout:
            self.lines.append(line.rstrip())

    def wait(self, seconds: float = 240.0) -> int:
        """Wait for the process and its last line, and store its output in `LAST_OUTPUT`; return its exit status.

        Raises:
            Broken: The process does not end in time; it is killed.
        """
        try:
            status = self.popen.wait(seconds)
        except subprocess.TimeoutExpired:
            self.popen.kill()
            self.popen.wait()
            raise Broken(f"did not end within {seconds:g} s: {self.lines[-3:]}") from None
        self.reader.join(5.0)
        LAST_OUTPUT.lines = self.lines
        return status

    def send(self, number: int) -> int:
        """Send a signal and wait for the end; return the exit status."""
        self.popen.send_signal(number)
        return self.wait()

    def stop(self) -> int:
        """Send SIGTERM if the process still runs, and wait for its end; return the exit status."""
        return self.send(signal.SIGTERM) if self.is_running() else self.wait()

    def is_running(self) -> bool:
        """Return True if the process has not ended yet."""
        return self.popen.poll() is None

    def wait_for(self, condition: Callable[[], bool], seconds: float = 180.0) -> bool:
        """Wait until a condition holds, ``seconds`` have passed or the process ends; return True if the condition holds."""
        deadline = time.monotonic() + seconds
        while self.is_running() and time.monotonic() < deadline:
            if condition():
                return True
            time.sleep(0.002)
        return condition()

    def is_compiling(self) -> bool:
        """Return True if compilation has begun."""
        return any(line.startswith("compiling") for line in self.lines)

    def is_training(self) -> bool:
        """Return True if compilation is over."""
        return any(line.startswith("compiled in") for line in self.lines)

    def is_saving(self) -> bool:
        """Return True if a checkpoint is being written."""
        return any("tmp" in path.name for path in self.folder.glob("checkpoints/*/*"))

    def count(self, text: str) -> int:
        """Count the printed lines that contain ``text``."""
        return sum(text in line for line in self.lines)

    def check_output(self) -> None:
        """Raise `Broken` if a traceback or a fatal error of Python was printed."""
        said = "\n".join(self.lines)
        if "Traceback" in said or "Fatal Python error" in said:
            raise Broken(f"a traceback\n{said}")


@contextlib.contextmanager
def kill_on_exit(process: RunProcess) -> Iterator[RunProcess]:
    """Kill the process and its group on exit, if it still runs."""
    try:
        yield process
    finally:
        if process.is_running():
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.popen.pid, signal.SIGKILL)
            process.popen.wait()
