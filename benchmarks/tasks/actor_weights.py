"""DDPG whose actor weights its auxiliary losses by products with the gradient of its own loss, not by the critic's weights.

--algorithm benchmarks.tasks.actor_weights:ddpg --actor-log loss

The weights of the critic are learned as always, and logged as ``train/weight/NAME``; those of the actor are logged as
``train/actor_weight/NAME``.
"""

from typing import Any

import jax
import jax.numpy as jnp

from jaxrl_vis.errors import RequestError
from jaxrl_vis.learner.algorithm import Algorithm, Setup
from jaxrl_vis.learner.ddpg import ddpg as base
from jaxrl_vis.learner.ddpg.network_gradients import NetworkGradients, PreparedBatch, weighting_metrics
from jaxrl_vis.learner.ddpg.objectives import ComputeCopies, Objectives
from jaxrl_vis.weighting import MAIN


def ddpg(setup: Setup) -> Algorithm:
    """Build DDPG with the states of two weightings, (critic's, actor's), in `Agent.weighting`.

    Raises:
        RequestError: The actor has no encoder of its own, the critic observes true states, there are no auxiliary losses, or
            the logarithm of the actor's loss is not that of the whole loss.
    """
    config = setup.config
    if config.network.encoders == "shared" or setup.critic_state_size or not setup.auxiliary.tasks:
        raise RequestError("actor_weights needs images for both networks, encoders separate, and aux_tasks")
    if config.ddpg.actor_log != "loss":
        raise RequestError("actor_weights takes the logarithm of the actor's whole loss: add --actor-log loss")
    algorithm = base.build(setup, compute=compute)

    def init(key: jax.Array) -> base.Agent:
        agent = algorithm.init(key)
        return agent.replace(weighting=(agent.weighting, setup.auxiliary.init_state(agent.actor, key)))

    return algorithm._replace(init=init)


def compute(
    objectives: Objectives, copies: ComputeCopies, prepared: PreparedBatch, state: Any, with_actor: bool
) -> NetworkGradients:
    """Compute the gradients of both networks, each weighted on its own; arguments as `network_gradients.critic_of_images`."""
    batch, inputs, image, noise = prepared
    of_critic, of_actor = state
    weighted = objectives.critic_gradient(copies, inputs, image, batch, noise)(copies.critic, of_critic)
    latents, value, keep = weighted.extra
    metrics = {"train/critic_loss": weighted.losses[MAIN], "train/value": jnp.mean(value), **weighting_metrics(weighted)}
    if not with_actor:
        return NetworkGradients(weighted.gradient, None, (weighted.state, of_actor), keep, None, metrics)
    acted = objectives.actor_gradient(copies.critic, latents.pair, inputs, image, batch)(copies.actor, of_actor)
    metrics["train/actor_loss"] = acted.losses[MAIN]
    metrics |= {f"train/actor_{name}": number for name, number in acted.metrics.items()}
    return NetworkGradients(weighted.gradient, acted.gradient, (weighted.state, acted.state), keep, acted.extra, metrics)
