"""Faults injected into a training run, and their expected outcomes, listed in `FAULTS`.

A strike injects its fault at a random moment of training and returns the exit status of the process, or None if the run
finished first. It raises `Broken` if the fault's own guarantee is violated; guarantees common to all faults are checked
afterwards by `Soak`.
"""

import contextlib
import dataclasses
import json
import os
import random
import shutil
import signal
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.soak.disks import freezing_disk, small_disk
from benchmarks.soak.run_process import Broken, RunProcess, environment, kill_on_exit, list_checkpoints, read_rows

SITE = Path(__file__).with_name("site")
Strike = Callable[[Path, random.Random], int | None]
Checkpoint = tuple[int, str, Path]  # iteration, tier, file or folder


@dataclasses.dataclass(frozen=True)
class Fault:
    """One kind of fault.

    Attributes:
        strike: Function of the run folder and a random generator that injects the fault.
        guarantee: Guaranteed outcome, for the table.
        statuses: Permitted exit statuses of the process.
        may_lose_rows: True if a row of metrics.jsonl, or the run itself, may be lost.
        goes_back: True if the run may resume from an older checkpoint than the newest; `strike` checks which one.
    """

    strike: Strike
    guarantee: str
    statuses: tuple[int, ...]
    may_lose_rows: bool = False
    goes_back: bool = False


def _start_run(
    folder: Path, rng: random.Random, variables: dict[str, str] | None = None, file_bytes: int | None = None
) -> RunProcess:
    """Start a process and return it at a random moment of training, or after its end if it finished first.

    Raises:
        Broken: Training did not begin.
    """
    process = RunProcess.start(folder, variables, file_bytes=file_bytes)
    if not process.wait_for(process.is_training) and (process.is_running() or process.wait() != 0):
        with kill_on_exit(process):
            raise Broken(f"it did not begin to train: {process.lines[-4:]}")
    time.sleep(rng.uniform(0.0, 0.8))
    return process


def _send_signal(*numbers: int, to_group: bool = False) -> Strike:
    def strike(folder: Path, rng: random.Random) -> int | None:
        with kill_on_exit(_start_run(folder, rng)) as process:
            for number in numbers:
                if not process.is_running():
                    break
                with contextlib.suppress(ProcessLookupError):
                    (os.killpg if to_group else os.kill)(process.popen.pid, number)
                time.sleep(rng.uniform(0.0, 0.3) if len(numbers) > 1 else 0.0)
            return _wait_for_end(process)

    return strike


def _wait_for_end(process: RunProcess) -> int | None:
    status = process.wait()
    process.check_output()
    return status or None


def _kill_during_a_save(folder: Path, rng: random.Random) -> int | None:
    with kill_on_exit(_start_run(folder, rng)) as process:
        process.wait_for(process.is_saving, 20.0)
        return process.send(signal.SIGKILL) or None


def _second_process(folder: Path, rng: random.Random) -> int | None:
    with kill_on_exit(RunProcess.start(folder)) as process:
        # Another process takes seconds to start; the first holds the folder from before it compiles.
        process.wait_for(process.is_compiling)
        rows = read_rows(folder)
        with kill_on_exit(RunProcess.start(folder)) as other:
            status = other.wait()
            other.check_output()
        if not process.is_running():
            return process.wait() or None
        if status != 2 or other.count("in use by process") != 1:
            raise Broken(f"a second process ended with {status}: {other.lines[-3:]}")
        if read_rows(folder)[: len(rows)] != rows:
            raise Broken("a second process changed the rows of the first")
        process.wait_for(process.is_training)
        return process.stop() or None


def _full_disk(folder: Path, rng: random.Random) -> int | None:
    """Fill the disk, including any space freed on it; if no disk can be mounted, limit the size of files instead."""
    with small_disk(folder) as (place, fill):
        limit = None if fill() and (place.parent / "other").unlink() is None else 100_000
        with kill_on_exit(_start_run(place, rng, file_bytes=limit)) as process:
            while process.is_running() and limit is None:
                fill()
                time.sleep(0.05)
            return _wait_for_end(process)


