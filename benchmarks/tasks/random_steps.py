"""A million random steps of every task, none of which may produce a non-finite number.

    python -m benchmarks.tasks.random_steps [TASK ...] [--steps 1000000] [--envs 8192]

Actions are uniform; one in a hundred is far outside [-1, 1], infinite or NaN, which tasks clip. Exits with 1 if a position, a
velocity, an achieved state or a reward is not finite. Meant for a GPU.
"""

import argparse
import sys
import time

import jax
import jax.numpy as jnp

import jaxrl_vis_envs
from jaxrl_vis_envs.names import TASKS

_BAD_FRACTION = 0.01
_BAD = (1e6, -1e6, jnp.inf, -jnp.inf, jnp.nan)


def count_bad_episodes(name: str, steps: int, count: int) -> tuple[int, int]:
    """Roll out whole episodes of parallel environments with random and invalid actions.

    Args:
        name: Name of the task.
        steps: Minimum number of environment steps, over all environments.
        count: Number of parallel environments.

    Returns:
        Number of steps, and number of episodes with a non-finite position, velocity, achieved state or reward.
    """
    env = jaxrl_vis_envs.make(name)

    def episode(key: jax.Array) -> jax.Array:
        reset_key, action_key = jax.random.split(key)

        def step(state, step_key):
            uniform_key, is_bad_key, bad_key = jax.random.split(step_key, 3)
            action = jax.random.uniform(uniform_key, (env.action_size,), minval=-1.0, maxval=1.0)
            is_bad = jax.random.bernoulli(is_bad_key, _BAD_FRACTION, action.shape)
            action = jnp.where(is_bad, jax.random.choice(bad_key, jnp.array(_BAD), action.shape), action)
            state = env.advance(state, action)
            numbers = (state.data.qpos, state.data.qvel, state.achieved_state, state.reward)
            return state, jnp.all(jnp.array([jnp.all(jnp.isfinite(number)) for number in numbers]))

        state = env.reset(reset_key).replace(obs=None)
        return jnp.all(jax.lax.scan(step, state, jax.random.split(action_key, env.horizon))[1])

    play = jaxrl_vis_envs.jit(jax.vmap(episode))
    played, bad = 0, 0
    while played < steps:
        bad += int(jnp.sum(~play(jax.random.split(jax.random.fold_in(jax.random.key(0), played), count))))
        played += count * env.horizon
    return played, bad


def main(arguments: list[str] | None = None) -> int:
    """Print a line for each task; return 1 if any number was not finite, else 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tasks", nargs="*", default=list(TASKS), metavar="TASK")
    parser.add_argument("--steps", type=int, default=1_000_000)
    parser.add_argument("--envs", type=int, default=8192)
    options = parser.parse_args(arguments)
    for name in options.tasks:
        if name not in TASKS:
            parser.error(f"unknown task {name!r}: choose {', '.join(TASKS)}")
    failed = False
    for name in options.tasks:
        start = time.perf_counter()
        played, bad = count_bad_episodes(name, options.steps, options.envs)
        failed |= bad > 0
        print(f"{name:12s} {played:10,d} steps, {bad} episodes not finite, {time.perf_counter() - start:.0f} s", flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
