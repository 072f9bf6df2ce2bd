"""Rewards and success: the one place. Environments score with these, and the learner relabels with the same functions.

Two rewards exist. The *oracle* compares true states within a threshold (thesis, equation 5.6). The *indicator* is positive only
where the observation equals the goal's in every element (thesis, equation 5.4), so it needs no state estimate and has
no false positives. Arrays may carry any leading batch axes; only the goal's own axes are reduced. NumPy arrays are scored by
NumPy, so that a learner on the host (see `adapters`) pays for no transfer and no compilation.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def _namespace(*arrays: Any) -> Any:
    """NumPy where all of ``arrays`` are NumPy's, else jax.numpy."""
    return np if all(isinstance(array, np.ndarray) for array in arrays) else jnp


def goal_distance(achieved_state: jax.Array, goal_state: jax.Array) -> jax.Array:
    """Euclidean distance of [..., G] float32 states, in their unit: [...] float32. Its gradient is 0 where they are equal."""
    numpy = _namespace(achieved_state, goal_state)
    square = numpy.sum(numpy.square(achieved_state - goal_state), axis=-1)
    if numpy is np:
        return np.sqrt(square)
    # A root has an endless slope at 0, which would make the gradient of a batch NaN.
    return jnp.where(square == 0, 0.0, jnp.sqrt(jnp.where(square == 0, 1.0, square)))


def success(achieved_state: jax.Array, goal_state: jax.Array, threshold: float) -> jax.Array:
    """1 where [..., G] states lie within ``threshold`` of each other, else 0 (NaN is a failure): [...] float32."""
    return (goal_distance(achieved_state, goal_state) <= threshold).astype(jnp.float32)


def oracle_reward(
    achieved_state: jax.Array,
    goal_state: jax.Array,
    threshold: float,
    positive: float = 0.0,
    negative: float = -1.0,
) -> jax.Array:
    """Ground-truth reward of [..., G] float32 states (thesis, equation 5.6): [...] float32.

    The defaults are those of Gymnasium's Fetch tasks: 0 at the goal, -1 elsewhere.

    Args:
        achieved_state: [..., G] float32, what was reached.
        goal_state: [..., G] float32, what the goal asks for, in the same unit.
        threshold: Distance up to which the goal counts as reached, in that unit.
        positive: R+.
        negative: R-.
    """
    is_reached = goal_distance(achieved_state, goal_state) <= threshold
    return _namespace(achieved_state, goal_state).where(is_reached, positive, negative).astype(jnp.float32)


def indicator_reward(
    observation: jax.Array, goal: jax.Array, positive: float = 1.0, negative: float = -1.0, num_axes: int = 3
) -> jax.Array:
    """Indicator reward (thesis, equation 5.4): ``positive`` where all elements of two observations agree: [...] float32.

    Args:
        observation: [..., C, H, W] uint8 images or [..., S] float32 state vectors, what was reached.
        goal: The same of the goal.
        positive: R+.
        negative: R-.
        num_axes: How many axes one observation has: 3 for images, 1 for state vectors.
    """
    numpy = _namespace(observation, goal)
    equal = numpy.all(observation == goal, axis=tuple(range(-num_axes, 0)))
    return numpy.where(equal, positive, negative).astype(jnp.float32)
