"""Reward models that are trained alongside the learner: each has its own image encoder, and a loss.

    autoencoder   cosine of the latents of achieved observation and goal (thesis, section 5.1.5, Auto Encoder); trained to
                  reconstruct achieved observations
    classifier    probability that the achieved observation is the goal, doubled and at most 1 (after VICE: Fu et al., 2018,
                  arXiv 1805.11686); trained to discriminate goals paired with themselves from achieved observations paired
                  with their goals

Rewards lie between R- and R+, and are recomputed for every batch with the current model, without gradient.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from jaxrl_vis.config import Config
from jaxrl_vis.errors import RequestError
from jaxrl_vis.learner import auxtasks
from jaxrl_vis.learner.memory.rewards import cosine_reward
from jaxrl_vis.learner.networks.networks import Inputs, Networks, Piece
from jaxrl_vis.learner.networks.normalizer import Scaling
from jaxrl_vis.learner.resolved import Resolved
from jaxrl_vis.types import Batch, Params, Replaceable


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ModelState(Replaceable):
    """State of a reward model between two gradient steps.

    Attributes:
        params: Parameters, nested dictionaries of float32 arrays.
        optimizer: optax state.
    """

    params: Params
    optimizer: Any


class BatchRewards(NamedTuple):
    """Result of `LearnedReward.compute_batch_rewards`.

    Attributes:
        reward: [B] float32, without gradient.
        loss: [] float32, loss of the model.
        gradient: Gradient of the loss with respect to the model's parameters, float32.
    """

    reward: jax.Array
    loss: jax.Array
    gradient: Params


class RewardInputs(NamedTuple):
    """Observations that a model compares, in the form that encoders read.

    Attributes:
        achieved_goal, goal: Prepared achieved observations and goals of B transitions, as pieces.
        image: [B, C, H, W] achieved observations, normalised.
        batch: Batch of transitions.
    """

    achieved_goal: list[Piece]
    goal: list[Piece]
    image: jax.Array
    batch: Batch


@dataclasses.dataclass(frozen=True)
class LearnedReward:
    """Model of one configuration; all methods are pure. Create it with `make_learned_reward`.

    Attributes:
        name: Name of the method, used for the metric of its loss.
        networks: Architecture of the encoder.
        init_params: key -> parameters.
        loss_and_reward: (parameters, `RewardInputs`) -> loss [] and rewards [B] float32.
        optimizer: Optimiser of the parameters.
    """

    name: str
    networks: Networks
    init_params: Callable[[jax.Array], Params]
    loss_and_reward: Callable[[Params, RewardInputs], tuple[jax.Array, jax.Array]]
    optimizer: optax.GradientTransformation

    def init(self, key: jax.Array) -> ModelState:
        """Initialise the parameters and the optimiser's state from a typed key []."""
        params = self.init_params(key)
        return ModelState(params=params, optimizer=self.optimizer.init(params))

    def compute_batch_rewards(self, state: ModelState, scaling: Scaling, inputs: Inputs, batch: Batch) -> BatchRewards:
        """Compute the rewards of a batch, and the model's gradient.

        Args:
            state: State of the model.
            scaling: Scaling of observations.
            inputs: Observations from `Networks.prepare_batch`.
            batch: Batch of transitions.
        """
        if batch.achieved_goal is None:
            achieved_goal, pieces = batch.observation_tp1, inputs.pieces("after")
        else:
            achieved_goal = batch.achieved_goal
            pieces = [(self.networks.prepare(scaling, achieved_goal), slice(None))]
        compared = RewardInputs(pieces, inputs.pieces("goal"), self.networks.normalize(scaling, achieved_goal), batch)
        (loss, reward), gradient = jax.value_and_grad(self.loss_and_reward, has_aux=True)(state.params, compared)
        return BatchRewards(jax.lax.stop_gradient(reward), loss, gradient)

    def apply(self, state: ModelState, gradient: Params) -> ModelState:
        """Take one step of the optimiser; return the new state."""
        change, moments = self.optimizer.update(gradient, state.optimizer)
        return ModelState(params=optax.apply_updates(state.params, change), optimizer=moments)


