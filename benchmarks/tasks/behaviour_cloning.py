"""Behaviour cloning with relabelled goals as a custom algorithm: ``--algorithm benchmarks.tasks.behaviour_cloning:make``.

The actor of the built-in networks (`Networks`) imitates the action taken on the way to a goal that the episode reached later:
the simplest offline learner, in one file with the interface of the built-in algorithms.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxrl_vis.learner.algorithm import Algorithm, Setup, scan_batches
from jaxrl_vis.learner.ddpg import adam
from jaxrl_vis.learner.networks.networks import Networks
from jaxrl_vis.learner.networks.policy import make_policy
from jaxrl_vis.types import Batch, Metrics, Params, Statistics


class AgentState(NamedTuple):
    """Parameters of the actor and state of its optimiser (Adam)."""

    actor: Params
    optimizer: Any


def make(setup: Setup) -> Algorithm:
    """Build behaviour cloning: mean squared error between the actor's action and the batch's, with an encoder of its own."""
    config = setup.config.replace(encoders="separate")  # the actor has an encoder of its own: there is no critic
    networks = Networks(config, setup.observation_spec, setup.action_size, 0.0)
    policy = make_policy(networks)

    def init(key: jax.Array) -> AgentState:
        actor = networks.init_actor(key)
        return AgentState(actor, adam.init(actor))

    def step(agent: AgentState, statistics: Statistics, batch: Batch, key: jax.Array) -> tuple[AgentState, Metrics]:
        inputs = networks.prepare_batch(networks.batch_scaling(statistics), batch)

        def loss(actor: Params) -> jax.Array:
            latents = networks.encode_pieces(actor, inputs.pieces("before", "goal")).reshape(2, inputs.size, -1)
            return jnp.mean(jnp.square(networks.act(actor, latents) - batch.action))

        value, gradient = jax.value_and_grad(loss)(agent.actor)
        value, gradient = setup.shards.mean((value, gradient))
        count = adam.count(agent.optimizer) + 1
        correction = adam.corrections(count[None])[0]
        actor, moments = adam.step(agent.actor, gradient, agent.optimizer, config.ddpg.actor_learning_rate, correction)
        return AgentState(actor, adam.with_count(moments, count)), {"train/imitation_loss": value}

    def policy_params(agent: AgentState, statistics: Statistics) -> Any:
        return policy.params(agent.actor, statistics)

    return Algorithm(init, policy.act, scan_batches(step), policy_params, policy.encode_goal)
