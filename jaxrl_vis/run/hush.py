"""Silence of orbax and tensorstore, which print at length, from threads of their own too, what they also raise."""

import contextlib
import gc
import logging
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any


@contextlib.contextmanager
def hushed() -> Iterator[None]:
    """Keeps orbax from printing pages about a checkpoint that we are about to describe in one line."""
    absl, before = logging.getLogger("absl"), sys.unraisablehook
    disabled = absl.disabled
    absl.disabled, sys.unraisablehook = True, lambda _: None
    try:
        yield
    finally:
        gc.collect()  # abandoned coroutines complain when they are collected
        absl.disabled, sys.unraisablehook = disabled, before


def silence_orbax() -> Callable[[], None]:
    """Keeps orbax and tensorstore from printing, in threads of their own, what they also raise; returns what undoes that."""

    def is_not_orbax(record: logging.LogRecord) -> bool:
        return "orbax" not in record.pathname

    def hook(unraisable: Any) -> None:
        # From another thread it is tensorstore, which wants to tell an event loop that has failed, and is gone.
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


def stay_silent() -> None:
    """In the place of what undoes `silence_orbax`."""
