"""Exceptions for requests and runs. Each message is one line: the problem and its remedy. Imports nothing heavy."""

import signal

from jaxrl_vis_envs.names import nearest

__all__ = ["NonFiniteError", "RequestError", "StorageError", "Terminated", "WorkerError", "is_out_of_memory", "nearest"]


class RequestError(ValueError):
    """Error in the request. The message is one line: what is wrong, and how to fix it. The command line exits with 2."""


class NonFiniteError(FloatingPointError):
    """Non-finite loss, state or parameter. The message is one line: which numbers, where the state was dumped, and the last
    checkpoint. The command line exits with 4.
    """


class StorageError(RuntimeError):
    """Failure to write files, for example because the disk is full. The message is one line: the cause and, for a run, what was
    saved and how to resume. The command line exits with 1.
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
    """Worker process killed externally. The message is one line: the cause and the remedy. The command line exits with 1."""


def is_out_of_memory(error: BaseException) -> bool:
    """Return True for an error of Python or JAX because the memory of the machine or of a device ran out."""
    # JAX's class is compared by name, so that JAX need not be imported.
    return isinstance(error, MemoryError) or (type(error).__name__ == "JaxRuntimeError" and "RESOURCE_EXHAUSTED" in str(error))
