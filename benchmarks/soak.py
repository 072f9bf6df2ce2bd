"""Random faults over small real runs: signals, kills, a full disk, damaged checkpoints and second writers, each then resumed.

    python benchmarks/soak.py [--faults 100] [--seed 0] [--workers 2] [--table docs/soak.md] [--folder FOLDER]

Each run is `jaxrl-vis train Reacher` with small settings, a process of its own that is struck by a fault and resumed until
it is finished. After every part of a run it is checked that

* nothing from before the last good checkpoint is lost: not a row of metrics.jsonl, and no newer checkpoint;
* nothing but one line was said about what went wrong: no traceback, and the exit status that the fault deserves;

and at the end of a run that it has every row exactly once. A run that met clean signals and second writers only must write
the metrics.jsonl of an undisturbed run, bit for bit (times apart). A full disk needs root, to mount a small one; without, the
limit on a file's size stands in for it.
"""

import argparse
import concurrent.futures
import contextlib
import dataclasses
import itertools
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

FAULTS_PER_RUN = 8
ITERATIONS, STEPS = 240, 200  # environment steps of an iteration: 4 environments, 50 steps each
OPTIONS = [
    *("Reacher", "--preset", "debug", "--env-steps", str(ITERATIONS * STEPS), "--updates-per-iteration", "20"),
    *("--eval-interval", "10", "--checkpoint-interval", "4", "--replay-transitions", "4000"),
]
CLEAN = ("SIGTERM", "SIGINT", "SIGTERM to the group", "second process")
FAULTS = (*CLEAN, "two signals", "SIGKILL", "SIGKILL in a save", "full disk", "damaged checkpoint")
STATUS = {  # what a part of a run may end with, beside 0: it may be over before the fault comes
    "SIGTERM": {143},
    "SIGTERM to the group": {143},
    "SIGINT": {130},
    "second process": set(),
    "two signals": {143, -signal.SIGTERM},  # the second may find the run saved, and its handler gone
    "SIGKILL": {-signal.SIGKILL},
    "SIGKILL in a save": {-signal.SIGKILL},
    "full disk": {1},
    "damaged checkpoint": {-signal.SIGKILL},
}


PROMISES = {
    "SIGTERM": "status 143, saved with the replay, goes on exactly",
    "SIGINT": "status 130, saved with the replay, goes on exactly",
    "SIGTERM to the group": "as SIGTERM, though children get the signal, too",
    "second process": "status 2 and one line; the first process goes on undisturbed",
    "two signals": "status 143 at once; the networks are saved",
    "SIGKILL": "goes on from the newest checkpoint",
    "SIGKILL in a save": "goes on from the checkpoint before the half-written one",
    "full disk": "status 1 and one line; goes on from the newest checkpoint when there is room again",
    "damaged checkpoint": "one line; goes on from the one before, and keeps the damaged one for inspection",
}
BEGIN, END = "<!-- soak: begin -->", "<!-- soak: end -->"


class Broken(AssertionError):
    """A promise was not kept."""


def rows_of(folder: Path) -> list[dict[str, Any]]:
    """Rows of a run's metrics.jsonl without their times and the run's id; a line that a kill cut off is left out."""
    rows = []
    for line in (folder / "metrics.jsonl").read_text().splitlines() if (folder / "metrics.jsonl").exists() else []:
        try:
            row = json.loads(line).items()
            rows.append({name: value for name, value in row if not name.startswith("time/") and name != "run_id"})
        except ValueError:
            continue
    return rows


def checkpoints_of(folder: Path) -> list[tuple[int, str, Path]]:
    """Finished checkpoints, ascending: iteration, tier, folder."""
    found = [(int(path.name), path.parent.name, path) for path in folder.glob("checkpoints/*/*") if path.name.isdigit()]
    return sorted(found)


