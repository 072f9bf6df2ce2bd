"""Rewards that depend only on the achieved observation and the goal, and are computed when batches are read.

    indicator             equality in every element
    indicator_tolerance   nearly all elements within some grey levels of the goal's, for cameras with noise
    features              cosine similarity of both in a frozen encoder's feature space

A custom method can be built from any image encoder: ``Mine = features_method(encode)``, ``--method module:Mine``.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxrl_vis.config import Config
from jaxrl_vis.config.methods import Method, RewardFunction
from jaxrl_vis.errors import RequestError
from jaxrl_vis.learner.networks import frozen_encoder
from jaxrl_vis_envs import goals

_SMALL = 1e-6  # minimum norm of a vector with a meaningful direction


def cosine_reward(vector: jax.Array, goal_vector: jax.Array, positive: float = 1.0, negative: float = 0.0) -> jax.Array:
    """Map the angle between vectors [B, L] to rewards [B] float32: ``positive`` at 0, ``negative`` at a right angle or more.

    Args:
        vector: [B, L] any float dtype, vectors of the achieved observations.
        goal_vector: [B, L], vectors of the goals.
        positive: R+.
        negative: R-.
    """
    first, second = (array.astype(jnp.float32) for array in (vector, goal_vector))
    lengths = jnp.linalg.norm(first, axis=-1) * jnp.linalg.norm(second, axis=-1)
    cosine = jnp.sum(first * second, axis=-1) / jnp.maximum(lengths, _SMALL**2)
    return jax.lax.stop_gradient(negative + (positive - negative) * jnp.clip(cosine, 0.0, 1.0))


def features_reward(encode: Callable[[jax.Array], jax.Array]) -> RewardFunction:
    """Build the reward of a frozen encoder: the cosine similarity of its vectors for achieved observation and goal.

    Args:
        encode: Images [B, C, H, W] uint8 -> vectors [B, L] of any float dtype.
    """

    def reward(batch: Any, achieved_goal: jax.Array, positive: float, negative: float) -> jax.Array:
        vector, goal_vector = jnp.split(encode(jnp.concatenate([achieved_goal, batch.goal])), 2)
        return cosine_reward(vector, goal_vector, positive, negative)

    return reward


def features_method(encode: Callable[[jax.Array], jax.Array]) -> Method:
    """Build a method for ``--method module:Name`` from an encoder; see `features_reward`."""
    return Method(reward=features_reward(encode), filter=False, reward_positive=1.0, reward_negative=0.0)


def make_reward(config: Config, method: Method, mask: Callable[[jax.Array], jax.Array] | None = None) -> RewardFunction:
    """Build the reward function of a method: (Batch, achieved_goal [B, ...], R+, R-) -> [B] float32.

    Args:
        config: Configuration with the tolerance and the encoder.
        method: The method.
        mask: Function from observations to the mask of the elements that matter, [B, ...] bool, broadcastable to them.
            Indicators compare those that matter in the achieved observation or in the goal; None for all elements.

    Raises:
        RequestError: The frozen encoder is missing or unreadable.
    """
    if callable(method.reward):
        return method.reward
    if method.reward == "features":
        if config.reward.reward_encoder is None:
            raise RequestError("method features needs an encoder: --reward-encoder FILE.npz, made by jaxrl-vis encoder")
        return features_reward(frozen_encoder.load(config.reward.reward_encoder))
    tolerance, share = 0.0, 1.0
    if method.reward == "indicator_tolerance":
        tolerance, share = config.reward.tolerance, config.reward.tolerance_share

    def indicator(batch: Any, achieved_goal: jax.Array, positive: float, negative: float) -> jax.Array:
        values = {"positive": positive, "negative": negative, "num_axes": achieved_goal.ndim - 1}
        compared = None if mask is None else mask(achieved_goal) | mask(batch.goal)
        return goals.indicator_reward(achieved_goal, batch.goal, tolerance=tolerance, share=share, compared=compared, **values)

    return indicator