def _stalled_disk(folder: Path, rng: random.Random) -> int | None:
    with freezing_disk(folder) as (place, freeze), kill_on_exit(_start_run(place, rng)) as process:
        still = rng.uniform(1.0, 4.0)
        process.wait_for(process.is_saving, 5.0)
        if freeze(True):
            time.sleep(still)
            freeze(False)
        elif process.is_running():
            process.popen.send_signal(signal.SIGSTOP)
            time.sleep(still)
            process.popen.send_signal(signal.SIGCONT)
        time.sleep(0.5)
        return process.stop() or None


def _with_site(**variables: str) -> dict[str, str]:
    """Return ``variables``, extended by the path from which Python imports `site/sitecustomize.py` at startup."""
    return {**variables, "PYTHONPATH": os.pathsep.join((str(SITE), environment()["PYTHONPATH"]))}


def _jumping_clock(folder: Path, rng: random.Random) -> int | None:
    clock = folder.with_name(f"{folder.name}.clock")
    clock.unlink(missing_ok=True)
    variables = _with_site(SOAK_CLOCK=str(clock))
    with kill_on_exit(_start_run(folder, rng, variables)) as process:
        for _ in range(3):
            clock.write_text(str(rng.choice((-1, 1)) * rng.uniform(60.0, 30 * 86400.0)))
            time.sleep(rng.uniform(0.1, 0.5))
        status = process.stop()
        process.check_output()
        file = folder / "metrics.jsonl"
        rows = [json.loads(line) for line in (file.read_text() if file.exists() else "").splitlines()]
        # An earlier fault may have flipped a bit of the name.
        walls = [row["time/wall_s"] for row in rows if "time/wall_s" in row]
        if walls != sorted(walls) or any(wall > 86400.0 for wall in walls):
            raise Broken(f"seconds follow the clock: {walls}")
        return status or None


def _kill_run(folder: Path, rng: random.Random) -> bool:
    """Send SIGKILL during training; return True if the run had not finished and has a checkpoint."""
    with kill_on_exit(_start_run(folder, rng)) as process:
        process.wait_for(lambda: len(list_checkpoints(folder)) > 1, 20.0)
        return process.send(signal.SIGKILL) != 0 and bool(list_checkpoints(folder))


def _resume_run(folder: Path, rng: random.Random, variables: dict[str, str] | None = None) -> tuple[int, RunProcess]:
    """Resume, and stop again during training; return the exit status and the process.

    Raises:
        Broken: The exit status is neither 0 nor 143, or a traceback was printed.
    """
    with kill_on_exit(_start_run(folder, rng, variables)) as process:
        status = process.stop()
        process.check_output()
        if status not in (0, 143):
            raise Broken(f"resumed, it ended with {status}: {process.lines[-4:]}")
        return status, process


def _check_went_back(
    folder: Path, before: list[dict[str, Any]], all_before: list[Checkpoint], intact: list[Checkpoint]
) -> None:
    """Check that a run with a damaged checkpoint resumed from the newest intact one.

    Args:
        folder: The run, resumed and stopped again.
        before: Its rows before it was resumed.
        all_before: Its checkpoints before it was resumed.
        intact: The undamaged ones among ``all_before``.

    Raises:
        Broken: The newest checkpoint is older than the newest intact one, or rows were lost.
    """
    newest, newest_good, last = (
        max((iteration for iteration, *_ in checkpoints), default=0)
        for checkpoints in (list_checkpoints(folder), intact, all_before)
    )
    if newest < newest_good:
        raise Broken(f"a good checkpoint was of iteration {newest_good}, and the newest is of {newest}")
    rows = read_rows(folder) + read_rows(folder, "checkpoints/damaged/metrics.jsonl")
    if lost := [row["iteration"] for row in before if row not in rows and row["iteration"] <= last]:
        raise Broken(f"rows {lost} are neither in metrics.jsonl nor kept for inspection")


