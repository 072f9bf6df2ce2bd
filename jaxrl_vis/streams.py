"""Standard streams that nothing printed can break.

A terminal may not know a character, a reader may leave (`| head`, ssh gone), a disk may be full, and a service may have no
streams at all. What cannot be shown is left out, or becomes a question mark, and whoever prints goes on.
"""

import contextlib
import os
import sys
from collections.abc import Iterable, Iterator
from typing import Any


class SafeStream:
    """A stream whose `write` and `flush` raise nothing. Anything else that is asked of it is asked of what lies below.

    Args:
        below: A text stream; None drops everything.

    Attributes:
        failure: The first error of what lies below; None while there was none.
    """

    def __init__(self, below: Any):
        self._below = below
        self.failure: Exception | None = None

    def write(self, text: str) -> int:
        """Writes what can be written; the length of ``text``."""
        if self._below is not None:
            try:
                self._write(text)
            except Exception as error:  # noqa: BLE001 - streams of notebooks and services have kinds of their own
                self.failure = self.failure or error
        return len(text)

    def _write(self, text: str) -> None:
        try:
            self._below.write(text)
        except UnicodeEncodeError as error:
            self._below.write(text.encode(error.encoding, "replace").decode(error.encoding))

    def writelines(self, lines: Iterable[str]) -> None:
        """Writes each of them."""
        for line in lines:
            self.write(line)

    def flush(self) -> None:
        """Passes on what was written, as far as that is possible."""
        if self._below is not None:
            try:
                self._below.flush()
            except Exception as error:  # noqa: BLE001 - as above
                self.failure = self.failure or error

    def isatty(self) -> bool:
        """Returns whether this is a terminal."""
        with contextlib.suppress(Exception):
            return bool(self._below.isatty())
        return False

    @property
    def encoding(self) -> str:
        """Encoding of the stream below."""
        return getattr(self._below, "encoding", None) or "utf-8"

    def fileno(self) -> int:
        """Number of the file below.

        Raises:
            OSError: It has none.
        """
        if self._below is None:
            raise OSError("there is no stream")
        return self._below.fileno()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._below, name)


def safe(stream: Any) -> SafeStream:
    """A stream, such as ``sys.stdout``, which may be None or closed, as one that can be printed to."""
    return stream if isinstance(stream, SafeStream) else SafeStream(stream)


def say(line: str) -> None:
    """Prints a line to stdout, for whoever can see it."""
    print(line, flush=True, file=safe(sys.stdout))


@contextlib.contextmanager
def safe_streams() -> Iterator[SafeStream]:
    """Lets everything in this process print to safe streams, third-party libraries included; gives stdout."""
    before = sys.stdout, sys.stderr
    stdout, stderr = safe(before[0]), safe(before[1])
    sys.stdout, sys.stderr = stdout, stderr  # type: ignore[assignment] - a stream, though not of Python's classes
    try:
        yield stdout
    finally:
        stdout.flush()
        stderr.flush()
        if (sys.stdout, sys.stderr) == (stdout, stderr):
            sys.stdout, sys.stderr = before


def reserve_standard_files() -> None:
    """Opens nothing in the place of standard files (0, 1, 2) that are closed.

    Otherwise the next file that is opened would take their place, such as a run's metrics, and what libraries in C print would
    be written into it.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            with contextlib.suppress(OSError):
                nothing = os.open(os.devnull, os.O_RDWR)
                if nothing != number:
                    os.dup2(nothing, number)
                    os.close(nothing)
                os.set_inheritable(number, True)


def let_go_of_broken_streams() -> None:
    """Flushes standard streams, for the last time, and leaves nothing in them that Python would complain about at its end."""
    for stream in (sys.stdout, sys.stderr):
        if stream is None:
            continue
        try:
            stream.flush()
        except Exception:  # noqa: BLE001 - as of `SafeStream`
            with contextlib.suppress(Exception):
                nothing = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nothing, stream.fileno())
                os.close(nothing)
