"""Silencing of orbax and tensorstore, which log long messages about errors that they also raise, even from their threads."""

import contextlib
import gc
import logging
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any


@contextlib.contextmanager
def silenced() -> Iterator[None]:
    """Suppress orbax's output about a checkpoint whose error will be reported in one line."""
    absl, before = logging.getLogger("absl"), sys.unraisablehook
    disabled = absl.disabled
    absl.disabled, sys.unraisablehook = True, lambda _: None
    try:
        yield
    except BaseException:
        gc.collect()  # abandoned coroutines print warnings when they are collected
        raise
    finally:
        absl.disabled, sys.unraisablehook = disabled, before


def silence_orbax() -> Callable[[], None]:
    """Silence orbax and tensorstore threads about errors that they also raise; return the function that undoes it."""

    def is_not_orbax(record: logging.LogRecord) -> bool:
        return "orbax" not in record.pathname

    def hook(unraisable: Any) -> None:
        # From other threads this is tensorstore, notifying an event loop that has failed and no longer exists.
        if threading.current_thread() is threading.main_thread():
            before(unraisable)

    def undo() -> None:
        absl.removeFilter(is_not_orbax)
        if sys.unraisablehook is hook:
            sys.unraisablehook = before

    absl, before = logging.getLogger("absl"), sys.unraisablehook
    absl.addFilter(is_not_orbax)
    sys.unraisablehook = hook
    return undo
