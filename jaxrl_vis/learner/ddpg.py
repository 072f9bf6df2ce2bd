"""Deep deterministic policy gradient with goals (Lillicrap et al., 2016), one gradient step as one pure function.

Four networks read three images (observation, goal, next observation). Each image is normalised and ordered once, and each
network encodes what it needs in one pass:

    critic, actor (online, with gradient)   observation, goal
    their targets                           goal, next observation

The actor's loss values its actions with the critic's latents from the critic's own forward pass: the actor cannot change them.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from jaxrl_vis.config import Config, Resolved
from jaxrl_vis.learner import losses, normalizer
from jaxrl_vis.learner.networks import Networks
from jaxrl_vis.types import Batch, Metrics, Params, TrainState


class Working(NamedTuple):
    """Networks of a `TrainState` in the dtype that they are computed with (`Networks.working_copy`)."""

    actor: Params
    critic: Params
    target_actor: Params
    target_critic: Params


class Algorithm(NamedTuple):
    """A learner. Pure; `TrainState` and `Working` are pytrees.

    Attributes:
        init: key -> TrainState.
        working: TrainState -> Working, made anew from it before the first of several updates.
        update: (TrainState, its Working, Batch, reward [B] float32) -> (TrainState, Working, metrics of [] float32).
    """

    init: Callable[[jax.Array], TrainState]
    working: Callable[[TrainState], Working]
    update: Callable[[TrainState, Working, Batch, jax.Array], tuple[TrainState, Working, Metrics]]


def _networks_of(state: TrainState) -> tuple[Params, ...]:
    """The four networks' parameters, in the order of `Working`."""
    return state.actor, state.critic, state.target_actor, state.target_critic


def _shares(reward: jax.Array, keep: jax.Array, positive_reward: float) -> Metrics:
    """Shares of the batch that are positives, and of its negatives (only those can be dropped) that are filtered."""
    positive = (reward == positive_reward).astype(jnp.float32)
    return {
        "train/positive_share": jnp.mean(positive),
        "train/filtered_share": jnp.sum(1.0 - keep) / jnp.maximum(jnp.sum(1.0 - positive), 1.0),
    }


def _start(
    networks: Networks,
    actor_optimizer: optax.GradientTransformation,
    critic_optimizer: optax.GradientTransformation,
    key: jax.Array,
) -> TrainState:
    """A learner that has learned nothing: targets equal the online networks."""
    actor_key, critic_key = jax.random.split(key)
    actor, critic = networks.init_actor(actor_key), networks.init_critic(critic_key)
    return TrainState(
        actor=actor,
        critic=critic,
        # Copies: a donated buffer must not appear twice.
        target_actor=jax.tree.map(jnp.copy, actor),
        target_critic=jax.tree.map(jnp.copy, critic),
        actor_optimizer=actor_optimizer.init(actor),
        critic_optimizer=critic_optimizer.init(critic),
        normalizer=normalizer.init(networks.observation_spec),
        updates=jnp.zeros((), jnp.int32),
    )


def make_ddpg(networks: Networks, config: Config, resolved: Resolved) -> Algorithm:
    """DDPG for these networks.

    Args:
        networks: What the parameters mean.
        config: Learning rates, target decay, action penalty.
        resolved: Discount, bounds of the targets, filter threshold.
    """
    actor_optimizer = optax.adam(config.actor_learning_rate)
    critic_optimizer = optax.adam(config.critic_learning_rate)

    def init(key: jax.Array) -> TrainState:
        return _start(networks, actor_optimizer, critic_optimizer, key)

    def working(state: TrainState) -> Working:
        return Working(*map(networks.working_copy, _networks_of(state)))

    def encode_pair(params: Params, inputs: jax.Array, first: int) -> jax.Array:
        """Latents [2, B, latent] of images ``first`` and ``first`` + 1 of the three."""
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

    def update(state: TrainState, copies: Working, batch: Batch, reward: jax.Array) -> tuple[TrainState, Working, Metrics]:
        now = Working(*map(networks.with_working_copy, _networks_of(state), copies))
        # Observation, goal, next observation: the online networks read the first two, their targets the last two.
        inputs = networks.prepare(state.normalizer, batch.frames.reshape(-1, *batch.frames.shape[2:]))

        # Turned round: their images come as (goal, observation).
        action_tp1 = networks.act(now.target_actor, encode_pair(now.target_actor, inputs, 1)[::-1])
        value_tp1 = networks.value(now.target_critic, encode_pair(now.target_critic, inputs, 1)[::-1], action_tp1)
        target = losses.td_target(reward, value_tp1, resolved.discount, resolved.target_minimum, resolved.target_maximum)

        (critic_error, (latents, value, keep)), critic_gradient = jax.value_and_grad(critic_loss, has_aux=True)(
            now.critic, inputs, batch.action, reward, target
        )
        (policy_loss, action), actor_gradient = jax.value_and_grad(actor_loss, has_aux=True)(
            now.actor, now.critic, inputs, latents
        )

        critic_gradient, actor_gradient = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), (critic_gradient, actor_gradient))
        critic_change, critic_moments = critic_optimizer.update(critic_gradient, state.critic_optimizer)
        actor_change, actor_moments = actor_optimizer.update(actor_gradient, state.actor_optimizer)
        actor = optax.apply_updates(state.actor, actor_change)
        critic = optax.apply_updates(state.critic, critic_change)
        updates = state.updates + 1
        follow = jnp.where(updates % config.target_update_interval == 0, 1.0 - config.target_decay, 0.0)
        state = state.replace(
            actor=actor,
            critic=critic,
            target_actor=optax.incremental_update(actor, state.target_actor, follow),
            target_critic=optax.incremental_update(critic, state.target_critic, follow),
            actor_optimizer=actor_moments,
            critic_optimizer=critic_moments,
            updates=updates,
        )
        metrics = {
            "train/critic_loss": critic_error,
            "train/actor_loss": policy_loss,
            "train/value": jnp.mean(value),
            "train/action_size": jnp.sqrt(jnp.mean(jnp.square(action))),
            **_shares(reward, keep, resolved.reward_positive),
        }
        return state, working(state), metrics

    return Algorithm(init=init, working=working, update=update)
