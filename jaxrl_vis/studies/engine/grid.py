"""Engine of all studies, which trains a grid of cells, each in a separate process, one per device.

    unfinished cells -> `python -m jaxrl_vis train ... [--resume]`, a free device each -> run folders (`cells`)

Locks, signals and checkpoints are handled by the runs themselves. So the engine may be interrupted or killed and started again
at any time, even concurrently with another one in the same folder. A cell that fails is reported in one line, and the others
continue.

Nothing here imports JAX, see `cells`.
"""

import contextlib
import dataclasses
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from jaxrl_vis.errors import RequestError
from jaxrl_vis.host import streams
from jaxrl_vis.host.devices import Device
from jaxrl_vis.host.provenance import child_environment
from jaxrl_vis.run.command import training_options
from jaxrl_vis.run.loggers.console import format_seconds
from jaxrl_vis.run.signals import SIGNALS, Interruption
from jaxrl_vis.run.storage.folder import RunFolder
from jaxrl_vis.studies.engine.cells import Cell, contradiction, format_budget, is_finished, latest_rows
from jaxrl_vis.studies.engine.cluster import Job

_POLL_S = 0.2
_STATUS_S = 60.0  # interval between status lines
_GRACE_S = 20.0  # time for processes to end after a second signal

Command = Callable[[Cell, Path, bool], Sequence[str]]
"""(cell, its folder, whether to resume a run there) -> words of the command that trains it."""


Start = Callable[[Sequence[str], Path, Mapping[str, str]], subprocess.Popen | Job]
"""(words of a command, log file, environment variables that restrict it to its device) -> process that runs it."""


def start_process(words: Sequence[str], log: Path, environment: Mapping[str, str]) -> subprocess.Popen:
    """Start a command on this machine with the variables of ``environment`` added, appending its output to ``log``.

    See `cluster` for other machines.
    """
    # In its own session, so that a Ctrl-C of the terminal reaches it only once, from here: a second signal would end it at
    # once.
    with log.open("a", encoding="utf-8") as file:
        variables = child_environment() | dict(environment)
        return subprocess.Popen(
            words, stdin=subprocess.DEVNULL, stdout=file, stderr=file, env=variables, start_new_session=True
        )


def train_command(cell: Cell, folder: Path, resume: bool) -> list[str]:
    """Return the words of the command that trains a cell in ``folder``, or resumes its run there."""
    words = [sys.executable, "-m", "jaxrl_vis", "train", *training_options(cell.config), "--run-dir", str(folder)]
    return [*words, "--resume"] if resume else words


@dataclasses.dataclass
class _Running:
    cell: Cell
    device: Device
    process: subprocess.Popen | Job
    log: Path
    started: float


def run_cells(
    cells: Sequence[Cell],
    runs: Path,
    find_devices: Callable[[], Sequence[Device]],
    seconds: float | None = None,
    command: Command = train_command,
    echo: Callable[[str], None] = streams.echo,
    start: Start = start_process,
) -> list[str]:
    """Train unfinished cells; resume those already started.

    Args:
        cells: Cells to train; the longest are started first, so that devices finish at about the same time, and equally long
            ones in this order.
        runs: Folder of the run folders.
        find_devices: Function that returns the devices, each of which runs one process at a time; called only if there are
            unfinished cells.
        seconds: Time in seconds after which to save and stop; None to run to completion.
        command: Function that returns the command to train a cell.
        echo: Function called with each line of output.
        start: Function that starts a command.

    Returns:
        One line for each cell that failed, or whose folder holds a run with other settings.

    Raises:
        RequestError: No device was found, or the folder cannot be written to.
        KeyboardInterrupt: Ctrl-C, after all processes have saved and ended.
        Terminated: Another signal, after all processes have saved and ended.
    """
    missing = [cell for cell in cells if not is_finished(cell, runs)]
    if not missing:
        return []
    failures = [reason for reason in (contradiction(cell, runs) for cell in missing) if reason is not None]
    missing = [cell for cell in missing if contradiction(cell, runs) is None]
    missing.sort(key=_work, reverse=True)
    for line in failures:
        echo(line)
    if not missing:
        return failures
    devices = list(find_devices())
    try:
        runs.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RequestError(f"cannot write to {runs} ({error.strerror}): choose another --runs") from error
    where = devices[0].name if len(devices) == 1 else f"{len(devices)} devices"
    echo(f"{len(missing)} of {len(cells)} cells to train on {where}; run folders and logs go to {runs}")
    with Interruption() as interruption:
        failures += _Grid(missing, runs, devices, command, echo, interruption, start).run(seconds)
    if interruption:
        interruption.end()
    return failures


