"""Progress bar whose text adapts to the terminal's width, with the most important information first."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from rich.cells import cell_len
from rich.console import Console, RenderableType
from rich.progress import Progress, Task
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from jaxrl_vis.host.streams import SafeStream

_MIN_BAR = 10  # minimum width of the bar, columns
_BETWEEN = "  "

Wordings = Callable[[Task, str, str], Sequence[Sequence[str]]]
"""(task, elapsed time, remaining time) -> texts beside the bar, longest wording first."""


def format_clock(seconds: float | None) -> str:
    """Format a duration as ``0:07:30``, with unlimited hours; ``-:--:--`` for None."""
    if seconds is None:
        return "-:--:--"
    seconds_left = max(0, int(seconds))
    return f"{seconds_left // 3600}:{seconds_left // 60 % 60:02}:{seconds_left % 60:02}"


class FittingProgress(Progress):
    """Progress display with one line per task, fitted to the terminal's current width.

    Args:
        stream: The terminal.
        wordings: Alternative texts; the first one that fits is shown, and the last one is truncated if necessary.
        refresh_per_second: Refresh rate.
    """

    def __init__(self, stream: SafeStream, wordings: Wordings, refresh_per_second: float = 10):
        self._wordings = wordings
        file: Any = stream
        super().__init__(console=Console(file=file), refresh_per_second=refresh_per_second)

    def get_renderables(self) -> Iterable[RenderableType]:
        """Yield one line per task."""
        for task in self.tasks:
            yield self._line(task, self.console.width)

    def _line(self, task: Task, width: int) -> RenderableType:
        lines = [
            _BETWEEN.join(words)
            for words in self._wordings(task, format_clock(task.finished_time or task.elapsed), self._left(task))
        ]
        shown = next((line for line in lines if cell_len(line) <= width), lines[-1])
        table = Table.grid(expand=True)
        room = width - cell_len(shown) - len(_BETWEEN)
        if room < _MIN_BAR:
            table.add_column(no_wrap=True, overflow="crop")
            table.add_row(Text(shown, no_wrap=True, overflow="crop"))
            return table
        table.add_column(width=room)
        table.add_column(no_wrap=True, justify="right")
        bar = ProgressBar(total=task.total, completed=task.completed, width=room, animation_time=task.get_time())
        table.add_row(bar, Text(shown, no_wrap=True))
        return table

    @staticmethod
    def _left(task: Task) -> str:
        return format_clock(0.0 if task.finished else task.time_remaining)
