"""Benchmark of whole training iterations, as `jaxrl-vis train` runs them, with a breakdown of their time.

    iteration    rollout, insert and updates, the host reading the metrics of one iteration during the next
    parts        each of the three alone, and the time of evaluations and of the host per iteration
    predicted    sum of the times of the same environments and gradient steps, measured as in `bench env` and `bench update`

    efficiency   on several devices: time of one device with its part of the seeds, or of the batch and the environments,
                 divided by the time of all devices together

If an iteration takes longer than predicted, time is lost between its parts, in the policy during the rollout, or in the
replay.
"""

import time
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np

from jaxrl_vis.bench.env import time_episodes
from jaxrl_vis.bench.record import Measurement
from jaxrl_vis.bench.settings import Settings
from jaxrl_vis.bench.timing import Timing, compile_timed
from jaxrl_vis.bench.timing import measure as measure_time
from jaxrl_vis.bench.update import seed_keys, time_updates, training_config
from jaxrl_vis.config import Config, data_devices
from jaxrl_vis.learner.acting.rollout_parts import join_parts
from jaxrl_vis.learner.train_step import TrainStep, make_train_step
from jaxrl_vis.run.compiled.programs import Programs
from jaxrl_vis.types import Episodes, LoopState, Metrics
from jaxrl_vis_envs.base import GoalEnv

_BUDGET_S = 40.0


def time_iterations(programs: Programs, repeats: int) -> tuple[LoopState, Timing, dict[str, float]]:
    """Train for some iterations and time them.

    Args:
        programs: Training programs, without a cache: otherwise the time of compilation is meaningless.
        repeats: Maximum number of timed repeats.

    Returns:
        The training state after these iterations; the timing of an iteration whose metrics the host reads during the next one;
        and the seconds of ``compile`` (compilation) and ``host`` (reading metrics).

    Raises:
        FloatingPointError: A metric is not finite.
    """
    loop = programs.program.init(seed_keys(programs.program, 0))
    start = time.perf_counter()
    programs.training_programs()
    compile_s = time.perf_counter() - start
    loop, waiting = programs.train_iteration(loop)
    pending = programs.pending(waiting)

    def dispatch() -> Any:
        nonlocal loop, waiting
        loop, waiting = programs.train_iteration(loop)
        return waiting

    def train() -> Any:
        nonlocal pending
        before = pending
        pending = programs.pending(dispatch())
        if any(not np.isfinite(values).all() for values in before.read().values()):
            raise FloatingPointError("training gave numbers that are not finite")
        return waiting

    alone = measure_time(dispatch, repeats, _BUDGET_S)
    timing = measure_time(train, repeats, _BUDGET_S)
    return loop, timing, {"compile": compile_s, "host": max(0.0, timing.median_s - alone.median_s)}


def _wait_for_result(program: TrainStep, call: Callable[[], Any]) -> Callable[[], Any]:
    """Return ``call``, wrapped to wait for its result if several devices share a CPU's threads: two calls could deadlock."""
    if program.layout.num_devices == 1 or jax.default_backend() != "cpu":
        return call
    return lambda: jax.block_until_ready(call())


def time_parts(programs: Programs, loop: LoopState, repeats: int) -> dict[str, float]:
    """Time the parts of an iteration, each alone and at the sizes of the iteration.

    Args:
        programs: Programs of the parts.
        loop: Training state; its buffers are donated.
        repeats: Maximum number of timed repeats.

    Returns:
        Seconds of ``rollout``, ``insert``, ``updates`` and ``evaluation``, the last per iteration.
    """
    program, iteration = programs.program, loop.iteration
    keys, key = seed_keys(program, 3), jax.random.key(4)
    evaluation = measure_time(_wait_for_result(program, lambda: programs.evaluate(loop.train, key)), repeats)
    num_envs = programs.config.run.num_envs

    def play() -> tuple[Episodes, Metrics]:
        return jax.tree.map(lambda *leaves: join_parts(leaves, num_envs, axis=1), *programs.play(loop.train, keys))

    rollout = measure_time(_wait_for_result(program, play), repeats)
    episodes, _ = play()
    insert, _ = compile_timed(program.insert, loop.train, loop.replay, episodes, keys, iteration)
    train, replay = loop.train, loop.replay

    def put() -> Any:
        nonlocal train, replay
        train, replay = insert(train, replay, episodes, keys, iteration)
        return train

    inserted = measure_time(put, repeats)
    updates, _ = time_updates(program, loop.replace(train=train, replay=replay), repeats)
    return {
        "rollout": rollout.median_s,
        "insert": inserted.median_s,
        "updates": updates.median_s,
        "evaluation": evaluation.median_s / program.config.run.eval_interval,
    }


