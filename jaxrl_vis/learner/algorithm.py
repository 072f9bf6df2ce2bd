"""Interface of an algorithm, through which rollouts, evaluations, checkpoints and policies access a learner.

    init            initial agent, a pytree that the algorithm defines
    update          all gradient steps of an iteration, on batches sampled from the replay
    policy_params   the part of an agent needed for acting: small, and sufficient for a policy
    act             actions without exploration
    encode_goal     representation of the goals that ``act`` takes, computed once per episode
    diagnose        further metrics of a rollout

An algorithm is built by a function of a `Setup`, which holds the configuration and the sizes of the task. DDPG, TD3 and
contrastive RL are built in (`train_step.ALGORITHMS`); ``--algorithm module:Name`` selects a custom one. `networks.policy`
provides ``act``, ``encode_goal`` and ``policy_params`` for algorithms with an actor of `Networks`.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxrl_vis.config import Config
from jaxrl_vis.learner.auxtasks.auxiliary import Auxiliary
from jaxrl_vis.learner.parallel.shards import ONE, Shards
from jaxrl_vis.learner.resolved import Resolved
from jaxrl_vis.types import Batch, Metrics, Statistics

Agent = Any
PolicyParams = Any


@dataclasses.dataclass(frozen=True)
class Setup:
    """Configuration and sizes for which an algorithm is built.

    Attributes:
        config: Configuration of the run.
        resolved: Discount, rewards and bounds of targets derived from ``config``.
        observation_spec: Shape and dtype of an observation: [C, H, W] uint8 or [S] float32.
        action_size: A; actions lie in [-1, 1].
        auxiliary: Auxiliary tasks of the run and their weighting; an algorithm may ignore them.
        shards: Shards of the learner: each reads its own batches, and the algorithm averages gradients and metrics over them.
        critic_state_size: P, size of the true states that the critic observes instead of images; 0 if it observes the same as
            the actor.
    """

    config: Config
    resolved: Resolved
    observation_spec: jax.ShapeDtypeStruct
    action_size: int
    auxiliary: Auxiliary
    shards: Shards = ONE
    critic_state_size: int = 0


@dataclasses.dataclass(frozen=True)
class Batches:
    """Batches of an iteration, sampled together and read one at a time.

    Attributes:
        choices: Tree of arrays [U, ...], one row for each gradient step.
        read: One row of ``choices`` -> `Batch` with rewards (unless the method leaves them to the algorithm).
    """

    choices: Any
    read: Callable[[Any], Batch]


Update = Callable[[Agent, Statistics, Batches, jax.Array], tuple[Agent, Metrics]]


class Algorithm(NamedTuple):
    """Algorithm of one learner: pure functions, mapped over seeds.

    Attributes:
        init: key -> agent.
        act: (policy parameters, observations [E, ...], encoded goals) -> actions [E, A] float32 in [-1, 1].
        update: (agent, Statistics, Batches, key) -> (agent after a gradient step on every batch, means of metrics, [] float32
            by name).
        policy_params: (agent, Statistics) -> parameters that ``act`` and ``encode_goal`` read.
        encode_goal: (policy parameters, goals [E, ...]) -> tree of arrays [E, ...], encoded goals as ``act`` takes them.
            Goals are constant, so it is computed once per episode. By default the goals themselves.
        diagnose: (agent, Statistics, goals [E, ...] of a rollout) -> further metrics, [] float32 by name, averaged over the
            shards of a learner.
        networks: Networks of the algorithm (`networks.Networks`), for tools that inspect them; None if it has none.
    """

    init: Callable[[jax.Array], Agent]
    act: Callable[[PolicyParams, jax.Array, Any], jax.Array]
    update: Update
    policy_params: Callable[[Agent, Statistics], PolicyParams]
    encode_goal: Callable[[PolicyParams, jax.Array], Any] = lambda params, goals: goals
    diagnose: Callable[[Agent, Statistics, jax.Array], Metrics] = lambda agent, statistics, goals: {}
    networks: Any = None

    def of_policies(self, statistics: Statistics) -> "Algorithm":
        """Return the algorithm for agents that consist of policy parameters only: they can act, but ``update`` raises an error.

        Args:
            statistics: Initial observation statistics.
        """

        def update(*_: Any) -> tuple[Agent, Metrics]:
            raise NotImplementedError("a policy alone does not learn")

        return Algorithm(
            init=lambda key: self.policy_params(self.init(key), statistics),
            act=self.act,
            update=update,
            policy_params=lambda agent, _: agent,
            encode_goal=self.encode_goal,
            networks=self.networks,
        )


def scan_batches(step: Callable[[Agent, Statistics, Batch, jax.Array], tuple[Agent, Metrics]]) -> Update:
    """Build `Algorithm.update` from a single gradient step.

    Args:
        step: (agent, Statistics, Batch, key) -> (agent, metrics, [] float32 by name).
    """

    def update(agent: Agent, statistics: Statistics, batches: Batches, key: jax.Array) -> tuple[Agent, Metrics]:
        def take(agent: Agent, row: tuple[Any, jax.Array]) -> tuple[Agent, Metrics]:
            choice, step_key = row
            return step(agent, statistics, batches.read(choice), step_key)

        count = jax.tree.leaves(batches.choices)[0].shape[0]
        agent, metrics = jax.lax.scan(take, agent, (batches.choices, jax.random.split(key, count)))
        return agent, jax.tree.map(lambda values: jnp.mean(values, axis=0), metrics)

    return update
