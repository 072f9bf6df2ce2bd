"""Benchmark of rendering alone, without physics: the observations of an environment, or the scenes of `scenes`.

All poses of a batch differ, and calls alternate between two batches, so that no renderer can reuse an image; the benchmark
asserts that images differ.
"""

from collections.abc import Iterator
from typing import Any

import jax

import jaxrl_vis_envs
from jaxrl_vis.bench.physics import start_states
from jaxrl_vis.bench.record import Measurement
from jaxrl_vis.bench.scenes import images as scene_images
from jaxrl_vis.bench.settings import Settings
from jaxrl_vis.bench.timing import compile_timed
from jaxrl_vis.bench.timing import measure as measure_time
from jaxrl_vis.bench.variation import assert_new_images, cycle_batches
from jaxrl_vis.errors import RequestError
from jaxrl_vis_envs import registry

CPU_COUNTS = (64,)
ACCELERATOR_COUNTS = (256, 1024, 4096)
CPU_SIZES = (32, 64)
ACCELERATOR_SIZES = (64, 100)
_STEPS = 5  # random control steps from the common start, after which no two robots have the same pose


def measure(settings: Settings) -> Iterator[Measurement]:
    """Yield images per second for each size, output and batch: of the scene if one is set, else of the environment.

    Raises:
        RequestError: The environment does not observe images; for a scene, see `scenes.models.load`.
    """
    if settings.scene is not None:
        yield from scene_images.measure(settings, image_sizes(settings))
        return
    if not settings.has_images:
        visual = registry.visual_variant(settings.env)
        hint = f": try --env {visual}" if visual else ""
        raise RequestError(f"bench render needs an environment with images, and {settings.env} has none{hint}")
    counts = settings.batch_sizes(CPU_COUNTS, ACCELERATOR_COUNTS)
    batches = [random_states(settings, max(counts), seed) for seed in (4, 5)]
    for size in image_sizes(settings):
        for output in ("depth", "rgb", "rgbd") if settings.on_accelerator else ("depth", "rgbd"):
            env = settings.make_env(image_size=size, pixels=output)
            for count in counts:
                drawn = [jax.tree.map(lambda leaf, count=count: leaf[:count], states) for states in batches]
                compiled, compile_s = compile_timed(jaxrl_vis_envs.jit(jax.vmap(env.observe)), drawn[0])
                assert_new_images(compiled, drawn)
                timing = measure_time(cycle_batches(compiled, drawn), settings.repeats)
                yield Measurement(
                    name="render/images",
                    value=count / timing.median_s,
                    unit="images/s",
                    config=dict(env=settings.env, image_size=size, pixels=output, envs=count),
                    details=timing.details(compile_s),
                )


def image_sizes(settings: Settings) -> tuple[int, ...]:
    """Return the image sizes to measure: the requested one, or the defaults for this kind of device."""
    if settings.image_size is not None:
        return (settings.image_size,)
    return ACCELERATOR_SIZES if settings.on_accelerator else CPU_SIZES


def random_states(settings: Settings, count: int, seed: int = 4) -> Any:
    """Create states of ``count`` environments after five random control steps, without images; ``seed`` selects the actions."""
    env = settings.make_env()

    def scatter(state: Any, key: jax.Array) -> Any:
        def step(state, step_key):
            action = jax.random.uniform(step_key, (env.action_size,), minval=-1.0, maxval=1.0)
            return env.advance(state, action), None

        return jax.lax.scan(step, state, jax.random.split(key, _STEPS))[0]

    return jaxrl_vis_envs.jit(jax.vmap(scatter))(start_states(env, count), jax.random.split(jax.random.key(seed), count))
