"""Deep deterministic policy gradient with goals (Lillicrap et al., 2016), as pure functions.

    prepare      inputs of the networks, which do not depend on learned parameters
    gradients    losses of a batch, main and auxiliary, and one weighted gradient for each network
    apply        optimisers, then target networks
    update       all of them, in a scan over the batches of an iteration

The losses are in `objectives`, their gradients in `network_gradients`.

Encoding images dominates the cost, and options of `Config` reduce it: with ``encoders="shared"`` the actor uses the critic's
latents, with ``target_encoder=False`` targets use the online encoders, and ``actor_interval`` makes actor steps less frequent.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from jaxrl_vis.config import Config
from jaxrl_vis.learner.algorithm import Algorithm, Batches, Setup
from jaxrl_vis.learner.auxtasks.auxiliary import Auxiliary, make_auxiliary
from jaxrl_vis.learner.ddpg import adam, diagnostics, network_gradients
from jaxrl_vis.learner.ddpg.learned_reward import LearnedReward, make_learned_reward
from jaxrl_vis.learner.ddpg.network_gradients import ComputeGradients, PreparedBatch
from jaxrl_vis.learner.ddpg.objectives import ComputeCopies, Objectives
from jaxrl_vis.learner.networks.networks import BatchScaling, Networks
from jaxrl_vis.learner.networks.policy import PolicyParams, make_policy
from jaxrl_vis.learner.parallel.shards import ONE, Shards
from jaxrl_vis.learner.resolved import Resolved
from jaxrl_vis.types import Batch, Metrics, Params, Replaceable, Statistics
from jaxrl_vis.weighting import WeightingState

# Folded into the networks' keys for the heads of auxiliary tasks, so that these change no other random numbers.
_HEADS = 0x686473
# Folded into the agent's key for a reward model.
_REWARD_MODEL = 0x617574


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Agent(Replaceable):
    """Networks, their targets and optimisers.

    Attributes:
        actor, critic: Online parameters. The actor is only a head if it shares the critic's encoder.
        target_actor, target_critic: Slowly updated copies; without target encoders, of the heads only.
        actor_optimizer, critic_optimizer: optax states.
        updates: [] int32, number of gradient steps taken (below 2^31 in any realistic run).
        weighting: `weighting.WeightingState` of the auxiliary losses; None without a weighting.
        reward_model: `learned_reward.ModelState`; None if rewards come from elsewhere.
    """

    actor: Params
    critic: Params
    target_actor: Params
    target_critic: Params
    actor_optimizer: Any
    critic_optimizer: Any
    updates: jax.Array
    weighting: Any = None
    reward_model: Any = None


class WorkingState(NamedTuple):
    """Agent between two gradient steps of one iteration.

    Attributes:
        agent: The agent; its counters are unchanged since the start of the iteration (and thus stale).
        copies: Copies of its parameters in the compute dtype.
        scaling: Scaling of observations. Constant, but carried so that it is not recomputed at the start of every step.
        counts: [3] int32, number of gradient steps of the critic and of the actor, and `Agent.updates`.
    """

    agent: Agent
    copies: ComputeCopies
    scaling: BatchScaling
    counts: jax.Array


class Gradients(NamedTuple):
    """Gradients of a batch.

    Attributes:
        critic, actor: Gradients for the optimisers, float32; ``actor`` is None if the actor is not updated.
        weighting: State of the weighting after this batch; None without a weighting.
        reward_model: Gradient for the optimiser of the reward model; None if there is none.
    """

    critic: Params
    actor: Params | None
    weighting: WeightingState | None = None
    reward_model: Params | None = None


class GradientSteps(NamedTuple):
    """Gradient steps of DDPG. Pure; all states are pytrees.

    Attributes:
        init: key -> Agent.
        begin: (Agent, Statistics) -> WorkingState, before the first of several gradient steps.
        prepare: (WorkingState, Batch) -> PreparedBatch, which is the same at every gradient step after one `begin`.
        gradients: (WorkingState, PreparedBatch, whether to include the actor) -> (Gradients, metrics, [] float32 by name).
        apply: (WorkingState, Gradients) -> WorkingState, after one gradient step.
        end: WorkingState -> Agent.
    """

    init: Callable[[jax.Array], Agent]
    begin: Callable[[Agent, Statistics], WorkingState]
    prepare: Callable[[WorkingState, Batch], PreparedBatch]
    gradients: Callable[[WorkingState, PreparedBatch, bool], tuple[Gradients, Metrics]]
    apply: Callable[[WorkingState, Gradients], WorkingState]
    end: Callable[[WorkingState], Agent]


def _network_parameters(state: Agent) -> tuple[Params, ...]:
    """Return the parameters of the four networks, in the order of `ComputeCopies`."""
    return state.actor, state.critic, state.target_actor, state.target_critic


def _start(networks: Networks, auxiliary: Auxiliary, learned_reward: LearnedReward | None, key: jax.Array) -> Agent:
    """Initialise an agent; its target networks equal the online networks. ``learned_reward`` is None without a reward model."""
    actor_key, critic_key = jax.random.split(key)
    actor, critic = networks.init_actor(actor_key), networks.init_critic(critic_key)
    target_actor, target_critic = networks.init_target(actor), networks.init_target(critic)
    if auxiliary.tasks:
        actor_key, critic_key = (jax.random.fold_in(network_key, _HEADS) for network_key in (actor_key, critic_key))
        if not networks.critic_state_size:
            critic["heads"] = auxiliary.init_heads(critic_key)
        if "encoder" in actor:
            actor["heads"] = auxiliary.init_heads(actor_key)
    return Agent(
        actor=actor,
        critic=critic,
        target_actor=target_actor,
        target_critic=target_critic,
        actor_optimizer=adam.init(actor),
        critic_optimizer=adam.init(critic),
        updates=jnp.zeros((), jnp.int32),
        weighting=auxiliary.init_state(actor if networks.critic_state_size else critic, key),
        reward_model=None if learned_reward is None else learned_reward.init(jax.random.fold_in(key, _REWARD_MODEL)),
    )


def _stack_counts(agent: Agent) -> jax.Array:
    """Stack `WorkingState.counts` in one array [3]: XLA would launch a kernel for each scalar counter."""
    return jnp.stack([adam.count(agent.critic_optimizer), adam.count(agent.actor_optimizer), agent.updates])


def _with_counts(agent: Agent, counts: jax.Array) -> Agent:
    """Return the agent with its counters replaced by ``counts``, [3] int32 as in `WorkingState`."""
    return agent.replace(
        critic_optimizer=adam.with_count(agent.critic_optimizer, counts[0]),
        actor_optimizer=adam.with_count(agent.actor_optimizer, counts[1]),
        updates=counts[2],
    )


def _compute_copies(networks: Networks, agent: Agent) -> ComputeCopies:
    """Return the compute copies of all four networks."""
    return ComputeCopies(*map(networks.compute_copy, _network_parameters(agent)))


def _begin(networks: Networks, agent: Agent, statistics: Statistics) -> WorkingState:
    """Implement `GradientSteps.begin`."""
    return WorkingState(agent, _compute_copies(networks, agent), networks.batch_scaling(statistics), _stack_counts(agent))


def _apply(state: Agent, counts: jax.Array, gradients: Gradients, config: Config) -> Agent:
    """Step the optimisers (the actor's only if it has a gradient), and update the target networks.

    ``counts`` are `WorkingState.counts` including this step; those in the returned agent are stale.
    """
    corrections = adam.corrections(counts[:2])
    critic, critic_moments = adam.step(
        state.critic, gradients.critic, state.critic_optimizer, config.ddpg.critic_learning_rate, corrections[0]
    )
    actor, actor_moments = state.actor, state.actor_optimizer
    if gradients.actor is not None:
        actor, actor_moments = adam.step(actor, gradients.actor, actor_moments, config.ddpg.actor_learning_rate, corrections[1])
    follow = jnp.where(counts[2] % config.ddpg.target_update_interval == 0, 1.0 - config.ddpg.target_decay, 0.0)

    def move_target(online: Params, target: Params) -> Params:
        return optax.incremental_update({part: online[part] for part in target}, target, follow)

    return state.replace(
        actor=actor,
        critic=critic,
        target_actor=move_target(actor, state.target_actor),
        target_critic=move_target(critic, state.target_critic),
        actor_optimizer=actor_moments,
        critic_optimizer=critic_moments,
        weighting=gradients.weighting,
    )


def _value_at_goals(networks: Networks, agent: Agent, statistics: Statistics, goals: jax.Array) -> Metrics:
    """Implement `Algorithm.diagnose`: the mean value of the policy's actions if the observation is the goal itself."""
    own = (statistics.observations,) if statistics.own_goals is None else (statistics.observations, statistics.goals)
    inputs = [networks.prepare(networks.scaling(part), goals) for part in own]

    def latents(params: Params) -> jax.Array:
        encoded = [networks.encode(params, array) for array in inputs]
        return jnp.stack([encoded[0], encoded[-1]])

    action = networks.act(agent.actor, latents(networks.with_encoder(agent.actor, agent.critic)))
    return {"train/value_at_goals": jnp.mean(networks.value(agent.critic, latents(agent.critic), action))}


def make_ddpg(
    networks: Networks,
    config: Config,
    resolved: Resolved,
    auxiliary: Auxiliary | None = None,
    shards: Shards = ONE,
    compute: ComputeGradients | None = None,
) -> GradientSteps:
    """Build the gradient steps of DDPG for these networks.

    Args:
        networks: Architecture of the parameters.
        config: Learning rates, target decay, action penalty.
        resolved: Discount, bounds of the targets, filter threshold.
        auxiliary: Auxiliary tasks; None for those of ``config``, without stacked images.
        shards: Shards of the learner: batches are those of one shard, gradients and metrics those of the whole.
        compute: See `build`.
    """
    if auxiliary is None:
        auxiliary = make_auxiliary(config, networks.observation_spec, networks.action_size, 1, networks.dtype)
    learned_reward = make_learned_reward(networks, config, resolved)
    learning = Objectives(networks, config, resolved, auxiliary, shards)
    keeps_state, of_states = auxiliary.weighting.name != "none", bool(networks.critic_state_size)
    compute = compute or (network_gradients.critic_of_states if of_states else network_gradients.critic_of_images)

    def prepare(working: WorkingState, batch: Batch) -> PreparedBatch:
        image = None
        if auxiliary.needs_image:
            image = networks.normalize(working.scaling.observations, batch.observation_t, batch.shift)
        # Before, goal, after, views: the online networks read the first two, their targets the second and third.
        return PreparedBatch(batch, networks.prepare_batch(working.scaling, batch), image)

    def gradients(working: WorkingState, prepared: PreparedBatch, with_actor: bool = True) -> tuple[Gradients, Metrics]:
        agent, batch = working.agent, prepared.batch
        copies = ComputeCopies(*map(networks.with_compute_copy, _network_parameters(agent), working.copies))
        rewarded = None
        if learned_reward is not None:
            rewarded = learned_reward.compute_batch_rewards(
                agent.reward_model, working.scaling.observations, prepared.inputs, batch
            )
        if rewarded is not None:
            batch = batch.replace(reward=rewarded.reward)
        assert batch.reward is not None
        state = auxiliary.start(copies.actor if of_states else copies.critic) if agent.weighting is None else agent.weighting
        computed = compute(learning, copies, prepared._replace(batch=batch), state, with_actor)
        metrics, mean_square = computed.metrics, None if computed.action is None else jnp.mean(jnp.square(computed.action))
        counts = diagnostics.count_rewards(
            batch.reward, computed.keep, resolved.reward_positive, resolved.reward_negative, batch.success, rewarded is not None
        )
        if learned_reward is not None and rewarded is not None:
            metrics[f"train/{learned_reward.name}_loss"] = rewarded.loss
        of_model = rewarded.gradient if rewarded is not None else None
        # Average everything that was not reduced earlier over the shards of a learner, in one all-reduce.
        own = {"critic": computed.critic, "actor": computed.actor}
        reduced = own.pop("actor" if of_states else "critic") if learning.reduces_early else None
        own, of_model, metrics, mean_square, counts = shards.mean((own, of_model, metrics, mean_square, counts))
        if mean_square is not None:
            metrics["train/action_size"] = jnp.sqrt(mean_square)
        metrics |= {f"train/{name}": fraction for name, fraction in diagnostics.fractions(counts, shards.count).items()}
        critic, actor = own.get("critic", reduced), own.get("actor", reduced)
        return Gradients(critic, actor, computed.weighting if keeps_state else None, of_model), metrics

    def apply(working: WorkingState, chosen: Gradients) -> WorkingState:
        counts = working.counts + jnp.array([1, int(chosen.actor is not None), 1])
        agent = _apply(working.agent, counts, chosen, config)
        if learned_reward is not None:
            agent = agent.replace(reward_model=learned_reward.apply(agent.reward_model, chosen.reward_model))
        return working._replace(agent=agent, copies=_compute_copies(networks, agent), counts=counts)

    return GradientSteps(
        init=lambda key: _start(networks, auxiliary, learned_reward, key),
        begin=functools.partial(_begin, networks),
        prepare=prepare,
        gradients=gradients,
        apply=apply,
        end=lambda working: _with_counts(working.agent, working.counts),
    )


DrawNoise = Callable[[jax.Array, int], jax.Array]
"""(key, U) -> `PreparedBatch.noise` of U gradient steps, [U, B, A]."""


def make_update(
    config: Config, steps: GradientSteps, draw_noise: DrawNoise | None = None
) -> Callable[..., tuple[Agent, Metrics]]:
    """Build `Algorithm.update` from gradient steps; without noise in targets if ``draw_noise`` is None."""
    interval = config.ddpg.actor_interval

    def update(agent: Agent, statistics: Statistics, batches: Batches, key: jax.Array) -> tuple[Agent, Metrics]:
        names: list[str] = []

        def take(
            state: tuple[WorkingState, PreparedBatch], following: Any
        ) -> tuple[tuple[WorkingState, PreparedBatch], jax.Array]:
            """Take gradient steps, of which only the last updates the actor; unrolled, so that the body has no conditional.

            Each step receives its prepared batch, and prepares the next one, which a GPU can do while it computes; otherwise,
            it would have to wait for its own batch first. Returns the new state, and the means of the metrics, stacked in the
            order of ``names``.
            """
            (working, prepared), rows = state, []
            for number in range(interval):
                coming = read(working, jax.tree.map(lambda leaf, number=number: leaf[number], following))
                gradients, metrics = steps.gradients(working, prepared, number == interval - 1)
                working, prepared = steps.apply(working, gradients), coming
                rows.append(metrics)
            names[:] = rows[-1]
            # Stack metrics in one vector, because writing each scalar would take a kernel.
            metrics = jnp.stack([_mean([row[name] for row in rows if name in row]) for name in names])
            return (working, prepared), metrics

        def read(working: WorkingState, row: tuple[Any, jax.Array | None]) -> PreparedBatch:
            choice, noise = row
            return steps.prepare(working, batches.read(choice))._replace(noise=noise)

        # Sample noise for all gradient steps at once, like the choices, which saves kernels in each step.
        count = jax.tree.leaves(batches.choices)[0].shape[0]
        rows = (batches.choices, None if draw_noise is None else draw_noise(key, count))
        working = steps.begin(agent, statistics)
        prepared = read(working, jax.tree.map(lambda leaf: leaf[0], rows))
        # The last prefetch wraps around to the first batch and is discarded.
        following = jax.tree.map(lambda leaf: jnp.roll(leaf, -1, axis=0).reshape(-1, interval, *leaf.shape[1:]), rows)
        (working, _), metrics = jax.lax.scan(take, (working, prepared), following)
        return steps.end(working), dict(zip(names, jnp.mean(metrics, axis=0), strict=True))

    return update


def _mean(values: list[jax.Array]) -> jax.Array:
    return functools.reduce(jnp.add, values) / len(values)


def make(setup: Setup) -> Algorithm:
    """Build DDPG; errors as in `make_learned_reward`."""
    return build(setup)


def build(
    setup: Setup, critic_heads: int = 1, draw_noise: DrawNoise | None = None, compute: ComputeGradients | None = None
) -> Algorithm:
    """Build an algorithm of DDPG's family.

    Args:
        setup: Configuration and sizes.
        critic_heads: Number of critic heads; all share one target, from the minimum of their values (`Networks.critic_heads`).
        draw_noise: Sampler of the noise on actions in targets; None for no noise.
        compute: Function that computes both networks' gradients; None for that of `network_gradients`.
    """
    config, resolved = setup.config, setup.resolved
    sizes = setup.action_size, resolved.critic_output_bias, critic_heads, setup.critic_state_size
    networks = Networks(config, setup.observation_spec, *sizes)
    steps = make_ddpg(networks, config, resolved, setup.auxiliary, setup.shards, compute)
    policy = make_policy(networks)

    def policy_params(agent: Agent, statistics: Statistics) -> PolicyParams:
        return policy.params(networks.with_encoder(agent.actor, agent.critic), statistics)

    update = make_update(config, steps, draw_noise)
    algorithm = Algorithm(steps.init, policy.act, update, policy_params, policy.encode_goal, networks=networks)
    if setup.critic_state_size:  # true states at goal images are unknown
        return algorithm
    return algorithm._replace(diagnose=functools.partial(_value_at_goals, networks))
