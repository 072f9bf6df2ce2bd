"""Reward and success functions, shared by the environments and by relabelling in the learner.

There are two rewards. The *oracle* compares true states within a threshold (thesis, equation 5.6). The *indicator* is positive
only if the observation equals the goal in every element (thesis, equation 5.4), so it needs no state estimate and has no false
positives. Arrays may have any leading batch axes; only the axes of one goal are reduced. NumPy arrays are scored with NumPy, so
that a learner on the host (see `adapters`) needs neither transfers nor compilation.

Images can mark the pixels of the object that a goal is about (`mark_object`), and indicators compare only these.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def _namespace(*arrays: Any) -> Any:
    """Return numpy if all ``arrays`` are NumPy arrays, else jax.numpy."""
    return np if all(isinstance(array, np.ndarray) for array in arrays) else jnp


def goal_distance(achieved_state: jax.Array, goal_state: jax.Array) -> jax.Array:
    """Compute the Euclidean distance between [..., G] float32 states, in their unit: [...] float32.

    Its gradient is 0 where they are equal.
    """
    numpy = _namespace(achieved_state, goal_state)
    square = numpy.sum(numpy.square(achieved_state - goal_state), axis=-1)
    if numpy is np:
        return np.sqrt(square)
    # The square root has an infinite slope at 0, which would turn the gradient of a batch into NaN.
    return jnp.where(square == 0, 0.0, jnp.sqrt(jnp.where(square == 0, 1.0, square)))


def success(achieved_state: jax.Array, goal_state: jax.Array, threshold: float) -> jax.Array:
    """Return 1 where [..., G] states lie within ``threshold`` of each other, else 0, also for NaN: [...] float32."""
    return (goal_distance(achieved_state, goal_state) <= threshold).astype(jnp.float32)


def oracle_reward(
    achieved_state: jax.Array,
    goal_state: jax.Array,
    threshold: float,
    positive: float = 0.0,
    negative: float = -1.0,
) -> jax.Array:
    """Compute the ground-truth reward of [..., G] float32 states (thesis, equation 5.6): [...] float32.

    The defaults are those of Gymnasium's Fetch tasks: 0 at the goal, -1 elsewhere.

    Args:
        achieved_state: [..., G] float32, the achieved state.
        goal_state: [..., G] float32, the desired state, in the same unit.
        threshold: Distance up to which the goal counts as reached, in that unit.
        positive: Reward at the goal (R+).
        negative: Reward elsewhere (R-).
    """
    is_reached = goal_distance(achieved_state, goal_state) <= threshold
    return _namespace(achieved_state, goal_state).where(is_reached, positive, negative).astype(jnp.float32)


def indicator_reward(
    observation: jax.Array,
    goal: jax.Array,
    positive: float = 1.0,
    negative: float = -1.0,
    num_axes: int = 3,
    tolerance: float = 0.0,
    share: float = 1.0,
    compared: jax.Array | None = None,
) -> jax.Array:
    """Compute the indicator reward (thesis, equation 5.4): ``positive`` if observation and goal are equal, else ``negative``.

    Args:
        observation: [..., C, H, W] uint8 images or [..., S] float32 state vectors that were achieved.
        goal: Goals, of the same shape and dtype.
        positive: Reward if they are equal (R+).
        negative: Reward otherwise (R-).
        num_axes: Number of axes of one observation: 3 for images, 1 for state vectors.
        tolerance: Difference up to which two elements count as equal, in their unit (grey levels for images).
        share: Fraction of the elements that must be equal.
        compared: bool, broadcastable to ``goal``, True for the elements to compare; None for all. If it is False
            everywhere, the reward is ``negative``.

    Returns:
        [...] float32.
    """
    numpy = _namespace(observation, goal)
    axes = tuple(range(-num_axes, 0))
    if compared is not None:
        compared = numpy.broadcast_to(compared, goal.shape)
        count = numpy.sum(compared, axis=axes)
        difference = numpy.abs(observation.astype(numpy.float32) - goal.astype(numpy.float32))
        differing = numpy.sum(compared & (difference > tolerance), axis=axes)
        equal = (count > 0) & (differing <= numpy.floor((1.0 - share) * count + 1e-6))
    elif tolerance == 0.0 and share == 1.0:
        equal = numpy.all(observation == goal, axis=axes)
    else:
        difference = numpy.abs(observation.astype(numpy.float32) - goal.astype(numpy.float32))
        allowed = int((1.0 - share) * np.prod(goal.shape[-num_axes:]) + 1e-6)  # 0.99 has no exact binary representation
        equal = numpy.sum(difference > tolerance, axis=axes) <= allowed
    return numpy.where(equal, positive, negative).astype(jnp.float32)


def mark_object(image: jax.Array, mask: jax.Array) -> jax.Array:
    """Write a mask [H, W] bool into the lowest bit of the first channel of an image [C, H, W] uint8."""
    return image.at[0].set(image[0] & 0xFE | mask.astype(jnp.uint8))


def object_mask(image: jax.Array) -> jax.Array:
    """Read the mask of `mark_object` from an image or a stack's newest one: [..., C, H, W] uint8 -> [..., 1, H, W] bool."""
    return (image[..., :1, :, :] & 1).astype(bool)