def _damage_checkpoint(folder: Path, rng: random.Random) -> int | None:
    if not _kill_run(folder, rng):
        return None
    rows, there = read_rows(folder), list_checkpoints(folder)
    *good, (_, tier, path) = there
    if path.is_dir():
        files = sorted((file for file in path.rglob("*") if file.is_file()), key=lambda file: file.stat().st_size)
        how = rng.choice(("truncate", "no manifest", "no learner"))
        for file in files if how == "truncate" else []:
            file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
        if how != "truncate":
            shutil.rmtree(path / ("manifest" if how == "no manifest" else "train"))
    else:
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    status, process = _resume_run(folder, rng)
    if process.count(f"checkpoint {tier}/") != 1 or process.count("is damaged") != 1:
        raise Broken(f"nothing was said about a damaged checkpoint: {process.lines}")
    _check_went_back(folder, rows, there, good)
    return status or None


def flip_a_bit(file: Path, rng: random.Random) -> int:
    """Flip a random bit of a file; return the index of its byte."""
    contents = bytearray(file.read_bytes())
    place = rng.randrange(len(contents))
    contents[place] ^= 1 << rng.randrange(8)
    file.write_bytes(bytes(contents))
    return place


def _bit_in_a_checkpoint(folder: Path, rng: random.Random) -> int | None:
    if not _kill_run(folder, rng):
        return None
    rows, there = read_rows(folder), list_checkpoints(folder)
    _, tier, path = rng.choice(there[-2:])
    files = [file for file in path.rglob("*") if file.is_file() and file.stat().st_size] if path.is_dir() else [path]
    if tier == "recent":
        files += list(path.parent.glob("*.rollout"))
    flip_a_bit(rng.choices(files, [file.stat().st_size for file in files])[0], rng)
    # The bit is either detected or does not affect the state that the run resumes from: rows are compared at the end.
    status = _resume_run(folder, rng)[0]
    good = [entry for entry in there if entry[2] != path and not tier == entry[1] == "recent"]  # recent ones share rollouts
    _check_went_back(folder, rows, there, good)
    return status or None


def _bit_in_metrics(folder: Path, rng: random.Random) -> int | None:
    if not _kill_run(folder, rng) or not read_rows(folder):
        return None
    before, file = read_rows(folder), folder / "metrics.jsonl"
    place = flip_a_bit(file, rng)
    number = file.read_bytes()[:place].count(b"\n")
    row = file.read_bytes().splitlines()[number] if number < len(file.read_bytes().splitlines()) else b""
    done = max((iteration for iteration, *_ in list_checkpoints(folder)), default=0)
    status, process = _resume_run(folder, rng)
    # The row of that line may be lost, and the next one if the line break was hit; all others are kept.
    others = [old for i, old in enumerate(before) if i not in (number, number + 1) and old["iteration"] <= done]
    if missing := [old["iteration"] for old in others if old not in read_rows(folder)]:
        raise Broken(f"rows {missing} were lost with row {number}: {process.lines}")
    try:
        json.loads(row)
    except ValueError:
        if not process.count("metrics.jsonl"):
            raise Broken(f"nothing was said about a damaged row, {row!r}: {process.lines}") from None
    return status or None


def _move_folder(is_kept: bool) -> Strike:
    """Return a strike that moves the folder away, and back after the process has ended; or one that deletes it."""

    def strike(folder: Path, rng: random.Random) -> int | None:
        there = folder.with_name(f"{folder.name}-{'moved' if is_kept else 'trash'}")
        with kill_on_exit(_start_run(folder, rng)) as process:
            rows = read_rows(folder)
            if not process.is_running():
                return process.wait() or None
            folder.rename(there)
            if not is_kept:
                shutil.rmtree(there)
            status = process.wait()
            process.check_output()
        if (folder / "checkpoints").exists():
            raise Broken(f"half a run was left in its place: {sorted(folder.rglob('*'))[:5]}; {process.lines[-2:]}")
        if folder.exists():
            shutil.rmtree(folder)
        if is_kept:
            there.rename(folder)
            if read_rows(folder)[: len(rows)] != rows:
                raise Broken("rows were lost in a folder that was moved")
        return status or None

    return strike


