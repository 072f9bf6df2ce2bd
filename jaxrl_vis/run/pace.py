"""The pace of a run: how fast it goes, and how long it will take."""

import time


class Pace:
    """Watches one process of a run.

    Args:
        steps: Environment steps of all seeds in an iteration.

    Attributes:
        begun: Iterations that the run had done when this process began to train.
    """

    def __init__(self, steps: int):
        self._steps = steps
        self.begin(0)

    def begin(self, done: int) -> None:
        """Takes down that training begins here, after so many iterations."""
        self.mark(done)
        self.begun, self._begun_at = done, self._marked_at

    def mark(self, done: int) -> None:
        """Takes down the end of an evaluation, which `speed` counts from."""
        self._marked, self._marked_at = done, time.monotonic()

    def speed(self, done: int) -> float:
        """Environment steps of all seeds per second since the last evaluation; updates included, evaluations not."""
        return max(0, done - self._marked) * self._steps / max(1e-9, time.monotonic() - self._marked_at)

    def seconds_left(self, done: int, total: int) -> float:
        """Seconds until ``total`` iterations are done, at the speed since the beginning; at least one must be done."""
        return (total - done) * (time.monotonic() - self._begun_at) / (done - self.begun)
