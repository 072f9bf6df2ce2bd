"""Deep deterministic policy gradient with goals (Lillicrap et al., 2016), one gradient step as pure functions.

    gradients    losses of a batch, main and auxiliary, and one weighted gradient for each network
    apply        optimisers, then target networks

Four networks read three observations (before, goal, after). Each is normalised and ordered once, and each network encodes what
it needs in one pass:

    critic, actor (online, with gradient)   before, goal, and for auxiliary tasks after, moved
    their targets                           goal, after

The actor's loss values its actions with the critic's latents from the critic's own forward pass: the actor cannot change them.

Encoding images is most of the work, and `Config` can save some of it: ``encoders="shared"`` lets the actor act on the critic's
latents, too, ``target_encoder=False`` computes targets with the online encoders, and ``actor_interval`` spares the actor steps.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from jaxrl_vis.config import Config, Resolved
from jaxrl_vis.learner import diagnostics, losses, normalizer
from jaxrl_vis.learner.auxiliary import Auxiliary, make_auxiliary
from jaxrl_vis.learner.auxtasks import View
from jaxrl_vis.learner.latent_reward import LatentReward, make_latent_reward
from jaxrl_vis.learner.networks import Networks
from jaxrl_vis.learner.shards import ONE, Shards
from jaxrl_vis.learner.weighting import MAIN, Weighted, WeightingState, weighted_grad
from jaxrl_vis.types import Batch, Metrics, Params, TrainState

# Folded into the networks' keys for the heads of auxiliary tasks, so that these change nothing else.
_HEADS = 0x686473
# The same for the autoencoder that makes rewards.
_AUTOENCODER = 0x617574


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
        held: The critic's parameters that the weighting's interval began with, for a weighting that asks for them; else None.
    """

    train: TrainState
    copies: _ComputeCopies
    held: Params = None


class Gradients(NamedTuple):
    """What a batch changes.

    Attributes:
        critic, actor: For the optimisers, float32; None for an actor that stays as it is.
        weighting: Of the auxiliary losses, after this batch; None where there is nothing to remember.
        autoencoder: For the optimiser of the autoencoder that makes rewards; None where there is none.
    """

    critic: Params
    actor: Params | None
    weighting: WeightingState | None = None
    autoencoder: Params | None = None


class Algorithm(NamedTuple):
    """A learner. Pure; all states are pytrees.

    Attributes:
        init: key -> TrainState.
        begin: TrainState -> Working, before the first of several gradient steps.
        gradients: (Working, Batch with rewards, whether for the actor, too) -> (Gradients, metrics of [] float32).
        apply: (Working, Gradients) -> Working, after one gradient step.
        end: Working -> TrainState.
        value_at_goals: (TrainState, goals [E, ...]) -> [] float32, the mean value of the policy's actions where the goal itself
            is observed.
    """

    init: Callable[[jax.Array], TrainState]
    begin: Callable[[TrainState], Working]
    gradients: Callable[[Working, Batch, bool], tuple[Gradients, Metrics]]
    apply: Callable[[Working, Gradients], Working]
    end: Callable[[Working], TrainState]
    value_at_goals: Callable[[TrainState, jax.Array], jax.Array]


def _networks_of(state: TrainState) -> tuple[Params, ...]:
    """The four networks' parameters, in the order of `_ComputeCopies`."""
    return state.actor, state.critic, state.target_actor, state.target_critic


def _start(
    networks: Networks, auxiliary: Auxiliary, latent_reward: LatentReward | None, optimizers: "_Optimizers", key: jax.Array
) -> TrainState:
    """A learner that has learned nothing: targets equal the online networks."""
    actor_key, critic_key = jax.random.split(key)
    actor, critic = networks.init_actor(actor_key), networks.init_critic(critic_key)
    target_actor, target_critic = networks.init_target(actor), networks.init_target(critic)
    if auxiliary.tasks:
        actor_key, critic_key = (jax.random.fold_in(each, _HEADS) for each in (actor_key, critic_key))
        critic["heads"] = auxiliary.init_heads(critic_key)
        if "encoder" in actor:
            actor["heads"] = auxiliary.init_heads(actor_key)
    separate = networks.config.normalizers == "separate"
    return TrainState(
        actor=actor,
        critic=critic,
        target_actor=target_actor,
        target_critic=target_critic,
        actor_optimizer=optimizers.actor.init(actor),
        critic_optimizer=optimizers.critic.init(critic),
        normalizer=normalizer.init(networks.observation_spec),
        goal_normalizer=normalizer.init(networks.observation_spec) if separate else None,
        updates=jnp.zeros((), jnp.int32),
        weighting=auxiliary.init_state(critic.get("encoder")),
        autoencoder=None if latent_reward is None else latent_reward.init(jax.random.fold_in(key, _AUTOENCODER)),
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
        weighting=gradients.weighting,
    )


