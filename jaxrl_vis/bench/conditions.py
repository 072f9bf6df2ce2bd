"""Conditions of a measurement: the machine, its load and its speed, which determine whether two results are comparable.

Many machines of different speeds share a name such as "AMD EPYC, 2 cores", and a machine is slower while others use it. A
record therefore stores an identifier of the machine, its load from other programs before the benchmark, and its speed on a
fixed workload (a calibration) before and after. Results are compared only if they come from one idle machine at one speed; for
any other pair the reason is printed.
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
"""Maximum relative difference between two calibrations that count as the same speed."""
BUSY_CORES = 0.3
"""Maximum fraction of the available cores that other programs may use during comparable measurements."""

_SAMPLE_S, _CALIBRATION_S, _REPEATS = 0.4, 0.04, 5


def machine_id() -> str:
    """Return an identifier of this machine: 12 hexadecimal digits, different for machines of the same name."""
    words = [platform.node()]
    for file in ("/etc/machine-id", "/var/lib/dbus/machine-id"):
        if os.path.exists(file):
            words.append(Path(file).read_text(encoding="ascii", errors="replace").strip())
    return hashlib.sha256("\n".join(words).encode()).hexdigest()[:12]


def busy_cores() -> float | None:
    """Measure the load of other programs on the cores of this process, in cores, over 0.4 s; None if unknown."""
    before = _busy_seconds()
    if before is None:
        return None
    start = time.perf_counter()
    time.sleep(_SAMPLE_S)
    after = _busy_seconds()
    return None if after is None else round(max(0.0, (after - before) / (time.perf_counter() - start)), 2)


def _busy_seconds() -> float | None:
    """Return the busy time of this process's cores since boot, in seconds over all programs; None if unknown."""
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
    """Measure the device's speed on two fixed workloads, by name: matrix products (``gflops``) and the addition of long arrays
    (``gbytes_per_s``), in 1e9 operations or bytes per second.
    """
    return {name: round(work.amount / _seconds(work), 2) for name, work in calibrations().items()}


@dataclasses.dataclass(frozen=True)
class Work:
    """Fixed workload.

    Attributes:
        program: Compiled program.
        arguments: Argument arrays. They are not constants of the program, because XLA folds constants during compilation,
            which takes minutes for a product of large matrices and leaves nothing to measure.
        amount: Work of one call, in 1e9 operations or bytes.
    """

    program: Callable[..., jax.Array]
    arguments: tuple[jax.Array, ...]
    amount: float

    def __call__(self) -> jax.Array:
        """Dispatch one call and return its result, which may not be ready yet."""
        return self.program(*self.arguments)


def calibrations() -> dict[str, Work]:
    """Return the workloads of `calibrate` by the name of the measured quantity."""
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
    """Time a call: median seconds over a few repeats of many calls."""

    def seconds_per_call(calls: int) -> float:
        start = time.perf_counter()
        result = None
        for _ in range(calls):
            result = call()  # releases the previous result: half a gigabyte each would fill the device
        jax.block_until_ready(result)
        return (time.perf_counter() - start) / calls

    seconds_per_call(1)
    calls = max(1, min(200, round(_CALIBRATION_S / max(seconds_per_call(1), 1e-6))))
    return statistics.median(seconds_per_call(calls) for _ in range(_REPEATS))


class ConditionMonitor:
    """Monitor of the machine during a benchmark; call `conditions` after each measurement."""

    def __init__(self) -> None:
        self._busy_cores, self._calibration = busy_cores(), calibrate()
        self._cores = num_cores()

    def conditions(self) -> dict[str, Any]:
        """Return the conditions of a record: machine, cores, load before the benchmark, and calibrations around it."""
        before, self._calibration = self._calibration, calibrate()
        return {
            "machine": machine_id(),
            "cores": self._cores,
            "busy_cores": self._busy_cores,
            "calibration": {"before": before, "after": self._calibration},
        }


def comparison_fault(new: dict[str, Any] | None, old: dict[str, Any] | None) -> str | None:
    """Return the reason why two results are not comparable, in words; None if they are.

    Args:
        new, old: Conditions from `ConditionMonitor`; None for a record without conditions.
    """
    if old is None or new is None:
        return "it does not say how fast its machine was"
    if old["machine"] != new["machine"]:
        return "it is of another machine of this name"
    for when, conditions in (("now", new), ("then", old)):
        if conditions["busy_cores"] is not None and conditions["busy_cores"] > BUSY_CORES * conditions["cores"]:
            return f"other programs used {conditions['busy_cores']:.1f} of {conditions['cores']} cores {when}"
        drift = speed_ratio(conditions["calibration"]["after"], conditions["calibration"]["before"])
        if abs(drift - 1) > SAME_SPEED:
            return f"while it was measured {when}, the machine's speed changed by {drift - 1:+.0%}"
    ratio = speed_ratio(_mean(new), _mean(old))
    if abs(ratio - 1) > SAME_SPEED:
        return f"the machine itself runs at {ratio:.2f} times the speed that it had then"
    return None


def speed_ratio(new: dict[str, float], old: dict[str, float]) -> float:
    """Return the ratio of two calibrations that is farthest from 1."""
    return max((new[name] / old[name] for name in old), key=lambda ratio: abs(ratio - 1))


def _mean(conditions: dict[str, Any]) -> dict[str, float]:
    before, after = conditions["calibration"]["before"], conditions["calibration"]["after"]
    return {name: (before[name] + after[name]) / 2 for name in before}
