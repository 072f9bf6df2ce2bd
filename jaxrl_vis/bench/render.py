"""Pictures alone: what the agent sees of a batch of different poses, without physics."""

from collections.abc import Iterator
from typing import Any

import jax

from jaxrl_vis.bench.physics import start_states
from jaxrl_vis.bench.record import Measurement
from jaxrl_vis.bench.settings import Settings
from jaxrl_vis.bench.timing import assert_varied, compile_timed
from jaxrl_vis.bench.timing import measure as measure_time
from jaxrl_vis.config import RequestError
from jaxrl_vis_envs.compilation import world_jit

CPU_COUNTS = (64,)
ACCELERATOR_COUNTS = (256, 1024, 4096)
CPU_SIZES = (32, 64)
ACCELERATOR_SIZES = (64, 100)
PEER_POSES = 64
_STEPS = 5  # random control steps from the common start, after which no two robots stand alike


def poses(settings: Settings, count: int) -> Any:
    """``count`` environments in different poses."""
    env = settings.make_env()

    def scatter(state: Any, key: jax.Array) -> Any:
        def step(state, step_key):
            action = jax.random.uniform(step_key, (env.action_size,), minval=-1.0, maxval=1.0)
            return env.advance(state, action), None

        return jax.lax.scan(step, state, jax.random.split(key, _STEPS))[0]

    return world_jit(jax.vmap(scatter))(start_states(env, count), jax.random.split(jax.random.key(4), count))


def measure(settings: Settings) -> Iterator[Measurement]:
    """Images per second for each picture size, output and batch."""
    if not settings.env.startswith("Visual"):
        raise RequestError(f"bench render needs a task with pictures: --env Visual{settings.env}")
    if settings.peer is not None:  # Checked first: it is the part that may be missing.
        from jaxrl_vis.bench import mujoco_renderer

        mujoco_renderer.check()
    counts = settings.counts(CPU_COUNTS, ACCELERATOR_COUNTS)
    states = poses(settings, max(*counts, PEER_POSES if settings.peer else 1))
    sizes = ACCELERATOR_SIZES if settings.on_accelerator else CPU_SIZES
    if settings.image_size is not None and settings.image_size not in sizes:
        sizes = (settings.image_size,)
    for size in sizes:
        for output in ("depth", "rgb", "rgbd") if settings.on_accelerator else ("depth", "rgbd"):
            env = settings.make_env(image_size=size, pixels=output)
            for count in counts:
                some = jax.tree.map(lambda leaf, count=count: leaf[:count], states)
                compiled, compile_s = compile_timed(world_jit(jax.vmap(env.observe)), some)
                assert_varied(compiled(some), "pictures")
                timing = measure_time(lambda: compiled(some), settings.repeats)  # noqa: B023 - called at once
                yield Measurement(
                    name="render/images",
                    value=count / timing.median_s,
                    unit="images/s",
                    config={"env": settings.env, "image_size": size, "pixels": output, "envs": count},
                    details=timing.details(compile_s),
                )
        if settings.peer is not None:
            yield mujoco_renderer.measure(settings, states, size, PEER_POSES)
