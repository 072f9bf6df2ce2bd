"""Timing of compiled programs, with warm-up, synchronisation and repeats."""

import dataclasses
import statistics
import time
from collections.abc import Callable
from typing import Any

import jax

from jaxrl_vis_envs.compiling.compilation import tracing_for_default_device

_MIN_SECONDS = 0.2


@dataclasses.dataclass(frozen=True)
class Timing:
    """Duration of one call, measured several times.

    Attributes:
        median_s: Median duration of the repeats in seconds.
        spread: (slowest - fastest) / median.
        repeats: Number of repeats.
    """

    median_s: float
    spread: float
    repeats: int

    def details(self, compile_s: float, **more: Any) -> dict[str, Any]:
        """Return the details of a record: repeats, spread, seconds of compilation, and further entries ``more``."""
        timing = {"repeats": self.repeats, "spread": round(self.spread, 4), "compile_s": round(compile_s, 2)}
        return {**timing, **more}


def compile_timed(jitted: Any, *arguments: Any) -> tuple[Any, float]:
    """Compile a jitted function ahead of time, for the default device; return the program and the seconds that it took."""
    start = time.perf_counter()
    with tracing_for_default_device():
        lowered = jitted.lower(*arguments)
    compiled = lowered.compile()
    return compiled, time.perf_counter() - start


def measure(
    call: Callable[[], Any],
    repeats: int = 5,
    budget_s: float = 30.0,
    wait: Callable[[Any], Any] = jax.block_until_ready,
) -> Timing:
    """Time ``call`` until its result is available, after one untimed call.

    Short calls are dispatched back to back and synchronised together, as in a loop that uses the results on the device:
    synchronising after each would measure the dispatch of the host.

    Args:
        call: Workload; returns arrays.
        repeats: Maximum number of timed repeats. The minimum is three, or ``repeats`` if that is less.
        budget_s: Time in seconds after which no further repeat starts.
        wait: Function that waits for all calls up to the one whose result it receives.
    """

    def seconds_per_call(calls: int) -> float:
        start = time.perf_counter()
        result = None
        for _ in range(calls):
            result = call()
        wait(result)
        return (time.perf_counter() - start) / calls

    wait(call())
    # Repeat short calls until their duration is well above the noise of clock and scheduler.
    calls = max(1, min(1000, round(_MIN_SECONDS / max(seconds_per_call(1), 1e-6))))
    seconds: list[float] = []
    while len(seconds) < repeats and (len(seconds) < 3 or sum(seconds) * calls < budget_s):
        seconds.append(seconds_per_call(calls))
    median = statistics.median(seconds)
    return Timing(median, (max(seconds) - min(seconds)) / median, len(seconds))
