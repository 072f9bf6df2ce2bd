"""Deep deterministic policy gradient with goals (Lillicrap et al., 2016), one gradient step as pure functions.

    gradients    losses of a batch, and their gradients by name: the main one of each network, and auxiliary ones beside it
    combine      one gradient a network; the place of a weighting
    apply        optimisers, then target networks

Four networks read three observations (before, goal, after). Each is normalised and ordered once, and each network encodes what
it needs in one pass:

    critic, actor (online, with gradient)   before, goal
    their targets                           goal, after

The actor's loss values its actions with the critic's latents from the critic's own forward pass: the actor cannot change them.
"""

import functools
import itertools
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from jaxrl_vis.config import Config, Resolved
from jaxrl_vis.learner import losses, normalizer
from jaxrl_vis.learner.networks import Networks
from jaxrl_vis.types import Batch, Metrics, Params, TrainState

MAIN = "main"
"""Name of the loss that a network has in any case."""


class _ComputeCopies(NamedTuple):
    """Networks of a `TrainState` in the dtype that they are computed with (`Networks.compute_copy`)."""

    actor: Params
    critic: Params
    target_actor: Params
    target_critic: Params


class Working(NamedTuple):
    """A learner between two gradient steps of one iteration. Its insides are this module's own.

    Attributes:
        train: The learner.
        copies: Its parameters as the networks compute with them.
    """

    train: TrainState
    copies: _ComputeCopies


class LossGradients(NamedTuple):
    """Gradients of each loss by its name, float32, shaped like the parameters of the network.

    Attributes:
        critic: `MAIN`, and whatever is learned beside it.
        actor: The same.
    """

    critic: dict[str, Params]
    actor: dict[str, Params]


class Gradients(NamedTuple):
    """What the optimisers get: one gradient for each network, float32."""

    critic: Params
    actor: Params


class Algorithm(NamedTuple):
    """A learner. Pure; all states are pytrees.

    Attributes:
        init: key -> TrainState.
        begin: TrainState -> Working, before the first of several gradient steps.
        gradients: (Working, Batch with rewards) -> (LossGradients, metrics of [] float32).
        apply: (Working, Gradients) -> Working, after one gradient step.
        end: Working -> TrainState.
    """

    init: Callable[[jax.Array], TrainState]
    begin: Callable[[TrainState], Working]
    gradients: Callable[[Working, Batch], tuple[LossGradients, Metrics]]
    apply: Callable[[Working, Gradients], Working]
    end: Callable[[Working], TrainState]


def combine(gradients: LossGradients, weights: Mapping[str, jax.Array] = MappingProxyType({})) -> Gradients:
    """The weighted sum of each network's gradients.

    Args:
        gradients: Of all losses.
        weights: [] float32 by name; a loss without one counts once.
    """

    def scaled(name: str, tree: Params) -> Params:
        if name not in weights:
            return tree
        return jax.tree.map(lambda leaf: weights[name] * leaf, tree)

    def total(named: dict[str, Params]) -> Params:
        return functools.reduce(lambda one, other: jax.tree.map(jnp.add, one, other), itertools.starmap(scaled, named.items()))

    return Gradients(critic=total(gradients.critic), actor=total(gradients.actor))


def _networks_of(state: TrainState) -> tuple[Params, ...]:
    """The four networks' parameters, in the order of `_ComputeCopies`."""
    return state.actor, state.critic, state.target_actor, state.target_critic


def _shares(reward: jax.Array, keep: jax.Array, positive_reward: float) -> Metrics:
    """Shares of the batch that are positives, and of its negatives (only those can be dropped) that are filtered."""
    positive = (reward == positive_reward).astype(jnp.float32)
    return {
        "train/positive_share": jnp.mean(positive),
        "train/filtered_share": jnp.sum(1.0 - keep) / jnp.maximum(jnp.sum(1.0 - positive), 1.0),
    }


def _start(networks: Networks, optimizers: "_Optimizers", key: jax.Array) -> TrainState:
    """A learner that has learned nothing: targets equal the online networks."""
    actor_key, critic_key = jax.random.split(key)
    actor, critic = networks.init_actor(actor_key), networks.init_critic(critic_key)
    separate = networks.config.normalizers == "separate"
    return TrainState(
        actor=actor,
        critic=critic,
        # Copies: a donated buffer must not appear twice.
        target_actor=jax.tree.map(jnp.copy, actor),
        target_critic=jax.tree.map(jnp.copy, critic),
        actor_optimizer=optimizers.actor.init(actor),
        critic_optimizer=optimizers.critic.init(critic),
        normalizer=normalizer.init(networks.observation_spec),
        goal_normalizer=normalizer.init(networks.observation_spec) if separate else None,
        updates=jnp.zeros((), jnp.int32),
    )


