"""Diagnostics of a batch's rewards against the ground truth, which is known only in simulation.

The ratio of two fractions, each averaged over many batches, estimates the fraction over all of these batches: precision of the
filter = ``filtered_false_share`` / ``filtered_share``.
"""

import jax
import jax.numpy as jnp

from jaxrl_vis.types import Metrics


def count_rewards(
    reward: jax.Array,
    keep: jax.Array,
    reward_positive: float,
    reward_negative: float,
    success: jax.Array | None = None,
    graded: bool = False,
) -> Metrics:
    """Count negatives, filtered transitions and errors among B transitions, [] float32 by name, for `fractions`.

    ``positive_share`` is a fraction already.

    If a batch is divided among devices, average the counts over the devices before calling `fractions`.

    Args:
        reward: [B] float32.
        keep: [B] float32, 0 for transitions dropped by the filter (`losses.keep_mask`).
        reward_positive, reward_negative: R+ and R-.
        success: [B] float32, 1 if the goal was truly reached; None for no comparison with the truth.
        graded: Whether rewards may lie anywhere between R- and R+: one in the middle counts as half a positive.
    """
    if graded:
        positive = (reward - reward_negative) / (reward_positive - reward_negative)
    else:
        positive = (reward == reward_positive).astype(jnp.float32)
    negative = 1.0 - positive
    counts = {"positive_share": jnp.mean(positive), "negative": jnp.sum(negative), "filtered": jnp.sum(1.0 - keep)}
    if success is None:
        return counts
    return counts | {
        "failure": jnp.sum(1.0 - success),
        "false_positive": jnp.sum(positive * (1.0 - success)),
        "false_negative": jnp.sum(negative * success),
        "filtered_false": jnp.sum((1.0 - keep) * success),
    }


def fractions(counts: Metrics, num_shards: int = 1) -> Metrics:
    """Compute fractions of a batch, [] float32 by name; docs/learner.md defines them.

    Args:
        counts: Counts from `count_rewards`; for a batch divided into shards, their mean over the shards.
        num_shards: Number of shards.
    """

    def fraction(count: str, total: str) -> jax.Array:
        return counts[count] / jnp.maximum(counts[total], 1.0 / num_shards)

    result = {"positive_share": counts["positive_share"], "filtered_share": fraction("filtered", "negative")}
    if "failure" not in counts:
        return result
    return result | {
        "false_positive_share": fraction("false_positive", "failure"),
        "false_negative_share": fraction("false_negative", "negative"),
        "filtered_false_share": fraction("filtered_false", "negative"),
    }
