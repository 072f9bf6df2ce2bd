"""Standard streams that never raise on output.

A terminal may not support a character, a reader may exit (`| head`, a lost ssh connection), a disk may be full, and a service
may have no streams at all. Output that cannot be shown is dropped or replaced by question marks, and the program continues.
"""

import contextlib
import os
import sys
from collections.abc import Iterable, Iterator
from typing import Any


class SafeStream:
    """Stream whose `write` and `flush` never raise; other attributes are those of the wrapped stream.

    Args:
        stream: The wrapped text stream; None discards everything.

    Attributes:
        failure: The first error of the wrapped stream; None if there was none.
    """

    def __init__(self, stream: Any):
        self._stream = stream
        self.failure: Exception | None = None

    def write(self, text: str) -> int:
        """Write as much as possible; return the length of ``text``."""
        if self._stream is not None:
            try:
                self._write(text)
            except Exception as error:  # noqa: BLE001 - streams of notebooks and services raise errors of their own
                self.failure = self.failure or error
        return len(text)

    def _write(self, text: str) -> None:
        try:
            self._stream.write(text)
        except UnicodeEncodeError as error:
            self._stream.write(text.encode(error.encoding, "replace").decode(error.encoding))

    def writelines(self, lines: Iterable[str]) -> None:
        """Write a sequence of lines."""
        for line in lines:
            self.write(line)

    def flush(self) -> None:
        """Flush the wrapped stream, if possible."""
        if self._stream is not None:
            try:
                self._stream.flush()
            except Exception as error:  # noqa: BLE001 - as above
                self.failure = self.failure or error

    def isatty(self) -> bool:
        """Return True if the stream is a terminal."""
        with contextlib.suppress(Exception):
            return bool(self._stream.isatty())
        return False

    @property
    def encoding(self) -> str:
        """Encoding of the wrapped stream."""
        return getattr(self._stream, "encoding", None) or "utf-8"

    def fileno(self) -> int:
        """Return the file descriptor of the wrapped stream.

        Raises:
            OSError: There is none.
        """
        if self._stream is None:
            raise OSError("there is no stream")
        return self._stream.fileno()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def safe(stream: Any) -> SafeStream:
    """Wrap a stream, such as ``sys.stdout``, which may be None or closed; a `SafeStream` is returned unchanged."""
    return stream if isinstance(stream, SafeStream) else SafeStream(stream)


def echo(line: str) -> None:
    """Print a line to stdout, ignoring errors."""
    print(line, flush=True, file=safe(sys.stdout))


@contextlib.contextmanager
def safe_streams() -> Iterator[SafeStream]:
    """Replace stdout and stderr by safe streams, for third-party libraries as well; yield stdout."""
    before = sys.stdout, sys.stderr
    stdout, stderr = safe(before[0]), safe(before[1])
    sys.stdout, sys.stderr = stdout, stderr  # type: ignore[assignment] - a stream, but not a subclass of Python's
    try:
        yield stdout
    finally:
        stdout.flush()
        stderr.flush()
        if (sys.stdout, sys.stderr) == (stdout, stderr):
            sys.stdout, sys.stderr = before


def reserve_standard_files() -> None:
    """Open the null device for closed standard files (0, 1, 2).

    Otherwise the next file to be opened, such as a run's metrics, would take their descriptor, and output of C libraries would
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


def detach_broken_streams() -> None:
    """Flush the standard streams and detach broken ones, so that Python does not report errors at exit."""
    for stream in (sys.stdout, sys.stderr):
        if stream is None:
            continue
        try:
            stream.flush()
        except Exception:  # noqa: BLE001 - as in `SafeStream`
            with contextlib.suppress(Exception):
                nothing = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nothing, stream.fileno())
                os.close(nothing)
