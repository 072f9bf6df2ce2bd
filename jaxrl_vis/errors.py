"""What can go wrong with a request or a run: each says in one line what it is, and how to mend it. Imports nothing heavy."""

import signal

from jaxrl_vis_envs.names import nearest

__all__ = ["NonFiniteError", "RequestError", "StorageError", "Terminated", "WorkerError", "nearest"]


class RequestError(ValueError):
    """The request was wrong. The message is one line: what is wrong, and how to mend it. The command line exits with 2."""


class NonFiniteError(FloatingPointError):
    """A loss, a state or a parameter is not finite any more. One line: what, where the state was dumped, what is still good."""


class StorageError(RuntimeError):
    """A run could not write its files, for instance because the disk is full. One line: what, what is kept, and the mend."""


class Terminated(SystemExit):
    """A signal other than Ctrl-C stopped the work, after saving. Left alone, it ends the program with 128 + its number.

    Attributes:
        signal: Its number.
    """

    def __init__(self, number: int = signal.SIGTERM) -> None:
        super().__init__(128 + number)
        self.signal = int(number)


class WorkerError(RuntimeError):
    """A process that works for this one was ended from outside. One line: what, and the mend. The command line exits with 1."""
