"""Timing that means something: compiled ahead of time, warmed up, waited for, repeated."""

import dataclasses
import statistics
import time
from collections.abc import Callable
from typing import Any

import jax

from jaxrl_vis_envs.compilation import tracing_for_default_device

_LEAST_SECONDS = 0.2


@dataclasses.dataclass(frozen=True)
class Timing:
    """Seconds of one call.

    Attributes:
        median_s: Of the repeats.
        spread: (slowest - fastest) / median.
        repeats: How many there were.
    """

    median_s: float
    spread: float
    repeats: int

    def details(self, compile_s: float, **more: Any) -> dict[str, Any]:
        """What a record keeps beside the figure."""
        timing = {"repeats": self.repeats, "spread": round(self.spread, 4), "compile_s": round(compile_s, 2)}
        return {**timing, **more}


def compile_timed(jitted: Any, *arguments: Any) -> tuple[Any, float]:
    """Compiles ahead of time: the program, and the seconds of tracing and compiling (few if a cache had it)."""
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
    """Times ``call`` until its result is there, after one untimed call.

    Short calls are made one after the other and waited for together, as in a loop that uses the results on the device: waiting
    after each would measure how fast the host dispatches.

    Args:
        call: The work; returns arrays.
        repeats: Timed repeats at most. At least three are made, or ``repeats`` if that is less.
        budget_s: No further repeat starts after this many seconds.
        wait: Waits for all calls whose last result it is given.
    """

    def seconds_of(calls: int) -> float:
        start = time.perf_counter()
        result = None
        for _ in range(calls):
            result = call()
        wait(result)
        return (time.perf_counter() - start) / calls

    wait(call())
    # A call of a few milliseconds is repeated until a clock and a scheduler can tell it from noise.
    calls = max(1, min(1000, round(_LEAST_SECONDS / max(seconds_of(1), 1e-6))))
    seconds: list[float] = []
    while len(seconds) < repeats and (len(seconds) < 3 or sum(seconds) * calls < budget_s):
        seconds.append(seconds_of(calls))
    median = statistics.median(seconds)
    return Timing(median, (max(seconds) - min(seconds)) / median, len(seconds))
