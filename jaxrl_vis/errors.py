"""What can go wrong with a request or a run: each says in one line what it is, and how to mend it. Imports nothing heavy."""

import difflib
import signal
from collections.abc import Iterable


class RequestError(ValueError):
    """The request was wrong. The message is one line: what is wrong, and how to mend it. The command line exits with 2."""


class NonFiniteError(FloatingPointError):
    """A loss, a state or a parameter is not finite any more. One line: what, where the state was dumped, what is still good."""


class StorageError(RuntimeError):
    """A run could not write its files, for instance because the disk is full. One line: what, what is kept, and the mend."""


class Terminated(SystemExit):
    """The run was stopped by SIGTERM, after saving. Left alone, it ends the program with status 143."""

    def __init__(self) -> None:
        super().__init__(128 + signal.SIGTERM)


def nearest(word: str, choices: Iterable[str], otherwise: str | None = None) -> str:
    """How to mend a misspelt word: '; did you mean X or Y?', with the nearest of ``choices``.

    Args:
        word: What was given.
        choices: What is allowed.
        otherwise: What to say where none is near; None for a list of all ``choices``.
    """
    lowered = {choice.lower(): choice for choice in choices}
    found = [lowered[match] for match in difflib.get_close_matches(word.lower(), list(lowered), n=3, cutoff=0.5)]
    if found:
        return f"; did you mean {' or '.join(found)}?"
    return f"; choose one of {', '.join(lowered.values())}" if otherwise is None else f"; {otherwise}"
