"""Exceptions for requests and runs. Each message is one line: the problem and its remedy. Imports nothing heavy."""

import signal

from jaxrl_vis_envs.names import nearest

__all__ = ["NonFiniteError", "RequestError", "StorageError", "Terminated", "WorkerError", "nearest"]


class RequestError(ValueError):
    """Error in the request. The message is one line: what is wrong, and how to fix it. The command line exits with 2."""


class NonFiniteError(FloatingPointError):
    """Non-finite loss, state or parameter. One line: which one, where the state was dumped, and what is still usable."""


class StorageError(RuntimeError):
    """Failure to write a run's files, for example because the disk is full. One line: the cause, what was saved, and the
    remedy.
    """


class Terminated(SystemExit):
    """Exit after a signal other than Ctrl-C, raised once the work is saved. Uncaught, it ends the program with 128 + the
    signal.

    Attributes:
        signal: Number of the signal.
    """

    def __init__(self, number: int = signal.SIGTERM) -> None:
        super().__init__(128 + number)
        self.signal = int(number)


class WorkerError(RuntimeError):
    """Worker process killed externally. One line: the cause and the remedy. The command line exits with 1."""
