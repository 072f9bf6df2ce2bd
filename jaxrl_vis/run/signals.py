"""Signals that end a process: noted when they come, acted upon where nothing is lost, and kept from children.

    Interruption   a run, or a grid of runs: a signal sets a flag, which is looked at between two iterations
    Ending         any other command: a signal raises an exception, on whose way out children end and files stay whole

Whoever was there before stays in charge: a signal that is ignored (nohup) stays ignored, and one for which the program that
calls this has a handler of its own goes to that. Faults (SIGSEGV, SIGBUS, SIGABRT ...) are left alone.
"""

import contextlib
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any, Self

from jaxrl_vis import processes
from jaxrl_vis.errors import Terminated

_NAMES = (
    *("SIGHUP", "SIGINT", "SIGQUIT", "SIGTERM", "SIGUSR1", "SIGUSR2", "SIGALRM", "SIGXCPU"),
    *("SIGVTALRM", "SIGPROF", "SIGPOLL", "SIGPWR", "SIGSTKFLT", "SIGBREAK"),
)
_REAL_TIME = range(signal.SIGRTMIN, signal.SIGRTMAX + 1) if hasattr(signal, "SIGRTMIN") else range(0)
SIGNALS: tuple[int, ...] = (*(int(getattr(signal, name)) for name in _NAMES if hasattr(signal, name)), *_REAL_TIME)
"""All that end a process unless it has a handler, but for faults, SIGKILL, and what Python ignores (SIGPIPE, SIGXFSZ)."""

# These are sent by somebody who wants an end, and a second time by somebody who does not want to wait. Of all others a second
# one says nothing new: SIGXCPU comes every second, and a closed terminal sends SIGHUP by the kernel and by the shell.
_DELIBERATE = tuple(
    int(getattr(signal, name)) for name in ("SIGINT", "SIGTERM", "SIGQUIT", "SIGBREAK") if hasattr(signal, name)
)
# Libraries install handlers in C for these two (JAX's notice of preemption, for one), which may be replaced.
_TAKEN_FROM_LIBRARIES = (signal.SIGINT, signal.SIGTERM)
_PATIENCE_S = 10.0  # after a signal a command has so long to end by itself: XLA, which compiles, may not look up for minutes


def name_of(number: int) -> str:
    """Name of a signal for a message: ``SIGHUP``, ``SIGRTMIN+2``, or ``Ctrl-C``."""
    if number in _REAL_TIME[1:-1]:  # Python has names for the first and the last of these
        return f"SIGRTMIN+{number - _REAL_TIME[0]}"
    return "Ctrl-C" if number == signal.SIGINT else signal.Signals(number).name


@contextlib.contextmanager
def shielded_children() -> Iterator[None]:
    """Processes and threads that this thread starts in here never see any of `SIGNALS`.

    `timeout`, cluster schedulers and terminals signal the whole process group. XLA compiles with child processes (ptxas): a
    signal that kills one of them fails the compilation, while the run itself means to save and end in good order. A blocked
    signal stays blocked in children and in threads that start there; the main thread itself still receives it afterwards.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows, where signals do not reach children
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def shield_this_thread() -> None:
    """As `shielded_children`, for the rest of this thread's life: an initializer for pools of threads that compile."""
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)


class _Handlers:
    """Handlers of all `SIGNALS` that nobody else takes care of, and of SIGPIPE, which ends nothing meanwhile.

    Python delivers signals to the main thread only; in any other thread nothing is installed.
    """

    def __init__(self) -> None:
        self._before: dict[int, Any] = {}

    def _install(self, handler: Callable[[int, FrameType | None], None]) -> None:
        if threading.current_thread() is not threading.main_thread():
            return
        caught_in_c = _caught_in_c()
        for number in SIGNALS:
            if _is_free(number, caught_in_c):
                self._before[number] = signal.signal(number, handler)
        # Scripts that want to end as `head` does set it so; a run does not.
        if hasattr(signal, "SIGPIPE") and signal.getsignal(signal.SIGPIPE) == signal.SIG_DFL:
            self._before[signal.SIGPIPE] = signal.signal(signal.SIGPIPE, signal.SIG_IGN)

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before.clear()


def _is_free(number: int, caught_in_c: int) -> bool:
    """Returns whether a signal would end this process, or is taken care of by the classes of this module."""
    handler = signal.getsignal(number)
    if handler is signal.default_int_handler or isinstance(getattr(handler, "__self__", None), _Handlers):
        return True
    return handler == signal.SIG_DFL and (number in _TAKEN_FROM_LIBRARIES or not caught_in_c >> (number - 1) & 1)


