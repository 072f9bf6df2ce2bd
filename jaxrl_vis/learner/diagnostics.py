"""What a batch says about its rewards, measured against the truth that only a simulation knows.

Shares of one batch are means of products, so that a quotient of two of them, averaged over many batches, is the share over all
of these batches: precision of the filter = ``filtered_false_share`` / ``filtered_share`` (see `run.metrics`).
"""

import jax
import jax.numpy as jnp

from jaxrl_vis.types import Metrics


def _share(part: jax.Array, whole: jax.Array) -> jax.Array:
    return jnp.sum(part) / jnp.maximum(jnp.sum(whole), 1.0)


def of_rewards(
    reward: jax.Array,
    keep: jax.Array,
    reward_positive: float,
    reward_negative: float,
    success: jax.Array | None = None,
    graded: bool = False,
) -> Metrics:
    """Shares of a batch of B transitions, [] float32 by name; docs/learner.md says what each one means.

    Args:
        reward: [B] float32.
        keep: [B] float32, 0 for what the filter drops (`losses.keep_mask`).
        reward_positive, reward_negative: R+ and R-.
        success: [B] float32, 1 where the goal was truly reached; None: nothing is said about the truth.
        graded: Whether rewards lie anywhere between R- and R+: one in the middle counts as half a positive.
    """
    if graded:
        positive = (reward - reward_negative) / (reward_positive - reward_negative)
    else:
        positive = (reward == reward_positive).astype(jnp.float32)
    negative = 1.0 - positive
    found = {"positive_share": jnp.mean(positive), "filtered_share": _share(1.0 - keep, negative)}
    if success is None:
        return found
    return found | {
        "false_positive_share": _share(positive * (1.0 - success), 1.0 - success),
        "false_negative_share": _share(negative * success, negative),
        "filtered_false_share": _share((1.0 - keep) * success, negative),
    }
