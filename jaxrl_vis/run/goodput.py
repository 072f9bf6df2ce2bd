"""Gradient steps that were computed, and those that are in the networks: what a run has lost to whatever ended its processes.

processes.jsonl has a line for each process that has trained the run:

    {"start": 35, "begun": 48, "replay_lost": false}

This one went on from iteration 35 with the replay that was there, and has begun to learn from 48 more. The line is overwritten
in place, at each of them. Nothing waits for the disk: what a process has written outlives it, however it ends, and a power cut
costs the count of the last seconds. An iteration counts in full from the moment in which its gradient steps are given to the
device, so the goodput of a run that was killed is never better than what is said here.
"""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import IO

_WIDTH = 80  # bytes of a line, its end included: it never grows over the next one


@dataclasses.dataclass
class Process:
    """A line of the file.

    Attributes:
        start: The iteration that the process went on from; 0 where it began the run.
        begun: Iterations that it has begun to learn from.
        replay_lost: Whether it went on with an empty replay.
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
        done: Iterations that are in the networks.
        begun: Iterations begun by all processes; None where a line cannot be read.
        resumes: How often a process went on with the run.
        replays_lost: How often it did so with an empty replay.
    """

    done: int
    begun: int | None
    resumes: int
    replays_lost: int

    @property
    def goodput(self) -> float | None:
        """The share of iterations begun that are in the networks; 1 before the first, None where it is not known."""
        if self.begun is None:
            return None
        return self.done / self.begun if self.begun else 1.0

    def describe(self, updates: int) -> str:
        """The account in a line; ``updates``: gradient steps of an iteration."""
        if self.begun is None:
            text = "goodput unknown (processes.jsonl is damaged)"
        else:
            text = f"goodput {self.goodput:.3f}: {self.done * updates:,} of {self.begun * updates:,} gradient steps are kept"
        return f"{text}; resumed {_times(self.resumes)}, replay lost {_times(self.replays_lost)}"


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


def account(processes: Sequence[Process | None], done: int) -> Account:
    """Adds up.

    Args:
        processes: As `read_processes` returns them.
        done: Iterations that are in the networks.
    """
    known = [process for process in processes if process is not None]
    begun = sum(process.begun for process in known) if len(known) == len(processes) else None
    return Account(done, begun, max(0, len(processes) - 1), sum(process.replay_lost for process in known))


def read_processes(path: Path) -> list[Process | None]:
    """The processes of a run in their order, None for a line that cannot be read; nothing where there is no file."""
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
    """Keeps the account of the process that trains. Nothing is written before `begin`.

    Args:
        path: processes.jsonl.
    """

    def __init__(self, path: Path):
        self._path = path
        self._earlier: list[Process | None] = []
        self._own = Process(0)
        self._file: IO[bytes] | None = None
        self._place = 0

    def begin(self, iteration: int, replay_lost: bool) -> None:
        """Adds a line for this process.

        Args:
            iteration: What it goes on from; 0 for a run that begins.
            replay_lost: Whether it goes on without the replay that there was.

        Raises:
            OSError: The file cannot be written.
        """
        self._earlier = read_processes(self._path)
        before = self._path.read_bytes() if self._earlier else b""
        if not self._earlier and iteration:  # nothing is known of earlier processes but what they have left
            self._earlier = [Process(0, iteration)]
            before = bytes(Process(0, iteration))
        if before and not before.endswith(b"\n"):
            before += b"\n"
        self._own, self._place = Process(iteration, 0, replay_lost), len(before)
        self._path.write_bytes(before + bytes(self._own))
        self._file = self._path.open("r+b", buffering=0)

    def count(self) -> None:
        """Notes that one more iteration is learned from."""
        self._own.begun += 1
        if self._file is None:
            return
        try:
            self._file.seek(self._place)
            self._file.write(bytes(self._own))
        except OSError:  # a count is no reason to end a run
            self.close()

    def close(self) -> None:
        """Lets go of the file."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def account(self, done: int) -> Account:
        """The account of this run, whose networks have learned from ``done`` iterations."""
        return account([*self._earlier, self._own], done)
