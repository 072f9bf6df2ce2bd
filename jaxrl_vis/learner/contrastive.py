"""Contrastive reinforcement learning (Eysenbach et al., 2022, arXiv 2206.07568): no rewards, and no targets.

    critic    logit f(s, a, g) = phi(s, a) . psi(g), trained to discriminate goals that follow (s, a) from those of other
              transitions of the batch; the optimal f is log p(g follows s, a) - log p(g), up to a function of g
    actor     trained to maximise f, for goals that follow and for those of other transitions

Goals that follow are future states, k steps ahead with probability proportional to gamma^k: ``future_goals="geometric"`` with
every goal relabelled, as set by presets for this algorithm.

Form ``nce`` is the original: binary cross-entropy of every pair. Form ``stable`` adds stabilising measures: layer normalisation
and cold initialisation (Zheng et al., 2024, arXiv 2306.03346), symmetric InfoNCE and a penalty on log-sum-exp (Bortkiewicz et
al., 2024, arXiv 2408.11052). Unlike in both, the policy is deterministic, explores with the same noise as all algorithms here,
and is penalised for large actions (``action_penalty``) instead of being rewarded for entropy.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxrl_vis.errors import RequestError
from jaxrl_vis.learner.algorithm import Algorithm, Setup, scan_batches
from jaxrl_vis.learner.ddpg import adam
from jaxrl_vis.learner.networks.networks import Networks
from jaxrl_vis.learner.networks.policy import PolicyParams, make_policy
from jaxrl_vis.types import Batch, Metrics, Params, Replaceable, Statistics

LOGSUMEXP_PENALTY = 0.1
"""Weight of the mean squared log-sum-exp of each row of logits, in form ``stable``."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Agent(Replaceable):
    """Networks and their optimisers.

    Attributes:
        actor: Parameters from `Networks.init_actor`.
        critic: ``sa`` and ``g``, heads for phi and psi; for images also their ``encoder``.
        actor_optimizer, critic_optimizer: optax states.
    """

    actor: Params
    critic: Params
    actor_optimizer: Any
    critic_optimizer: Any


def contrastive_loss(logits: jax.Array, form: str) -> jax.Array:
    """Compute the critic's loss: [] float32.

    Args:
        logits: [B, B] float32, for B transitions (rows) and their goals (columns); pairs on the diagonal are positives.
        form: ``nce`` or ``stable``, see ``contrastive_form``.
    """
    following = jnp.diagonal(logits)
    if form == "nce":  # log-sigmoid of positives, and of the negated negatives
        return jnp.mean(jax.nn.softplus(logits)) - jnp.sum(following) / logits.size
    of_rows, of_columns = (jax.nn.logsumexp(logits, axis=axis) for axis in (1, 0))
    return jnp.mean(of_rows + of_columns - 2.0 * following) + LOGSUMEXP_PENALTY * jnp.mean(jnp.square(of_rows))


def _check(setup: Setup) -> None:
    """Check that the algorithm supports a configuration.

    Raises:
        RequestError: It sets a reward or auxiliary losses, which this algorithm ignores, random shifts, another sampling of
            goals than geometric future states, or several devices per learner.
    """
    config = setup.config
    if config.reward.method != "oracle":
        raise RequestError(f"contrastive reads no rewards: leave out --method {config.reward.method}")
    if config.auxiliary.aux_tasks:
        raise RequestError("contrastive has no auxiliary losses: leave out --aux-tasks")
    if config.network.random_shift:
        raise RequestError(
            "contrastive would recognise a goal by its shift, which its observation has, too: leave out --random-shift"
        )
    goals = config.goals
    following = dataclasses.replace(goals, relabel_probability=1.0, trivial_goals=1.0, future_goals="geometric")
    for field in dataclasses.fields(goals):
        value, wanted = getattr(goals, field.name), getattr(following, field.name)
        if value != wanted:
            raise RequestError(f"contrastive learns from goals that follow: {field.name} must be {wanted}, not {value}")
    if setup.resolved.balance_probability:
        raise RequestError(f"contrastive learns from goals that follow: no balance_probability {goals.balance_probability}")
    if setup.shards.count > 1:
        raise RequestError("contrastive compares all pairs of a batch, which devices do not share: write --data-devices 1")


def make(setup: Setup) -> Algorithm:
    """Build contrastive RL.

    Raises:
        RequestError: The configuration sets rewards, auxiliary losses, goals or several devices per learner, which the
            algorithm does not support.
    """
    form = setup.config.contrastive.contrastive_form
    return build(setup, functools.partial(contrastive_loss, form=form), stabilized=form == "stable")


