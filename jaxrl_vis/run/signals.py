"""Handling of signals that end a process: deferred until it is safe, and kept from child processes.

    Interruption   a run, or a grid of runs: a signal sets a flag, which is checked between iterations
    Ending         any other command: a signal raises an exception, which ends children and keeps files intact

Existing handlers take precedence: an ignored signal (nohup) stays ignored, and a signal with a handler of the calling program
goes to that handler. Faults (SIGSEGV, SIGBUS, SIGABRT ...) are not handled.
"""

import contextlib
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any, Self

from jaxrl_vis.errors import Terminated
from jaxrl_vis.host import distributed

_NAMES = (
    *("SIGHUP", "SIGINT", "SIGQUIT", "SIGTERM", "SIGUSR1", "SIGUSR2", "SIGALRM", "SIGXCPU"),
    *("SIGVTALRM", "SIGPROF", "SIGPOLL", "SIGPWR", "SIGSTKFLT", "SIGBREAK"),
)
_REAL_TIME = range(signal.SIGRTMIN, signal.SIGRTMAX + 1) if hasattr(signal, "SIGRTMIN") else range(0)
SIGNALS: tuple[int, ...] = (*(int(getattr(signal, name)) for name in _NAMES if hasattr(signal, name)), *_REAL_TIME)
"""All signals that terminate a process by default, except faults, SIGKILL, and those ignored by Python (SIGPIPE, SIGXFSZ)."""

# Sent deliberately; a second one means that the sender does not want to wait. A second one of the others has no meaning:
# SIGXCPU comes every second, and on a closed terminal both the kernel and the shell send SIGHUP.
_DELIBERATE = tuple(
    int(getattr(signal, name)) for name in ("SIGINT", "SIGTERM", "SIGQUIT", "SIGBREAK") if hasattr(signal, name)
)
# Libraries install C handlers for these two (such as JAX's preemption notice), which may be replaced.
_TAKEN_FROM_LIBRARIES = (signal.SIGINT, signal.SIGTERM)
_PATIENCE_S = 10.0  # for a command to end after a signal: a compilation by XLA may not return to Python for minutes


def signal_name(number: int) -> str:
    """Return a signal's name for messages: ``SIGHUP``, ``SIGRTMIN+2``, or ``Ctrl-C``."""
    if number in _REAL_TIME[1:-1]:  # Python has names for the first and the last of these
        return f"SIGRTMIN+{number - _REAL_TIME[0]}"
    return "Ctrl-C" if number == signal.SIGINT else signal.Signals(number).name


@contextlib.contextmanager
def shielded_children() -> Iterator[None]:
    """Block `SIGNALS` in processes and threads started in this context by this thread.

    `timeout`, cluster schedulers and terminals signal the whole process group. XLA compiles with child processes (ptxas): a
    signal that killed one of them would fail the compilation, while the run itself is to save and end in good order. A blocked
    signal stays blocked in child processes and threads; the main thread itself receives it afterwards.
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
    """Block `SIGNALS` permanently in this thread; an initializer for pools of compiling threads."""
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)


class _Handlers:
    """Handlers of all `SIGNALS` that have no other handler; SIGPIPE is ignored meanwhile.

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
        # Scripts that should end when `head` does set it so; a run should not.
        if hasattr(signal, "SIGPIPE") and signal.getsignal(signal.SIGPIPE) == signal.SIG_DFL:
            self._before[signal.SIGPIPE] = signal.signal(signal.SIGPIPE, signal.SIG_IGN)

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before.clear()


def _is_free(number: int, caught_in_c: int) -> bool:
    """Return True if a signal would end this process, or has a handler of this module."""
    handler = signal.getsignal(number)
    if handler is signal.default_int_handler or isinstance(getattr(handler, "__self__", None), _Handlers):
        return True
    return handler == signal.SIG_DFL and (number in _TAKEN_FROM_LIBRARIES or not caught_in_c >> (number - 1) & 1)


def _caught_in_c() -> int:
    """Return the bit mask of caught and ignored signals, including handlers of C code such as `faulthandler.register`'s.

    Python itself does not know those handlers. The mask is 0 on systems without /proc.
    """
    masks = 0
    with contextlib.suppress(OSError, ValueError):
        for line in Path("/proc/self/status").read_text(encoding="ascii", errors="replace").splitlines():
            if line.startswith(("SigCgt:", "SigIgn:")):
                masks |= int(line.split()[1], 16)
    return masks


