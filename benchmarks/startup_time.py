"""Startup time of a run: imports, environment, then tracing, lowering and compiling of every program.

    python benchmarks/startup_time.py [ENV] [--preset P] [--seeds S] [--json FILE]

Three processes are started, one after the other, with a compilation cache of their own:

    parts    every program traced, lowered and compiled by itself, with nothing beside it; an iteration's parts, too
    cold     as a run starts: `Programs.compile`, then the first iteration
    warm     the same once more, with everything in the cache

Seconds are wall-clock; processor seconds (of all threads) stand beside them, because they say more on a machine that does other
things as well. What a first start after an installation takes longer, Python's compilation of its modules, is included where
Python may not keep it (PYTHONDONTWRITEBYTECODE).
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

STARTED = "JAXRL_VIS_START_TIME"
"""Environment variable of the moment at which a process was asked for, seconds since the epoch."""


class Clock:
    """Laps of wall-clock and processor seconds.

    Attributes:
        laps: Name -> (wall-clock seconds, processor seconds).
    """

    def __init__(self) -> None:
        self.laps: dict[str, tuple[float, float]] = {}
        self._wall, self._processor = float(os.environ.get(STARTED, time.time())), 0.0

    def lap(self, name: str) -> None:
        """End a lap and start the next."""
        wall, processor = time.time(), time.process_time()
        self.laps[name] = round(wall - self._wall, 3), round(processor - self._processor, 3)
        self._wall, self._processor = time.time(), time.process_time()


def imported(clock: Clock, options: argparse.Namespace) -> Any:
    """The programs of a run, nothing of them traced yet."""
    import jax

    clock.lap("import jax")
    import jaxrl_vis.run.trainer  # noqa: F401

    clock.lap("import jaxrl_vis")
    from jaxrl_vis import preset
    from jaxrl_vis.host.devices import check_devices, enable_compilation_cache, start_devices
    from jaxrl_vis.learner.environment import locate_env, make_env
    from jaxrl_vis.learner.train_step import make_train_step
    from jaxrl_vis.run.compiled.programs import Programs

    # As `make_trainer` does it: devices start while MuJoCo is imported.
    start_devices()
    locate_env(preset("fast", env=options.env))
    clock.lap("import the environment")
    check_devices()
    clock.lap("device")
    name = options.preset or ("cpu" if jax.default_backend() == "cpu" else "fast")
    config = preset(name, env=options.env, seeds=options.seeds)
    env = make_env(config)
    clock.lap("environment")
    enable_compilation_cache()
    return Programs(config, make_train_step(env, config), keep=True)


def parts(clock: Clock, options: argparse.Namespace) -> None:
    """Every program by itself."""
    from jaxrl_vis.learner.acting.rollout_parts import played_spec

    programs = imported(clock, options)
    program, shapes, keys = programs.program, programs.shapes, programs.run_keys
    clock.lap("shapes")
    for name in programs.names:
        lowered = programs.lower(name)
        clock.lap(f"{name}: trace and lower")
        lowered.compile()
        clock.lap(f"{name}: compile")
    episodes, _ = played_spec(program.env, programs.config.run.num_envs, len(programs.seeds))
    arguments = {  # JAX keeps what it traced, so what is part of something above takes less than it would alone
        "insert": (shapes.train, shapes.replay, episodes, keys, shapes.iteration),
        "update_many": (shapes.train, shapes.replay, keys, shapes.iteration),
    }
    for name, inputs in arguments.items():
        traced = getattr(program, name).trace(*inputs)
        clock.lap(f"{name}: trace")
        lowered = traced.lower()
        clock.lap(f"{name}: lower")
        lowered.compile()
        clock.lap(f"{name}: compile")


def start(clock: Clock, options: argparse.Namespace) -> None:
    """Start as a run does."""
    import jax

    programs = imported(clock, options)
    programs.compile()
    clock.lap("compile")
    loop, metrics = programs.train_iteration(programs.init(programs.run_keys))
    jax.block_until_ready((loop.iteration, metrics))
    clock.lap("first iteration")


MODES = {"parts": parts, "cold": start, "warm": start}


def measured(mode: str, cache: str, options: argparse.Namespace) -> dict[str, tuple[float, float]]:
    """The laps of a process of its own."""
    command = [sys.executable, __file__, options.env, "--seeds", str(options.seeds), "--mode", mode]
    command += ["--preset", options.preset] if options.preset else []
    variables = {
        **os.environ,
        "JAX_COMPILATION_CACHE_DIR": cache,
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.3",
        STARTED: str(time.time()),
    }
    output = subprocess.run(command, env=variables, check=True, stdout=subprocess.PIPE, text=True).stdout
    return {name: tuple(seconds) for name, seconds in json.loads(output.splitlines()[-1]).items()}


def show(mode: str, laps: dict[str, tuple[float, float]]) -> None:
    """Print a table."""
    print(f"{mode:32}{'wall-clock s':>14}{'processor s':>14}")
    total = [sum(seconds) for seconds in zip(*laps.values(), strict=True)]
    for name, (wall, processor) in [*laps.items(), ("total", total)]:
        print(f"    {name:28}{wall:14.2f}{processor:14.2f}", flush=True)


def main() -> None:
    """Measure, print, and write a file if asked to."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("env", nargs="?", default="VisualFetchReach")
    parser.add_argument("--preset")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--json", type=Path, help="write the figures here")
    parser.add_argument("--mode", choices=MODES, help=argparse.SUPPRESS)  # of the processes that it starts
    options = parser.parse_args()
    if options.mode:
        clock = Clock()
        MODES[options.mode](clock, options)
        print(json.dumps(clock.laps))
        return
    laps = {}
    with tempfile.TemporaryDirectory() as own, tempfile.TemporaryDirectory() as shared:
        for mode in MODES:
            laps[mode] = measured(mode, own if mode == "parts" else shared, options)
            show(mode, laps[mode])
    if options.json:
        options.json.write_text(json.dumps(laps, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
