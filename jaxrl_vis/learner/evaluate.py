"""How good a learner is, and what its first few episodes look like, in one program."""

from collections.abc import Callable

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

    def newest(observations: jax.Array) -> jax.Array:
        """For people, the newest of stacked images, which come first: [S, K, slots, C, H, W]."""
        if env.frame_stack == 1:
            return observations
        return observations[:, :, :, : observations.shape[3] // env.frame_stack]

    def evaluate(train: TrainState, key: jax.Array) -> tuple[Metrics, dict[str, jax.Array]]:
        num_recorded = min(max(1, _NUM_RECORDED // shards.count), config.eval_episodes // shards.count)
        keys = jnp.broadcast_to(key, (jax.tree.leaves(train)[0].shape[0],))
        episodes, outcome, _ = play(env, networks, train, keys, config.eval_episodes, num_kept=num_recorded, shards=shards)
        outcome_of_all = {name: shards.gather(values, axis=1) for name, values in outcome.items()}
        shown = newest(episodes.observations)
        metrics = {
            "eval/success": jnp.mean(outcome_of_all["success"], axis=1),
            "eval/goal_distance": jnp.mean(outcome_of_all["goal_distance"], axis=1),
            "eval/goal_distance_median": jnp.median(outcome_of_all["goal_distance"], axis=1),
        }
        recording = {"frames": shown[:, :, :-1], "goals": shown[:, :, -1], "success": outcome["success"][:, :num_recorded]}
        return metrics, recording

    return evaluate
