"""How far a command has come: a bar in a terminal, a line for each part elsewhere."""

import contextlib
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

Done = Callable[[str, int, int], None]
"""Called with the name of a part, how much of it is done, and how much there is."""


@contextlib.contextmanager
def progress(unit: str) -> Iterator[Done]:
    """Shows how far a command has come.

    Args:
        unit: What is counted, in the plural.
    """
    console = Console()
    if not console.is_terminal:

        def say(name: str, done: int, of: int) -> None:
            if done == of:
                print(f"{name}: {of} {unit}", flush=True)

        yield say
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn(unit),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    tasks = {}
    with Progress(*columns, console=console) as bars:

        def draw(name: str, done: int, of: int) -> None:
            if name not in tasks:
                tasks[name] = bars.add_task(name, total=of)
            bars.update(tasks[name], completed=done)

        yield draw