class _Optimizers(NamedTuple):
    actor: optax.GradientTransformation
    critic: optax.GradientTransformation


def _apply(state: TrainState, gradients: Gradients, optimizers: _Optimizers, config: Config) -> TrainState:
    """One step of both optimisers, and the targets a little after the online networks."""
    critic_change, critic_moments = optimizers.critic.update(gradients.critic, state.critic_optimizer)
    actor_change, actor_moments = optimizers.actor.update(gradients.actor, state.actor_optimizer)
    actor = optax.apply_updates(state.actor, actor_change)
    critic = optax.apply_updates(state.critic, critic_change)
    updates = state.updates + 1
    follow = jnp.where(updates % config.target_update_interval == 0, 1.0 - config.target_decay, 0.0)
    return state.replace(
        actor=actor,
        critic=critic,
        target_actor=optax.incremental_update(actor, state.target_actor, follow),
        target_critic=optax.incremental_update(critic, state.target_critic, follow),
        actor_optimizer=actor_moments,
        critic_optimizer=critic_moments,
        updates=updates,
    )


def make_ddpg(networks: Networks, config: Config, resolved: Resolved) -> Algorithm:
    """DDPG for these networks.

    Args:
        networks: What the parameters mean.
        config: Learning rates, target decay, action penalty.
        resolved: Discount, bounds of the targets, filter threshold.
    """
    optimizers = _Optimizers(optax.adam(config.actor_learning_rate), optax.adam(config.critic_learning_rate))

    def begin(train: TrainState) -> Working:
        return Working(train, _ComputeCopies(*map(networks.compute_copy, _networks_of(train))))

    def encode_pair(params: Params, inputs: jax.Array, first: int) -> jax.Array:
        """Latents [2, B, latent] of observations ``first`` and ``first`` + 1 of the three."""
        size = inputs.shape[0] // 3
        return networks.encode(params, inputs, slice(first * size, (first + 2) * size)).reshape(2, size, -1)

    def critic_loss(critic: Params, inputs: jax.Array, action: jax.Array, reward: jax.Array, target: jax.Array):
        latents = encode_pair(critic, inputs, 0)
        value = networks.value(critic, latents, action)
        keep = losses.keep_mask(reward, value, resolved.reward_negative, resolved.filter_threshold)
        loss = losses.critic_loss(value, target, keep)
        return loss, (latents, value, keep)

    def actor_loss(actor: Params, critic: Params, inputs: jax.Array, critic_latents: jax.Array):
        action = networks.act(actor, encode_pair(actor, inputs, 0))
        value = networks.value(critic, critic_latents, action)
        return losses.actor_loss(value, action, config.action_penalty), action

    def gradients(working: Working, batch: Batch) -> tuple[LossGradients, Metrics]:
        assert batch.reward is not None
        now = _ComputeCopies(*map(networks.with_compute_copy, _networks_of(working.train), working.copies))
        # Before, goal, after: the online networks read the first two, their targets the last two.
        inputs = networks.prepare_batch(working.train, batch)

        # The targets' observations come as (goal, after); the heads take them the other way round.
        action_tp1 = networks.act(now.target_actor, encode_pair(now.target_actor, inputs, 1)[::-1])
        value_tp1 = networks.value(now.target_critic, encode_pair(now.target_critic, inputs, 1)[::-1], action_tp1)
        target = losses.td_target(batch.reward, value_tp1, resolved.discount, resolved.target_minimum, resolved.target_maximum)

        (critic_error, (latents, value, keep)), critic_gradient = jax.value_and_grad(critic_loss, has_aux=True)(
            now.critic, inputs, batch.action, batch.reward, target
        )
        (policy_loss, action), actor_gradient = jax.value_and_grad(actor_loss, has_aux=True)(
            now.actor, now.critic, inputs, latents
        )
        critic_gradient, actor_gradient = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), (critic_gradient, actor_gradient))
        metrics = {
            "train/critic_loss": critic_error,
            "train/actor_loss": policy_loss,
            "train/value": jnp.mean(value),
            "train/action_size": jnp.sqrt(jnp.mean(jnp.square(action))),
            **_shares(batch.reward, keep, resolved.reward_positive),
        }
        return LossGradients({MAIN: critic_gradient}, {MAIN: actor_gradient}), metrics

    return Algorithm(
        init=lambda key: _start(networks, optimizers, key),
        begin=begin,
        gradients=gradients,
        apply=lambda working, chosen: begin(_apply(working.train, chosen, optimizers, config)),
        end=lambda working: working.train,
    )
