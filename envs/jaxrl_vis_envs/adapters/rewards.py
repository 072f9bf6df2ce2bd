"""Rewards of the adapters, chosen when an environment is constructed."""

import functools
from collections.abc import Callable
from typing import Any, Literal, get_args

from jaxrl_vis_envs import goals

Reward = Literal["oracle", "dense"]
RewardFunction = Callable[[Any, Any], Any]
"""Function from achieved and goal states [..., G] to rewards [...] float32; NumPy for NumPy arrays, JAX for JAX arrays."""


def reward_function(reward: Reward, threshold: float) -> RewardFunction:
    """Return the reward function of achieved and goal states; it can be pickled.

    Args:
        reward: ``oracle`` is 0 within ``threshold`` of the goal and -1 elsewhere (`goals.oracle_reward`); ``dense`` is the
            negative distance, in the unit of the states.
        threshold: Distance within which an episode succeeds, in the unit of the states.

    Raises:
        ValueError: There is no such reward.
    """
    if reward not in get_args(Reward):
        raise ValueError(f"reward must be one of {', '.join(get_args(Reward))}, got {reward!r}")
    return _dense_reward if reward == "dense" else functools.partial(goals.oracle_reward, threshold=threshold)


def _dense_reward(achieved_state: Any, goal_state: Any) -> Any:
    return -goals.goal_distance(achieved_state, goal_state)
