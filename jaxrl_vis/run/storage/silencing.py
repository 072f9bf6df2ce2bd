"""Silencing of orbax and tensorstore, which log long messages about errors that they also raise, even from their threads."""

import logging
import sys
import threading
from collections.abc import Callable
from typing import Any


def silence_orbax() -> Callable[[], None]:
    """Silence orbax and tensorstore threads about errors that they also raise; return the function that undoes it."""

    def is_not_orbax(record: logging.LogRecord) -> bool:
        return "orbax" not in record.pathname

    def is_not_abandoned(record: logging.LogRecord) -> bool:
        # Of several reads that fail, orbax raises the first error; the event loop reports the others when they are deleted.
        text = record.getMessage()
        return "exception was never retrieved" not in text or not ("orbax" in text or 'Error opening "' in text)

    def hook(unraisable: Any) -> None:
        # From other threads this is tensorstore, notifying an event loop that has failed and no longer exists.
        if threading.current_thread() is threading.main_thread():
            before(unraisable)

    def undo() -> None:
        absl.removeFilter(is_not_orbax)
        event_loop.removeFilter(is_not_abandoned)
        if sys.unraisablehook is hook:
            sys.unraisablehook = before

    absl, event_loop, before = logging.getLogger("absl"), logging.getLogger("asyncio"), sys.unraisablehook
    absl.addFilter(is_not_orbax)
    event_loop.addFilter(is_not_abandoned)
    sys.unraisablehook = hook
    return undo
