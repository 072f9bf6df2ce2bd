"""Evaluation of a learner: metrics of all episodes, and images of the first few, in one program."""

from collections.abc import Callable, Mapping
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxrl_vis.learner.acting.rollout import Acting, play
from jaxrl_vis.learner.parallel.shards import ONE, Shards
from jaxrl_vis.types import Metrics, TrainState

# Number of episodes whose images are returned, for videos.
_NUM_RECORDED = 8


class Evaluation(NamedTuple):
    """Result of an evaluation.

    Attributes:
        metrics: [S] float32 by name, over all episodes: means of `GoalEnv.metric_names`, each prefixed by ``eval/``, and
            ``eval/goal_distance_median``.
        recording: ``frames`` [S, K, T+1, ...] and ``goals`` [S, K, ...] in the dtype of observations, without older stacked
            images, and ``success`` [S, K] float32, of the first K episodes of one shard of each seed (`num_recorded`); D * K
            episodes once D shards are assembled.
    """

    metrics: Metrics
    recording: dict[str, Any]


def num_recorded(num_episodes: int, shards: Shards = ONE) -> int:
    """Return K, the number of episodes per shard whose images are returned."""
    return min(max(1, _NUM_RECORDED // shards.count), num_episodes // shards.count)


def summarize(
    outcome: Mapping[str, Any], observations: Any, success: Any, frame_stack: int, xp: ModuleType = jnp
) -> Evaluation:
    """Summarize the episodes of an evaluation.

    Args:
        outcome: [S, N] by name, metrics (`GoalEnv.metric_names`) of all N episodes at their last steps.
        observations: [S, K, T+2, ...], the T+1 observations of each recorded episode, followed by its goal.
        success: [S, at least K] success of the recorded episodes and possibly more.
        frame_stack: Number of images that an observation stacks.
        xp: ``jax.numpy`` or ``numpy``, according to the type of the arrays.
    """
    metrics = {f"eval/{name}": xp.mean(values, axis=1) for name, values in outcome.items()}
    metrics["eval/goal_distance_median"] = xp.median(outcome["goal_distance"], axis=1)
    if frame_stack > 1:  # for display, keep the newest of the stacked images, which come first
        observations = observations[:, :, :, : observations.shape[3] // frame_stack]
    frames, goals = observations[:, :, :-1], observations[:, :, -1]
    return Evaluation(metrics, {"frames": frames, "goals": goals, "success": success[:, : observations.shape[1]]})


def make_evaluate(acting: Acting, num_episodes: int, shards: Shards = ONE) -> Callable[[TrainState, jax.Array], Evaluation]:
    """Build the evaluation without exploration, as a function to be compiled.

    Args:
        acting: Environment and algorithm.
        num_episodes: N, number of episodes per learner.
        shards: Shards of each learner. Each rolls out its part of the episodes; metrics cover all of them, images the first
            few of each shard.

    Returns:
        (TrainState [S, ...], key []) -> `Evaluation`. All seeds are evaluated on the same episodes.
    """

    def evaluate(train: TrainState, key: jax.Array) -> Evaluation:
        num_kept = num_recorded(num_episodes, shards)
        keys = jnp.broadcast_to(key, (jax.tree.leaves(train)[0].shape[0],))
        num_envs = num_episodes // shards.count
        episodes, outcome, _ = play(acting, train, keys, num_envs, num_kept=num_kept, random_source=shards)
        outcome_of_all = {name: shards.gather(values, axis=1) for name, values in outcome.items()}
        return summarize(outcome_of_all, episodes.observations, outcome["success"], acting.env.frame_stack)

    return evaluate
