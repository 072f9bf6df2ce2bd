"""Gradient steps alone, including sampling from the replay and relabelling; on request, PyTorch beside ours."""

import dataclasses
import math
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp

from jaxrl_vis.bench import roofline, torch_peer
from jaxrl_vis.bench.record import Measurement
from jaxrl_vis.bench.settings import Settings
from jaxrl_vis.bench.timing import Timing, compile_timed
from jaxrl_vis.bench.timing import measure as measure_time
from jaxrl_vis.bench.variation import assert_varied
from jaxrl_vis.config import Config, preset
from jaxrl_vis.learner.train_step import TrainStep, make_train_step
from jaxrl_vis.types import LoopState, ReplayState


def training_config(settings: Settings, **overrides: Any) -> Config:
    """The preset that was asked for, or that of this device, with the benchmark's environment, images and sizes."""
    if settings.has_images:
        overrides |= {"image_size": settings.image_size, "pixels": settings.pixels}
    if settings.batch_size is not None:
        overrides["batch_size"] = settings.batch_size
    overrides |= {"devices": settings.devices, "data_devices": settings.data_devices}
    overrides |= {"seeds": settings.seeds, "weighting": settings.weighting, "aux_tasks": settings.aux_tasks}
    if settings.peer == "torch":
        overrides |= {"trivial_goals": 1.0, "random_shift": 0}  # the peer does neither
    own = "fast" if settings.on_accelerator else "cpu"
    return preset(settings.preset or own, env=settings.env, **overrides)


def _left_out(settings: Settings, config: Config) -> dict[str, str]:
    """For a record's configuration: what the preset does, and its gradient steps beside a peer do not."""
    whole = training_config(dataclasses.replace(settings, peer=None))
    names = [name for name in ("random_shift", "trivial_goals") if getattr(config, name) != getattr(whole, name)]
    return {"without": " ".join(names)} if names else {}


def fill_replay(replay: ReplayState, key: jax.Array) -> ReplayState:
    """A replay full of noise: no two frames are equal, and every part of the replay is read.

    Filled one episode at a time: random words for a whole replay of images would take several times as much memory.
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
    """[S] typed keys, one for each learner, where that is."""
    keys = jax.random.split(jax.random.key(seed), program.config.seeds)
    return program.layout.put(keys, program.layout.by_seed)


def start(program: TrainStep) -> LoopState:
    """Fresh learners with full replays."""
    loop = program.init(seed_keys(program, 0))
    fill = jax.jit(jax.vmap(fill_replay), donate_argnums=0)
    return loop.replace(replay=fill(loop.replay, seed_keys(program, 1)))


def time_updates(program: TrainStep, loop: LoopState, repeats: int) -> tuple[Timing, float]:
    """The time of one call of ``update_many``, and the seconds of its compilation; the learners of ``loop`` are donated."""
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
    """Yields gradient steps per second, of all seeds together, and how far they are from the roofline."""
    updates = 200 if settings.on_accelerator else 20
    config = training_config(settings, updates_per_iteration=updates)
    if settings.peer is not None:
        torch_peer.load()  # first, because it may be missing
    env = settings.make_env()
    program = make_train_step(env, config)
    if settings.peer is not None:
        torch_peer.check_config(program)
    loop = start(program)
    assert_varied(loop.replay.episodes.observations[:1, :64, :1][0, :, 0], "observations of the replay")
    timing, compile_s = time_updates(program, loop, settings.repeats)
    del loop
    seconds = timing.median_s / (updates * config.seeds)

    # As few gradient steps of one learner as there can be, compiled for their cost alone: that of a turn of their loop.
    few = math.lcm(config.actor_interval, program.auxiliary.weighting.interval)
    single = make_train_step(env, config.replace(updates_per_iteration=few, seeds=1))
    shapes = jax.eval_shape(single.init, seed_keys(single, 0))
    arguments = shapes.train, shapes.replay, seed_keys(single, 2), shapes.iteration
    counted = roofline.compiler_cost(single.update_many.lower(*arguments).compile(), config.actor_interval)
    params = jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), (shapes.train.agent.actor, shapes.train.agent.critic)
    )
    dtype, device = str(program.networks.dtype), jax.devices()[0].device_kind
    costs = {}
    if not config.aux_tasks:
        least = roofline.least_cost(program.networks, params, config.batch_size)
        costs["roofline"] = roofline.describe(least, seconds, dtype, device)
    if counted is not None:
        costs["compiler"] = roofline.describe(counted, seconds, dtype, device)
    ours = Measurement(
        name="update/gradient_steps",
        value=1.0 / seconds,
        unit="updates/s",
        config={
            **settings.image_config(),
            **settings.preset_config(),
            "method": config.method,
            "batch_size": config.batch_size,
            "dtype": dtype,
            **_left_out(settings, config),
            **settings.seeds_config(),
            **settings.auxiliary_config(),
        },
        details=timing.details(compile_s, replay_mb=round(program.replay_bytes / 1e6, 1), **costs),
    )
    yield ours
    if settings.peer is not None:
        fresh = jax.tree.map(lambda leaf: leaf[0], start(program).replace(iteration=jnp.zeros(1, jnp.int32)))
        yield torch_peer.measure(program, fresh.train, fresh.replay, settings, ours)