def describe(iteration: float, part_seconds: dict[str, float], predicted: float) -> str:
    """Format a table of the parts of an iteration: milliseconds, and percent of an iteration.

    Args:
        iteration: Duration of an iteration in seconds.
        part_seconds: Results of `time_parts`, and ``host``.
        predicted: Predicted duration of an iteration in seconds.
    """
    total = part_seconds["rollout"] + part_seconds["insert"] + part_seconds["updates"] + part_seconds["host"]
    rows = {**part_seconds, "sum without evaluation": total, "iteration": iteration, "predicted": predicted}
    lines = [f"    {name:24}{1e3 * seconds:12,.2f} ms {seconds / iteration:8.1%}" for name, seconds in rows.items()]
    return "\n".join(lines)


def single_device_config(config: Config) -> Config:
    """Return the configuration of one device's part of a run, as a run on one device."""
    parts = data_devices(config)
    return config.replace(
        devices=1,
        data_devices=None,
        seeds=config.run.seeds * parts // config.run.devices,
        num_envs=config.run.num_envs // parts,
        batch_size=config.run.batch_size // parts,
        replay_transitions=config.run.replay_transitions // parts,
    )


def _time_single_device(env: GoalEnv, config: Config, settings: Settings) -> float:
    """Time an iteration of `single_device_config`, in seconds."""
    config_of_one = single_device_config(config)
    return time_iterations(Programs(config_of_one, make_train_step(env, config_of_one), cache=False), settings.repeats)[
        1
    ].median_s


def measure(settings: Settings) -> Iterator[Measurement]:
    """Yield the total environment steps and gradient steps per second of all seeds; print the time of each part."""
    env = settings.make_env()
    for count in settings.batch_sizes((0,), (0,)):  # 0: the preset's number of environments
        config = training_config(settings, **({"num_envs": count} if count else {}))
        program, started = make_train_step(env, config), time.perf_counter()
        programs = Programs(config, program, cache=False)
        loop, timing, seconds = time_iterations(programs, settings.repeats)
        parts = {**time_parts(programs, loop, settings.repeats), "host": seconds["host"]}
        del loop
        efficiency = {}
        if config.run.devices > 1:
            efficiency["efficiency"] = round(_time_single_device(env, config, settings) / timing.median_s, 3)
        episodes, _ = time_episodes(env, config.run.num_envs * config.run.seeds // config.run.devices, settings.repeats)
        predicted = episodes.median_s + parts["updates"]
        print(describe(timing.median_s, parts, predicted), flush=True)
        shared = {
            "config": dict(
                **settings.image_config(),
                preset=config.run.preset,
                method=config.reward.method,
                num_envs=config.run.num_envs,
                batch_size=config.run.batch_size,
                updates=program.updates_per_iteration,
                **settings.seeds_config(),
                **settings.devices_config(),
                **settings.auxiliary_config(),
            ),
            "details": timing.details(
                seconds["compile"],
                measured_s=round(time.perf_counter() - started, 1),
                milliseconds={name: round(1e3 * part, 3) for name, part in {**parts, "env": episodes.median_s}.items()},
                share_of_predicted=round(predicted / timing.median_s, 3),
                **efficiency,
            ),
        }
        per_s = config.run.seeds / timing.median_s
        yield Measurement("train/env_steps", program.steps_per_iteration * per_s, "env-steps/s", **shared)
        yield Measurement("train/updates", program.updates_per_iteration * per_s, "updates/s", **shared)
