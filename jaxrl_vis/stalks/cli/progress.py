"""Progress of a command: a bar in a terminal, a line for each part elsewhere."""

import contextlib
import sys
from collections.abc import Callable, Iterator, Sequence

from rich.progress import Task

from jaxrl_vis.run.bar import FittingProgress
from jaxrl_vis.streams import safe

Done = Callable[[str, int, int], None]
"""Called with the name of a part, how much of it is done, and how much there is."""
_SHORT_NAME = 20


@contextlib.contextmanager
def progress(unit: str) -> Iterator[Done]:
    """Shows how far a command has come.

    Args:
        unit: Unit of progress, in the plural.
    """
    stream = safe(sys.stdout)
    if not stream.isatty():

        def say(name: str, done: int, of: int) -> None:
            if done == of:
                print(f"{name}: {of} {unit}", flush=True, file=stream)

        yield say
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

        def draw(name: str, done: int, of: int) -> None:
            if name not in tasks:
                tasks[name] = bars.add_task(name, total=of)
            bars.update(tasks[name], completed=done)

        yield draw
