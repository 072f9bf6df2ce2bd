"""Forms of contrastive RL between ``nce`` and ``stable``: loss and networks one at a time, to find what each contributes.

--algorithm benchmarks.tasks.contrastive_forms:nce_stabilised        the loss of nce, the networks of stable
--algorithm benchmarks.tasks.contrastive_forms:infonce_plain         the loss of stable, the networks of nce
--algorithm benchmarks.tasks.contrastive_forms:balanced              nce with positives as heavy as negatives
"""

import functools

import jax
import jax.numpy as jnp

from jaxrl_vis.learner.algorithm import Algorithm, Setup
from jaxrl_vis.learner.contrastive import build, contrastive_loss


def nce_stabilised(setup: Setup) -> Algorithm:
    """Build contrastive RL with binary cross-entropy, and the networks of ``stable``."""
    return build(setup, functools.partial(contrastive_loss, form="nce"), stabilized=True)


def infonce_plain(setup: Setup) -> Algorithm:
    """Build contrastive RL with symmetric InfoNCE, and the networks of ``nce``."""
    return build(setup, functools.partial(contrastive_loss, form="stable"), stabilized=False)


def balanced(setup: Setup) -> Algorithm:
    """Build contrastive RL with `balanced_loss`, and the networks of ``nce``."""
    return build(setup, balanced_loss, stabilized=False)


def balanced_loss(logits: jax.Array) -> jax.Array:
    """Return the mean binary cross-entropy of the B positives plus that of the B (B - 1) negatives, [] float32.

    Args:
        logits: [B, B] float32 with B > 1, positives on the diagonal.
    """
    following, size = jnp.diagonal(logits), len(logits)
    negatives = jnp.sum(jax.nn.softplus(logits)) - jnp.sum(jax.nn.softplus(following))
    return jnp.mean(jax.nn.softplus(-following)) + negatives / (size * (size - 1))
