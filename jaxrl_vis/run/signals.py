"""SIGTERM and Ctrl-C: noted when they come, acted upon between two iterations, and kept from child processes."""

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType
from typing import Self

from jaxrl_vis.errors import Terminated

_SIGNALS = (signal.SIGTERM, signal.SIGINT)


@contextlib.contextmanager
def shielded_children() -> Iterator[None]:
    """Processes and threads that this thread starts in here never see SIGTERM or Ctrl-C.

    `timeout`, cluster schedulers and terminals signal the whole process group. XLA compiles with child processes (ptxas): a
    signal that kills one of them fails the compilation, while the run itself means to save and end in good order. A blocked
    signal stays blocked in children and in threads that start there; the main thread itself still receives it afterwards.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows, where signals do not reach children
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def shield_this_thread() -> None:
    """As `shielded_children`, for the rest of this thread's life: an initializer for pools of threads that compile."""
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)


class Interruption:
    """A context in which SIGTERM and Ctrl-C only set a flag. The second signal does not wait: it raises at once.

    Python delivers signals to the main thread only; in any other thread this context does nothing.

    Attributes:
        signal: The first signal that came, or None.
        is_urgent: Whether a second one came.
    """

    def __init__(self) -> None:
        self.signal: int | None = None
        self.is_urgent = False
        self._before: dict[int, object] = {}

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            for number in _SIGNALS:
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
        return "Ctrl-C" if self.signal == signal.SIGINT else "SIGTERM"  # as `end` has it: another process may have been told

    def _note(self, number: int, _: FrameType | None) -> None:
        if self.signal is not None:
            self.signal, self.is_urgent = number, True
            self.end()
        self.signal = number

    def end(self) -> None:
        """Raises what the signal stands for: `Terminated` or KeyboardInterrupt."""
        if self.signal == signal.SIGINT:
            raise KeyboardInterrupt
        raise Terminated  # which another process may have been told