def _step(optimizer: optax.GradientTransformation, params: Params, gradient: Params, moments: Any) -> tuple[Params, Any]:
    change, moments = optimizer.update(gradient, moments)
    return optax.apply_updates(params, change), moments


def _encode(networks: Networks, params: Params, inputs: jax.Array, size: int, first: int, count: int = 2) -> jax.Array:
    """Latents [count, B, latent] of observations ``first``, ``first`` + 1, ... of those of a batch of ``size`` transitions."""
    return networks.encode(params, inputs, slice(first * size, (first + count) * size)).reshape(count, size, -1)


class _Latents(NamedTuple):
    """Latents of a transition's observations by one online network, [B, latent] each.

    Attributes:
        pair: [2, B, latent] before and goal, as heads take them.
        before: The first of them.
        after, moved: None where no loss reads them.
    """

    pair: jax.Array
    before: jax.Array
    after: jax.Array | None = None
    moved: jax.Array | None = None


def _encode_online(networks: Networks, auxiliary: Auxiliary, params: Params, inputs: jax.Array, size: int) -> _Latents:
    """Latents of all observations that losses read, with gradient.

    Most auxiliary losses read two of them or one. Encoded one by one, the gradient of each loss passes through these alone.
    """
    if not auxiliary.tasks:
        pair = _encode(networks, params, inputs, size, 0)
        return _Latents(pair, pair[0])
    before, goal, *others = (_encode(networks, params, inputs, size, n, count=1)[0] for n in range(auxiliary.observations))
    return _Latents(jnp.stack([before, goal]), before, *others)


def _next_latents(networks: Networks, now: _ComputeCopies, inputs: jax.Array, latents: _Latents) -> tuple[jax.Array, jax.Array]:
    """Latents [2, B, latent] of the observation after and the goal, for the target actor and for the target critic.

    Heads take them in this order; observations come as (goal, after). ``latents`` are the online critic's.
    """
    size = latents.before.shape[0]
    if networks.config.target_encoder:
        of_critic = _encode(networks, now.target_critic, inputs, size, 1)[::-1]
    else:
        after = latents.after
        after = _encode(networks, now.critic, inputs, size, 2, count=1) if after is None else after[None]
        of_critic = jnp.concatenate([after, latents.pair[1:]])
    if networks.config.encoders == "shared":
        return of_critic, of_critic
    of_actor = _encode(networks, networks.with_encoder(now.target_actor, now.actor), inputs, size, 1)[::-1]
    return of_actor, of_critic


def _value_at_goals(networks: Networks, train: TrainState, goals: jax.Array) -> jax.Array:
    """`Algorithm.value_at_goals`."""
    statistics = (train.normalizer,) if train.goal_normalizer is None else (train.normalizer, train.goal_normalizer)
    inputs = [networks.prepare(each, goals) for each in statistics]

    def latents(params: Params) -> jax.Array:
        encoded = [networks.encode(params, each) for each in inputs]
        return jnp.stack([encoded[0], encoded[-1]])

    action = networks.act(train.actor, latents(networks.with_encoder(train.actor, train.critic)))
    return jnp.mean(networks.value(train.critic, latents(train.critic), action))


