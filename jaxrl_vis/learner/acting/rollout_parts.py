"""Rollouts divided into parts of a few environments, which the threads of a CPU run in parallel.

A GPU steps all environments at once, and so do several devices. One CPU steps at most `PART_SIZE` at a time, in as many threads
as it has cores (`jaxrl_vis.run.compiled.threaded_rollout`): XLA would divide single operations among its threads, and those of
a physics step are too small for that. An evaluation calls the same program, as physics and rendering take longest to compile.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp

from jaxrl_vis.types import Episodes, Metrics
from jaxrl_vis_envs.base import GoalEnv

PART_SIZE = 8
"""Maximum number of environments in a part: as many float32 numbers as fit into a vector register of most CPUs."""

PartResult = tuple[Episodes, Metrics]
"""Episodes [S, P, ...] of one part, and their metrics (`GoalEnv.metric_names`) at the last step, [S, P] float32 by name."""


def part_size(num_envs: int) -> int:
    """Return P, the minimum part size that needs no more parts than `PART_SIZE` would."""
    return math.ceil(num_envs / math.ceil(num_envs / PART_SIZE))


def join_parts(parts: Sequence[Any], count: int, xp: ModuleType = jnp, axis: int = 0) -> Any:
    """Concatenate arrays of parts along the environment axis, and truncate to ``count`` environments.

    Args:
        parts: Arrays with P environments along ``axis``.
        count: Number of environments to return.
        xp: ``jax.numpy`` or ``numpy``, according to the type of the arrays.
        axis: Axis of environments, 0 or 1.
    """
    joined = xp.concatenate(parts, axis=axis)
    return joined[:count] if axis == 0 else joined[:, :count]


@dataclasses.dataclass(frozen=True)
class RolloutPart:
    """Random numbers of one part of a rollout, in a program that can run any part.

    It has the methods that `rollout.play` calls on `shards.Shards`. Environment ``first + i`` starts as it does in a rollout of
    all environments, and its actions have the same noise. Image noise is sampled separately for each part: sampling it for all
    environments would take longer than rendering the images.

    Attributes:
        first: [] int32, index of the first environment. From ``total`` on, as in evaluations, no action noise is available.
        total: Number of environments in a whole rollout.
    """

    first: jax.Array
    total: int

    def draw(self, draw: Callable[[tuple[int, ...]], jax.Array], shape: tuple[int, ...]) -> jax.Array:
        """Sample numbers for all environments, and return those of this part, [P, ...] of ``shape``; padded with zeros.

        Args:
            draw: shape -> random numbers, with a key that all parts share.
            shape: Shape of the result; the first axis is that of environments.
        """
        drawn = draw((self.total, *shape[1:]))
        filled = jnp.concatenate([drawn, jnp.zeros(shape, drawn.dtype)])  # the last part may be longer than what is left
        return jax.lax.dynamic_slice_in_dim(filled, self.first, shape[0])

    def noise(self, key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
        """Sample standard normal numbers of ``shape``, different in every part."""
        return jax.random.normal(jax.random.fold_in(key, self.first), shape)

    def split(self, key: jax.Array, count: int) -> jax.Array:
        """Return this part's slice [count] of the typed keys that `jax.random.split` returns for all environments."""
        return jax.vmap(jax.random.fold_in, (None, 0))(key, self.first + jnp.arange(count))


def part_result_spec(env: GoalEnv, size: int, seeds: int, full_state_size: int = 0) -> PartResult:
    """Return shapes and dtypes of the result of one part, without tracing its program.

    Args:
        env: The environment.
        size: P, number of environments in the part.
        seeds: S.
        full_state_size: Size of `Episodes.full_states` of one step; 0 if they are not collected.
    """

    def spec(shape: tuple[int, ...], dtype: Any = jnp.float32) -> Any:
        return jax.ShapeDtypeStruct(shape, dtype)

    slots = (seeds, size, env.horizon + 2)
    episodes = Episodes(
        observations=spec((*slots, *env.observation_spec.shape), env.observation_spec.dtype),
        states=spec((*slots, env.goal_state_size)),
        actions=spec((seeds, size, env.horizon, env.action_size)),
        full_states=spec((seeds, size, env.horizon + 1, full_state_size)) if full_state_size else None,
    )
    return episodes, {name: spec((seeds, size)) for name in env.metric_names}
