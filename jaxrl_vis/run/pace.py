"""Speed and remaining time of a run."""

import time


class Pace:
    """Stopwatch of one process of a run.

    Args:
        steps: Environment steps per iteration, all seeds together.

    Attributes:
        begun: Iterations completed when this process began to train.
    """

    def __init__(self, steps: int):
        self._steps = steps
        self.begin(0)

    def begin(self, done: int) -> None:
        """Start the clock after ``done`` iterations."""
        self.mark(done)
        self.begun, self._begun_at = done, self._marked_at

    def mark(self, done: int) -> None:
        """Record the end of an evaluation, from which `speed` is measured."""
        self._marked, self._marked_at = done, time.monotonic()

    def speed(self, done: int) -> float:
        """Return environment steps per second since the last evaluation, all seeds together, updates included."""
        return max(0, done - self._marked) * self._steps / max(1e-9, time.monotonic() - self._marked_at)

    def seconds_left(self, done: int, total: int) -> float:
        """Return the estimated time in seconds until ``total`` iterations are done, at the average speed of this process.

        Args:
            done: Iterations completed so far; must exceed `begun`.
            total: Iterations of the whole run.
        """
        return (total - done) * (time.monotonic() - self._begun_at) / (done - self.begun)