def _work(cell: Cell) -> float:
    """Estimate the relative duration of a cell: a gradient step with auxiliary losses takes about three times as long."""
    return cell.config.run.env_steps * cell.config.run.seeds * (3.0 if cell.config.auxiliary.aux_tasks else 1.0)


class _Grid:
    """State of one call of `run_cells`."""

    def __init__(
        self,
        cells: Sequence[Cell],
        runs: Path,
        devices: Sequence[Device],
        command: Command,
        echo: Callable[[str], None],
        interruption: Interruption,
        start: Start,
    ):
        self._waiting, self._free = list(cells), list(devices)
        self._total, self._runs, self._command, self._echo = len(cells), runs, command, echo
        self._interruption, self._start_command = interruption, start
        self._running: list[_Running] = []
        self._failures: list[str] = []
        self._is_stopping = False

    def run(self, seconds: float | None) -> list[str]:
        started = reported = time.monotonic()
        try:
            while self._running or (self._waiting and not self._is_stopping):
                late = seconds is not None and time.monotonic() - started >= seconds
                if not self._is_stopping and (self._interruption or late):
                    self._stop(self._interruption.name if self._interruption else "time is up")
                while self._waiting and self._free and not self._is_stopping:
                    self._start(self._waiting.pop(0), self._free.pop(0))
                time.sleep(_POLL_S)
                for ended in [running for running in self._running if running.process.poll() is not None]:
                    self._end(ended)
                if time.monotonic() - reported >= _STATUS_S and self._running:
                    reported = time.monotonic()
                    self._echo("  " + "; ".join(map(self._describe, self._running)))
        finally:
            self._end_at_once()
        return self._failures

    def _start(self, cell: Cell, device: Device) -> None:
        folder, log = self._runs / cell.name, self._runs / f"{cell.name}.log"
        words = self._command(cell, folder, RunFolder(folder).config.exists())
        label = f"[{self._total - len(self._waiting)}/{self._total}] {cell.name}"
        process = self._start_command(words, log, device.environment)
        self._running.append(_Running(cell, device, process, log, time.monotonic()))
        self._echo(f"{label}: {'resumes' if '--resume' in words else 'starts'} on {device.name}")

    def _end(self, done: _Running) -> None:
        self._running.remove(done)
        self._free.append(done.device)
        status, took = done.process.wait(), format_seconds(time.monotonic() - done.started)
        if status == 0 and is_finished(done.cell, self._runs):
            self._echo(f"{done.cell.name}: done in {took}{_success(self._runs / done.cell.name)}")
        elif self._is_stopping and (-status in SIGNALS or status - 128 in SIGNALS):
            self._echo(f"{done.cell.name}: stopped after {took}; start again to resume")
        else:
            outcome = "ended before it was finished" if status == 0 else f"failed with exit status {status}"
            # The log shows no error if settings differ, for example because another version was installed meanwhile.
            cause = (contradiction(done.cell, self._runs) if status == 0 else None) or _last_line(done.log)
            line = f"{done.cell.name}: {outcome} after {took}: {cause} (log: {done.log})"
            self._failures.append(line)
            self._echo(line)

    def _describe(self, running: _Running) -> str:
        latest = latest_rows(self._runs / running.cell.name)
        steps = format_budget(latest[0]["env_steps"]) if latest else "0"
        budget = format_budget(running.cell.config.run.env_steps)
        return f"{running.cell.name}: {steps} of {budget} steps{_success(self._runs / running.cell.name)}"

    def _stop(self, reason: str) -> None:
        self._is_stopping = True
        if self._running:
            self._echo(f"{reason}: waiting for {len(self._running)} to save; a second Ctrl-C does not wait")
        self._signal()

    def _signal(self) -> None:
        for running in self._running:
            with contextlib.suppress(ProcessLookupError):
                running.process.send_signal(signal.SIGTERM)

    def _end_at_once(self) -> None:
        """Terminate all processes that still run, and kill those that have not ended after 20 s."""
        self._signal()
        deadline = time.monotonic() + _GRACE_S
        for running in self._running:
            try:
                running.process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                running.process.kill()
                running.process.wait()


def _success(folder: Path) -> str:
    values = [row["eval/success"] for row in latest_rows(folder) if row.get("eval/success") is not None]
    return f", success {statistics.median(values):.2f}" if values else ""


def _last_line(log: Path) -> str:
    with contextlib.suppress(OSError):
        lines = [line.strip() for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
        if lines:
            return lines[-1]
    return "it printed nothing"
