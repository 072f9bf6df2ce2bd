"""Batches from the replay: sample, relabel, reward.

    choose     sample transitions (`replay`), and for each the slot of its episode that becomes the goal (`relabel`)
    batch      read them, convert observations in those slots to goals, and compute rewards

Rewards are recomputed from the contents of the replay, by the same functions that score the environments. No MuJoCo here.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxrl_vis.config import Config
from jaxrl_vis.config.methods import RewardFunction
from jaxrl_vis.learner.auxtasks.auxiliary import Auxiliary
from jaxrl_vis.learner.memory import reward_errors
from jaxrl_vis.learner.memory.random_integers import fractions_to_integers
from jaxrl_vis.learner.memory.relabel import choose_goal_slots
from jaxrl_vis.learner.memory.replay import Indices, Replay
from jaxrl_vis.learner.memory.rewards import make_reward
from jaxrl_vis.learner.parallel.shards import ONE, Shards
from jaxrl_vis.learner.resolved import Resolved
from jaxrl_vis.types import Batch, ReplayState
from jaxrl_vis_envs import goals

# Folded into a key for samples that only some configurations need, so that they do not affect the others.
_TRIVIAL, _SHIFT, _TARGETS = 0x747276, 0x736866, 0x617578


class Choice(NamedTuple):
    """Chosen transitions and goals, sampled in advance for many batches at once.

    Attributes:
        indices: Positions of the transitions, [B] each.
        goal_slot: [B] int32 in [t + 1, T + 1]; for goals from another episode, in [1, T].
        goal_episode: [B] int32, episodes of the goal slots; None for the transitions' own episodes.
        shift: [B, 2] int32, see `Batch`; None without random shifts.
        target_key: [] typed key, for targets of auxiliary tasks; None without any.
        clutter_end: [] float32, see `reward_errors`; None if false rewards are not confined.
        is_replaceable: [B] bool, mask of relabelled goals to be replaced by another transition's if they are already reached;
            None if there are none, or if true states have determined them (``goal_episode``).
    """

    indices: Indices
    goal_slot: jax.Array
    goal_episode: jax.Array | None = None
    shift: jax.Array | None = None
    target_key: jax.Array | None = None
    clutter_end: jax.Array | None = None
    is_replaceable: jax.Array | None = None


@dataclasses.dataclass(frozen=True)
class Sampler:
    """Sampler of batches; all methods are pure.

    Attributes:
        config: Configuration with the batch size, method, and p1.
        resolved: p2, R+ and R-.
        replay: Sizes of the replay to read from.
        threshold: Threshold of the oracle's reward, in the unit of the true states.
        as_goal: [...] -> [...], converts an achieved observation to a goal (`GoalEnv.as_goal`); None if observations already
            have the form of goals.
        auxiliary: Auxiliary tasks whose targets are added to batches; None for no targets.
        shards: Shards of the learner. ``replay`` and batches are those of one shard; the configured batch size is the total.
        mask: Mask of the elements that indicators compare (`rewards.make_reward`); None for all.
    """

    config: Config
    resolved: Resolved
    replay: Replay
    threshold: float
    as_goal: Callable[[jax.Array], jax.Array] | None = None
    auxiliary: Auxiliary | None = None
    shards: Shards = ONE
    mask: Callable[[jax.Array], jax.Array] | None = None

    def choose(self, state: ReplayState, key: jax.Array, iteration: jax.Array) -> Choice:
        """Sample B transitions and their goals; every shard samples those of the whole learner and keeps its own part.

        Args:
            state: State of the replay, with the rollout of ``iteration`` inserted.
            key: [] typed key.
            iteration: [] int32.
        """
        sample_key, goal_key = jax.random.split(key)
        indices = self.replay.sample_indices(state, sample_key, iteration, self.config.run.batch_size)
        goal_slot = self.goal_slots(goal_key, indices.time)
        choice = Choice(indices, goal_slot)
        if self.config.goals.trivial_goals < 1.0:
            choice = self._replace_trivial_goals(state, choice, jax.random.fold_in(key, _TRIVIAL))
        if self.config.network.random_shift:
            max_shift, shape = self.config.network.random_shift, (self.config.run.batch_size, 2)
            fraction = jax.random.uniform(jax.random.fold_in(key, _SHIFT), shape)
            choice = choice._replace(shift=fractions_to_integers(fraction, 2 * max_shift + 1) - max_shift)
        if self.config.study.reward_clutter < 1.0:
            choice = choice._replace(clutter_end=self._clutter_end(state, iteration))
        parted = jax.tree.map(self.shards.part, choice._replace(clutter_end=None))
        choice = parted._replace(clutter_end=choice.clutter_end)
        if not self._has_targets:
            return choice
        return choice._replace(target_key=self.shards.own_key(jax.random.fold_in(key, _TARGETS)))

    def _clutter_end(self, state: ReplayState, iteration: jax.Array) -> jax.Array:
        goal_states = self.shards.gather(state.episodes.states[:, -1])
        is_stored = self.shards.gather(self.replay.is_stored(state, iteration))
        return reward_errors.find_clutter_end(goal_states, is_stored, self.config.study.reward_clutter)

    @property
    def _has_targets(self) -> bool:
        return self.auxiliary is not None and bool(self.auxiliary.tasks)

    def goal_slots(self, key: jax.Array, time: jax.Array) -> jax.Array:
        """Choose goal slots for transitions that start at ``time`` [B] int32; see `relabel`."""
        probabilities = self.config.goals.relabel_probability, self.resolved.balance_probability
        discount = self.resolved.discount if self.config.goals.future_goals == "geometric" else None
        return choose_goal_slots(key, time, self.replay.horizon, *probabilities, discount)

    def _replace_trivial_goals(self, state: ReplayState, choice: Choice, key: jax.Array) -> Choice:
        """Substitute goals of another episode for the relabelled goals that the transition has reached before its action.

        A fraction ``trivial_goals`` of these goals is kept. With rewards that compare observations, the reached goals are
        not known yet: then only ``is_replaceable`` is set, for `_replace_reached_goals`.

        They are not replaced by original goals. If these look different from observations in episodes (VisualFingerTurn's
        finger always hangs down in them), rarely reached goals would all share that look, and the critic could infer rewards
        from it.
        """
        (episode, time), goal_slot = choice.indices, choice.goal_slot
        is_replaceable = ~jax.random.bernoulli(key, self.config.goals.trivial_goals, time.shape)
        is_replaceable &= goal_slot <= self.replay.horizon
        if self.resolved.method.reward != "oracle":  # observations decide, which are not read yet
            return choice._replace(is_replaceable=is_replaceable)
        states = state.episodes.states
        is_replaceable &= goals.success(states[episode, time], states[episode, goal_slot], self.threshold) > 0
        # Transitions are sampled at random, so the next transition's episode is a random one.
        return choice._replace(goal_episode=jnp.where(is_replaceable, jnp.roll(episode, 1), episode))

    def _replace_reached_goals(self, batch: Batch, is_replaceable: jax.Array) -> Batch:
        """Substitute the next transition's goal for those in ``is_replaceable`` [B] that are reached before the action."""
        before = batch.observation_t if self.as_goal is None else jax.vmap(self.as_goal)(batch.observation_t)
        is_replaceable = is_replaceable & (self._reward(batch, before, 1.0, 0.0) > 0.0)

        def replaced(values: jax.Array) -> jax.Array:
            chosen = is_replaceable.reshape(-1, *(1,) * (values.ndim - 1))
            return jnp.where(chosen, jnp.roll(values, 1, axis=0), values)

        observations = batch.observations.at[1].set(replaced(batch.goal))
        return batch.replace(observations=observations, goal_state=replaced(batch.goal_state))

    def batch(self, state: ReplayState, choice: Choice) -> Batch:
        """Read the chosen transitions, with goals at rest, and compute their rewards.

        Args:
            state: State of the replay.
            choice: Choice from `choose`.

        Returns:
            B transitions, with rewards unless a learned model computes them.
        """
        batch = self.replay.gather(state, choice.indices, choice.goal_slot, self.config.study.n_step, choice.goal_episode)
        batch = batch.replace(shift=choice.shift)
        if choice.target_key is not None:
            assert self.auxiliary is not None
            batch = self.auxiliary.with_targets(choice.target_key, batch, self.replay.read_stored(state, choice.indices))
        achieved_goal = batch.observation_tp1
        if self.as_goal is not None:
            # Stacked images also show motion, while goals are at rest; convert achieved observations to the same form.
            achieved_goal = jax.vmap(self.as_goal)(batch.observation_tp1)
            batch = batch.replace(achieved_goal=achieved_goal)
            if batch.goal.ndim == 2:  # of states; the replay repeats a goal's newest image itself
                batch = batch.replace(observations=batch.observations.at[1].set(jax.vmap(self.as_goal)(batch.goal)))
        if choice.is_replaceable is not None:
            batch = self._replace_reached_goals(batch, choice.is_replaceable)
        if self.config.study.n_step > 1:
            return self._with_n_step_rewards(state, choice, batch)
        batch = batch.replace(success=goals.success(batch.state_tp1, batch.goal_state, self.threshold))
        if self.resolved.method.is_learned:
            return batch  # the learner computes rewards with its current model (`learned_reward`)
        return batch.replace(reward=self.reward(batch, achieved_goal, choice.clutter_end))

    def _with_n_step_rewards(self, state: ReplayState, choice: Choice, batch: Batch) -> Batch:
        """Replace rewards by discounted sums of the oracle's over up to ``n_step`` steps, and adapt the discounts."""
        episode, time = choice.indices
        after = time[:, None] + 1 + jnp.arange(self.config.study.n_step)  # slots that the steps lead to, [B, n]
        is_step = after <= self.replay.horizon
        achieved_goal = state.episodes.states[episode[:, None], jnp.minimum(after, self.replay.horizon)]
        values = {"positive": self.resolved.reward_positive, "negative": self.resolved.reward_negative}
        rewards = goals.oracle_reward(achieved_goal, batch.goal_state[:, None], self.threshold, **values)
        weights = is_step * self.resolved.discount ** jnp.arange(self.config.study.n_step)
        return batch.replace(
            reward=jnp.sum(weights * rewards, axis=1),
            discount=self.resolved.discount ** jnp.sum(is_step, axis=1).astype(jnp.float32),
        )

    def reward(self, batch: Batch, achieved_goal: jax.Array, clutter_end: jax.Array | None = None) -> jax.Array:
        """Compute the rewards [B] float32.

        Args:
            batch: Relabelled transitions.
            achieved_goal: [B, ...] achieved observations, converted to goals.
            clutter_end: See `Choice`.
        """
        values = {"positive": self.resolved.reward_positive, "negative": self.resolved.reward_negative}
        method = self.resolved.method
        if method.reward == "oracle":
            return self._estimated_reward(batch, clutter_end)
        return self._reward(batch, achieved_goal, values["positive"], values["negative"])

    @functools.cached_property
    def _reward(self) -> RewardFunction:
        return make_reward(self.config, self.resolved.method, self.mask)

    def _estimated_reward(self, batch: Batch, clutter_end: jax.Array | None) -> jax.Array:
        """Compute the oracle's rewards [B] float32, with an estimator's errors if configured; ``clutter_end``: see `Choice`."""
        config, positive, negative = self.config, self.resolved.reward_positive, self.resolved.reward_negative
        states = (
            reward_errors.estimate(batch.state_tp1, config.study.reward_noise) if config.study.reward_noise else batch.state_tp1
        )
        reward = goals.oracle_reward(states, batch.goal_state, self.threshold, positive, negative)
        error_rates = config.study.reward_false_positives, config.study.reward_false_negatives
        if not any(error_rates):
            return reward
        is_positive = reward_errors.flip(
            reward == positive, batch.state_tp1, batch.goal_state, *error_rates, config.study.reward_clutter, clutter_end
        )
        return jnp.where(is_positive, positive, negative).astype(jnp.float32)