class Interruption(_Handlers):
    """Context in which `SIGNALS` only set a flag. A second deliberate signal raises at once.

    Attributes:
        signal: The first signal received, or None.
        is_urgent: True after a second signal out of Ctrl-C, SIGTERM, SIGQUIT and SIGBREAK.
    """

    def __init__(self) -> None:
        super().__init__()
        self.signal: int | None = None
        self.is_urgent = False
        self._was_deliberate = False

    def __enter__(self) -> Self:
        self._install(self._note)
        return self

    def __bool__(self) -> bool:
        return self.signal is not None

    def reached_any(self) -> bool:
        """Return True if any process has received a signal, on which all then agree; a collective call."""
        if number := distributed.max_over_processes(self.signal or 0):
            self.signal = number
        return bool(number)

    @property
    def name(self) -> str:
        """Name of the signal for a message."""
        return signal_name(self.signal or signal.SIGTERM)

    @property
    def quit_hint(self) -> str:
        """Hint for messages: the input that ends the process without waiting."""
        return "once more quits" if self.signal in _DELIBERATE else "Ctrl-C or SIGTERM, twice, quits"

    def _note(self, number: int, _: FrameType | None) -> None:
        if number in _DELIBERATE and self._was_deliberate:
            self.signal, self.is_urgent = number, True
            _ignore_half_made_loops()
            self.end()
        self._was_deliberate |= number in _DELIBERATE
        if self.signal is None:
            self.signal = number

    def end(self) -> None:
        """Raise the exception of the signal: `Terminated` or KeyboardInterrupt."""
        _raise(self.signal or signal.SIGTERM)


def _ignore_half_made_loops() -> None:
    """Silence asyncio, used by orbax for saving, about an event loop whose creation was interrupted by a raising handler."""
    before = sys.unraisablehook

    def hook(unraisable: "sys.UnraisableHookArgs") -> None:
        if getattr(unraisable.object, "__qualname__", "") != "BaseEventLoop.__del__":
            before(unraisable)

    sys.unraisablehook = hook


def _raise(number: int) -> None:
    if number == signal.SIGINT:
        raise KeyboardInterrupt
    raise Terminated(number)


class Ending(_Handlers):
    """Context in which `SIGNALS` raise `Terminated` or KeyboardInterrupt in the main thread, as Ctrl-C does anyway.

    Args:
        force_exit: Called in another thread with a signal that has not ended this process after 10 s, because the main thread
            does not return to Python. It must end the process. None: no such watchdog.

    Attributes:
        signal: The first signal received, except those handled by an `Interruption`; None if there was none.
    """

    def __init__(self, force_exit: Callable[[int], None] | None = None) -> None:
        super().__init__()
        self.signal: int | None = None
        self._force_exit = force_exit
        self._wakeup_sockets: list[socket.socket] = []
        self._wakeup_before = -1

    def __enter__(self) -> Self:
        self._install(self._end)
        if self._force_exit is not None and self._before:
            # Python's C-level handler, which runs at once whatever the main thread does, writes the signal's number here.
            reader, writer = socket.socketpair()
            writer.setblocking(False)
            self._wakeup_sockets = [reader, writer]
            self._wakeup_before = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
            threading.Thread(target=self._watch, args=(reader, self._force_exit), daemon=True).start()
        return self

    def __exit__(self, *error: object) -> None:
        super().__exit__(*error)
        if self._wakeup_sockets:
            signal.set_wakeup_fd(self._wakeup_before)
            self._wakeup_sockets[1].close()  # ends the thread that reads the other end
            self._wakeup_sockets.clear()

    def _end(self, number: int, _: FrameType | None) -> None:
        if self.signal is not None and number not in _DELIBERATE:
            return
        self.signal = self.signal or number
        _raise(number)

    def _watch(self, reader: socket.socket, force_exit: Callable[[int], None]) -> None:
        shield_this_thread()
        with reader:
            while received := reader.recv(1):
                # An `Interruption` has handlers of its own: the code that it guards has no time limit.
                if received[0] in SIGNALS and signal.getsignal(received[0]) == self._end:
                    time.sleep(_PATIENCE_S)
                    force_exit(received[0])


def obey_parent_only() -> None:
    """Let a child process, in which `SIGNALS` are blocked (`shielded_children`), end only by a SIGTERM of its parent.

    If the system does not report the sender of a signal (macOS), any SIGTERM ends it.
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
