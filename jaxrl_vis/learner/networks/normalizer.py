"""Running mean and standard deviation of observations, per pixel and channel, merged batch by batch (Chan et al., 1979).

Most of what a static camera sees never changes: subtracting the mean image leaves the moving parts.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxrl_vis.learner.parallel.shards import ONE, Shards
from jaxrl_vis.types import NormalizerState


class Scaling(NamedTuple):
    """Mean and scale for normalising observations.

    Attributes:
        mean: [...] float32, in the observation's unit.
        scale: [...] float32, 1 / standard deviation.
    """

    mean: jax.Array
    scale: jax.Array


def init(observation_spec: jax.ShapeDtypeStruct) -> NormalizerState:
    """Return empty statistics of observations of this shape."""
    zeros = jnp.zeros(observation_spec.shape, jnp.float32)
    return NormalizerState(count=jnp.zeros((), jnp.float32), mean=zeros, sum_of_squares=zeros)


def update(
    state: NormalizerState, observations: jax.Array, axes: tuple[int, ...] = (0, 1), shards: Shards = ONE
) -> NormalizerState:
    """Merge the statistics of ``observations``, such as those of a rollout [E, T+2, ...], into the running ones.

    Args:
        state: Statistics so far.
        observations: Observations in their own dtype, preceded by the axes to reduce.
        axes: Leading axes to reduce.
        shards: Shards of the learner; ``observations`` are those of one shard.
    """
    count = jnp.float32(shards.count)
    for axis in axes:
        count = count * observations.shape[axis]
    # Compute deviations from the running mean, not from zero: these are small, so that their squares keep precision.
    centred = observations.astype(jnp.float32) - state.mean
    shift = shards.mean(jnp.mean(centred, axis=axes))
    batch_squares = shards.total(jnp.sum(jnp.square(centred), axis=axes)) - count * jnp.square(shift)
    total = state.count + count
    return NormalizerState(
        count=total,
        mean=state.mean + shift * (count / total),
        sum_of_squares=state.sum_of_squares + jnp.maximum(batch_squares, 0.0) + jnp.square(shift) * state.count * count / total,
    )


def scale(state: NormalizerState, floor: float) -> jax.Array:
    """Return 1 / max(standard deviation, ``floor``), [...] float32."""
    variance = state.sum_of_squares / jnp.maximum(state.count, 1.0)
    return 1.0 / jnp.maximum(jnp.sqrt(variance), floor)
