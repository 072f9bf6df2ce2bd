"""Losses of goal-conditioned DDPG as pure functions of arrays (Lillicrap et al., 2016; thesis, section 5.1).

Subscripts are time: ``value_t`` belongs to the state before the action, ``value_tp1`` to the one after it.
"""

from collections.abc import Callable
from typing import Literal

import jax
import jax.numpy as jnp

LOG_FLOOR = 1e-6
"""Minimum argument of a logarithm in a loss; values this close to the maximum give the actor no gradient."""


def td_target(
    reward_t: jax.Array,
    value_tp1: jax.Array,
    discount: float | jax.Array,
    minimum: float = -jnp.inf,
    maximum: float = jnp.inf,
) -> jax.Array:
    """Compute r + gamma Q'(s', pi'(s')), clipped to the range of returns: [B] float32, without gradient.

    Episodes end by running out of time, never by a terminal state, so the discount is never zeroed.

    Args:
        reward_t: [B] float32, rewards of the transitions.
        value_tp1: [B] float32, the target critic's values of the target actor's actions in the next states.
        discount: gamma, or its power for transitions of several steps, [B].
        minimum: Minimum target, R-/(1-gamma).
        maximum: Maximum target, R+/(1-gamma).
    """
    return jax.lax.stop_gradient(jnp.clip(reward_t + discount * value_tp1, minimum, maximum))


def keep_mask(reward_t: jax.Array, value_t: jax.Array, reward_negative: float, threshold: float) -> jax.Array:
    """Return 0 for negatives whose value exceeds the threshold and which are thus likely false, else 1 (thesis, 5.1.4).

    Args:
        reward_t: [B] float32, rewards.
        value_t: [B] float32, the online critic's values of the same transitions.
        reward_negative: R-.
        threshold: q0; infinity keeps everything.

    Returns:
        [B] float32, without gradient.
    """
    false_negative = (reward_t == reward_negative) & (value_t > threshold)
    return jax.lax.stop_gradient(1.0 - false_negative.astype(jnp.float32))


def critic_loss(value_t: jax.Array, target: jax.Array, keep: jax.Array, count: jax.Array | None = None) -> jax.Array:
    """Compute the mean squared temporal-difference error over transitions with ``keep`` 1: [] float32; 0 if there are none.

    Args:
        value_t: [B] float32, the online critic's values.
        target: [B] float32, from `td_target`.
        keep: [B] float32, 0 or 1, from `keep_mask`.
        count: [] float32, divisor of the sum; None for the sum of ``keep``, at least 1.
    """
    count = jnp.maximum(jnp.sum(keep), 1.0) if count is None else count
    return jnp.sum(keep * jnp.square(value_t - target)) / count


def actor_loss(
    value_t: jax.Array,
    action: jax.Array,
    action_penalty: float,
    log_below: float | None = None,
    global_mean: Callable[[jax.Array], jax.Array] = lambda mean: mean,
    log_of: Literal["value", "loss"] = "value",
) -> jax.Array:
    """Compute minus the mean value of the policy's actions, plus their weighted mean square: [] float32.

    Args:
        value_t: [B] float32, the online critic's values of ``action``.
        action: [B, A] float32 in [-1, 1], actions of the policy.
        action_penalty: Weight of the mean square.
        log_below: Maximum possible value, R+/(1-gamma): the logarithm of the distance to it replaces minus the value, to match
            auxiliary losses minimised as logarithms. With the rewards 0/-1 of the OL-AUX release, it is 0, and this is the
            release's log(-Q). None for no logarithm.
        global_mean: Function from the mean over these transitions to that over the whole batch, applied before a logarithm.
        log_of: Argument of the logarithm: value, the distance alone, with the mean square added afterwards (the release); or
            loss, their sum. The derivative of a logarithm is the inverse of its argument: with ``value`` it divides the
            gradient of the value, but not that of the mean square.
    """
    value, penalty = jnp.mean(value_t), action_penalty * jnp.mean(jnp.square(action))
    if log_below is None:
        return penalty - value
    if log_of == "loss":
        return jnp.log(jnp.maximum(global_mean(log_below - value + penalty), LOG_FLOOR))
    return jnp.log(jnp.maximum(log_below - global_mean(value), LOG_FLOOR)) + penalty
