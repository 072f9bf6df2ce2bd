"""Kernels of a training iteration on a GPU: of a gradient step, a control step and an insertion.

    python -m benchmarks.profiling.kernels [TASK] [--preset P] [--parts update rollout insert] [--set FIELD VALUE ...]
        [--rows 20] [--in-order] [--options xla_gpu_autotune_level=0 ...]

Every part is a separate program with a replay full of noise, as in `jaxrl-vis bench update`. Printed are its time, the time of
its kernels together, which is longer if they overlap, and the kernels that take most of it. ``--hlo FOLDER`` writes the
compiled program, which explains their names. With ``--options``, of which there may be several sets, the same is
measured with these compiler options, too.
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
from jaxrl_vis.bench.update import seed_keys, start
from jaxrl_vis.config import Config, fields
from jaxrl_vis.errors import RequestError, nearest
from jaxrl_vis.host.devices import check_devices, enable_compilation_cache
from jaxrl_vis.learner.environment import make_env
from jaxrl_vis.learner.train_step import TrainStep, make_train_step
from jaxrl_vis.run.compiled.programs import rarely_collecting_garbage

PARTS = ("update", "rollout", "insert")


def traced(call: Callable[[], Any]) -> list[tuple[float, float, str]]:
    """Start and duration in nanoseconds and name of each kernel of a call, which must wait for its results, in order."""
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            call()
        data = jax.profiler.ProfileData.from_file(str(next(Path(folder).rglob("*.xplane.pb"))))
    streams = (line for plane in data.planes if "GPU" in plane.name for line in plane.lines if line.name.startswith("Stream"))
    return sorted((event.start_ns, event.duration_ns, event.name) for line in streams for event in line.events)


def kernels(call: Callable[[], Any]) -> tuple[collections.Counter, collections.Counter]:
    """Nanoseconds and launches of each kernel of a call, by name; `traced`."""
    return counted(traced(call))


def counted(events: list[tuple[float, float, str]]) -> tuple[collections.Counter, collections.Counter]:
    """Nanoseconds and launches of each kernel, by name."""
    spent, launches = collections.Counter(), collections.Counter()
    for _, duration, name in events:
        spent[name] += duration
        launches[name] += 1
    return spent, launches


def report(name: str, call: Callable[[], Any], turns: int, rows: int, in_order: bool) -> None:
    """Print where a call spends its time, per one of its ``turns``, and the kernels of one of them ``in_order``."""
    call()
    seconds = []
    for _ in range(3):
        begun = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - begun)
    events = traced(call)
    spent, launches = counted(events)
    print(
        f"{name}: {1e6 * min(seconds) / turns:.0f} us, of which {sum(spent.values()) / turns / 1e3:.0f} us in "
        f"{sum(launches.values()) / turns:.0f} kernels"
    )
    for kernel, nanoseconds in spent.most_common(rows):
        print(f"  {nanoseconds / turns / 1e3:10.1f} us  {launches[kernel] / turns:7.1f} x  {kernel[:90]}")
    of_turn = len(events) // turns
    of_one = events[turns // 2 * of_turn :][:of_turn]
    for at, duration, kernel in of_one if in_order else ():
        print(f"  at {(at - of_one[0][0]) / 1e3:8.1f} us for {duration / 1e3:7.1f} us  {kernel[:90]}")
    sys.stdout.flush()


def measure(program: TrainStep, asked: argparse.Namespace, options: dict[str, Any]) -> None:
    """Compile the parts with compiler options and report each."""
    parts: list[str] = asked.parts
    hlo: Path | None = asked.hlo
    loop, keys = start(program), seed_keys(program, 2)
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
            compiled[part] = function.lower(*inputs).compile(options)
        if hlo is not None:
            hlo.mkdir(parents=True, exist_ok=True)
            (hlo / f"{part}.txt").write_text(compiled[part].as_text(), encoding="utf-8")

    def call(part: str) -> None:
        # What is donated comes back, so that the next call has it.
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
        _, _, turns, what = arguments[part]
        report(
            f"{what} of {program.config.run.seeds} learners", lambda part=part: call(part), turns, asked.rows, asked.in_order
        )


def parse_compiler_options(words: list[str]) -> dict[str, Any]:
    """Compiler options, NAME=VALUE each.

    Raises:
        RequestError: A word is none.
    """
    pairs = [word.partition("=") for word in words]
    if wrong := [name for name, equals, _ in pairs if not equals]:
        raise RequestError(f"--options takes NAME=VALUE, not {wrong[0]!r}")
    return {name: {"true": True, "false": False}.get(value.lower(), value) for name, _, value in pairs}


def parse_config(options: argparse.Namespace) -> Config:
    """The configuration that the options ask for.

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
    """Read the command line and print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("task", nargs="?", default="VisualFetchReach", help="the environment")
    parser.add_argument("--preset", default="fast", help="of the run")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS), help="what to measure")
    parser.add_argument(
        "--set", nargs="+", action="append", default=[], metavar=("FIELD", "VALUE"), help="a field of the configuration"
    )
    parser.add_argument("--rows", type=int, default=20, help="kernels to list of each part")
    parser.add_argument("--in-order", action="store_true", help="list the kernels of one turn, too, in their order")
    parser.add_argument("--hlo", type=Path, help="a folder for the compiled programs")
    parser.add_argument(
        "--options", nargs="+", action="append", default=[], metavar="NAME=VALUE", help="compiler options to try"
    )
    options = parser.parse_args()
    try:
        check_devices()
        if jax.default_backend() != "gpu":
            raise RequestError("kernels are seen on an NVIDIA GPU only, and JAX computes on something else here")
        config = parse_config(options)
        enable_compilation_cache()
        sets = {" ".join(words) or "as it is": parse_compiler_options(words) for words in ([], *options.options)}
        program = make_train_step(make_env(config), config)
        for name, compiler_options in sets.items():
            print(f"-- {name}")
            measure(program, options, compiler_options)
    except RequestError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
