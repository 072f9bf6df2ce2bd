"""Second half of a training iteration, after the rollout, for one learner: pure functions, not yet compiled.

    insert      write one contiguous slice of the replay; update the observation statistics
    update      scan over U: sample, relabel, reward, gradient step, target networks
    learn       both, and metrics: fixed-shape means

Random keys are derived from ``fold_in(key of the seed, iteration)``.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxrl_vis.config import Config
from jaxrl_vis.learner.acting.rollout_parts import PartResult, join_parts
from jaxrl_vis.learner.algorithm import Algorithm, Batches
from jaxrl_vis.learner.auxtasks.auxiliary import Auxiliary
from jaxrl_vis.learner.memory.sampling import Sampler
from jaxrl_vis.learner.networks import normalizer
from jaxrl_vis.learner.parallel.sharding import Layout
from jaxrl_vis.types import Episodes, LoopState, Metrics, ReplayState, TrainState

Insert = Callable[[TrainState, ReplayState, Episodes, jax.Array, jax.Array], tuple[TrainState, ReplayState]]
"""(TrainState, ReplayState, Episodes, key [], iteration []) -> updated TrainState and ReplayState."""

Update = Callable[[TrainState, ReplayState, jax.Array, jax.Array], tuple[TrainState, Metrics]]
"""(TrainState, ReplayState, key [], iteration []) -> TrainState after all gradient steps, and means of their metrics."""

# Folded into an iteration's key for sampling statistics. Large, because small numbers give the keys of `jax.random.split`.
_STATISTICS = 0x73656E
# Folded into an iteration's key for the algorithm's sampling.
_UPDATES = 0x757064


class Learned(NamedTuple):
    """Result of an iteration, for one learner or, after `jax.vmap`, for S learners.

    Attributes:
        loop: State at the start of the next iteration.
        metrics: [] or [S] float32 by name.
    """

    loop: LoopState
    metrics: Metrics


def split_key(key: jax.Array, iteration: jax.Array) -> jax.Array:
    """Derive a learner's two keys [2] for an iteration: one for its rollout, one for the rest."""
    return jax.random.split(jax.random.fold_in(key, iteration))


def choose_batches(config: Config, sampler: Sampler, replay: ReplayState, key: jax.Array, iteration: jax.Array) -> Batches:
    """Choose the batches of all gradient steps at once: within the loop, sampling would run a dozen tiny kernels per step.

    Args:
        config: Configuration with the number of gradient steps.
        sampler: Sampler of the replay.
        replay: Replay of one learner, or one shard of it.
        key: [] typed key, split into one per gradient step.
        iteration: [] int32, iterations completed.
    """
    keys = jax.random.split(key, config.run.updates_per_iteration)
    choices = jax.vmap(lambda update_key: sampler.choose(replay, update_key, iteration))(keys)
    return Batches(choices, lambda choice: sampler.batch(replay, choice))


def _update_statistics(train: TrainState, episodes: Episodes, key: jax.Array, config: Config, sampler: Sampler) -> TrainState:
    """Return the learner with normalisers updated from a rollout, or from as many transitions sampled from it.

    The option ``normalizer_source`` selects one of these. Goals update their own normaliser if there is one, else the common
    one.
    """
    if config.study.normalizer_source == "rollouts":
        observations, goals = episodes.observations, episodes.observations[:, -1:]
        if train.goal_normalizer is not None:
            observations = observations[:, :-1]
        axes = (0, 1)
    else:  # as in the authors' release: as many relabelled transitions as the rollout has
        count = config.run.num_envs * sampler.replay.horizon
        latest = sampler.replay._replace(num_rollouts=1, mean_age=None)
        sampler = dataclasses.replace(sampler, config=config.replace(batch_size=count), replay=latest)
        rollout = latest.of_rollout(episodes)
        batch = sampler.batch(rollout, sampler.choose(rollout, key, jnp.zeros((), jnp.int32)))
        observations, goals = batch.observation_t, batch.goal
        if train.goal_normalizer is None:
            observations = jnp.concatenate([observations, goals])
        axes = (0,)
    train = train.replace(normalizer=normalizer.update(train.normalizer, observations, axes, sampler.shards))
    if train.state_normalizer is not None:
        assert episodes.full_states is not None
        states = jnp.concatenate([episodes.full_states, episodes.states[:, :-1]], axis=-1)
        train = train.replace(state_normalizer=normalizer.update(train.state_normalizer, states, shards=sampler.shards))
    if train.goal_normalizer is None:
        return train
    return train.replace(goal_normalizer=normalizer.update(train.goal_normalizer, goals, axes, sampler.shards))


def make_insert(config: Config, sampler: Sampler, auxiliary: Auxiliary) -> Insert:
    """Build the function that adds a rollout to the replay and to the observation statistics."""

    def insert(
        train: TrainState, replay_state: ReplayState, episodes: Episodes, key: jax.Array, iteration: jax.Array
    ) -> tuple[TrainState, ReplayState]:
        episodes = auxiliary.with_stored(episodes)
        replay_state = sampler.replay.insert(replay_state, episodes, iteration)
        return _update_statistics(train, episodes, jax.random.fold_in(key, _STATISTICS), config, sampler), replay_state

    return insert


def make_update(config: Config, sampler: Sampler, algorithm: Algorithm) -> Update:
    """Build the function that takes the gradient steps of an iteration alone, for timing."""

    def update(train: TrainState, replay: ReplayState, key: jax.Array, iteration: jax.Array) -> tuple[TrainState, Metrics]:
        batches = choose_batches(config, sampler, replay, key, iteration)
        agent, metrics = algorithm.update(train.agent, train.statistics, batches, jax.random.fold_in(key, _UPDATES))
        return train.replace(agent=agent), metrics

    return update


def make_learn(
    config: Config, insert: Insert, algorithm: Algorithm, sampler: Sampler, layout: Layout
) -> Callable[[LoopState, Sequence[PartResult]], Learned]:
    """Build the second half of an iteration.

    Returns:
        (LoopState, parts of the rollout in order) -> `Learned`, for one learner or one shard of it, whose replay has the given
        ``layout``. Surplus environments of the last part are dropped.
    """
    shards, num_envs = sampler.shards, sampler.replay.num_envs

    def learn(loop: LoopState, parts: Sequence[PartResult]) -> Learned:
        episodes, outcome = jax.tree.map(lambda *leaves: join_parts(leaves, num_envs), *parts)
        key = split_key(loop.key, loop.iteration)[1]
        train, replay_state = insert(loop.train, layout.unfold_replay(loop.replay), episodes, key, loop.iteration)
        batches = choose_batches(config, sampler, replay_state, key, loop.iteration)
        agent, metrics = algorithm.update(train.agent, train.statistics, batches, jax.random.fold_in(key, _UPDATES))
        train = train.replace(agent=agent)
        means = {f"train/{name}": jnp.mean(values) for name, values in outcome.items()}
        means |= algorithm.diagnose(train.agent, train.statistics, episodes.observations[:, -1])
        metrics |= shards.mean(means)
        metrics["guard/nonfinite"] = shards.total(
            _count_nonfinite((metrics, episodes.states, episodes.full_states, episodes.actions))
        )
        replay_state = layout.fold_replay(replay_state, num_envs)
        return Learned(LoopState(train=train, replay=replay_state, key=loop.key, iteration=loop.iteration + 1), metrics)

    return learn


def _count_nonfinite(tree: Any) -> jax.Array:
    floats = [leaf for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    return sum((jnp.sum(~jnp.isfinite(leaf)) for leaf in floats), jnp.zeros((), jnp.int32)).astype(jnp.float32)
