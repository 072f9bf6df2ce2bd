"""One process of a run, and what its folder holds."""

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
"""Tiers of checkpoints; of those of the same iteration, a run goes on from the last."""


class Broken(AssertionError):
    """A promise was not kept."""


LAST = threading.local()
"""Output of the last process that ended in this thread: ``lines``."""


def environment() -> dict[str, str]:
    """Variables for a run of the checkout, on the CPU; programs that were traced once are kept, as for any user."""
    root = Path(__file__).parents[2]
    paths = os.pathsep.join(filter(None, (str(root), str(root / "envs"), os.environ.get("PYTHONPATH"))))
    variables = {name: value for name, value in os.environ.items() if name != "JAXRL_VIS_KEEP_PROGRAMS"}
    return {**variables, "JAX_PLATFORMS": "cpu", "PYTHONPATH": paths}


def read_rows(folder: Path, name: str = "metrics.jsonl") -> list[dict[str, Any]]:
    """Rows of a run's metrics without their times and the run's id; a line that is not one is left out."""
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
    """Finished checkpoints, iteration, tier, file or folder; the last one is what a run goes on from, if it is good."""
    places = [path for path in folder.glob("checkpoints/*/*") if path.parent.name in PRECEDENCE]
    names = [(path.name.removesuffix(".state"), path) for path in places]
    there = [(int(name), path.parent.name, path) for name, path in names if name.isdigit()]
    return sorted(there, key=lambda checkpoint: (checkpoint[0], PRECEDENCE.index(checkpoint[1])))


@dataclasses.dataclass
class Part:
    """One process of a run.

    Attributes:
        folder: The run folder.
        process: The process.
        lines: What it has said so far, stdout and stderr.
    """

    folder: Path
    process: subprocess.Popen
    lines: list[str] = dataclasses.field(default_factory=list)

    @classmethod
    def start(
        cls,
        folder: Path,
        variables: dict[str, str] | None = None,
        options: Sequence[str] = OPTIONS,
        file_bytes: int | None = None,
    ) -> "Part":
        """Start or resume the run in ``folder``; no file may become larger than ``file_bytes``."""
        goes_on = ["--resume"] if folder.exists() else []
        command = [sys.executable, "-m", "jaxrl_vis", "train", *options, "--run-dir", str(folder), *goes_on]
        return cls.command(command, folder, variables, file_bytes)

    @classmethod
    def command(
        cls, command: Sequence[str], folder: Path, variables: dict[str, str] | None = None, file_bytes: int | None = None
    ) -> "Part":
        """Start any command, which works beside ``folder``."""

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
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.append(line.rstrip())

    def end(self, seconds: float = 240.0) -> int:
        """Wait for the process and its last line; its exit status.

        Raises:
            Broken: It does not end.
        """
        try:
            status = self.process.wait(seconds)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
            raise Broken(f"did not end within {seconds:g} s: {self.lines[-3:]}") from None
        self.reader.join(5.0)
        LAST.lines = self.lines
        return status

    def send(self, number: int) -> int:
        """Send a signal and wait for the end; the exit status."""
        self.process.send_signal(number)
        return self.end()

    def stop(self) -> int:
        """SIGTERM, where the process still runs, and its end."""
        return self.send(signal.SIGTERM) if self.runs() else self.end()

    def runs(self) -> bool:
        """Return whether the process has not ended yet."""
        return self.process.poll() is None

    def wait_for(self, condition: Callable[[], bool], seconds: float = 180.0) -> bool:
        """Wait until something is so, and say whether it is; not longer than the process runs."""
        deadline = time.monotonic() + seconds
        while self.runs() and time.monotonic() < deadline:
            if condition():
                return True
            time.sleep(0.002)
        return condition()

    def is_compiling(self) -> bool:
        """Return whether compilation has begun."""
        return any(line.startswith("compiling") for line in self.lines)

    def is_training(self) -> bool:
        """Return whether compilation is over."""
        return any(line.startswith("compiled in") for line in self.lines)

    def is_saving(self) -> bool:
        """Return whether a checkpoint is half written."""
        return any("tmp" in path.name for path in self.folder.glob("checkpoints/*/*"))

    def count(self, words: str) -> int:
        """In how many lines these words were said."""
        return sum(words in line for line in self.lines)

    def check_words(self) -> None:
        """Raise `Broken` where there was a traceback, or Python's own words for a crash."""
        said = "\n".join(self.lines)
        if "Traceback" in said or "Fatal Python error" in said:
            raise Broken(f"a traceback\n{said}")


@contextlib.contextmanager
def killed_afterwards(part: Part) -> Iterator[Part]:
    """Leaves no process behind, whatever happens."""
    try:
        yield part
    finally:
        if part.runs():
            with contextlib.suppress(ProcessLookupError):
                os.killpg(part.process.pid, signal.SIGKILL)
            part.process.wait()