def make_autoencoder(networks: Networks, config: Config, resolved: Resolved) -> LearnedReward:
    """Build the reward model that compares observations in the latent space of an autoencoder; see `make_learned_reward`."""
    shape = networks.observation_spec, networks.action_size, config.network.latent_size
    spec = auxtasks.Spec(*shape, levels=len(config.network.encoder_filters), dtype=networks.dtype)
    task = auxtasks.make(("autoencoder",), spec)["autoencoder"]

    def init(key: jax.Array) -> Params:
        encoder_key, decoder_key = jax.random.split(key)
        return {"encoder": networks.init_encoder(encoder_key), "decoder": task.init(decoder_key)}

    def loss_and_reward(params: Params, compared: RewardInputs) -> tuple[jax.Array, jax.Array]:
        latent = networks.encode_pieces(params, compared.achieved_goal)
        view = auxtasks.View(latent_t=latent, action=compared.batch.action, image=compared.image)
        goal_latent = networks.encode_pieces(jax.lax.stop_gradient(params), compared.goal)
        reward = cosine_reward(latent, goal_latent, resolved.reward_positive, resolved.reward_negative)
        return task.loss(params["decoder"], view), reward

    return LearnedReward("autoencoder", networks, init, loss_and_reward, optax.adam(config.ddpg.critic_learning_rate))


def make_classifier(networks: Networks, config: Config, resolved: Resolved) -> LearnedReward:
    """Build the reward model that classifies pairs of achieved observation and goal.

    All achieved observations are negatives, as in VICE, even if they equal the goal: both classes are then equally likely.
    Arguments as for `make_learned_reward`.
    """
    head = networks.head(1)

    def init(key: jax.Array) -> Params:
        encoder_key, head_key = jax.random.split(key)
        inputs = jnp.zeros((1, 2 * config.network.latent_size))
        return {"encoder": networks.init_encoder(encoder_key), "head": head.init(head_key, inputs)["params"]}

    def loss_and_reward(params: Params, compared: RewardInputs) -> tuple[jax.Array, jax.Array]:
        achieved_goal, goal = (networks.encode_pieces(params, pieces) for pieces in (compared.achieved_goal, compared.goal))
        pairs = jnp.stack([jnp.concatenate([goal, achieved_goal]), jnp.concatenate([goal, goal])])
        of_goals, of_achieved = head.apply({"params": params["head"]}, pairs)[:, 0].reshape(2, -1)
        loss = jnp.mean(jax.nn.softplus(-of_goals)) + jnp.mean(jax.nn.softplus(of_achieved))
        fraction = jnp.minimum(2.0 * jax.nn.sigmoid(of_achieved), 1.0)  # a pair in both classes, of probability 1/2, gets R+
        return loss, resolved.reward_negative + (resolved.reward_positive - resolved.reward_negative) * fraction

    return LearnedReward("classifier", networks, init, loss_and_reward, optax.adam(config.ddpg.critic_learning_rate))


_MAKERS = {"autoencoder": make_autoencoder, "classifier": make_classifier}


def make_learned_reward(networks: Networks, config: Config, resolved: Resolved) -> LearnedReward | None:
    """Build the model that computes the rewards; None if the configuration's method has none.

    Args:
        networks: Architecture of the model's own encoder.
        config: Configuration with the method and the learning rate, which is that of the critic.
        resolved: R+ and R-.

    Raises:
        RequestError: The method needs images, and observations are states.
    """
    method = resolved.method
    if method.needs_images and not networks.sees_images:
        raise RequestError(
            f"method {config.reward.method} encodes images, and {config.environment.env} shows states: train on "
            f"Visual{config.environment.env}, or use --method indicator"
        )
    return _MAKERS[str(method.reward)](networks, config, resolved) if method.is_learned else None
