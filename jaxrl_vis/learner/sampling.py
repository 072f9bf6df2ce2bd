"""From the replay to a batch that a loss can be taken of: sample, relabel, reward.

    choose     which transitions (`replay`), and which slot of its own episode is each one's goal (`relabel`)
    batch      reads them, makes goals of what was observed in those slots, and rewards what was reached

Rewards are computed anew from what the replay holds, by the same functions that score the environments. No MuJoCo here.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxrl_vis.config import Config, Resolved
from jaxrl_vis.learner.relabel import choose_goal_slots
from jaxrl_vis.learner.replay import Indices, Replay
from jaxrl_vis.methods import METHODS
from jaxrl_vis.types import Batch, ReplayState
from jaxrl_vis_envs import goals


class Choice(NamedTuple):
    """Which transitions to read, and with which goals; made ahead, for many batches at once.

    Attributes:
        indices: Where the transitions lie, [B] each.
        goal_slot: [B] int32 in [t + 1, T + 1].
    """

    indices: Indices
    goal_slot: jax.Array


@dataclasses.dataclass(frozen=True)
class Sampler:
    """Draws batches; all methods are pure.

    Attributes:
        config: Batch size, method, and p1.
        resolved: p2, R+ and R-.
        replay: What to read from.
        threshold: Of the oracle's reward, in the unit of the true states.
        as_goal: [...] -> [...], makes a goal of an observation (`GoalEnv.as_goal`); None where an observation is one already.
    """

    config: Config
    resolved: Resolved
    replay: Replay
    threshold: float
    as_goal: Callable[[jax.Array], jax.Array] | None = None

    def choose(self, state: ReplayState, key: jax.Array, iteration: jax.Array) -> Choice:
        """Draws B transitions and their goals.

        Args:
            state: The replay, with the rollout of ``iteration`` inserted.
            key: [] a typed key.
            iteration: [] int32.
        """
        sample_key, goal_key = jax.random.split(key)
        indices = self.replay.sample_indices(state, sample_key, iteration, self.config.batch_size)
        return Choice(indices, self.goal_slots(goal_key, indices.time))

    def goal_slots(self, key: jax.Array, time: jax.Array) -> jax.Array:
        """Goal slots for transitions that start at ``time`` [B] int32; see `relabel`."""
        shares = self.config.relabel_probability, self.resolved.balance_probability
        return choose_goal_slots(key, time, self.replay.horizon, *shares)

    def batch(self, state: ReplayState, choice: Choice) -> Batch:
        """Reads what was chosen, with goals that stand still and rewards that belong to them.

        Args:
            state: The replay.
            choice: From `choose`.

        Returns:
            B transitions with rewards.
        """
        batch = self.replay.gather(state, *choice)
        reached = batch.observation_tp1
        if self.as_goal is not None:
            # Stacked images also show how things move, and a goal stands still; what is reached is compared in the same terms.
            as_goal = jax.vmap(self.as_goal)
            observed_t, goal, observed_tp1 = batch.observations
            batch = batch.replace(observations=jnp.stack([observed_t, as_goal(goal), observed_tp1]))
            reached = as_goal(observed_tp1)
        return batch.replace(reward=self.reward(batch, reached))

    def reward(self, batch: Batch, reached: jax.Array) -> jax.Array:
        """Rewards [B] float32.

        Args:
            batch: The transitions, relabelled.
            reached: [B, ...] what they have reached, as a goal would show it.
        """
        values = {"positive": self.resolved.reward_positive, "negative": self.resolved.reward_negative}
        if METHODS[self.config.method].reward == "oracle":
            return goals.oracle_reward(batch.state_tp1, batch.goal_state, self.threshold, **values)
        return goals.indicator_reward(reached, batch.goal, **values)