def _stale_lock(folder: Path, rng: random.Random) -> int | None:
    """Leave the lock of a dead process. Rarely without file locks, where its lease must expire, which takes a minute."""
    no_locks = rng.random() < 0.15
    variables = _with_site(SOAK_NO_LOCKS="1") if no_locks else _with_site()
    with kill_on_exit(_start_run(folder, rng, variables)) as process:
        if process.send(signal.SIGKILL) == 0:
            return None
    lock = folder / "run.lock"
    if not lock.exists():
        raise Broken("a process that was killed left no run.lock")
    lock.write_text(lock.read_text().replace(socket.gethostname(), "elsewhere"))
    os.utime(lock, (time.time() - 3600.0, time.time() - 3600.0))
    return _resume_run(folder, rng, variables)[0] or None


EXACT = "exact resume"
FAULTS: dict[str, Fault] = {
    "SIGTERM": Fault(_send_signal(signal.SIGTERM), f"exit status 143; saves the state with the replay; {EXACT}", (143,)),
    "SIGINT": Fault(_send_signal(signal.SIGINT), f"exit status 130; saves the state with the replay; {EXACT}", (130,)),
    "SIGHUP": Fault(_send_signal(signal.SIGHUP), f"exit status 129; saves the state with the replay; {EXACT}", (129,)),
    "SIGTERM to the group": Fault(
        _send_signal(signal.SIGTERM, to_group=True), "as SIGTERM, although child processes receive the signal, too", (143,)
    ),
    "two signals": Fault(
        _send_signal(signal.SIGTERM, signal.SIGTERM),
        "exits at once with status 143; the networks are saved",
        (143, -signal.SIGTERM),  # the second one may arrive when the run is saved and its handler removed
    ),
    "second process": Fault(_second_process, "exit status 2, one-line message; the first process is undisturbed", (143,)),
    "SIGKILL": Fault(_send_signal(signal.SIGKILL), f"loses one or two iterations; {EXACT}", (-signal.SIGKILL,)),
    "SIGKILL during a save": Fault(
        _kill_during_a_save, f"ignores the incomplete checkpoint; {EXACT} from the one before", (-signal.SIGKILL,)
    ),
    "full disk": Fault(_full_disk, "exit status 1 (2 before training), one-line message; resumes once there is space", (1, 2)),
    "stalled disk": Fault(_stalled_disk, f"waits for the disk; {EXACT}", (143,)),
    "damaged checkpoint": Fault(
        _damage_checkpoint,
        "one-line message; resumes from the previous checkpoint, and quarantines the damaged one",
        (143,),
        goes_back=True,
    ),
    "bit flipped in a checkpoint": Fault(
        _bit_in_a_checkpoint, "detected, or without effect on the restored state", (143,), goes_back=True
    ),
    "bit flipped in metrics.jsonl": Fault(
        _bit_in_metrics, "all other rows are kept; an unreadable row is quarantined with a message", (143,), may_lose_rows=True
    ),
    "folder moved": Fault(
        _move_folder(is_kept=True),
        "exit status 1, one-line message; nothing is left in the old place, and the run resumes in the new one",
        (1,),
    ),
    "folder deleted": Fault(_move_folder(is_kept=False), "exit status 1, one-line message; leaves no partial run folder", (1,)),
    "stale lock of another host": Fault(_stale_lock, "the lock is taken over", (143,)),
    "clock jumps of up to a month": Fault(_jumping_clock, f"durations are unaffected; {EXACT}", (143,)),
}
"""Faults of a training run by name."""
