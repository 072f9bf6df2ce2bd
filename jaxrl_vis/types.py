"""Arrays and records passed between the learner's modules, and the letters that name their axes.

    E  environments in a rollout          B  transitions in a batch       C, H, W  channels, height, width of an image
    N  episodes that the replay holds     A  action components            G        components of the true goal state
    T  control steps of an episode        S  seeds trained in parallel

An observation is a planar image [C, H, W] uint8 or a state vector [S] float32; "..." stands for its own axes.
"""

import dataclasses
from typing import Any, NamedTuple, Self

import jax

Params = Any  # a nested dict of arrays, as flax.linen makes it
Metrics = dict[str, jax.Array]


class Replaceable:
    """Mixin that gives a frozen dataclass a ``replace`` method."""

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some fields changed."""
        return dataclasses.replace(self, **changes)  # type: ignore[type-var]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Episodes(Replaceable):
    """E complete episodes, episode-major, each observation stored once. Slot T+1 of observations and states holds the goal.

    With the observations *and* the goal of an episode in one array, relabelling is the choice of a slot: t+1 to T is an
    observation of the same episode, T+1 the original goal.

    Attributes:
        observations: [E, T+2, ...] after 0, 1, ... T steps, then the goal's.
        states: [E, T+2, G] float32, the true goal-space states at the same times.
        actions: [E, T, A] float32, as executed (with exploration noise).
        stored: [E, T, ...] uint8 or float32, values that auxiliary tasks computed for each step, by task (`AuxTask.episode`).
    """

    observations: jax.Array
    states: jax.Array
    actions: jax.Array
    stored: dict[str, jax.Array] = dataclasses.field(default_factory=dict)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ReplayState(Replaceable):
    """Ring buffer of N episodes. The arrays are those of `Episodes` with E = N, except that images are packed and stored once
    (`replay`).

    Attributes:
        episodes: [N, ...] storage; unwritten entries are zero.
        size: [] int32, number of episodes stored.
    """

    episodes: Episodes
    size: jax.Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Batch(Replaceable):
    """Batch of B sampled and relabelled transitions, each with a goal.

    Attributes:
        observations: [3, B, ...] before the action, of the goal (relabelled or original), and after the action: contiguous, in
            the order in which the networks take them, to avoid a copy.
        action: [B, A] float32.
        state_tp1: [B, G] float32, the true state after the action.
        goal_state: [B, G] float32, the true state depicted by the goal.
        reward: [B] float32 for reaching that goal, summed over the steps between the first and the last observation; None while
            goals may still change, and where the learner itself computes the reward (method autoencoder).
        discount: [B] float32, discount of the value after these steps; None: that of one step.
        shift: [B, 2] int32, pixels by which to shift the images down and to the right; None: no shift.
        views: [B, ...] images in the observation's dtype that auxiliary tasks have computed, by task (`AuxTask.view`).
        targets: Targets of auxiliary tasks, by task.
        reached: [B, ...] the observation after the action in the form of a goal, if the forms differ (stacked images); else
            None.
        success: [B] float32, 1 where the true state after the action reaches the goal, else 0; for diagnostics only. None if
            rewards span several steps.
    """

    observations: jax.Array
    action: jax.Array
    state_tp1: jax.Array
    goal_state: jax.Array
    reward: jax.Array | None = None
    discount: jax.Array | None = None
    shift: jax.Array | None = None
    views: dict[str, jax.Array] = dataclasses.field(default_factory=dict)
    targets: dict[str, Any] = dataclasses.field(default_factory=dict)
    reached: jax.Array | None = None
    success: jax.Array | None = None

    @property
    def observation_t(self) -> jax.Array:
        """[B, ...] observation before the action."""
        return self.observations[0]

    @property
    def goal(self) -> jax.Array:
        """[B, ...] observation of the goal."""
        return self.observations[1]

    @property
    def observation_tp1(self) -> jax.Array:
        """[B, ...] observation after the action."""
        return self.observations[2]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class NormalizerState(Replaceable):
    """Running mean and variance of observations, per pixel and channel.

    Attributes:
        count: [] float32, number of observations.
        mean: [...] float32, in the observation's own unit (0 to 255 for images).
        sum_of_squares: [...] float32, of deviations from the mean.
    """

    count: jax.Array
    mean: jax.Array
    sum_of_squares: jax.Array


class Statistics(NamedTuple):
    """Observation statistics of a learner.

    Attributes:
        observations: Statistics of observations; of goals, too, unless they have their own.
        own_goals: Those of goals alone; None where they have not.
    """

    observations: NormalizerState
    own_goals: NormalizerState | None

    @property
    def goals(self) -> NormalizerState:
        """Statistics that goals are normalised with."""
        return self.observations if self.own_goals is None else self.own_goals


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TrainState(Replaceable):
    """State of the learner: an agent, and observation statistics.

    Attributes:
        agent: State of the algorithm, a pytree of its own (`learner.algorithm`).
        normalizer: Observation statistics.
        goal_normalizer: Separate statistics of goals; None if they share ``normalizer``.
    """

    agent: Any
    normalizer: NormalizerState
    goal_normalizer: NormalizerState | None = None

    @property
    def statistics(self) -> Statistics:
        """Both statistics."""
        return Statistics(self.normalizer, self.goal_normalizer)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class LoopState(Replaceable):
    """State carried from one training iteration to the next, with a leading seed axis S on every leaf except ``iteration``.

    Attributes:
        train: The learner, [S, ...].
        replay: The episodes, [S, N, ...].
        key: [S] typed keys, constant: iteration k draws from ``fold_in(key, k)``, so that a resumed run is reproduced exactly.
        iteration: [] int32, iterations completed; shared by all seeds, so that the replay is written with one contiguous slice.
    """

    train: TrainState
    replay: ReplayState
    key: jax.Array
    iteration: jax.Array
