"""Environment steps per second of a task on the default device, with and without images, under random actions."""

from collections.abc import Iterator
from typing import Any

import jax

import jaxrl_vis_envs
from benchmarks.pixels import playground
from jaxrl_vis.bench.record import Measurement
from jaxrl_vis.bench.timing import compile_timed
from jaxrl_vis.bench.timing import measure as measure_time
from jaxrl_vis.bench.variation import assert_varied
from jaxrl_vis_envs import pixels


def measure(task: str, count: int, steps: int, size: int, repeats: int) -> Iterator[Measurement]:
    """Yield environment steps per second without images, then with them.

    Args:
        task: Name of the task.
        count: Number of environments.
        steps: Steps in one call.
        size: Height and width of the RGB images.
        repeats: Maximum number of timed repeats.
    """
    env = playground.load(task)
    config = {"task": task, "envs": count, "steps": steps}
    plain_s, plain = _time(env, config, "pixels/steps", repeats)
    yield plain
    camera = playground.camera(env)
    wrapped = pixels.wrap(env, camera, size, layout="images", dtype="uint8", site_groups=playground.SITE_GROUPS)
    seconds, seen = _time(wrapped, {**config, "camera": camera, "image_size": size}, "pixels/steps_with_images", repeats)
    seen.details["share_of_images"] = round(1.0 - plain_s / seconds, 3)
    yield seen


def _time(env: Any, config: dict[str, Any], name: str, repeats: int) -> tuple[float, Measurement]:
    """Return the time of one call (s), and the measurement."""
    count, steps = config["envs"], config["steps"]
    states = jaxrl_vis_envs.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(1), count))

    def advance(states: Any, key: jax.Array) -> tuple[Any, Any]:
        def step(states: Any, step_key: jax.Array) -> tuple[Any, Any]:
            actions = jax.random.uniform(step_key, (count, env.action_size), minval=-1.0, maxval=1.0)
            states = jax.vmap(env.step)(states, actions)
            # Every observation is returned, so that the compiler cannot drop any.
            return states, states.obs

        states, observations = jax.lax.scan(step, states, jax.random.split(key, steps))
        return states.data.qpos, observations

    arguments = states, jax.random.key(2)
    compiled, compile_s = compile_timed(jaxrl_vis_envs.jit(advance), *arguments)
    assert_varied(compiled(*arguments)[0], f"end states of {config['task']}")
    timing = measure_time(lambda: compiled(*arguments), repeats)
    value = count * steps / timing.median_s
    return timing.median_s, Measurement(name, value, "env-steps/s", config, timing.details(compile_s))