@dataclasses.dataclass
class Part:
    """One process of a run.

    Attributes:
        fault: What strikes it; None for none.
        folder: The run folder.
        process: The process.
        lines: What it has said so far, stdout and stderr.
    """

    fault: str | None
    folder: Path
    process: subprocess.Popen
    lines: list[str] = dataclasses.field(default_factory=list)

    @classmethod
    def start(cls, fault: str | None, folder: Path, environment: dict[str, str], file_bytes: int | None = None) -> "Part":
        """Starts or resumes the run in ``folder``; no file may become larger than ``file_bytes``."""

        def limit() -> None:
            if file_bytes is not None:
                resource.setrlimit(resource.RLIMIT_FSIZE, (file_bytes, resource.RLIM_INFINITY))

        goes_on = ["--resume"] if folder.exists() else []
        command = [sys.executable, "-m", "jaxrl_vis", "train", *OPTIONS, "--run-dir", str(folder), *goes_on]
        process = subprocess.Popen(
            command, env=environment, cwd=folder.parent, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            start_new_session=True, preexec_fn=limit,
        )  # fmt: skip
        part = cls(fault, folder, process)
        part.reader.start()
        return part

    def __post_init__(self) -> None:
        self.reader = threading.Thread(target=self._read, daemon=True)

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.append(line.rstrip())

    def end(self) -> int:
        """Waits for the process and its last line; its exit status."""
        status = self.process.wait()
        self.reader.join(5.0)
        return status

    def runs(self) -> bool:
        """Whether the process has not ended yet."""
        return self.process.poll() is None

    def wait_for(self, condition: Callable[[], bool], seconds: float = 180.0) -> bool:
        """Waits until something is so, and says whether it is; not longer than the process runs."""
        deadline = time.monotonic() + seconds
        while self.runs() and time.monotonic() < deadline:
            if condition():
                return True
            time.sleep(0.002)
        return condition()

    def is_compiling(self) -> bool:
        """Whether compilation has begun."""
        return any(line.startswith("compiling") for line in self.lines)

    def is_training(self) -> bool:
        """Whether compilation is over."""
        return any(line.startswith("compiled in") for line in self.lines)

    def is_saving(self) -> bool:
        """Whether a checkpoint is half written."""
        return any("tmp" in path.name for path in self.folder.glob("checkpoints/*/*"))


def strike(part: Part, dice: random.Random, environment: dict[str, str]) -> bool:
    """Lets the fault of a part happen, at a random moment of training; says whether it did, before the run was over."""
    fault = part.fault
    if fault in (None, "full disk"):
        return part.end() != 0
    # A second process takes seconds to start; the first holds the folder from before it compiles.
    part.wait_for(part.is_compiling if fault == "second process" else part.is_training)
    time.sleep(dice.uniform(0.0, 1.0))
    if not part.runs():
        return False
    if fault == "second process":
        rows = rows_of(part.folder)
        other = Part.start(None, part.folder, environment)
        status = other.end()
        if part.runs() and (status != 2 or sum("in use by process" in line for line in other.lines) != 1):
            raise Broken(f"a second process ended with {status}: {other.lines[-3:]}")
        if rows_of(part.folder)[: len(rows)] != rows:
            raise Broken("a second process changed the rows of the first")
        return status == 2
    elif fault in ("SIGTERM", "SIGINT", "two signals"):
        part.process.send_signal(signal.SIGINT if fault == "SIGINT" else signal.SIGTERM)
        if fault == "two signals":
            time.sleep(dice.uniform(0.0, 0.3))
            part.process.send_signal(signal.SIGTERM)
    elif fault == "SIGTERM to the group":
        os.killpg(part.process.pid, signal.SIGTERM)
    elif fault == "SIGKILL in a save":
        if part.wait_for(part.is_saving, 20.0):
            part.process.kill()
    else:
        part.process.kill()
    return part.end() != 0


