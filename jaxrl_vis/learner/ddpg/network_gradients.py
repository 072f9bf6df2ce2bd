"""Gradients of both networks from one batch, by what the critic observes.

critic_of_images    the critic's loss and auxiliary losses are weighted; the actor follows with the same weights
critic_of_states    the critic encodes nothing; the actor's loss and auxiliary losses are weighted
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxrl_vis.learner.ddpg.objectives import ComputeCopies, Objectives
from jaxrl_vis.learner.networks.networks import Inputs
from jaxrl_vis.types import Batch, Metrics, Params
from jaxrl_vis.weighting import MAIN, Weighted, WeightingState


class PreparedBatch(NamedTuple):
    """Batch in the form that networks take.

    Attributes:
        batch: Batch of transitions, with rewards unless a learned model computes them.
        inputs: Its observations in the form that encoders read.
        image: [B, C, H, W] its observations before the action, normalised, if an auxiliary task needs them; else None.
        noise: [B, A] float32, added to the next actions in the critic's targets; None for no noise.
    """

    batch: Batch
    inputs: Inputs
    image: jax.Array | None = None
    noise: jax.Array | None = None


class NetworkGradients(NamedTuple):
    """Gradients of one shard's batch.

    Attributes:
        critic, actor: Gradients for the optimisers, float32; ``actor`` is None if the actor is not updated. With
            `Objectives.reduces_early`, that of the network with the weighted losses is of the whole learner's batch.
        weighting: State of the weighting after this batch.
        keep: [B] float32, 1 for unfiltered transitions and 0 for others.
        action: [B, A] float32 in [-1, 1], actions of the policy; None if the actor is not updated.
        metrics: [] float32 by name.
    """

    critic: Params
    actor: Params | None
    weighting: WeightingState
    keep: jax.Array
    action: jax.Array | None
    metrics: Metrics


ComputeGradients = Callable[[Objectives, ComputeCopies, PreparedBatch, Any, bool], NetworkGradients]
"""Function with the arguments of `critic_of_images`; the state of the weighting is whatever the algorithm's ``init`` made."""


def critic_of_images(
    objectives: Objectives, copies: ComputeCopies, prepared: PreparedBatch, state: WeightingState, with_actor: bool
) -> NetworkGradients:
    """Compute the gradients if both networks have the same observations.

    Args:
        objectives: Losses.
        copies: Parameters of the four networks.
        prepared: Batch with rewards.
        state: State of the weighting.
        with_actor: Whether to compute the actor's gradient.
    """
    batch, inputs, image, noise = prepared
    weighted = objectives.critic_gradient(copies, inputs, image, batch, noise)(copies.critic, state)
    latents, value, keep = weighted.extra
    metrics = {"train/critic_loss": weighted.losses[MAIN], "train/value": jnp.mean(value), **weighting_metrics(weighted)}
    if not with_actor:
        return NetworkGradients(weighted.gradient, None, weighted.state, keep, None, metrics)
    (metrics["train/actor_loss"], action), actor = jax.value_and_grad(objectives.actor_loss, has_aux=True)(
        copies.actor, copies.critic, inputs, latents, image, batch, weighted.weights
    )
    return NetworkGradients(weighted.gradient, _float32(actor), weighted.state, keep, action, metrics)


def critic_of_states(
    objectives: Objectives, copies: ComputeCopies, prepared: PreparedBatch, state: WeightingState, with_actor: bool
) -> NetworkGradients:
    """Compute the gradients if the critic observes true states, the actor images; arguments as for `critic_of_images`."""
    batch, inputs, image, noise = prepared
    (loss, (value, keep)), critic = jax.value_and_grad(objectives.critic_error_on_states, has_aux=True)(
        copies.critic, copies, inputs, batch, noise
    )
    metrics = {"train/critic_loss": loss, "train/value": jnp.mean(value)}
    if not with_actor:
        return NetworkGradients(_float32(critic), None, state, keep, None, metrics)
    weighted = objectives.actor_gradient(copies.critic, inputs.states_t, inputs, image, batch)(copies.actor, state)
    metrics |= {"train/actor_loss": weighted.losses[MAIN], **weighting_metrics(weighted)}
    return NetworkGradients(_float32(critic), weighted.gradient, weighted.state, keep, weighted.extra, metrics)


def weighting_metrics(weighted: Weighted) -> Metrics:
    """Return the metrics of the weighting, and the auxiliary losses."""
    return {
        **{f"train/{name}": number for name, number in weighted.metrics.items()},
        **{f"train/loss/{name}": loss for name, loss in weighted.losses.items() if name != MAIN},
    }


def _float32(gradient: Params) -> Params:
    return jax.tree.map(lambda leaf: leaf.astype(jnp.float32), gradient)
