"""Benchmark of whole episodes: reset with its goal image, then physics and an image at every step, under random actions."""

from collections.abc import Iterator

import jax

import jaxrl_vis_envs
from jaxrl_vis.bench.record import Measurement
from jaxrl_vis.bench.settings import Settings
from jaxrl_vis.bench.timing import Timing, compile_timed
from jaxrl_vis.bench.timing import measure as measure_time
from jaxrl_vis.bench.variation import assert_varied
from jaxrl_vis_envs.base import GoalEnv

CPU_COUNTS = (16, 256)
ACCELERATOR_COUNTS = (256, 1024, 4096, 8192)


def time_episodes(env: GoalEnv, count: int, repeats: int) -> tuple[Timing, float]:
    """Time one episode in each of ``count`` environments; return the timing and the seconds of compilation.

    Args:
        env: Environment, stepped with random actions.
        count: Number of environments.
        repeats: Maximum number of timed episodes, see `timing.measure`.

    Raises:
        AssertionError: The last frames or the goals are mostly copies (`assert_varied`).
    """

    def episode(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        reset_key, action_key = jax.random.split(key)
        state = env.reset(reset_key)
        goal = state.obs["desired_goal"]  # type: ignore[index] - reset fills it in

        def step(state, step_key):
            action = jax.random.uniform(step_key, (env.action_size,), minval=-1.0, maxval=1.0)
            state = env.advance(state, action)
            return state, env.observe(state)

        # Every image is returned, so that the compiler cannot drop any.
        return jax.lax.scan(step, state.replace(obs=None), jax.random.split(action_key, env.horizon))[1], goal

    keys = jax.random.split(jax.random.key(3), count)
    compiled, compile_s = compile_timed(jaxrl_vis_envs.jit(jax.vmap(episode, out_axes=(1, 0))), keys)
    frames, goals = compiled(keys)
    assert_varied(frames[-1], "last frames")
    assert_varied(goals, "goals")
    del frames, goals
    return measure_time(lambda: compiled(keys), repeats), compile_s


def measure(settings: Settings) -> Iterator[Measurement]:
    """Yield environment steps per second; the time of resets and goal images is spread over the horizon."""
    env = settings.make_env()
    for count in settings.batch_sizes(CPU_COUNTS, ACCELERATOR_COUNTS):
        timing, compile_s = time_episodes(env, count, settings.repeats)
        yield Measurement(
            name="env/steps",
            value=count * env.horizon / timing.median_s,
            unit="env-steps/s",
            config={**settings.image_config(), "envs": count},
            details=timing.details(compile_s),
        )
