"""Startup hook of every Python with this folder on its path: a clock that jumps, and a file system without locks.

SOAK_CLOCK names a file: once it exists, the clock is offset by the number of seconds in it. Durations (`time.monotonic`) stay
right, as on any computer whose clock is set. SOAK_NO_LOCKS makes `flock` fail as on some network file systems.
"""

import errno
import os
import time

if clock := os.environ.get("SOAK_CLOCK", ""):
    right, right_ns = time.time, time.time_ns

    def offset() -> float:
        try:
            with open(clock) as file:
                return float(file.read() or 0.0)
        except (OSError, ValueError):
            return 0.0

    time.time = lambda: right() + offset()
    time.time_ns = lambda: right_ns() + int(1e9 * offset())

if os.environ.get("SOAK_NO_LOCKS"):
    import fcntl

    def flock(*_: object) -> None:
        raise OSError(errno.ENOSYS, "Function not implemented")

    fcntl.flock = flock
