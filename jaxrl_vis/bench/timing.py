"""Timing that means something: compiled ahead, warmed up, waited for, repeated, and never of copies of one result."""

import dataclasses
import itertools
import statistics
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

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
    """Compiles ahead of time: the program, and the seconds of tracing and compiling (few where a cache had it)."""
    start = time.perf_counter()
    compiled = jitted.lower(*arguments).compile()
    return compiled, time.perf_counter() - start


def measure(
    call: Callable[[], Any],
    repeats: int = 5,
    budget_s: float = 30.0,
    wait: Callable[[Any], Any] = jax.block_until_ready,
) -> Timing:
    """Times ``call`` after one untimed call, until its result is there.

    Short calls are made one after the other and waited for together, as in a loop that does something with the results on the
    device: a wait after each would time how fast the host gives orders.

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


def assert_varied(rows: Any, what: str) -> None:
    """Asserts that [N, ...] ``rows`` are not copies of each other: more than half are unlike all others.

    A benchmark whose environments all do the same measures one environment and a broadcast.
    """
    rows = np.asarray(rows)
    count = rows.shape[0]
    distinct = len({row.tobytes() for row in rows})
    if count > 1 and distinct <= count // 2:
        raise AssertionError(f"only {distinct} of {count} {what} differ: this would measure a broadcast")


def alternate(draw: Callable[[Any], Any], batches: list[Any]) -> Callable[[], Any]:
    """A call without arguments that draws the next of the batches, round and round."""
    turns = itertools.cycle(batches)
    return lambda: draw(next(turns))


def assert_new_images(draw: Callable[[Any], Any], batches: list[Any]) -> None:
    """Asserts that images differ within a batch and between batches.

    Args:
        draw: Gives arrays [N, ...], or a tree of them.
        batches: Two or more.
    """
    drawn = [rows_of(draw(batch)) for batch in batches]
    for rows in drawn:
        assert_varied(rows, "images")
    for first, second in itertools.pairwise(drawn):
        same = int(np.sum(np.all(first == second, axis=1)))
        if len(first) > 1 and same >= len(first) / 2:
            raise AssertionError(
                f"{same} of {len(first)} images stay the same in the next batch: this would measure a broadcast"
            )


def rows_of(images: Any) -> np.ndarray:
    """[N, bytes] of a tree of arrays [N, ...]."""
    planes = [np.ascontiguousarray(plane) for plane in jax.tree.leaves(jax.device_get(images))]
    return np.concatenate([plane.reshape(len(plane), -1).view(np.uint8) for plane in planes], axis=1)
