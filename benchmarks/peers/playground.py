"""FingerTurn of MuJoCo Playground compared with ours: states only, random actions, equal simulated time per action.

    python -m benchmarks.peers.playground [--envs 4096]

Playground models dm_control's finger differently (implicit integration, physics steps of 5 ms, two Newton iterations). It is
measured with its own steps and with our 10 ms. Its default engine is MuJoCo Warp; here both run on MJX.
"""

import dataclasses
import sys
from collections.abc import Iterator
from typing import Any

import jax

from benchmarks.peers import command
from jaxrl_vis.bench import physics
from jaxrl_vis.bench.record import Measurement
from jaxrl_vis.bench.settings import Settings
from jaxrl_vis.bench.timing import compile_timed
from jaxrl_vis.bench.timing import measure as measure_time
from jaxrl_vis.bench.variation import assert_varied
from jaxrl_vis.errors import RequestError

_TIMESTEPS = (0.005, 0.01)  # Playground's, and ours, s


def load() -> Any:
    """Import Playground's module of the environment.

    Raises:
        RequestError: Playground is not installed.
    """
    try:
        from mujoco_playground._src.dm_control_suite import finger  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise RequestError(f"the peer playground needs MuJoCo Playground: pip install playground ({error})") from error
    return finger


def measure(settings: Settings) -> Iterator[Measurement]:
    """Yield our environment steps per second, then Playground's, for every number of environments."""
    load()  # first, because it may be missing
    settings = dataclasses.replace(settings, env="FingerTurn")
    control_period = settings.make_env().control_period
    for ours in physics.measure(settings):
        yield ours
        yield from measure_peer(ours, control_period, settings.repeats)


def measure_peer(ours: Measurement, control_period: float, repeats: int) -> Iterator[Measurement]:
    """Yield Playground's actions per second for each physics step.

    Args:
        ours: Our measurement, with the number of environments and the actions per call.
        control_period: Simulated time per action, s.
        repeats: Maximum number of timed repeats.
    """
    finger, count, steps = load(), ours.config["envs"], ours.config["steps"]
    for timestep in _TIMESTEPS:
        config = finger.default_config()
        config.impl, config.sim_dt, config.ctrl_dt = "jax", timestep, control_period
        env = finger.Turn(finger.EASY_TARGET_SIZE, config=config)
        states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(1), count))

        def advance(states: Any, key: jax.Array, env: Any = env) -> Any:
            def step(states: Any, step_key: jax.Array) -> tuple[Any, None]:
                actions = jax.random.uniform(step_key, (count, env.action_size), minval=-1.0, maxval=1.0)
                return jax.vmap(env.step)(states, actions), None

            return jax.lax.scan(step, states, jax.random.split(key, steps))[0]

        arguments = states, jax.random.key(2)
        compiled, compile_s = compile_timed(jax.jit(advance), *arguments)
        assert_varied(compiled(*arguments).data.qpos, "end states of Playground's FingerTurn")
        timing = measure_time(lambda: compiled(*arguments).data.qpos, repeats)  # noqa: B023 - called at once
        rate = count * steps / timing.median_s
        yield Measurement(
            name="physics/peer_playground",
            value=rate,
            unit="env-steps/s",
            config={"env": "FingerTurn", "envs": count, "steps": steps, "timestep": timestep},
            details=timing.details(compile_s, ours_over_peer=round(ours.value / rate, 2), substeps=env.n_substeps),
        )


if __name__ == "__main__":
    sys.exit(command.run("physics", measure, __doc__, ("envs",)))