def make_ddpg(
    networks: Networks, config: Config, resolved: Resolved, auxiliary: Auxiliary | None = None, shards: Shards = ONE
) -> Algorithm:
    """DDPG for these networks.

    Args:
        networks: What the parameters mean.
        config: Learning rates, target decay, action penalty.
        resolved: Discount, bounds of the targets, filter threshold.
        auxiliary: What is learned beside; None for what ``config`` asks for, without stacked images.
        shards: Of the learner: batches are those of one part, gradients and metrics those of the whole.
    """
    if auxiliary is None:
        auxiliary = make_auxiliary(config, networks.observation_spec, networks.action_size, 1, networks.dtype)
    optimizers = _Optimizers(optax.adam(config.actor_learning_rate), optax.adam(config.critic_learning_rate))
    latent_reward = make_latent_reward(networks, config, resolved, auxiliary.frame_stack)
    learning = _Losses(networks, config, resolved, auxiliary, shards)
    keeps_state, held = auxiliary.weighting.name != "none", auxiliary.weighting.held

    def begin(train: TrainState, held: Params = None) -> Working:
        return Working(train, _ComputeCopies(*map(networks.compute_copy, _networks_of(train))), held)

    def gradients(working: Working, batch: Batch, with_actor: bool = True) -> tuple[Gradients, Metrics]:
        train = working.train
        now = _ComputeCopies(*map(networks.with_compute_copy, _networks_of(train), working.copies))
        # Before, goal, after, moved: the online networks read the first two, their targets the second and third.
        inputs = networks.prepare_batch(train, batch)
        rewarded = None if latent_reward is None else latent_reward.of_batch(train, inputs, batch)
        if rewarded is not None:
            batch = batch.replace(reward=rewarded.reward)
        assert batch.reward is not None
        image = networks.normalize(train.normalizer, batch.observation_t) if "image" in auxiliary.needs else None
        found = learning.of_critic(now, train.weighting, inputs, image, batch, working.held)
        latents, value, keep = found.extra
        counts = diagnostics.count_rewards(
            batch.reward, keep, resolved.reward_positive, resolved.reward_negative, batch.success, rewarded is not None
        )
        metrics = {
            "train/critic_loss": found.losses[MAIN],
            "train/value": jnp.mean(value),
            **{f"train/{name}": number for name, number in found.metrics.items()},
            **{f"train/loss/{name}": loss for name, loss in found.losses.items() if name != MAIN},
        }
        actor_gradient, mean_square = None, None
        if with_actor:
            (policy_loss, action), actor_gradient = jax.value_and_grad(learning.of_actor, has_aux=True)(
                now.actor, now.critic, inputs, latents, image, batch, found.weights
            )
            actor_gradient = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), actor_gradient)
            metrics["train/actor_loss"], mean_square = policy_loss, jnp.mean(jnp.square(action))
        if rewarded is not None:
            metrics["train/autoencoder_loss"] = rewarded.loss
        of_autoencoder = rewarded.gradient if rewarded is not None else None
        # Of a learner in several parts, this is the one thing that an update waits for the others for.
        own_gradient = None if learning.reduces_early else found.gradient
        own_gradient, actor_gradient, of_autoencoder, metrics, mean_square, counts = shards.mean(
            (own_gradient, actor_gradient, of_autoencoder, metrics, mean_square, counts)
        )
        if mean_square is not None:
            metrics["train/action_size"] = jnp.sqrt(mean_square)
        metrics |= {f"train/{name}": share for name, share in diagnostics.shares(counts, shards.count).items()}
        critic_gradient = found.gradient if own_gradient is None else own_gradient
        return Gradients(critic_gradient, actor_gradient, found.state if keeps_state else None, of_autoencoder), metrics

    def apply(working: Working, chosen: Gradients) -> Working:
        train = _apply(working.train, chosen, optimizers, config)
        if latent_reward is not None:
            train = train.replace(autoencoder=latent_reward.apply(train.autoencoder, chosen.autoencoder))
        if not held:
            return begin(train)
        is_new = train.weighting.updates % auxiliary.weighting.interval == 0
        return begin(train, jax.tree.map(lambda now, before: jnp.where(is_new, now, before), train.critic, working.held))

    return Algorithm(
        init=lambda key: _start(networks, auxiliary, latent_reward, optimizers, key),
        begin=lambda train: begin(train, train.critic if held else None),
        gradients=gradients,
        apply=apply,
        end=lambda working: working.train,
        value_at_goals=functools.partial(_value_at_goals, networks),
    )


