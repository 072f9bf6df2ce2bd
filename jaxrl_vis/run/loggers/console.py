"""Console output of a run: a progress bar on a terminal, plain lines otherwise. Output errors never end the run."""

import statistics
import sys
from collections.abc import Sequence
from types import TracebackType
from typing import Self

from rich.progress import Task

from jaxrl_vis.host import streams
from jaxrl_vis.run.loggers.bar import FittingProgress


def format_fractions(values: Sequence[float]) -> str:
    """Format fractions: ``0.93`` for one seed; for several, the median and all values: ``0.93 (0.91 0.93 0.96)``."""
    median = f"{statistics.median(values):.2f}"
    return median if len(values) == 1 else f"{median} ({' '.join(f'{value:.2f}' for value in values)})"


def format_seconds(seconds: float) -> str:
    """Format a duration in seconds as ``4.2 s``, ``42 s``, ``3 min 5 s`` or ``2 h 10 min``."""
    rounded = round(seconds)
    if rounded < 60:
        return f"{seconds:.1f} s" if seconds < 10 else f"{rounded} s"
    if rounded < 3600:
        return f"{rounded // 60} min {rounded % 60} s"
    return f"{rounded // 3600} h {rounded % 3600 // 60} min"


def _wordings(task: Task, elapsed: str, left: str) -> list[tuple[str, ...]]:
    count = f"{task.completed:.0f}/{task.total:.0f}"
    success, distance, speed = (
        f"success {task.fields['success']}",
        f"distance {task.fields['distance']}",
        f"{task.fields['speed']} steps/s",
    )
    iteration, times = f"iteration {count}", (f"{elapsed} elapsed", f"{left} left")
    return [
        (iteration, success, distance, speed, *times),
        (iteration, success, distance, *times),
        (iteration, success, *times),
        (iteration, *times),
        (count, f"{elapsed} elapsed, {left} left"),
        (count, f"{elapsed}, {left} left"),
    ]


class RunConsole:
    """Progress display of a run. A bar appears only if stdout is a terminal; lines are printed above it.

    Args:
        quiet: Whether to suppress all output.
    """

    def __init__(self, quiet: bool = False):
        self._quiet = quiet
        self._bar: FittingProgress | None = None
        self._task = None

    def echo(self, line: str) -> None:
        """Print one line."""
        if self._quiet:
            return
        if self._bar is not None:
            self._bar.console.print(line, markup=False, highlight=False, soft_wrap=True)
        else:
            streams.echo(line)

    def start(self, total: int, done: int) -> None:
        """Start the progress bar, on a terminal.

        Args:
            total: Iterations of the whole run.
            done: Iterations completed before this process.
        """
        stream = streams.safe(sys.stdout)
        if self._quiet or not stream.isatty():
            return
        self._bar = FittingProgress(stream, _wordings, refresh_per_second=4)
        self._bar.start()
        self._task = self._bar.add_task("training", total=total, completed=done, success="-", distance="-", speed="-")

    def advance(self, done: int, steps_per_second: float) -> None:
        """Advance the progress bar to ``done`` iterations of the whole run, and show the environment steps per second."""
        if self._bar is not None and self._task is not None:
            self._bar.update(self._task, completed=done, speed=f"{steps_per_second:,.0f}")

    def show_evaluation(self, success: Sequence[float], distance: Sequence[float], unit: str) -> None:
        """Show the medians over seeds of the latest evaluation beside the bar.

        Args:
            success: Success rate of each seed.
            distance: Distance to the goal of each seed, in ``unit``.
            unit: Unit of the distances.
        """
        if self._bar is not None and self._task is not None:
            shown = f"{statistics.median(distance):.3f} {unit}"
            self._bar.update(self._task, success=f"{statistics.median(success):.2f}", distance=shown)

    def stop(self) -> None:
        """Remove the progress bar."""
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        self.stop()
