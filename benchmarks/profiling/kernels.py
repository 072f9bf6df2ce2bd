"""Kernels of a training iteration on a GPU: of a gradient step, a control step and an insertion.

    python -m benchmarks.profiling.kernels [TASK] [--preset P] [--parts update rollout insert] [--set FIELD VALUE ...]
        [--rows 20] [--in-order]

Every part is a separate program with a replay full of noise, as in `jaxrl-vis bench update`. The output is its time, the total
time of its kernels, which is longer if they overlap, and the slowest kernels.
"""

import argparse
import collections
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from jaxrl_vis import preset
from jaxrl_vis.bench.update import init_with_full_replay, seed_keys
from jaxrl_vis.config import Config, fields
from jaxrl_vis.errors import RequestError, nearest
from jaxrl_vis.host.devices import check_devices, enable_compilation_cache
from jaxrl_vis.learner.environment import make_env
from jaxrl_vis.learner.train_step import TrainStep, make_train_step
from jaxrl_vis.run.compiled.programs import rarely_collecting_garbage

PARTS = ("update", "rollout", "insert")


def trace_kernels(call: Callable[[], Any]) -> list[tuple[float, float, str]]:
    """Profile a call, which must wait for its results; return start and duration (ns) and name of each kernel, in order."""
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            call()
        data = jax.profiler.ProfileData.from_file(str(next(Path(folder).rglob("*.xplane.pb"))))
    streams = (line for plane in data.planes if "GPU" in plane.name for line in plane.lines if line.name.startswith("Stream"))
    return sorted((event.start_ns, event.duration_ns, event.name) for line in streams for event in line.events)


def kernels(call: Callable[[], Any]) -> tuple[collections.Counter, collections.Counter]:
    """Return the total time (ns) and the number of launches of each kernel of a call, by name; see `trace_kernels`."""
    return count_kernels(trace_kernels(call))


def count_kernels(events: list[tuple[float, float, str]]) -> tuple[collections.Counter, collections.Counter]:
    """Sum up events of `trace_kernels`: total time (ns) and number of launches of each kernel, by name."""
    spent, launches = collections.Counter(), collections.Counter()
    for _, duration, name in events:
        spent[name] += duration
        launches[name] += 1
    return spent, launches


def report(name: str, call: Callable[[], Any], repetitions: int, rows: int, in_order: bool) -> None:
    """Print the time of a call and of its kernels, and the slowest kernels, all divided by the number of repetitions in a call.

    Args:
        name: Label of the first line.
        call: Function to time, which must wait for its results.
        repetitions: Number of repetitions in a call, such as gradient steps.
        rows: Number of kernels to list.
        in_order: List the kernels of one repetition as well, in their order.
    """
    call()
    seconds = []
    for _ in range(3):
        begun = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - begun)
    events = trace_kernels(call)
    spent, launches = count_kernels(events)
    print(
        f"{name}: {1e6 * min(seconds) / repetitions:.0f} us, of which {sum(spent.values()) / repetitions / 1e3:.0f} us in "
        f"{sum(launches.values()) / repetitions:.0f} kernels"
    )
    for kernel, nanoseconds in spent.most_common(rows):
        print(f"  {nanoseconds / repetitions / 1e3:10.1f} us  {launches[kernel] / repetitions:7.1f} x  {kernel[:90]}")
    per_repetition = len(events) // repetitions
    of_one = events[repetitions // 2 * per_repetition :][:per_repetition]
    for at, duration, kernel in of_one if in_order else ():
        print(f"  at {(at - of_one[0][0]) / 1e3:8.1f} us for {duration / 1e3:7.1f} us  {kernel[:90]}")
    sys.stdout.flush()


def measure(program: TrainStep, options: argparse.Namespace) -> None:
    """Compile the parts in ``options.parts`` for a program with a replay full of noise, and print a report of each."""
    parts: list[str] = options.parts
    loop, keys = init_with_full_replay(program), seed_keys(program, 2)
    train, replay, iteration = loop.train, loop.replay, jnp.zeros((), jnp.int32)
    playing = train, keys, jnp.int32(0), program.exploration
    rolled = jax.eval_shape(program.play, *playing)[0]
    arguments = {
        "update": (program.update_many, (train, replay, keys, iteration), program.updates_per_iteration, "a gradient step"),
        "rollout": (program.play, playing, program.env.horizon, "a control step, with its share of the reset"),
        "insert": (program.insert, (train, replay, rolled, keys, iteration), 1, "an insertion"),
    }
    del loop
    compiled = {}
    for part in dict.fromkeys([*(["rollout"] if "insert" in parts else []), *parts]):
        function, inputs, _, _ = arguments[part]
        with rarely_collecting_garbage():
            compiled[part] = function.lower(*inputs).compile()

    def run_phase(part: str) -> None:
        # Donated arguments are returned, so that the next call can use them.
        nonlocal train, replay
        if part == "update":
            train, done = compiled[part](train, replay, keys, iteration)
        elif part == "rollout":
            done = compiled[part](*playing)
        else:
            train, replay = done = compiled[part](train, replay, episodes, keys, iteration)
        jax.block_until_ready(done)

    episodes = compiled["rollout"](*playing)[0] if "insert" in parts else None
    for part in parts:
        _, _, repetitions, what = arguments[part]
        report(
            f"{what} of {program.config.run.seeds} learners",
            lambda part=part: run_phase(part),
            repetitions,
            options.rows,
            options.in_order,
        )


def parse_config(options: argparse.Namespace) -> Config:
    """Return the requested configuration.

    Raises:
        RequestError: A name is not a field, or a value does not suit it.
    """
    hints, changes = fields.hints(Config), {}
    for name, *words in options.set:
        if name not in hints:
            raise RequestError(f"unknown field {name!r}{nearest(name, hints)}")
        if len(words) != 1 and not fields.unwrap(hints[name])[2]:
            raise RequestError(f"--set {name} takes one value, not {len(words)}")
        changes[name] = fields.read(name, hints[name], words)
    return preset(options.preset, env=options.task, **changes)


def main() -> int:
    """Print the tables; return the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("task", nargs="?", default="VisualFetchReach", help="the environment")
    parser.add_argument("--preset", default="fast", help="of the run")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS), help="what to measure")
    parser.add_argument(
        "--set", nargs="+", action="append", default=[], metavar=("FIELD", "VALUE"), help="a field of the configuration"
    )
    parser.add_argument("--rows", type=int, default=20, help="kernels to list of each part")
    parser.add_argument("--in-order", action="store_true", help="list the kernels of one repetition, too, in their order")
    options = parser.parse_args()
    try:
        check_devices()
        if jax.default_backend() != "gpu":
            raise RequestError("kernels are seen on an NVIDIA GPU only, and JAX computes on something else here")
        config = parse_config(options)
        enable_compilation_cache()
        measure(make_train_step(make_env(config), config), options)
    except RequestError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