@dataclasses.dataclass(frozen=True)
class _Losses:
    """The losses of both networks and their weighted gradients, for one configuration."""

    networks: Networks
    config: Config
    resolved: Resolved
    auxiliary: Auxiliary
    shards: Shards

    @property
    def reduces_early(self) -> bool:
        """Whether the critic's gradients are averaged over the parts of a learner before they are weighted.

        A weighting that takes logarithms of losses, or compares gradients, must see those of the whole learner. What others
        make of them is a sum, which may be averaged afterwards, together with all else.
        """
        weighting = self.auxiliary.weighting
        return self.shards.count > 1 and (weighting.needs != "losses" or weighting.log)

    def of_critic(
        self,
        now: _ComputeCopies,
        state: WeightingState | None,
        inputs: jax.Array,
        image: jax.Array | None,
        batch: Batch,
        held: Params,
    ) -> Weighted:
        """The critic's losses and their gradient; ``extra`` is (latents, values [B], keep [B])."""
        networks, weighting = self.networks, self.auxiliary.weighting
        size = batch.action.shape[0]

        def critic_losses(critic: Params):
            assert batch.reward is not None
            latents = _encode_online(networks, self.auxiliary, critic, inputs, size)
            target = self._target(now, inputs, latents, batch)
            value = networks.value(critic, latents.pair, batch.action)
            keep = losses.keep_mask(batch.reward, value, self.resolved.reward_negative, self.resolved.filter_threshold)
            others = self._auxiliary(critic, latents, image, batch)
            return {MAIN: losses.critic_loss(value, target, keep, self._kept(keep)), **others}, (latents, value, keep)

        # Weightings that compare no gradients need one backward pass only, which the last way of finding them takes.
        way = "jvp" if weighting.needs == "losses" else self.config.aux_gradients
        options = {"reduce": self.shards.mean} if self.reduces_early else {}
        find = weighted_grad(critic_losses, weighting, lambda critic: critic["encoder"], way, has_aux=True, **options)
        state = self.auxiliary.start(now.critic.get("encoder")) if state is None else state
        return find(now.critic, state, held=held) if weighting.held else find(now.critic, state)

    def _kept(self, keep: jax.Array) -> jax.Array | None:
        """Transitions that count in a part, on average over the parts, by which all divide alike; None: its own."""
        if self.shards.count == 1 or math.isinf(self.resolved.filter_threshold):
            return None
        return jnp.maximum(self.shards.mean(jnp.sum(keep)), 1.0 / self.shards.count)

    def _target(self, now: _ComputeCopies, inputs: jax.Array, latents: _Latents, batch: Batch) -> jax.Array:
        assert batch.reward is not None
        networks, resolved = self.networks, self.resolved
        of_actor, of_critic = _next_latents(networks, now, inputs, jax.lax.stop_gradient(latents))
        value_tp1 = networks.value(now.target_critic, of_critic, networks.act(now.target_actor, of_actor))
        discount = resolved.discount if batch.discount is None else batch.discount
        return losses.td_target(batch.reward, value_tp1, discount, resolved.target_minimum, resolved.target_maximum)

    def of_actor(
        self,
        actor: Params,
        critic: Params,
        inputs: jax.Array,
        critic_latents: _Latents,
        image: jax.Array | None,
        batch: Batch,
        weights: dict[str, jax.Array],
    ) -> tuple[jax.Array, jax.Array]:
        """The actor's loss, those of its auxiliary tasks with the critic's weights added, and its actions [B, A]."""
        has_encoder = self.config.encoders == "separate"
        latents, others = critic_latents, {}
        if has_encoder:
            latents = _encode_online(self.networks, self.auxiliary, actor, inputs, batch.action.shape[0])
            others = self._auxiliary(actor, latents, image, batch)
        if self.auxiliary.weighting.log:
            others = {name: self.shards.whole(loss) for name, loss in others.items()}
        action = self.networks.act(actor, latents.pair)
        value = self.networks.value(critic, critic_latents.pair, action)
        best = self.resolved.reward_positive / (1.0 - self.resolved.discount) if self.auxiliary.weighting.log else None
        loss = losses.actor_loss(value, action, self.config.action_penalty, best, self.shards.whole)
        return loss + self.auxiliary.weighting.objective(weights, others), action

    def _auxiliary(self, params: Params, latents: _Latents, image: jax.Array | None, batch: Batch) -> dict[str, jax.Array]:
        """Losses of the auxiliary tasks on a network's latents, by name."""
        seen = {"latent_t": latents.before, "latent_tp1": latents.after, "latent_moved": latents.moved}
        return self.auxiliary.losses(params.get("heads", {}), View(**seen, image=image, action=batch.action), batch)
