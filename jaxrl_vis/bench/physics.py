"""Physics alone: `advance` under random actions, no images; MuJoCo Playground's FingerTurn beside ours on request."""

from collections.abc import Iterator

import jax
import jax.numpy as jnp

from jaxrl_vis.bench import playground
from jaxrl_vis.bench.record import Measurement
from jaxrl_vis.bench.settings import Settings
from jaxrl_vis.bench.timing import compile_timed
from jaxrl_vis.bench.timing import measure as measure_time
from jaxrl_vis.bench.variation import assert_varied
from jaxrl_vis.errors import RequestError
from jaxrl_vis_envs.base import GoalEnv, State
from jaxrl_vis_envs.compilation import env_jit

CPU_COUNTS = (16, 256)
ACCELERATOR_COUNTS = (256, 1024, 4096, 8192)


def start_states(env: GoalEnv, count: int) -> State:
    """``count`` different starts, without images."""
    keys = jax.random.split(jax.random.key(1), count)
    return env_jit(jax.vmap(lambda key: env.reset(key).replace(obs=None)))(keys)


def measure(settings: Settings) -> Iterator[Measurement]:
    """Environment steps per second."""
    if settings.peer is not None:
        if settings.env != "FingerTurn":
            raise RequestError("bench physics --peer playground needs --env FingerTurn")
        playground.load()  # first: it is the part that may be missing
    env = settings.make_env()
    steps = env.horizon if settings.on_accelerator else 10
    counts = settings.counts(CPU_COUNTS, ACCELERATOR_COUNTS)
    # One program starts them all; smaller measurements take the first ones.
    states = start_states(env, max(counts))

    def advance(states: State, key: jax.Array) -> State:
        def step(states: State, step_key: jax.Array) -> tuple[State, None]:
            actions = jax.random.uniform(step_key, (*states.reward.shape, env.action_size), minval=-1.0, maxval=1.0)
            return jax.vmap(env.advance)(states, actions), None

        return jax.lax.scan(step, states, jax.random.split(key, steps))[0]

    for count in counts:
        arguments = jax.tree.map(lambda leaf, count=count: leaf[:count], states), jax.random.key(2)
        compiled, compile_s = compile_timed(env_jit(advance), *arguments)
        final = compiled(*arguments)
        assert_varied(final.achieved_state, "end states")
        if not bool(jnp.isfinite(final.achieved_state).all()):
            raise FloatingPointError("physics gave numbers that are not finite")
        timing = measure_time(lambda: compiled(*arguments).achieved_state, settings.repeats)  # noqa: B023 - called at once
        rate = count * steps / timing.median_s
        yield Measurement(
            name="physics/steps",
            value=rate,
            unit="env-steps/s",
            config={"env": settings.env, "envs": count, "steps": steps},
            details=timing.details(compile_s),
        )
        if settings.peer is not None:
            yield from playground.measure(settings, count, steps, env.control_period, rate)