def build(setup: Setup, loss: Callable[[jax.Array], jax.Array], stabilized: bool) -> Algorithm:
    """Build contrastive RL with any loss of the logits.

    Args:
        setup: Configuration and task.
        loss: Logits [B, B] float32, as for `contrastive_loss` -> loss [] float32.
        stabilized: True for heads with layer normalisation and cold initialisation.

    Raises:
        RequestError: As in `make`.
    """
    _check(setup)
    config = setup.config
    networks = Networks(config, setup.observation_spec, setup.action_size, 0.0)
    policy, head = make_policy(networks), networks.head(config.contrastive.representation_size, stabilized=stabilized)
    latent = networks.latent_size

    def init(key: jax.Array) -> Agent:
        keys = jax.random.split(key, 4)
        sizes = {"sa": latent + setup.action_size, "g": latent}
        critic = {name: head.init(own, jnp.zeros((1, sizes[name])))["params"] for name, own in zip(sizes, keys, strict=False)}
        if networks.sees_images:
            critic["encoder"] = networks.init_encoder(keys[2])
        actor = networks.init_actor(keys[3])
        return Agent(actor, critic, adam.init(actor), adam.init(critic))

    def represent(critic: Params, latents: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Compute phi(s, a) and psi(g), [B, R] each, from latents [2, B, latent] of observations and goals."""
        return head.apply({"params": critic["sa"]}, latents[0], action), head.apply({"params": critic["g"]}, latents[1])

    def step(agent: Agent, statistics: Statistics, batch: Batch, key: jax.Array) -> tuple[Agent, Metrics]:
        inputs = networks.prepare_batch(networks.batch_scaling(statistics), batch)

        def encode(params: Params) -> jax.Array:
            return networks.encode_pieces(params, inputs.pieces("before", "goal")).reshape(2, inputs.size, -1)

        def critic_objective(critic: Params) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
            latents = encode(critic)
            of_pairs, of_goals = represent(critic, latents, batch.action)
            logits = of_pairs @ of_goals.T
            return loss(logits), (logits, latents)

        def actor_objective(actor: Params, critic_latents: jax.Array) -> tuple[jax.Array, jax.Array]:
            latents = encode(actor) if "encoder" in actor else critic_latents
            action = networks.act(actor, _with_other_goals(latents))
            of_pairs, of_goals = represent(agent.critic, _with_other_goals(critic_latents), action)
            size = jnp.mean(jnp.square(action))
            return config.ddpg.action_penalty * size - jnp.mean(jnp.sum(of_pairs * of_goals, axis=-1)), size

        (critic_loss, (logits, latents)), of_critic_parameters = jax.value_and_grad(critic_objective, has_aux=True)(
            agent.critic
        )
        (actor_loss, size), of_actor_parameters = jax.value_and_grad(actor_objective, has_aux=True)(
            agent.actor, jax.lax.stop_gradient(latents)
        )
        critic, critic_optimizer = _step(
            agent.critic, of_critic_parameters, agent.critic_optimizer, config.ddpg.critic_learning_rate
        )
        actor, actor_optimizer = _step(agent.actor, of_actor_parameters, agent.actor_optimizer, config.ddpg.actor_learning_rate)
        metrics = {"critic_loss": critic_loss, "actor_loss": actor_loss, "action_size": jnp.sqrt(size), **_metrics(logits)}
        return Agent(actor, critic, actor_optimizer, critic_optimizer), {f"train/{name}": metrics[name] for name in metrics}

    def policy_params(agent: Agent, statistics: Statistics) -> PolicyParams:
        return policy.params(networks.with_encoder(agent.actor, agent.critic), statistics)

    return Algorithm(init, policy.act, scan_batches(step), policy_params, policy.encode_goal, networks=networks)


def _with_other_goals(latents: jax.Array) -> jax.Array:
    """Append the B transitions with the goals of others: latents [2, B, latent] -> [2, 2 B, latent]."""
    observations, goals = latents
    return jnp.stack([jnp.concatenate([observations, observations]), jnp.concatenate([goals, jnp.roll(goals, 1, axis=0)])])


def _step(params: Params, gradient: Params, state: Any, learning_rate: float) -> tuple[Params, Any]:
    """Take one step of Adam; return the new parameters and state."""
    count = adam.count(state) + 1
    params, state = adam.step(params, gradient, state, learning_rate, adam.corrections(count[None])[0])
    return params, adam.with_count(state, count)


def _metrics(logits: jax.Array) -> Metrics:
    """Compute the fraction of transitions whose own goal has the largest logit, and mean logits, [] float32 by name."""
    size, following = len(logits), jnp.diagonal(logits)
    return {
        "accuracy": jnp.mean((jnp.argmax(logits, axis=1) == jnp.arange(size)).astype(jnp.float32)),
        "logit_following": jnp.mean(following),
        "logit_other": (jnp.sum(logits) - jnp.sum(following)) / max(1, size * (size - 1)),
    }
