"""Losses of critic and actor for a batch, including auxiliary losses, and their weighted gradients.

Four networks read three observations (before, goal, after). Each observation is normalised and reordered once, and each network
encodes those that it needs in one pass:

    critic, actor (online, with gradient)   before, goal, and for auxiliary tasks after, views
    their targets                           goal, after

The actor's loss evaluates its actions on the latents from the critic's forward pass, without a gradient through these.

With ``critic_states``, the critic reads true states and encodes nothing; auxiliary losses are then those of the actor's
encoder, and weighted against the actor's main loss.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxrl_vis.config import Config
from jaxrl_vis.learner.auxtasks import View
from jaxrl_vis.learner.auxtasks.auxiliary import Auxiliary
from jaxrl_vis.learner.ddpg import losses
from jaxrl_vis.learner.networks import forward_mode
from jaxrl_vis.learner.networks.networks import Inputs, Networks
from jaxrl_vis.learner.parallel.shards import Shards
from jaxrl_vis.learner.resolved import Resolved
from jaxrl_vis.types import Batch, Params
from jaxrl_vis.weighting import MAIN, Weighted, WeightingState, weighted_grad


class ComputeCopies(NamedTuple):
    """Compute copies of an agent's four networks (`Networks.compute_copy`), or their parameters with these substituted.

    Attributes:
        actor, critic: Online networks.
        target_actor, target_critic: Target networks.
    """

    actor: Params
    critic: Params
    target_actor: Params
    target_critic: Params


def _encode(networks: Networks, params: Params, inputs: Inputs, *names: str) -> jax.Array:
    """Encode the named observations: [names, B, latent]."""
    return networks.encode_pieces(params, inputs.pieces(*names)).reshape(len(names), inputs.size, -1)


class Latents(NamedTuple):
    """Latents of a transition's observations by one online network, [B, latent] each.

    Attributes:
        pair: [2, B, latent] latents before the action and of the goal, the input of heads.
        before: Latents before the action.
        after: Latents after the action; None if no loss reads them.
        views: Latents of the auxiliary tasks' own images, by name.
    """

    pair: jax.Array
    before: jax.Array
    after: jax.Array | None
    views: dict[str, jax.Array]


def _encode_online(networks: Networks, auxiliary: Auxiliary, params: Params, inputs: Inputs, separately: bool) -> Latents:
    """Encode all observations that losses read, with gradient.

    Most auxiliary losses read only one or two of them. If encoded ``separately``, the gradient of each loss passes through
    these alone.
    """
    names = ("before", "goal", *auxiliary.encoded)
    if separately:
        latents = [_encode(networks, params, inputs, name)[0] for name in names]
        pair = jnp.stack(latents[:2])
    else:
        latents = _encode(networks, params, inputs, *names)
        pair = latents[:2]
    return _with_others(auxiliary, pair, latents[0], latents[2:])


def _with_others(auxiliary: Auxiliary, pair: jax.Array, before: jax.Array, others: Iterable[jax.Array]) -> Latents:
    views = dict(zip(auxiliary.encoded, others, strict=True))
    after = views.pop("after", None)
    return Latents(pair, before, after, views)


_MAIN_READS, _OTHERS_READ = "main", "others"


def _encoders(networks: Networks, auxiliary: Auxiliary, inputs: Inputs) -> dict[str, Callable[[Params], jax.Array]]:
    """Return functions from encoder parameters to the latents [observations, B, latent] of the main loss and of the others.

    Only the main loss reads goals, so separate encodings shorten the backward passes of auxiliary losses.
    """

    def of(*names: str) -> Callable[[Params], jax.Array]:
        return lambda encoder: _encode(networks, {"encoder": encoder}, inputs, *names)

    return {_MAIN_READS: of("before", "goal"), _OTHERS_READ: of("before", *auxiliary.encoded)}


def _collect_latents(auxiliary: Auxiliary, encoded: Latents | dict[str, jax.Array]) -> Latents:
    """Collect the latents for the losses, whether encoded together or by `_encoders`."""
    if isinstance(encoded, Latents):
        return encoded
    before, *others = encoded[_OTHERS_READ]
    return _with_others(auxiliary, encoded[_MAIN_READS], before, others)


def _next_latents(networks: Networks, copies: ComputeCopies, inputs: Inputs, latents: Latents) -> tuple[jax.Array, jax.Array]:
    """Encode next observations and goals for the target actor, and for the target critic; return [2, B, latent] of each.

    Heads take them in this order; inputs are stored as (goal, after). ``latents`` are the online critic's.
    """
    if networks.config.network.target_encoder:
        of_critic = _encode(networks, copies.target_critic, inputs, "goal", "after")[::-1]
    else:
        after = latents.after
        after = _encode(networks, copies.critic, inputs, "after") if after is None else after[None]
        of_critic = jnp.concatenate([after, latents.pair[1:]])
    return of_critic if networks.shares_encoder else _next_actor_latents(networks, copies, inputs), of_critic


def _next_actor_latents(networks: Networks, copies: ComputeCopies, inputs: Inputs) -> jax.Array:
    """Encode next observations and goals for the target actor, [2, B, latent], by an encoder of its own."""
    return _encode(networks, networks.with_encoder(copies.target_actor, copies.actor), inputs, "goal", "after")[::-1]


def _minimum(values: jax.Array) -> jax.Array:
    """Return the minimum of the heads' values: [K, B] -> [B]."""
    return values[0] if values.shape[0] == 1 else jnp.min(values, axis=0)


