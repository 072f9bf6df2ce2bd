"""Under which conditions a figure was measured, and whether two figures may be compared.

A name such as "AMD EPYC, 2 cores" is that of many machines of many speeds, and one machine is slower while others use it. So a
record keeps which machine it was, how busy it was with other programs before, and how fast it computed a fixed piece of work
(a calibration) before and after. Only figures of one machine that was idle, at the same speed, are compared; of all others the
reason why they are not is told.
"""

import dataclasses
import hashlib
import os
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from jaxrl_vis_envs.cores import num_cores

SAME_SPEED = 0.1
"""Calibrations that differ by at most this share are of the same speed."""
BUSY_CORES = 0.3
"""Other programs may use so much of the machine's cores (of a core, for each core that may be used)."""

_SAMPLE_S, _CALIBRATION_S, _REPEATS = 0.4, 0.04, 5


def machine() -> str:
    """12 hexadecimal digits that stay the same on one machine, and tell it from others of the same name."""
    words = [platform.node()]
    for file in ("/etc/machine-id", "/var/lib/dbus/machine-id"):
        if os.path.exists(file):
            words.append(Path(file).read_text(encoding="ascii", errors="replace").strip())
    return hashlib.sha256("\n".join(words).encode()).hexdigest()[:12]


def busy_cores() -> float | None:
    """How many of the cores that this process may use others are using now; looks for a moment. None where nobody says."""
    before = _busy_seconds()
    if before is None:
        return None
    start = time.perf_counter()
    time.sleep(_SAMPLE_S)
    after = _busy_seconds()
    return None if after is None else round(max(0.0, (after - before) / (time.perf_counter() - start)), 2)


def _busy_seconds() -> float | None:
    """Seconds that this process's cores have worked since the machine started, all programs together."""
    if not (hasattr(os, "sched_getaffinity") and os.path.exists("/proc/stat")):
        return None
    allowed, total = os.sched_getaffinity(0), 0
    with open("/proc/stat", encoding="ascii") as file:
        for line in file:
            name, *ticks = line.split()
            if name.startswith("cpu") and name[3:].isdigit() and int(name[3:]) in allowed:
                user, nice, system, _, _, *interrupts = map(int, ticks)
                total += user + nice + system + sum(interrupts[:3])
    return total / os.sysconf("SC_CLK_TCK")


def calibrate() -> dict[str, float]:
    """How fast the device does two fixed pieces of work: products of matrices (GFLOP/s), and adding long arrays (GB/s)."""
    return {name: round(work.amount / _seconds(work), 2) for name, work in calibrations().items()}


@dataclasses.dataclass(frozen=True)
class Work:
    """A fixed piece of work.

    Attributes:
        program: Compiled.
        arguments: Its arrays. They are no constants of the program: XLA computes what is constant while it compiles, which
            takes minutes for a product of large matrices, and leaves nothing to measure.
        amount: Of work in a call, in 1e9 of its unit.
    """

    program: Callable[..., jax.Array]
    arguments: tuple[jax.Array, ...]
    amount: float

    def __call__(self) -> jax.Array:
        """Does it, or begins to: wait for the result."""
        return self.program(*self.arguments)


def calibrations() -> dict[str, Work]:
    """What `calibrate` measures, by the name of the figure."""
    on_cpu = jax.default_backend() == "cpu"
    size, length = (384, 2**22) if on_cpu else (4096, 2**27)
    matrix = jnp.ones((size, size), jnp.float32 if on_cpu else jnp.bfloat16)
    array = jnp.ones((length,), jnp.float32)

    def work(function: Callable[..., jax.Array], arguments: tuple[jax.Array, ...], amount: float) -> Work:
        return Work(jax.jit(function).lower(*arguments).compile(), arguments, amount)

    return {
        "gflops": work(jnp.matmul, (matrix, matrix), 2e-9 * size**3),
        "gbytes_per_s": work(lambda values: values + 1.0, (array,), 8e-9 * length),
    }


def _seconds(call: Callable[[], Any]) -> float:
    """The median of a few repeats, each of many calls."""

    def of(calls: int) -> float:
        start = time.perf_counter()
        result = None
        for _ in range(calls):
            result = call()  # the one before is let go: results of half a gigabyte each would fill the device
        jax.block_until_ready(result)
        return (time.perf_counter() - start) / calls

    of(1)
    calls = max(1, min(200, round(_CALIBRATION_S / max(of(1), 1e-6))))
    return statistics.median(of(calls) for _ in range(_REPEATS))


class Watch:
    """Watches the machine during a benchmark: ask it after each measurement for the conditions of that one."""

    def __init__(self) -> None:
        self._busy, self._before = busy_cores(), calibrate()
        self._cores = num_cores()

    def conditions(self) -> dict[str, Any]:
        """What a record keeps: machine, cores, cores busy with other programs before the benchmark, and two calibrations."""
        before, self._before = self._before, calibrate()
        return {
            "machine": machine(),
            "cores": self._cores,
            "busy_cores": self._busy,
            "calibration": {"before": before, "after": self._before},
        }


def why_not_comparable(new: dict[str, Any] | None, old: dict[str, Any] | None) -> str | None:
    """Why a new figure says nothing about an old one; None where it does.

    Args:
        new, old: Conditions as `Watch` gives them; None of a record that has none.
    """
    if old is None or new is None:
        return "it does not say how fast its machine was"
    if old["machine"] != new["machine"]:
        return "it is of another machine of this name"
    for which, each in (("now", new), ("then", old)):
        if each["busy_cores"] is not None and each["busy_cores"] > BUSY_CORES * each["cores"]:
            return f"other programs used {each['busy_cores']:.1f} of {each['cores']} cores {which}"
        drift = speed_ratio(each["calibration"]["after"], each["calibration"]["before"])
        if abs(drift - 1) > SAME_SPEED:
            return f"while it was measured {which}, the machine's speed changed by {drift - 1:+.0%}"
    ratio = speed_ratio(_mean(new), _mean(old))
    if abs(ratio - 1) > SAME_SPEED:
        return f"the machine itself runs at {ratio:.2f} times the speed that it had then"
    return None


def speed_ratio(new: dict[str, float], old: dict[str, float]) -> float:
    """The ratio of two calibrations that is farthest from 1."""
    return max((new[name] / old[name] for name in old), key=lambda ratio: abs(ratio - 1))


def _mean(conditions: dict[str, Any]) -> dict[str, float]:
    before, after = conditions["calibration"]["before"], conditions["calibration"]["after"]
    return {name: (before[name] + after[name]) / 2 for name in before}
