"""A training iteration in two programs, which a run calls one after the other.

    keys     which random numbers this iteration's rollout draws
    play     environments, from number ``first`` on         -> their episodes
    learn    replay, statistics, gradient steps, metrics

They are what `train_step` has in one program. XLA compiles the two side by side, and nothing is lost: what is played lies in
the device's memory in either case, and neither waits for the host.

A GPU plays all environments at once, and so do several devices. One CPU plays `PART_SIZE` at a time, by as many threads as it
has cores (`jaxrl_vis.run.side_by_side`): XLA would share out single operations, and those of a physics step are too small for
that. On two cores 16 environments of VisualFetchReach are played in 0.13 s in place of 0.25. An evaluation of 256 episodes
calls the same program, and takes 2.0 s in place of 2.7; so most of what takes long to compile, physics and images, is compiled
once.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp

import jaxrl_vis_envs
from jaxrl_vis.config import Config
from jaxrl_vis.learner.networks import Networks
from jaxrl_vis.learner.rollout import Exploration, play
from jaxrl_vis.learner.sharding import Layout
from jaxrl_vis.learner.shards import Slice
from jaxrl_vis.types import Episodes, LoopState, Metrics, TrainState
from jaxrl_vis_envs.base import GoalEnv
from jaxrl_vis_envs.compiling.compilation import targets_cpu, tracing_for_default_device

PART_SIZE = 8
"""Environments of a part at most, on a CPU: as many float32 numbers as the vector registers of most of them hold."""

Played = tuple[Episodes, Metrics]
"""Episodes [S, P, ...], and ``success`` and ``goal_distance`` at their last steps, [S, P] float32."""


@dataclasses.dataclass(frozen=True)
class Parts:
    """The programs of a run in parts; make it with `make_parts`.

    Attributes:
        size: P, environments of a part, on all devices together.
        total: E, environments of a rollout of training.
        plays_any: Whether ``play`` can begin with any environment, and so evaluate, too; else it plays all of a rollout.
        exploration: The noise of training; an evaluation has none.
        keys: (keys [S], iteration []) -> keys [S] of this iteration's rollout.
        play: (TrainState, keys [S], first [] int32, `Exploration`) -> `Played`, see `shards.Slice`.
        learn: (LoopState, parts) -> (LoopState, metrics of [S] float32), the first donated. The parts are those of all E
            environments in their order; what they have beyond that is left out.
    """

    size: int
    total: int
    plays_any: bool
    exploration: Exploration
    keys: Any
    play: Any
    learn: Any

    @property
    def count(self) -> int:
        """Parts of a rollout of training."""
        return math.ceil(self.total / self.size)


def part_size(num_envs: int) -> int:
    """P: the least that makes as few parts of at most `PART_SIZE` environments as can be."""
    return math.ceil(num_envs / math.ceil(num_envs / PART_SIZE))


def joined(parts: Sequence[Any], count: int, xp: ModuleType = jnp) -> Any:
    """Arrays [S, P, ...] of parts, of ``jax.numpy`` or ``numpy``, as one [S, ``count``, ...]."""
    return xp.concatenate(parts, axis=1)[:, :count]


def make_parts(
    env: GoalEnv,
    networks: Networks,
    config: Config,
    layout: Layout,
    keys_of: Callable[[jax.Array, jax.Array], jax.Array],
    learn: Callable[[LoopState, Episodes, Metrics, jax.Array], tuple[LoopState, Metrics]],
) -> Parts:
    """Builds the programs of a run. Nothing is compiled yet.

    Args:
        env: The environment.
        networks: What the parameters mean.
        config: The run.
        layout: Where it runs.
        keys_of: (keys [S], iteration) -> keys [2, S]: of an iteration's rollout, and of what comes after it.
        learn: (LoopState, Episodes, outcome, keys [S]) -> (LoopState, metrics): what comes after a rollout, for all seeds of
            one device.
    """
    with tracing_for_default_device():
        plays_any = targets_cpu() and layout.mesh is None
    total, shards = config.num_envs, layout.shards
    size = part_size(total) if plays_any else total

    def keys(seed_keys: jax.Array, iteration: jax.Array) -> jax.Array:
        return keys_of(seed_keys, iteration)[0]

    def play_part(train: TrainState, rollout_keys: jax.Array, first: jax.Array, exploration: Exploration) -> Played:
        played = Slice(first=first, total=total) if plays_any else shards
        episodes, outcome, _ = play(env, networks, train, rollout_keys, size, exploration, shards=played)
        return episodes, outcome

    def learn_parts(loop: LoopState, parts: Sequence[Played]) -> tuple[LoopState, Metrics]:
        episodes, outcome = jax.tree.map(lambda *leaves: joined(leaves, total), *parts)
        return learn(loop, episodes, outcome, keys_of(loop.key, loop.iteration)[1])

    seeds, environments, whole = layout.by_seed, layout.by_environment, layout.everywhere
    spread = functools.partial(layout.spread, jit=jaxrl_vis_envs.jit)
    return Parts(
        size=size,
        total=total,
        plays_any=plays_any,
        exploration=Exploration(config.random_action_probability, config.action_noise),
        keys=spread(keys, (seeds, whole), seeds),
        play=spread(play_part, (seeds, seeds, whole, whole), (environments, environments)),
        learn=spread(
            learn_parts,
            (layout.loop, environments),
            (layout.loop, seeds),
            kept_as=(layout.loop, layout.read_by_host),
            donate_argnums=0,
        ),
    )


def played_spec(env: GoalEnv, size: int, seeds: int) -> tuple[Episodes, dict[str, Any]]:
    """Shapes and types of what `Parts.play` returns, without tracing it."""

    def spec(shape: tuple[int, ...], dtype: Any = jnp.float32) -> Any:
        return jax.ShapeDtypeStruct(shape, dtype)

    slots = (seeds, size, env.horizon + 2)
    episodes = Episodes(
        observations=spec((*slots, *env.observation_spec.shape), env.observation_spec.dtype),
        states=spec((*slots, env.goal_state_size)),
        actions=spec((seeds, size, env.horizon, env.action_size)),
    )
    return episodes, {name: spec((seeds, size)) for name in ("success", "goal_distance")}
