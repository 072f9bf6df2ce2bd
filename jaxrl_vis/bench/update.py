"""Benchmark of gradient steps alone, including sampling from the replay and relabelling."""

import math
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp

from jaxrl_vis.bench import roofline
from jaxrl_vis.bench.record import Measurement
from jaxrl_vis.bench.settings import Settings
from jaxrl_vis.bench.timing import Timing, compile_timed
from jaxrl_vis.bench.timing import measure as measure_time
from jaxrl_vis.bench.variation import assert_varied
from jaxrl_vis.config import Config, changes, preset
from jaxrl_vis.learner.train_step import TrainStep, make_train_step
from jaxrl_vis.types import LoopState, ReplayState


def training_config(settings: Settings, **overrides: Any) -> Config:
    """Return the requested preset, or this device's, with the environment, images and sizes of the benchmark."""
    if settings.has_images:
        overrides |= changes(image_size=settings.size, pixels=settings.pixels)
    if settings.batch_size is not None:
        overrides["batch_size"] = settings.batch_size
    overrides |= changes(devices=settings.devices, data_devices=settings.data_devices, seeds=settings.seeds)
    overrides |= changes(weighting=settings.weighting, aux_tasks=settings.aux_tasks)
    own = "fast" if settings.on_accelerator else "cpu"
    return preset(settings.preset or own, env=settings.env, **overrides)


def fill_replay(replay: ReplayState, key: jax.Array) -> ReplayState:
    """Fill a replay with noise: no two frames are equal, and every part of the replay is read.

    Episodes are filled one at a time: random bits for a whole replay of images would need several times the memory.
    """

    def noise(leaf: jax.Array, leaf_key: jax.Array) -> jax.Array:
        def episode(_: None, episode_key: jax.Array) -> tuple[None, jax.Array]:
            if jnp.issubdtype(leaf.dtype, jnp.unsignedinteger):
                return None, jax.random.bits(episode_key, leaf.shape[1:], leaf.dtype)
            return None, jax.random.uniform(episode_key, leaf.shape[1:], leaf.dtype, -1.0, 1.0)

        return jax.lax.scan(episode, None, jax.random.split(leaf_key, leaf.shape[0]))[1]

    leaves, structure = jax.tree.flatten(replay.episodes)
    filled = [noise(leaf, leaf_key) for leaf, leaf_key in zip(leaves, jax.random.split(key, len(leaves)), strict=True)]
    episodes = jax.tree.unflatten(structure, filled)
    return replay.replace(episodes=episodes, size=jnp.full_like(replay.size, leaves[0].shape[0]))


def seed_keys(program: TrainStep, seed: int) -> jax.Array:
    """Create typed keys [S], one per learner, on its devices."""
    keys = jax.random.split(jax.random.key(seed), program.config.run.seeds)
    return program.layout.put(keys, program.layout.by_seed)


def init_with_full_replay(program: TrainStep) -> LoopState:
    """Initialise learners with full replays."""
    loop = program.init(seed_keys(program, 0))
    fill = jax.jit(jax.vmap(fill_replay), donate_argnums=0)
    return loop.replace(replay=fill(loop.replay, seed_keys(program, 1)))


def time_updates(program: TrainStep, loop: LoopState, repeats: int) -> tuple[Timing, float]:
    """Time one call of ``update_many``, which donates ``loop.train``; return the timing and the seconds of compilation.

    Args:
        program: Programs of the run.
        loop: State with a full replay.
        repeats: Maximum number of timed calls, see `timing.measure`.

    Raises:
        AssertionError: The parameters of the actor did not change.
    """
    keys = seed_keys(program, 2)
    compiled, compile_s = compile_timed(program.update_many, loop.train, loop.replay, keys, loop.iteration)
    train = loop.train
    before = jax.device_get(train.agent.actor)

    def call() -> Any:
        nonlocal train
        train, metrics = compiled(train, loop.replay, keys, loop.iteration)
        return train, metrics

    timing = measure_time(call, repeats)
    after = jax.device_get(train.agent.actor)
    if all((old == new).all() for old, new in zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True)):
        raise AssertionError("the parameters did not move: no gradient step was taken")
    return timing, compile_s


def measure(settings: Settings) -> Iterator[Measurement]:
    """Yield the total gradient steps per second of all seeds, with their distance from the roofline."""
    config = training_config(settings, updates_per_iteration=updates_per_call(settings))
    yield measure_program(make_train_step(settings.make_env(), config), settings)


def updates_per_call(settings: Settings) -> int:
    """Return the number of gradient steps in one timed call."""
    return 200 if settings.on_accelerator else 20


def measure_program(program: TrainStep, settings: Settings) -> Measurement:
    """Measure the total gradient steps per second of all seeds, and their distance from the roofline.

    Args:
        program: Learner, one call of which takes ``updates_per_iteration`` gradient steps.
        settings: Settings of the record, and the maximum number of timed repeats.
    """
    config = program.config
    loop = init_with_full_replay(program)
    assert_varied(loop.replay.episodes.observations[:1, :64, :1][0, :, 0], "observations of the replay")
    timing, compile_s = time_updates(program, loop, settings.repeats)
    del loop
    seconds = timing.median_s / (program.updates_per_iteration * config.run.seeds)
    dtype = str(program.networks.dtype)
    return Measurement(
        name="update/gradient_steps",
        value=1.0 / seconds,
        unit="updates/s",
        config=dict(
            **settings.image_config(),
            **settings.preset_config(),
            method=config.reward.method,
            batch_size=config.run.batch_size,
            dtype=dtype,
            **settings.seeds_config(),
            **settings.auxiliary_config(),
        ),
        details=timing.details(compile_s, replay_mb=round(program.replay_bytes / 1e6, 1), **_costs(program, seconds)),
    )


def _costs(program: TrainStep, seconds: float) -> dict[str, Any]:
    """Return the cost of a gradient step of ``seconds``, by the lower bound (``roofline``) and the compiler (``compiler``)."""
    config = program.config
    # Minimum number of gradient steps of one learner, compiled for their cost alone: the count covers one loop iteration.
    steps = math.lcm(config.ddpg.actor_interval, program.auxiliary.weighting.interval)
    single = make_train_step(program.env, config.replace(updates_per_iteration=steps, seeds=1))
    shapes = jax.eval_shape(single.init, seed_keys(single, 0))
    arguments = shapes.train, shapes.replay, seed_keys(single, 2), shapes.iteration
    counted = roofline.compiler_cost(single.update_many.lower(*arguments).compile(), config.ddpg.actor_interval)
    params = jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), (shapes.train.agent.actor, shapes.train.agent.critic)
    )
    dtype, device = str(program.networks.dtype), jax.devices()[0].device_kind
    costs = {}
    if not config.auxiliary.aux_tasks:
        bound = roofline.minimum_cost(program.networks, params, config.run.batch_size)
        costs["roofline"] = roofline.describe(bound, seconds, dtype, device)
    if counted is not None:
        costs["compiler"] = roofline.describe(counted, seconds, dtype, device)
    return costs