@dataclasses.dataclass(frozen=True)
class Objectives:
    """Losses of both networks and their weighted gradients, for one configuration.

    Attributes:
        networks: Architecture of the networks.
        config: Configuration of the run.
        resolved: Rewards, discount, filter threshold and bounds of the targets.
        auxiliary: Auxiliary tasks and their weighting.
        shards: Shards of the learner; batches are those of one shard.
    """

    networks: Networks
    config: Config
    resolved: Resolved
    auxiliary: Auxiliary
    shards: Shards

    @property
    def reduces_early(self) -> bool:
        """True if gradients with auxiliary losses are averaged over the shards of a learner before they are weighted.

        A weighting that reads losses or compares gradients needs those of the whole learner. Other weightings are linear, so
        their result can be averaged afterwards, together with everything else.
        """
        weighting = self.auxiliary.weighting
        return self.shards.count > 1 and (weighting.needs != "losses" or weighting.reads_losses)

    def critic_gradient(
        self, copies: ComputeCopies, inputs: Inputs, image: jax.Array | None, batch: Batch, noise: jax.Array | None = None
    ) -> Callable[[Params, WeightingState], Weighted]:
        """Build the function that computes the critic's losses and gradient; ``extra`` is (latents, values [B], keep [B]).

        All heads are trained on the same target; ``values`` are the minimum over heads.

        Args:
            copies: Parameters of the networks.
            inputs, image, batch, noise: Fields of `network_gradients.PreparedBatch`; ``batch`` must have rewards.
        """
        networks = self.networks

        def critic_losses(critic: Params, encoded: Latents | dict[str, jax.Array]):
            latents = _collect_latents(self.auxiliary, encoded)
            of_actor, of_critic = _next_latents(networks, copies, inputs, jax.lax.stop_gradient(latents))
            target = self._target(copies, of_actor, of_critic, batch, noise)
            main, value, keep = self._error(networks.values(critic, latents.pair, batch.action), target, batch)
            return {MAIN: main, **self._auxiliary_losses(critic, latents, inputs, image, batch)}, (latents, value, keep)

        return self._weighted_grad(critic_losses, inputs)

    def critic_error_on_states(
        self, critic: Params, copies: ComputeCopies, inputs: Inputs, batch: Batch, noise: jax.Array | None = None
    ) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        """Compute the loss [] of a critic that observes true states; and (values [B], keep [B]) as in `critic_gradient`.

        ``critic`` are the differentiated parameters; the target networks are those of ``copies``.
        """
        target = self._target(copies, _next_actor_latents(self.networks, copies, inputs), inputs.states_tp1, batch, noise)
        main, value, keep = self._error(self.networks.values(critic, inputs.states_t, batch.action), target, batch)
        return main, (value, keep)

    def actor_gradient(
        self, critic: Params, critic_inputs: jax.Array, inputs: Inputs, image: jax.Array | None, batch: Batch
    ) -> Callable[[Params, WeightingState], Weighted]:
        """Build the function that computes the losses of an actor, and their gradient with weights of its own.

        ``extra`` are the actions [B, A]. The main loss is that of `actor_loss`; for a logarithm, it is raised by the maximum
        value, so that it is positive.

        Args:
            critic: Parameters of the critic, which are held constant.
            critic_inputs: True states, or latents of the critic's encoder (`Networks.values`).
            inputs, image, batch: As in `critic_gradient`.
        """

        def actor_losses(actor: Params, encoded: Latents | dict[str, jax.Array]):
            latents = _collect_latents(self.auxiliary, encoded)
            action = self.networks.act(actor, latents.pair)
            value = self.networks.value(critic, critic_inputs, action)
            main = losses.actor_loss(value, action, self.config.ddpg.action_penalty)
            if self.auxiliary.weighting.log:
                main = main + self._maximum_value
            return {MAIN: main, **self._auxiliary_losses(actor, latents, inputs, image, batch)}, action

        return self._weighted_grad(actor_losses, inputs)

    def _weighted_grad(
        self, network_losses: Callable[..., Any], inputs: Inputs
    ) -> Callable[[Params, WeightingState], Weighted]:
        """Build the weighted gradient of (parameters of a network, `Latents` or pieces of them) -> (losses by name, extra)."""
        networks, weighting, mode = self.networks, self.auxiliary.weighting, self.auxiliary.gradient_mode

        def encode(encoder: Params) -> Latents:
            return _encode_online(networks, self.auxiliary, {"encoder": encoder}, inputs, separately=mode == "per_loss")

        # If losses are differentiated one by one, auxiliary losses need not pass through everything that the main one reads.
        passes_apart = mode == "latents" and weighting.needs in ("dots", "gramian")
        encoders = _encoders(networks, self.auxiliary, inputs) if passes_apart else encode
        options: dict[str, Any] = {"forwards": forward_mode.with_tangents, "encode": encoders, "has_aux": True}
        if self.reduces_early:
            options["reduce"] = self.shards.mean
        return weighted_grad(network_losses, weighting, lambda params: params.get("encoder"), mode, **options)

    @property
    def _maximum_value(self) -> float:
        """Maximum return, R+/(1-gamma)."""
        return self.resolved.reward_positive / (1.0 - self.resolved.discount)

    def _error(self, values: jax.Array, target: jax.Array, batch: Batch) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Compute the critic's loss [] over all heads, their minimum [B], and the mask [B] of unfiltered transitions."""
        assert batch.reward is not None
        value = _minimum(values)
        keep = losses.keep_mask(batch.reward, value, self.resolved.reward_negative, self.resolved.filter_threshold)
        errors = [losses.critic_loss(of_head, target, keep, self._kept_mean(keep)) for of_head in values]
        return functools.reduce(jnp.add, errors), value, keep

    def _kept_mean(self, keep: jax.Array) -> jax.Array | None:
        """Return the mean number of unfiltered transitions per shard, the divisor for all; None if each divides by its own."""
        if self.shards.count == 1 or math.isinf(self.resolved.filter_threshold):
            return None
        return jnp.maximum(self.shards.mean(jnp.sum(keep)), 1.0 / self.shards.count)

    def _target(
        self, copies: ComputeCopies, of_actor: jax.Array, of_critic: jax.Array, batch: Batch, noise: jax.Array | None
    ) -> jax.Array:
        """Compute the critic's targets [B].

        Args:
            copies: Parameters of the networks.
            of_actor, of_critic: Inputs of the heads of the target actor and the target critic after the transition: latents
                [2, B, latent] of observations and goals, or true states if the critic observes these (`Networks.values`).
            batch: Transitions with rewards.
            noise: [B, A], added to the next actions; None for no noise.
        """
        assert batch.reward is not None
        resolved = self.resolved
        action = self.networks.act(copies.target_actor, of_actor)
        if noise is not None:
            action = jnp.clip(action + noise, -1.0, 1.0)
        value_tp1 = _minimum(self.networks.values(copies.target_critic, of_critic, action))
        discount = resolved.discount if batch.discount is None else batch.discount
        return losses.td_target(batch.reward, value_tp1, discount, resolved.target_minimum, resolved.target_maximum)

    def actor_loss(
        self,
        actor: Params,
        critic: Params,
        inputs: Inputs,
        critic_latents: Latents,
        image: jax.Array | None,
        batch: Batch,
        weights: dict[str, jax.Array],
    ) -> tuple[jax.Array, jax.Array]:
        """Compute the actor's loss [] and its actions [B, A].

        An actor with an encoder of its own also has auxiliary losses, with the critic's ``weights``, [] float32 by name.

        Args:
            actor, critic: Parameters; those of the critic are held constant.
            inputs, image, batch: As in `critic_gradient`.
            critic_latents: Latents of the critic's encoder, which an actor without an encoder reads, too.
            weights: Weights of the critic's losses in this step, with `MAIN`.
        """
        has_encoder = not self.networks.shares_encoder
        latents, others = critic_latents, {}
        if has_encoder:
            latents = _encode_online(self.networks, self.auxiliary, actor, inputs, separately=False)
            others = self._auxiliary_losses(actor, latents, inputs, image, batch, weights)
        if self.auxiliary.weighting.log:
            others = {name: self.shards.global_mean(loss) for name, loss in others.items()}
        action = self.networks.act(actor, self.auxiliary.main_latents(latents.pair, weights) if has_encoder else latents.pair)
        value = self.networks.value(critic, critic_latents.pair, action)
        best = self._maximum_value if self.auxiliary.weighting.log else None
        loss = losses.actor_loss(
            value, action, self.config.ddpg.action_penalty, best, self.shards.global_mean, self.config.ddpg.actor_log
        )
        weighting = self.auxiliary.weighting
        of_heads = weighting.head_weights(weights)
        if has_encoder and not weighting.main:
            loss = of_heads[MAIN] * loss
        return loss + weighting.objective(of_heads, others), action

    def _auxiliary_losses(
        self,
        params: Params,
        latents: Latents,
        inputs: Inputs,
        image: jax.Array | None,
        batch: Batch,
        weights: dict[str, jax.Array] | None = None,
    ) -> dict[str, jax.Array]:
        """Compute the auxiliary losses of a network's latents, [] float32 by name.

        ``weights`` are applied here only if they are for the encoder alone; the sum of the losses applies those of the heads.
        """
        if not self.auxiliary.tasks:
            return {}
        patches = inputs.observed if self.networks.uses_kernel else None
        view = View(latents.before, batch.action, latents.after, image, patches=patches)
        latent_scales = weights if self.auxiliary.weighting.heads == "always" else None
        return self.auxiliary.losses(params["heads"], view, latents.views, batch, latent_scales)
