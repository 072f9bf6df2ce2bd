"""Startup time of a run: imports, environment, compilation of all programs, and the first iteration.

    python benchmarks/startup_time.py [ENV] [--preset P] [--seeds S] [--json FILE]

Two processes are started one after the other, with a common, initially empty compilation cache:

    cold     as a run starts: `Programs.compile`, then the first iteration
    warm     the same once more, with everything in the cache

Times are wall-clock seconds, with processor seconds (of all threads) beside them, which are more reliable on a busy machine.
Python's compilation of modules to bytecode, which slows down the first start after an installation, is included only if Python
may not cache it (PYTHONDONTWRITEBYTECODE).
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
"""Environment variable with the time at which a process was launched, seconds since the epoch."""


class Clock:
    """Laps of wall-clock and processor seconds.

    Attributes:
        laps: Pairs of (wall-clock seconds, processor seconds) by name.
    """

    def __init__(self) -> None:
        self.laps: dict[str, tuple[float, float]] = {}
        self._wall, self._processor = float(os.environ.get(STARTED, time.time())), 0.0

    def lap(self, name: str) -> None:
        """End a lap, store its wall-clock and processor time (s) under ``name``, and start the next."""
        wall, processor = time.time(), time.process_time()
        self.laps[name] = round(wall - self._wall, 3), round(processor - self._processor, 3)
        self._wall, self._processor = time.time(), time.process_time()


def import_programs(clock: Clock, options: argparse.Namespace) -> Any:
    """Import everything and return the programs of a run, untraced."""
    import jax

    clock.lap("import jax")
    import jaxrl_vis.run.trainer  # noqa: F401

    clock.lap("import jaxrl_vis")
    from jaxrl_vis import preset
    from jaxrl_vis.host.devices import check_devices, enable_compilation_cache, start_devices
    from jaxrl_vis.learner.environment import locate_env, make_env
    from jaxrl_vis.learner.train_step import make_train_step
    from jaxrl_vis.run.compiled.programs import Programs

    # As in `make_trainer`: devices are initialised while MuJoCo is imported.
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


def start(clock: Clock, options: argparse.Namespace) -> None:
    """Start like a run: compile, then do the first iteration."""
    import jax

    programs = import_programs(clock, options)
    programs.compile()
    clock.lap("compile")
    loop, metrics = programs.train_iteration(programs.init(programs.run_keys))
    jax.block_until_ready((loop.iteration, metrics))
    clock.lap("first iteration")


MODES = ("cold", "warm")


def time_mode(mode: str, cache: str, options: argparse.Namespace) -> dict[str, tuple[float, float]]:
    """Measure one mode in a new process.

    Args:
        mode: One of the values of ``--mode``.
        cache: Folder of the compilation cache.
        options: Options of the command line: ``env``, ``seeds`` and ``preset``.

    Returns:
        Wall-clock and processor time of each lap, s, by name.

    Raises:
        subprocess.CalledProcessError: The process failed.
    """
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


def print_laps(mode: str, laps: dict[str, tuple[float, float]]) -> None:
    """Print the table of a process."""
    print(f"{mode:32}{'wall-clock s':>14}{'processor s':>14}")
    total = [sum(seconds) for seconds in zip(*laps.values(), strict=True)]
    for name, (wall, processor) in [*laps.items(), ("total", total)]:
        print(f"    {name:28}{wall:14.2f}{processor:14.2f}", flush=True)


def main() -> None:
    """Measure, print, and write a file if requested."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("env", nargs="?", default="VisualFetchReach")
    parser.add_argument("--preset")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--json", type=Path, help="file for the times")
    parser.add_argument("--mode", choices=MODES, help=argparse.SUPPRESS)  # for its child processes
    options = parser.parse_args()
    if options.mode:
        clock = Clock()
        start(clock, options)
        print(json.dumps(clock.laps))
        return
    laps = {}
    with tempfile.TemporaryDirectory() as cache:
        for mode in MODES:
            laps[mode] = time_mode(mode, cache, options)
            print_laps(mode, laps[mode])
    if options.json:
        options.json.write_text(json.dumps(laps, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
