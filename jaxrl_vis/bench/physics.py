"""Benchmark of physics alone: batches of environments under random actions, without images."""

from collections.abc import Iterator

import jax
import jax.numpy as jnp

import jaxrl_vis_envs
from jaxrl_vis.bench.record import Measurement
from jaxrl_vis.bench.settings import Settings
from jaxrl_vis.bench.timing import compile_timed
from jaxrl_vis.bench.timing import measure as measure_time
from jaxrl_vis.bench.variation import assert_varied
from jaxrl_vis_envs.base import GoalEnv, State

CPU_COUNTS = (16, 256)
ACCELERATOR_COUNTS = (256, 1024, 4096, 8192)


def start_states(env: GoalEnv, count: int) -> State:
    """Create ``count`` different initial states, without images."""
    keys = jax.random.split(jax.random.key(1), count)
    return jaxrl_vis_envs.jit(jax.vmap(lambda key: env.reset(key).replace(obs=None)))(keys)


def measure(settings: Settings) -> Iterator[Measurement]:
    """Yield environment steps per second for each batch size.

    Raises:
        AssertionError: Environments behave alike.
        FloatingPointError: A final state is not finite.
    """
    env = settings.make_env()
    steps = env.horizon if settings.on_accelerator else 10
    counts = settings.batch_sizes(CPU_COUNTS, ACCELERATOR_COUNTS)
    # One program creates all initial states; smaller batches use the first of them.
    states = start_states(env, max(counts))

    def advance(states: State, key: jax.Array) -> State:
        def step(states: State, step_key: jax.Array) -> tuple[State, None]:
            actions = jax.random.uniform(step_key, (*states.reward.shape, env.action_size), minval=-1.0, maxval=1.0)
            return jax.vmap(env.advance)(states, actions), None

        return jax.lax.scan(step, states, jax.random.split(key, steps))[0]

    for count in counts:
        arguments = jax.tree.map(lambda leaf, count=count: leaf[:count], states), jax.random.key(2)
        compiled, compile_s = compile_timed(jaxrl_vis_envs.jit(advance), *arguments)
        final = compiled(*arguments)
        assert_varied(final.achieved_state, "end states")
        if not bool(jnp.isfinite(final.achieved_state).all()):
            raise FloatingPointError("physics gave numbers that are not finite")
        timing = measure_time(lambda: compiled(*arguments).achieved_state, settings.repeats)  # noqa: B023 - called at once
        yield Measurement(
            name="physics/steps",
            value=count * steps / timing.median_s,
            unit="env-steps/s",
            config={"env": settings.env, "envs": count, "steps": steps},
            details=timing.details(compile_s),
        )
