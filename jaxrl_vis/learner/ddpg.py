"""Deep deterministic policy gradient with goals (Lillicrap et al., 2016), one gradient step as pure functions.

    gradients    losses of a batch, and their gradients by name: the main one of each network, and auxiliary ones beside it
    combine      one gradient a network; the place of a weighting
    apply        optimisers, then target networks

Four networks read three observations (before, goal, after). Each is normalised and ordered once, and each network encodes what
it needs in one pass:

    critic, actor (online, with gradient)   before, goal
    their targets                           goal, after

The actor's loss values its actions with the critic's latents from the critic's own forward pass: the actor cannot change them.

Encoding images is most of the work, and `Config` can save some of it: ``encoders="shared"`` lets the actor act on the critic's
latents, too, ``target_encoder=False`` computes targets with the online encoders, and ``actor_interval`` spares the actor steps.
"""

import functools
import itertools
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

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
        actor: The same; empty in a step of the critic alone.
    """

    critic: dict[str, Params]
    actor: dict[str, Params]


class Gradients(NamedTuple):
    """What the optimisers get: one gradient for each network, float32; None for an actor that stays as it is."""

    critic: Params
    actor: Params | None


class Algorithm(NamedTuple):
    """A learner. Pure; all states are pytrees.

    Attributes:
        init: key -> TrainState.
        begin: TrainState -> Working, before the first of several gradient steps.
        gradients: (Working, Batch with rewards, whether for the actor, too) -> (LossGradients, metrics of [] float32).
        apply: (Working, Gradients) -> Working, after one gradient step.
        end: Working -> TrainState.
    """

    init: Callable[[jax.Array], TrainState]
    begin: Callable[[TrainState], Working]
    gradients: Callable[[Working, Batch, bool], tuple[LossGradients, Metrics]]
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
        if not named:
            return None
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
        target_actor=networks.init_target(actor),
        target_critic=networks.init_target(critic),
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
    critic, critic_moments = _step(optimizers.critic, state.critic, gradients.critic, state.critic_optimizer)
    actor, actor_moments = state.actor, state.actor_optimizer
    if gradients.actor is not None:
        actor, actor_moments = _step(optimizers.actor, actor, gradients.actor, actor_moments)
    updates = state.updates + 1
    follow = jnp.where(updates % config.target_update_interval == 0, 1.0 - config.target_decay, 0.0)

    def followed(online: Params, target: Params) -> Params:
        return optax.incremental_update({part: online[part] for part in target}, target, follow)

    return state.replace(
        actor=actor,
        critic=critic,
        target_actor=followed(actor, state.target_actor),
        target_critic=followed(critic, state.target_critic),
        actor_optimizer=actor_moments,
        critic_optimizer=critic_moments,
        updates=updates,
    )


def _step(optimizer: optax.GradientTransformation, params: Params, gradient: Params, moments: Any) -> tuple[Params, Any]:
    change, moments = optimizer.update(gradient, moments)
    return optax.apply_updates(params, change), moments


def _encode(networks: Networks, params: Params, inputs: jax.Array, first: int, count: int = 2) -> jax.Array:
    """Latents [count, B, latent] of observations ``first``, ``first`` + 1, ... of the three."""
    size = inputs.shape[0] // 3
    return networks.encode(params, inputs, slice(first * size, (first + count) * size)).reshape(count, size, -1)


def _next_latents(
    networks: Networks, now: _ComputeCopies, inputs: jax.Array, latents: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Latents [2, B, latent] of the observation after and the goal, for the target actor and for the target critic.

    Heads take them in this order; observations come as (goal, after). ``latents`` are the critic's of the first two.
    """
    if networks.config.target_encoder:
        of_critic = _encode(networks, now.target_critic, inputs, 1)[::-1]
    else:
        of_critic = jnp.concatenate([_encode(networks, now.critic, inputs, 2, count=1), latents[1:]])
    if networks.config.encoders == "shared":
        return of_critic, of_critic
    return _encode(networks, networks.with_encoder(now.target_actor, now.actor), inputs, 1)[::-1], of_critic


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

    def make_target(now: _ComputeCopies, inputs: jax.Array, latents: jax.Array, batch: Batch) -> jax.Array:
        assert batch.reward is not None
        of_actor, of_critic = _next_latents(networks, now, inputs, jax.lax.stop_gradient(latents))
        value_tp1 = networks.value(now.target_critic, of_critic, networks.act(now.target_actor, of_actor))
        discount = resolved.discount if batch.discount is None else batch.discount
        return losses.td_target(batch.reward, value_tp1, discount, resolved.target_minimum, resolved.target_maximum)

    def critic_loss(critic: Params, now: _ComputeCopies, inputs: jax.Array, batch: Batch):
        assert batch.reward is not None
        latents = _encode(networks, critic, inputs, 0)
        target = make_target(now, inputs, latents, batch)
        value = networks.value(critic, latents, batch.action)
        keep = losses.keep_mask(batch.reward, value, resolved.reward_negative, resolved.filter_threshold)
        return losses.critic_loss(value, target, keep), (latents, value, keep)

    def actor_loss(actor: Params, critic: Params, inputs: jax.Array, critic_latents: jax.Array):
        latents = critic_latents if config.encoders == "shared" else _encode(networks, actor, inputs, 0)
        action = networks.act(actor, latents)
        value = networks.value(critic, critic_latents, action)
        return losses.actor_loss(value, action, config.action_penalty), action

    def in_float32(tree: Params) -> Params:
        return jax.tree.map(lambda leaf: leaf.astype(jnp.float32), tree)

    def gradients(working: Working, batch: Batch, with_actor: bool = True) -> tuple[LossGradients, Metrics]:
        assert batch.reward is not None
        now = _ComputeCopies(*map(networks.with_compute_copy, _networks_of(working.train), working.copies))
        # Before, goal, after: the online networks read the first two, their targets the last two.
        inputs = networks.prepare_batch(working.train, batch)
        (critic_error, (latents, value, keep)), critic_gradient = jax.value_and_grad(critic_loss, has_aux=True)(
            now.critic, now, inputs, batch
        )
        metrics = {
            "train/critic_loss": critic_error,
            "train/value": jnp.mean(value),
            **_shares(batch.reward, keep, resolved.reward_positive),
        }
        found = LossGradients({MAIN: in_float32(critic_gradient)}, {})
        if with_actor:
            (policy_loss, action), actor_gradient = jax.value_and_grad(actor_loss, has_aux=True)(
                now.actor, now.critic, inputs, latents
            )
            found = found._replace(actor={MAIN: in_float32(actor_gradient)})
            metrics["train/actor_loss"] = policy_loss
            metrics["train/action_size"] = jnp.sqrt(jnp.mean(jnp.square(action)))
        return found, metrics

    return Algorithm(
        init=lambda key: _start(networks, optimizers, key),
        begin=begin,
        gradients=gradients,
        apply=lambda working, chosen: begin(_apply(working.train, chosen, optimizers, config)),
        end=lambda working: working.train,
    )
