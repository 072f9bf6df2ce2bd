"""Progress of a command: progress bars in a terminal, otherwise one line per completed part."""

import contextlib
import sys
from collections.abc import Callable, Iterator, Sequence

from rich.progress import Task

from jaxrl_vis.host.streams import safe
from jaxrl_vis.run.loggers.bar import FittingProgress

ProgressFunction = Callable[[str, int, int], None]
"""Progress callback, called with the name of a part, the number of units done, and the total number of units."""
_SHORT_NAME = 20


@contextlib.contextmanager
def progress(unit: str) -> Iterator[ProgressFunction]:
    """Show the progress of a command on stdout, and yield the callback that updates it.

    Args:
        unit: Unit of progress, in the plural.
    """
    stream = safe(sys.stdout)
    if not stream.isatty():

        def echo(name: str, done: int, total: int) -> None:
            if done == total:
                print(f"{name}: {total} {unit}", flush=True, file=stream)

        yield echo
        return

    def wordings(task: Task, elapsed: str, left: str) -> Sequence[Sequence[str]]:
        count, name = f"{task.completed:.0f}/{task.total:.0f}", task.description
        times = (f"{elapsed} elapsed", f"{left} left")
        return [
            (name, f"{count} {unit}", *times),
            (name[:_SHORT_NAME], count, *times),
            (count, *times),
            (count, f"{elapsed}, {left} left"),
        ]

    tasks = {}
    with FittingProgress(stream, wordings) as bars:

        def draw(name: str, done: int, total: int) -> None:
            if name not in tasks:
                tasks[name] = bars.add_task(name, total=total)
            bars.update(tasks[name], completed=done)

        yield draw
