"""Whole training iterations, as `jaxrl-vis train` runs them: rollout, insert, gradient steps."""

import time
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

from jaxrl_vis.bench.record import Measurement
from jaxrl_vis.bench.settings import Settings
from jaxrl_vis.bench.timing import compile_timed
from jaxrl_vis.bench.timing import measure as measure_time
from jaxrl_vis.bench.update import training_config
from jaxrl_vis.learner.train_step import make_train_step


def measure(settings: Settings) -> Iterator[Measurement]:
    """Yields environment steps and gradient steps per second of the device's preset, one seed."""
    env = settings.make_env()
    for count in settings.counts((0,), (0,)):  # 0: the preset's own number of environments
        config = training_config(settings, **({"num_envs": count} if count else {}))
        program = make_train_step(env, config)
        loop = program.init(jax.random.split(jax.random.key(0), 1))
        compiled, compile_s = compile_timed(program.train_iteration, loop)

        def call() -> Any:
            nonlocal loop
            loop, metrics = compiled(loop)  # noqa: B023 - called at once
            return loop.iteration, metrics

        started = time.perf_counter()
        timing = measure_time(call, settings.repeats, budget_s=40.0)
        metrics = {name: np.asarray(values) for name, values in call()[1].items()}
        if any(not np.isfinite(values).all() for values in metrics.values()):
            raise FloatingPointError("training gave numbers that are not finite")
        sizes = {"num_envs": config.num_envs, "batch_size": config.batch_size, "updates": program.updates_per_iteration}
        shared = {
            "config": {**settings.image_config(), "preset": config.preset, "method": config.method, **sizes},
            "details": timing.details(compile_s, measured_s=round(time.perf_counter() - started, 1)),
        }
        yield Measurement("train/env_steps", program.steps_per_iteration / timing.median_s, "env-steps/s", **shared)
        yield Measurement("train/updates", program.updates_per_iteration / timing.median_s, "updates/s", **shared)
