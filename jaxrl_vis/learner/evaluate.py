"""How good a learner is, and what its first few episodes look like, in one program."""

from collections.abc import Callable, Mapping
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp

from jaxrl_vis.config import Config
from jaxrl_vis.learner.networks import Networks
from jaxrl_vis.learner.rollout import play
from jaxrl_vis.learner.shards import ONE, Shards
from jaxrl_vis.types import Metrics, TrainState
from jaxrl_vis_envs.base import GoalEnv

# Episodes whose images are handed back, for videos.
_NUM_RECORDED = 8


def num_recorded(num_episodes: int, shards: Shards = ONE) -> int:
    """K: of how many of the episodes images are handed back, by each part of a learner."""
    return min(max(1, _NUM_RECORDED // shards.count), num_episodes // shards.count)


def metrics_of(outcome: Mapping[str, Any], xp: ModuleType = jnp) -> Metrics:
    """What an evaluation says of episodes that ended so: [S] float32, of ``success`` and ``goal_distance`` [S, N].

    Args:
        outcome: At the last steps.
        xp: ``jax.numpy``, or ``numpy``, whose arrays these are.
    """
    return {
        "eval/success": xp.mean(outcome["success"], axis=1),
        "eval/goal_distance": xp.mean(outcome["goal_distance"], axis=1),
        "eval/goal_distance_median": xp.median(outcome["goal_distance"], axis=1),
    }


def recording_of(observations: Any, success: Any, frame_stack: int) -> dict[str, Any]:
    """What is shown of episodes: their observations [S, K, T+2, ...], the goals' at the end, and of all, ``success`` [S, N]."""
    if frame_stack > 1:  # for people, the newest of stacked images, which come first
        observations = observations[:, :, :, : observations.shape[3] // frame_stack]
    frames, goals = observations[:, :, :-1], observations[:, :, -1]
    return {"frames": frames, "goals": goals, "success": success[:, : observations.shape[1]]}


def make_evaluate(
    env: GoalEnv, networks: Networks, config: Config, shards: Shards = ONE
) -> Callable[[TrainState, jax.Array], tuple[Metrics, dict[str, jax.Array]]]:
    """Evaluation without exploration, as a function to be compiled.

    Args:
        env: The environment.
        networks: What the parameters mean.
        config: The number of episodes, ``eval_episodes``.
        shards: Of each learner. Each part plays its part of the episodes; metrics are of all, and images are of the first few
            of each part.

    Returns:
        (TrainState [S, ...], key []) -> metrics of [S] float32 and, of the first K episodes, ``frames`` [S, K, T+1, ...],
        ``goals`` [S, K, ...] and ``success`` [S, K]. All seeds play the same ``config.eval_episodes`` episodes.
    """

    def evaluate(train: TrainState, key: jax.Array) -> tuple[Metrics, dict[str, jax.Array]]:
        num_kept = num_recorded(config.eval_episodes, shards)
        keys = jnp.broadcast_to(key, (jax.tree.leaves(train)[0].shape[0],))
        episodes, outcome, _ = play(env, networks, train, keys, config.eval_episodes, num_kept=num_kept, shards=shards)
        outcome_of_all = {name: shards.gather(values, axis=1) for name, values in outcome.items()}
        return metrics_of(outcome_of_all), recording_of(episodes.observations, outcome["success"], env.frame_stack)

    return evaluate
