"""SIGTERM and Ctrl-C, noted when they come and acted upon between two iterations."""

import signal
import threading
from types import FrameType
from typing import Self

from jaxrl_vis.errors import Terminated


class Interruption:
    """A context in which SIGTERM and Ctrl-C only set a flag. The second signal does not wait: it raises at once.

    Python delivers signals to the main thread only; in any other thread this context does nothing.
    """

    def __init__(self) -> None:
        self.signal: int | None = None
        self._before: dict[int, object] = {}

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGTERM, signal.SIGINT):
                self._before[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            # None: the handler was not installed by Python, and cannot be put back by it.
            signal.signal(number, signal.SIG_DFL if handler is None else handler)  # type: ignore[arg-type]
        self._before.clear()

    def __bool__(self) -> bool:
        return self.signal is not None

    @property
    def name(self) -> str:
        """What to call it in a message."""
        return "SIGTERM" if self.signal == signal.SIGTERM else "Ctrl-C"

    def _note(self, number: int, _: FrameType | None) -> None:
        if self.signal is not None:
            self.signal = number
            self.end()
        self.signal = number

    def end(self) -> None:
        """Raises what the signal stands for: `Terminated` or KeyboardInterrupt."""
        if self.signal == signal.SIGTERM:
            raise Terminated
        raise KeyboardInterrupt
