"""FingerTurn of MuJoCo Playground beside ours: states only, the same simulated time in an action, random actions.

Playground's is another model of dm_control's finger (implicit integration, 5 ms a physics step, two Newton iterations). It is
measured as it comes, and at our 10 ms. Its default engine is MuJoCo Warp; here both run on MJX's.
"""

from collections.abc import Iterator
from typing import Any

import jax

from jaxrl_vis.bench.record import Measurement
from jaxrl_vis.bench.settings import Settings
from jaxrl_vis.bench.timing import compile_timed
from jaxrl_vis.bench.timing import measure as measure_time
from jaxrl_vis.bench.variation import assert_varied
from jaxrl_vis.errors import RequestError

_TIMESTEPS = (0.005, 0.01)  # s; its own, and ours


def load() -> Any:
    """Playground's module of the task.

    Raises:
        RequestError: It is not installed.
    """
    try:
        from mujoco_playground._src.dm_control_suite import finger  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise RequestError(f"--peer playground needs MuJoCo Playground: pip install playground ({error})") from error
    return finger


def measure(settings: Settings, count: int, steps: int, control_period: float, ours: float) -> Iterator[Measurement]:
    """Actions per second.

    Args:
        settings: How often to repeat.
        count: Environments.
        steps: Actions in a call.
        control_period: Simulated time of an action, s.
        ours: Our actions per second.
    """
    finger = load()
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
        timing = measure_time(lambda: compiled(*arguments).data.qpos, settings.repeats)  # noqa: B023 - called at once
        rate = count * steps / timing.median_s
        yield Measurement(
            name="physics/peer_playground",
            value=rate,
            unit="env-steps/s",
            config={"env": "FingerTurn", "envs": count, "steps": steps, "timestep": timestep},
            details=timing.details(compile_s, ours_over_peer=round(ours / rate, 2), substeps=env.n_substeps),
        )
