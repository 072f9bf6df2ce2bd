"""Deterministic policy with an actor of `Networks`, and the statistics that normalise its observations.

Implements `Algorithm.act`, ``encode_goal`` and ``policy_params`` for any algorithm with such an actor.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxrl_vis.learner.networks.networks import Networks
from jaxrl_vis.types import NormalizerState, Params, Statistics


class PolicyParams(NamedTuple):
    """Parameters of the policy.

    Attributes:
        actor: Parameters of the actor, for images including an encoder (its own or the critic's).
        observations, goals: Statistics for normalising observations and goals.
    """

    actor: Params
    observations: NormalizerState
    goals: NormalizerState


class Policy(NamedTuple):
    """Policy of given networks; pure functions.

    Attributes:
        params: (actor parameters with an encoder, Statistics) -> PolicyParams.
        encode_goal: (PolicyParams, goals [E, ...]) -> latents [E, latent], computed once per episode.
        act: (PolicyParams, observations [E, ...], latents of the goals [E, latent]) -> actions [E, A] float32 in [-1, 1].
    """

    params: Callable[[Params, Statistics], PolicyParams]
    encode_goal: Callable[[PolicyParams, jax.Array], jax.Array]
    act: Callable[[PolicyParams, jax.Array, jax.Array], jax.Array]


def make_policy(networks: Networks) -> Policy:
    """Build the policy of these networks."""

    def encode(policy: PolicyParams, statistics: NormalizerState, observations: jax.Array) -> jax.Array:
        return networks.encode(policy.actor, networks.prepare(networks.scaling(statistics), observations))

    def act(policy: PolicyParams, observations: jax.Array, encoded_goal: jax.Array) -> jax.Array:
        return networks.act(policy.actor, jnp.stack([encode(policy, policy.observations, observations), encoded_goal]))

    return Policy(
        params=lambda actor, statistics: PolicyParams(actor, statistics.observations, statistics.goals),
        encode_goal=lambda policy, goals: encode(policy, policy.goals, goals),
        act=act,
    )