def _caught_in_c() -> int:
    """A bit for each signal that has a handler, or is ignored: Python does not know of those that C code installs.

    `faulthandler.register` does, for one. Nothing is known where there is no /proc.
    """
    masks = 0
    with contextlib.suppress(OSError, ValueError):
        for line in Path("/proc/self/status").read_text(encoding="ascii", errors="replace").splitlines():
            if line.startswith(("SigCgt:", "SigIgn:")):
                masks |= int(line.split()[1], 16)
    return masks


class Interruption(_Handlers):
    """A context in which `SIGNALS` only set a flag. Who asks for the end a second time does not wait: it raises at once.

    Attributes:
        signal: The first signal that came, or None.
        is_urgent: Whether Ctrl-C, SIGTERM or SIGQUIT came twice.
    """

    def __init__(self) -> None:
        super().__init__()
        self.signal: int | None = None
        self.is_urgent = False
        self._was_asked = False

    def __enter__(self) -> Self:
        self._install(self._note)
        return self

    def __bool__(self) -> bool:
        return self.signal is not None

    def reached_any(self) -> bool:
        """Returns whether any of several processes, which all ask here, was told to end; they then agree on the signal."""
        if number := processes.max_over_processes(self.signal or 0):
            self.signal = number
        return bool(number)

    @property
    def name(self) -> str:
        """Name of the signal for a message."""
        return name_of(self.signal or signal.SIGTERM)

    @property
    def hurry(self) -> str:
        """Words for what would end the process without waiting."""
        return "once more quits" if self.signal in _DELIBERATE else "Ctrl-C or SIGTERM, twice, quits"

    def _note(self, number: int, _: FrameType | None) -> None:
        if number in _DELIBERATE and self._was_asked:
            self.signal, self.is_urgent = number, True
            self.end()
        self._was_asked |= number in _DELIBERATE
        if self.signal is None:
            self.signal = number

    def end(self) -> None:
        """Raises what the signal stands for: `Terminated` or KeyboardInterrupt."""
        _raise(self.signal or signal.SIGTERM)


def _raise(number: int) -> None:
    if number == signal.SIGINT:
        raise KeyboardInterrupt
    raise Terminated(number)


class Ending(_Handlers):
    """A context in which `SIGNALS` raise `Terminated` or KeyboardInterrupt in the main thread, as Ctrl-C does anyway.

    Args:
        give_up: Called, in another thread, with a signal that has not ended this process after some seconds: whatever the main
            thread does then does not return to Python. It ends the process. None: nothing of that kind happens.

    Attributes:
        signal: The first signal that came in here, but for those that an `Interruption` took; None for none.
    """

    def __init__(self, give_up: Callable[[int], None] | None = None) -> None:
        super().__init__()
        self.signal: int | None = None
        self._give_up = give_up
        self._told: list[socket.socket] = []
        self._wakeup_before = -1

    def __enter__(self) -> Self:
        self._install(self._end)
        if self._give_up is not None and self._before:
            # The system's handler, which Python runs at once whatever the main thread does, writes the signal's number here.
            reader, writer = socket.socketpair()
            writer.setblocking(False)
            self._told = [reader, writer]
            self._wakeup_before = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
            threading.Thread(target=self._watch, args=(reader, self._give_up), daemon=True).start()
        return self

    def __exit__(self, *error: object) -> None:
        super().__exit__(*error)
        if self._told:
            signal.set_wakeup_fd(self._wakeup_before)
            self._told[1].close()  # the other end is read by a thread, which it ends
            self._told.clear()

    def _end(self, number: int, _: FrameType | None) -> None:
        if self.signal is not None and number not in _DELIBERATE:
            return
        self.signal = self.signal or number
        _raise(number)

    def _watch(self, reader: socket.socket, give_up: Callable[[int], None]) -> None:
        shield_this_thread()
        with reader:
            while told := reader.recv(1):
                # An `Interruption` has handlers of its own: what it guards takes as long as it takes.
                if told[0] in SIGNALS and signal.getsignal(told[0]) == self._end:
                    time.sleep(_PATIENCE_S)
                    give_up(told[0])


def heed_parent_only() -> None:
    """Lets a child process, in which `SIGNALS` are blocked (`shielded_children`), end by a SIGTERM of its parent alone.

    Where the system cannot say who has sent a signal (macOS), any SIGTERM ends it.
    """
    if hasattr(signal, "sigwaitinfo"):
        threading.Thread(target=_wait_for_parent, daemon=True).start()
    elif hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, (signal.SIGTERM,))
    else:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def _wait_for_parent() -> None:
    parent = os.getppid()
    while signal.sigwaitinfo((signal.SIGTERM,)).si_pid != parent:
        pass
    os._exit(128 + signal.SIGTERM)
