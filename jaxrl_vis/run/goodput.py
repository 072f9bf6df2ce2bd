"""Goodput: fraction of the computed gradient steps that are contained in the networks, over all processes of a run.

processes.jsonl has one line per process that has trained the run:

    {"start": 35, "begun": 48, "replay_lost": false}

This process resumed from iteration 35 with the replay, and has begun 48 more iterations. The line is overwritten in place at
each iteration, without waiting for the disk: data written by a process survives its end, and a power cut loses only the last
seconds. An iteration counts as begun when its gradient steps are dispatched to the device, so the goodput reported for a killed
run is a lower bound.
"""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import IO

_WIDTH = 80  # bytes per line, newline included, so that a line never overwrites the next one


@dataclasses.dataclass
class Process:
    """One line of the file.

    Attributes:
        start: Iteration from which the process resumed; 0 if it started the run.
        begun: Iterations begun by the process.
        replay_lost: True if it resumed with an empty replay.
    """

    start: int
    begun: int = 0
    replay_lost: bool = False

    def __bytes__(self) -> bytes:
        return (json.dumps(dataclasses.asdict(self)).ljust(_WIDTH - 1) + "\n").encode()


@dataclasses.dataclass(frozen=True)
class Account:
    """Account of the iterations of a run.

    Attributes:
        done: Iterations contained in the networks.
        begun: Iterations begun by all processes; None if a line cannot be read.
        resumes: Number of resumptions.
        replays_lost: Number of resumptions with an empty replay.
    """

    done: int
    begun: int | None
    resumes: int
    replays_lost: int

    @property
    def goodput(self) -> float | None:
        """Fraction of the begun iterations that are contained in the networks; 1 before the first one, None if unknown."""
        if self.begun is None:
            return None
        return self.done / self.begun if self.begun else 1.0

    def describe(self, updates: int) -> str:
        """Format the account as one line; ``updates``: gradient steps per iteration."""
        if self.begun is None:
            text = "goodput unknown (processes.jsonl is damaged)"
        else:
            text = f"goodput {self.goodput:.3f}: {self.done * updates:,} of {self.begun * updates:,} gradient steps are kept"
        return f"{text}; resumed {_times(self.resumes)}, replay lost {_times(self.replays_lost)}"


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


def account(processes: Sequence[Process | None], done: int) -> Account:
    """Sum up the processes of a run.

    Args:
        processes: As `read_processes` returns them.
        done: Iterations contained in the networks.
    """
    known = [process for process in processes if process is not None]
    begun = sum(process.begun for process in known) if len(known) == len(processes) else None
    return Account(done, begun, max(0, len(processes) - 1), sum(process.replay_lost for process in known))


def read_processes(path: Path) -> list[Process | None]:
    """Read the processes of a run in order, None for a damaged line; empty if there is no file."""
    if not path.exists():
        return []
    return [_process(line) for line in path.read_bytes().splitlines() if line.strip()]


def _process(line: bytes) -> Process | None:
    try:
        process = Process(**json.loads(line))
    except (ValueError, TypeError):
        return None
    counts = (process.start, process.begun)
    is_good = all(type(count) is int and count >= 0 for count in counts) and type(process.replay_lost) is bool
    return process if is_good else None


class Goodput:
    """Counter of the iterations begun by this process, in its line of the file. Nothing is written before `begin`.

    Args:
        path: processes.jsonl.
    """

    def __init__(self, path: Path):
        self._path = path
        self._earlier: list[Process | None] = []
        self._own = Process(0)
        self._file: IO[bytes] | None = None
        self._offset = 0

    def begin(self, iteration: int, replay_lost: bool) -> None:
        """Append a line for this process.

        Args:
            iteration: Iteration from which it resumes; 0 for a new run.
            replay_lost: True if it resumes without the replay.

        Raises:
            OSError: The file cannot be written.
        """
        self._earlier = read_processes(self._path)
        before = self._path.read_bytes() if self._earlier else b""
        if not self._earlier and iteration:  # only the result of earlier processes is known
            self._earlier = [Process(0, iteration)]
            before = bytes(Process(0, iteration))
        if before and not before.endswith(b"\n"):
            before += b"\n"
        self._own, self._offset = Process(iteration, 0, replay_lost), len(before)
        self._path.write_bytes(before + bytes(self._own))
        self._file = self._path.open("r+b", buffering=0)

    def count(self) -> None:
        """Record the start of one more iteration; after a write error, only in memory."""
        self._own.begun += 1
        if self._file is None:
            return
        try:
            self._file.seek(self._offset)
            self._file.write(bytes(self._own))
        except OSError:  # a failed count must not end the run
            self.close()

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def account(self, done: int) -> Account:
        """Return the account of this run after ``done`` iterations."""
        return account([*self._earlier, self._own], done)
