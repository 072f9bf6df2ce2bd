"""Rewards from the latent space of an autoencoder that is trained along with the learner (thesis, section 5.1.5, Auto Encoder).

    reward = R- + (R+ - R-) max(0, cosine of the latents of achieved observation and goal)

The autoencoder has an encoder of its own, like those of actor and critic, and reconstructs achieved observations. Rewards are
recomputed for every batch with the current encoder, without gradient.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from jaxrl_vis.config import Config
from jaxrl_vis.errors import RequestError
from jaxrl_vis.learner import auxtasks
from jaxrl_vis.learner.networks.networks import Inputs, Networks
from jaxrl_vis.learner.networks.normalizer import Scaling
from jaxrl_vis.learner.resolved import Resolved
from jaxrl_vis.types import Batch, Params, Replaceable

_SMALL = 1e-6  # of a latent's length: the direction of a shorter one means nothing


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class AutoencoderState(Replaceable):
    """State of the autoencoder between two gradient steps.

    Attributes:
        params: ``encoder`` and ``decoder``, nested dictionaries of float32.
        optimizer: optax state.
    """

    params: Params
    optimizer: Any


class Rewarded(NamedTuple):
    """Result of `LatentReward.of_batch`.

    Attributes:
        reward: [B] float32, without gradient.
        loss: [] float32, mean squared error of the reconstruction, of normalised observations.
        gradient: Gradient of that loss, for the parameters, float32.
    """

    reward: jax.Array
    loss: jax.Array
    gradient: Params


def cosine_reward(latent: jax.Array, goal_latent: jax.Array, positive: float = 1.0, negative: float = 0.0) -> jax.Array:
    """Map the angle between latents [B, L] to rewards [B] float32: ``positive`` at 0, ``negative`` at a right angle or more.

    Args:
        latent: [B, L] any float dtype, of the achieved observations.
        goal_latent: [B, L], of the goals.
        positive: R+.
        negative: R-.
    """
    first, second = (array.astype(jnp.float32) for array in (latent, goal_latent))
    lengths = jnp.linalg.norm(first, axis=-1) * jnp.linalg.norm(second, axis=-1)
    cosine = jnp.sum(first * second, axis=-1) / jnp.maximum(lengths, _SMALL**2)
    return jax.lax.stop_gradient(negative + (positive - negative) * jnp.clip(cosine, 0.0, 1.0))


@dataclasses.dataclass(frozen=True)
class LatentReward:
    """Autoencoder of one configuration; all methods are pure. Create it with `make_latent_reward`."""

    networks: Networks
    resolved: Resolved
    task: auxtasks.AuxTask
    optimizer: optax.GradientTransformation

    def init(self, key: jax.Array) -> AutoencoderState:
        """Initialise the autoencoder."""
        encoder_key, decoder_key = jax.random.split(key)
        params = {"encoder": self.networks.init_encoder(encoder_key), "decoder": self.task.init(decoder_key)}
        return AutoencoderState(params=params, optimizer=self.optimizer.init(params))

    def of_batch(self, state: AutoencoderState, scaling: Scaling, inputs: Inputs, batch: Batch) -> Rewarded:
        """Compute the rewards of a batch, and the autoencoder's gradient.

        Args:
            state: The autoencoder.
            scaling: Scaling of observations.
            inputs: From `Networks.prepare_batch`.
            batch: The transitions.
        """
        networks = self.networks
        if batch.reached is None:
            reached, pieces = batch.observation_tp1, inputs.pieces("after")
        else:
            reached = batch.reached
            pieces = [(networks.prepare(scaling, reached), slice(None))]
        image = networks.normalize(scaling, reached)

        def reconstruction(params: Params) -> tuple[jax.Array, jax.Array]:
            latent = networks.encode_pieces(params, pieces)
            view = auxtasks.View(latent_t=latent, action=batch.action, image=image)
            return self.task.loss(params["decoder"], view), latent

        params = state.params
        (loss, latent), gradient = jax.value_and_grad(reconstruction, has_aux=True)(params)
        goal_latent = networks.encode_pieces(params, inputs.pieces("goal"))
        reward = cosine_reward(latent, goal_latent, self.resolved.reward_positive, self.resolved.reward_negative)
        return Rewarded(reward, loss, gradient)

    def apply(self, state: AutoencoderState, gradient: Params) -> AutoencoderState:
        """Take one step of the optimiser."""
        change, moments = self.optimizer.update(gradient, state.optimizer)
        return AutoencoderState(params=optax.apply_updates(state.params, change), optimizer=moments)


def make_latent_reward(networks: Networks, config: Config, resolved: Resolved) -> LatentReward | None:
    """Build the autoencoder that computes the rewards; None if the configuration's method uses none.

    Args:
        networks: Architecture of the autoencoder's separate encoder.
        config: The method and the step size, that of the critic.
        resolved: R+ and R-.

    Raises:
        RequestError: Observations are no images.
    """
    method = resolved.method
    if method.needs_images and not networks.sees_images:
        raise RequestError(
            f"method {config.reward.method} encodes images, and {config.environment.env} shows states: train on "
            f"Visual{config.environment.env}, or use --method indicator"
        )
    if method.reward != "autoencoder":
        return None
    shape = networks.observation_spec, networks.action_size, config.network.latent_size
    spec = auxtasks.Spec(*shape, levels=len(config.network.encoder_filters), dtype=networks.dtype)
    task = auxtasks.make(("autoencoder",), spec)["autoencoder"]
    return LatentReward(networks, resolved, task, optax.adam(config.ddpg.critic_learning_rate))