@contextlib.contextmanager
def small_disk(folder: Path) -> Iterator[tuple[Path, int | None]]:
    """A run folder on a disk that is nearly full; what is there afterwards is put back into ``folder``.

    Yields:
        The folder on that disk, or, where none can be mounted, ``folder`` itself and the most bytes that a file may have.
    """
    folder.mkdir(exist_ok=True)
    used = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    disk = folder.with_name(f"{folder.name}-disk")
    disk.mkdir()
    size = f"size={used // 1024 + 4 * sum(1 for _ in folder.rglob('*')) + 300}k"
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", size, "tmpfs", str(disk)], capture_output=True).returncode == 0
    try:
        if not mounted:
            yield folder, 100_000
            return
        shutil.copytree(folder, disk / "run")
        yield disk / "run", None
        shutil.rmtree(folder)
        shutil.copytree(disk / "run", folder)
    finally:
        if mounted:
            subprocess.run(["umount", str(disk)], check=True)
        disk.rmdir()


def damage(folder: Path, dice: random.Random) -> None:
    """Damages the newest checkpoint."""
    *_, path = checkpoints_of(folder)[-1]
    files = sorted((file for file in path.rglob("*") if file.is_file()), key=lambda file: file.stat().st_size)
    how = dice.choice(("flip", "truncate", "delete", "no manifest"))
    if how == "flip":
        contents = bytearray(files[-1].read_bytes())
        contents[len(contents) // 2] ^= 0xFF
        files[-1].write_bytes(bytes(contents))
    elif how == "truncate":
        for file in files:
            file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    else:
        shutil.rmtree(path / ("manifest" if how == "no manifest" else "train"))


class Soak:
    """All faults; several runs go on at the same time.

    Args:
        folder: Where runs lie.
        faults: How many there are to be.
        seed: Of what happens when.
        minutes: After so long no fault begins any more.
    """

    def __init__(self, folder: Path, faults: int, seed: int, minutes: float):
        self._folder, self._seed = folder, seed
        self._deadline = time.monotonic() + 60.0 * minutes
        self._environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
        self._waiting = [FAULTS[i % len(FAULTS)] for i in range(faults)]
        random.Random(seed).shuffle(self._waiting)
        self._lock = threading.Lock()
        self.struck: Counter[str] = Counter()
        self.clean, self.runs = 0, 0
        self.reference: list[dict[str, Any]] = []

    def _next_fault(self, allowed: tuple[str, ...]) -> str | None:
        with self._lock:
            if time.monotonic() > self._deadline:
                self._waiting.clear()
            found = next((fault for fault in self._waiting if fault in allowed), None)
            if found is not None:
                self._waiting.remove(found)
            return found

    def undisturbed(self) -> None:
        """The run that others are compared with."""
        part = Part.start(None, self._folder / "reference", self._environment)
        if part.end() != 0:
            raise Broken("\n".join(part.lines))
        self.reference = rows_of(part.folder)

    def work(self, worker: int) -> None:
        """Runs until there are no faults left; every other run meets clean ones only, as long as there are any."""
        for turn in itertools.count():
            number = 100 * worker + turn
            allowed = CLEAN if turn % 2 and set(self._waiting) & set(CLEAN) else FAULTS
            if not self._waiting:
                return
            self._one_run(self._folder / f"run{number}", random.Random(f"{self._seed} {number}"), allowed)

    def _one_run(self, folder: Path, dice: random.Random, allowed: tuple[str, ...]) -> None:
        faults: list[str] = []
        while True:
            fault = self._next_fault(allowed) if len(faults) < FAULTS_PER_RUN else None
            with small_disk(folder) if fault == "full disk" else contextlib.nullcontext((folder, None)) as (place, limit):
                before, good = rows_of(place), checkpoints_of(place)
                part = Part.start(fault, place, self._environment, limit)
                struck = strike(part, dice, self._environment)
                status = self._check_part(part, before, good[-1][0] if good else 0)
            if fault == "damaged checkpoint" and struck and len(checkpoints_of(folder)) > 1:
                self._damage_and_resume(folder, dice)
            if fault is None:
                break
            if not struck:  # the run was over before: another one gets it
                with self._lock:
                    self._waiting.append(fault)
                break
            faults.append(fault)
            with self._lock:
                self.struck[fault] += 1
                print(f"{sum(self.struck.values()):4}  {folder.name:8} {fault:22} status {status}", flush=True)
        self._check_end(folder, faults)

    def _damage_and_resume(self, folder: Path, dice: random.Random) -> None:
        damage(folder, dice)
        rows, kept = rows_of(folder), checkpoints_of(folder)[-2][0]
        part = Part.start(None, folder, self._environment)
        self._check_part(part, rows, kept)
        if not any("is damaged" in line for line in part.lines):
            raise Broken(f"nothing was said about a damaged checkpoint: {part.lines}")

    def _check_part(self, part: Part, before: list[dict[str, Any]], kept: int) -> int:
        """Waits for the end of a part, and looks whether promises were kept.

        Args:
            part: It may still run.
            before: The rows that there were when it began.
            kept: The iteration of the newest good checkpoint at that time.

        Returns:
            The exit status.
        """
        status = part.end()
        said = "\n".join(part.lines)
        if "Traceback" in said:
            raise Broken(f"{part.fault}: a traceback\n{said}")
        if status not in {0} | STATUS.get(part.fault or "", set()):
            raise Broken(f"{part.fault}: status {status}\n{said}")
        old = [row for row in before if row["iteration"] <= kept]
        if rows_of(part.folder)[: len(old)] != old:
            raise Broken(f"{part.fault}: rows from before iteration {kept} were lost\n{said}")
        newest = max((iteration for iteration, *_ in checkpoints_of(part.folder)), default=0)
        if newest < kept:
            raise Broken(f"{part.fault}: the newest checkpoint was of iteration {kept}, and is of {newest}\n{said}")
        return status

    def _check_end(self, folder: Path, faults: list[str]) -> None:
        rows = rows_of(folder)
        if [row["iteration"] for row in rows] != [row["iteration"] for row in self.reference]:
            raise Broken(f"{faults}: rows {[row['iteration'] for row in rows]}")
        is_clean = set(faults) <= set(CLEAN)
        if is_clean and rows != self.reference:
            raise Broken(f"{faults}: metrics.jsonl differs from the undisturbed run's")
        with self._lock:
            self.runs += 1
            self.clean += is_clean
        shutil.rmtree(folder)

    def table(self) -> str:
        """What happened, as Markdown."""
        lines = ["| fault | times | what must hold |", "|---|---|---|"]
        lines += [f"| {fault} | {self.struck[fault]} | {PROMISES[fault]} |" for fault in FAULTS]
        lines += [
            f"| all | {sum(self.struck.values())} | {self.runs} runs, resumed after every fault, none with a row missing or "
            f"twice; {self.clean} met clean signals and second writers only, and wrote the undisturbed run's metrics.jsonl bit "
            f"for bit |"
        ]
        return "\n".join(lines) + "\n"


def main() -> int:
    """Reads the command line and does what it asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--faults", type=int, default=108)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=60.0, help="after so long no fault begins any more")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--table", type=Path, help="write the table here, between the markers")
    parser.add_argument("--folder", type=Path, help="where runs lie; a temporary folder if not given")
    options = parser.parse_args()
    folder = options.folder or Path(tempfile.mkdtemp(prefix="soak-"))
    folder.mkdir(parents=True, exist_ok=True)
    soak = Soak(folder.resolve(), options.faults, options.seed, options.minutes)
    soak.undisturbed()
    with concurrent.futures.ThreadPoolExecutor(options.workers) as pool:
        for future in [pool.submit(soak.work, worker) for worker in range(options.workers)]:
            future.result()
    print(soak.table())
    if options.table is not None:
        head, _, rest = options.table.read_text().partition(BEGIN)
        options.table.write_text(head + BEGIN + "\n" + soak.table() + END + rest.partition(END)[2])
    return 0


if __name__ == "__main__":
    sys.exit(main())
