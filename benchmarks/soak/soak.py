"""Runs with several faults each, resumed after each fault, and compared with an undisturbed run."""

import itertools
import random
import shutil
import threading
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.soak.alone import SEPARATE_FAULTS, References, strike_alone
from benchmarks.soak.faults import FAULTS
from benchmarks.soak.record import Record
from benchmarks.soak.run_process import LAST_OUTPUT, Broken, RunProcess, kill_on_exit, list_checkpoints, read_rows
from jaxrl_vis.run.goodput import account, read_processes

FAULTS_PER_RUN = 8


class Soak:
    """Injection of all faults into several concurrent runs.

    Args:
        folder: Folder of the runs.
        faults: Maximum number of faults.
        seed: Seed of the order and times of the faults.
        seconds: Time after which no further fault begins, s.
        note: Function called with the record after each fault, violation and run.
        alone: Include faults with folders of their own (`benchmarks.soak.alone`), which take longer.
    """

    def __init__(
        self, folder: Path, faults: int, seed: int, seconds: float, note: Callable[[Record], None], alone: bool = True
    ):
        self._folder, self._seed, self._note, self._left, self._alone = folder, seed, note, faults, alone
        self._started = time.monotonic()
        self._deadline = self._started + seconds
        self._decks: dict[str, list[str]] = {}
        self._dice = random.Random(seed)
        self._lock = threading.Lock()
        self._references = References(folder / "references")
        self.record = Record(seed=seed)
        self.reference: list[dict[str, Any]] = []

    def train_reference(self) -> None:
        """Train the run that others are compared with, and store its rows.

        Raises:
            Broken: The run failed.
        """
        with kill_on_exit(RunProcess.start(self._folder / "reference")) as process:
            if process.wait() != 0:
                raise Broken("\n".join(process.lines))
        self.reference = read_rows(process.folder)

    def _next_fault(self, faults: dict[str, Any]) -> str | None:
        """Draw the next fault of these kinds, all equally often; None if it is time to end."""
        with self._lock:
            if self._left <= 0 or time.monotonic() > self._deadline:
                return None
            self._left -= 1
            deck = self._decks.setdefault(next(iter(faults)), [])
            if not deck:
                deck += self._dice.sample(list(faults), len(faults))
            return deck.pop()

    def _return_fault(self, faults: dict[str, Any], fault: str) -> None:
        """Put a fault back into the deck, because the run had finished before it."""
        with self._lock:
            self._left += 1
            self._decks[next(iter(faults))].insert(0, fault)

    def _note_fault(self, run: str, fault: str, outcome: str) -> None:
        with self._lock:
            self.record.faults[fault] += 1
            self.record.minutes = round((time.monotonic() - self._started) / 60.0, 2)
            print(f"{self.record.total:4}  {run:8} {fault:32} {outcome}", flush=True)
            self._note(self.record)

    def _note_violation(self, folder: Path, faults: list[str], error: Exception) -> None:
        text = str(error) if isinstance(error, Broken) else traceback.format_exc()
        with self._lock:
            self.record.broken.append(f"{folder.name}, {faults}: {text}")
            print(f"BROKEN in {folder}, after {faults}: {text}", flush=True)
            self._note(self.record)

    def work(self, worker: int) -> None:
        """Alternate between a run and a fault with a folder of its own, until it is time to end."""
        for turn in itertools.count():
            number = 1000 * worker + turn
            rng, place = random.Random(f"{self._seed} {number}"), self._folder / f"run{number}"
            faults: list[str] = []
            try:
                # Workers begin with different kinds, so that a short soak covers both.
                if self._alone and (turn + worker) % 2:
                    going = self._strike_alone(place, rng, faults)
                else:
                    going = self._strike_run(place, rng, faults)
            except Exception as error:  # the others continue; the folder is kept for inspection
                self._note_violation(place, faults, error)
                going = True
            if not going:
                return

    def _strike_alone(self, folder: Path, rng: random.Random, faults: list[str]) -> bool:
        fault = self._next_fault(SEPARATE_FAULTS)
        if fault is None:
            return False
        faults.append(fault)
        if strike_alone(fault, folder, rng, self._references):
            self._note_fault(folder.name, fault, "")
        else:
            self._return_fault(SEPARATE_FAULTS, fault)
        return True

    def _strike_run(self, folder: Path, rng: random.Random, faults: list[str]) -> bool:
        """Train one run to its end, with faults; return False if none is left for it."""
        may_have_lost_rows, fault = False, None
        while len(faults) < FAULTS_PER_RUN:
            fault = self._next_fault(FAULTS)
            if fault is None:
                break
            faults.append(fault)
            before, good = read_rows(folder), list_checkpoints(folder)
            status = FAULTS[fault].strike(folder, rng)
            if status is None:  # the run finished before the fault
                self._return_fault(FAULTS, faults.pop())
                break
            if status not in FAULTS[fault].statuses:
                raise Broken(f"status {status}: {LAST_OUTPUT.lines[-4:]}")
            may_have_lost_rows |= FAULTS[fault].may_lose_rows
            if folder.exists() and not (FAULTS[fault].may_lose_rows or FAULTS[fault].goes_back):
                self._check_nothing_lost(folder, before, good[-1][0] if good else 0)
            self._note_fault(folder.name, fault, f"status {status}")
        if not faults:  # the run finished before the first fault, or it is time to end
            shutil.rmtree(folder, ignore_errors=True)
            return fault is not None
        with kill_on_exit(RunProcess.start(folder)) as process:
            if (status := process.wait()) != 0:
                raise Broken(f"it did not finish: status {status}, {process.lines[-5:]}")
            process.check_output()
        self._check_end(folder, may_have_lost_rows)
        return True

    def _check_nothing_lost(self, folder: Path, before: list[dict[str, Any]], checkpointed: int) -> None:
        """Check that no rows and no checkpoints were lost.

        Args:
            folder: The run.
            before: The rows when its last process began.
            checkpointed: Iteration of the newest checkpoint at that time.

        Raises:
            Broken: Rows up to that checkpoint are missing, or the newest checkpoint is more than one iteration older.
        """
        old = [row for row in before if row["iteration"] <= checkpointed]
        if read_rows(folder)[: len(old)] != old:
            raise Broken(f"rows from before iteration {checkpointed} were lost")
        newest = max((iteration for iteration, *_ in list_checkpoints(folder)), default=0)
        # A recent state may have been dropped for lack of space, and a damaged one is set aside.
        if newest < checkpointed - 1:
            raise Broken(f"the newest checkpoint was of iteration {checkpointed}, and is of {newest}")

    def _check_end(self, folder: Path, may_have_lost_rows: bool) -> None:
        rows = read_rows(folder)
        total = account(read_processes(folder / "processes.jsonl"), self.reference[-1]["iteration"])
        if not may_have_lost_rows and [row["iteration"] for row in rows] != [row["iteration"] for row in self.reference]:
            raise Broken(f"rows {[row['iteration'] for row in rows]}")
        exact = rows == self.reference
        if not exact and not may_have_lost_rows and not total.replays_lost:
            raise Broken("metrics.jsonl differs from the undisturbed run's, though no replay was lost")
        if total.begun is None:
            raise Broken("processes.jsonl is damaged")
        with self._lock:
            record = self.record
            record.runs, record.exact = record.runs + 1, record.exact + exact
            record.done, record.begun = record.done + total.done, record.begun + total.begun
            record.resumes += total.resumes
            record.replays_lost += total.replays_lost
            self._note(record)
        shutil.rmtree(folder)
