"""Training iterations and evaluations made of one program that plays a few environments: how a CPU runs them.

    keys     which random numbers this iteration's rollout draws
    play     `PART_SIZE` environments, from number ``first`` on     training calls it E / 8 times, an evaluation N / 8 times
    learn    what they have played -> replay, statistics, gradient steps

Most of what takes long to compile is physics and images, and here both purposes share it. And calls that do not wait for each
other keep all cores busy (`jaxrl_vis.run.side_by_side`), which XLA does not: it shares out single operations, and those of a
physics step are too small. On two cores an iteration's 16 environments of VisualFetchReach are played in 0.13 s in place of
0.25, and its evaluation of 256 episodes takes 2.0 s in place of 2.7.

A GPU plays all environments at once: there an iteration is one program, and an evaluation another (`train_step`, `evaluate`).
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from jaxrl_vis.config import Config
from jaxrl_vis.learner.networks import Networks
from jaxrl_vis.learner.rollout import Exploration, play
from jaxrl_vis.types import Episodes, LoopState, Metrics, TrainState
from jaxrl_vis_envs.base import GoalEnv
from jaxrl_vis_envs.compilation import env_jit

PART_SIZE = 8
"""Environments of a part at most: as many float32 numbers as the vector registers of most CPUs hold.

It does not depend on the number of cores, for a part draws its own noise: a run is to be the same on a larger machine.
"""

Played = tuple[Episodes, Metrics]
"""Episodes [S, P, ...], and ``success`` and ``goal_distance`` at their last steps, [S, P] float32."""


@dataclasses.dataclass(frozen=True)
class Parts:
    """The programs of a run in parts; make it with `make_parts`.

    Attributes:
        size: P, environments of a part.
        exploration: The noise of training; an evaluation has none.
        keys: (keys [S], iteration []) -> keys [S] of this iteration's rollout.
        play: (TrainState, keys [S], first [] int32, `Exploration`) -> `Played`. Environment ``first + i`` starts as it does where
            all are played at once; the noise of a part is its own.
        learn: (LoopState, parts) -> (LoopState, metrics of [S] float32), the first donated. The parts are those of all E
            environments, in their order; what they have beyond that is left out.
    """

    size: int
    exploration: Exploration
    keys: Any
    play: Any
    learn: Any


def part_size(num_envs: int) -> int:
    """P: the least that makes as few parts of at most `PART_SIZE` environments as can be."""
    return math.ceil(num_envs / math.ceil(num_envs / PART_SIZE))


def joined(parts: Sequence[jax.Array], count: int) -> jax.Array:
    """Arrays [S, P, ...] of parts as one [S, ``count``, ...]."""
    return jnp.concatenate(parts, axis=1)[:, :count]


def make_parts(
    env: GoalEnv,
    networks: Networks,
    config: Config,
    keys_of: Callable[[jax.Array, jax.Array], jax.Array],
    learn: Callable[[LoopState, Episodes, Metrics, jax.Array], tuple[LoopState, Metrics]],
) -> Parts:
    """Builds the programs of a run on one device. Nothing is compiled yet.

    Args:
        env: The environment.
        networks: What the parameters mean.
        config: The run.
        keys_of: (keys [S], iteration) -> keys [2, S]: of an iteration's rollout, and of what comes after it.
        learn: (LoopState, Episodes, outcome, keys [S]) -> (LoopState, metrics): what comes after a rollout, for all seeds.
    """
    size = part_size(config.num_envs)

    def keys(seed_keys: jax.Array, iteration: jax.Array) -> jax.Array:
        return keys_of(seed_keys, iteration)[0]

    def play_part(train: TrainState, rollout_keys: jax.Array, first: jax.Array, exploration: Exploration) -> Played:
        episodes, outcome, _ = play(env, networks, train, rollout_keys, size, exploration, first=first)
        return episodes, outcome

    def learn_parts(loop: LoopState, parts: Sequence[Played]) -> tuple[LoopState, Metrics]:
        episodes, outcome = jax.tree.map(lambda *leaves: joined(leaves, config.num_envs), *parts)
        return learn(loop, episodes, outcome, keys_of(loop.key, loop.iteration)[1])

    return Parts(
        size=size,
        exploration=Exploration(config.random_action_probability, config.action_noise),
        keys=env_jit(keys),
        play=env_jit(play_part),
        learn=env_jit(learn_parts, donate_argnums=0),
    )


def played_spec(env: GoalEnv, size: int, seeds: int) -> Played:
    """Shapes and types of what `Parts.play` returns, without tracing it."""
    spec = functools.partial(jax.ShapeDtypeStruct, dtype=jnp.float32)
    slots = (seeds, size, env.horizon + 2)
    episodes = Episodes(
        observations=jax.ShapeDtypeStruct((*slots, *env.observation_spec.shape), env.observation_spec.dtype),
        states=spec((*slots, env.goal_state_size)),
        actions=spec((seeds, size, env.horizon, env.action_size)),
    )
    return episodes, {name: spec((seeds, size)) for name in ("success", "goal_distance")}
