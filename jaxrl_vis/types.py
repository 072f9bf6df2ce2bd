"""Arrays and records passed between the learner's modules, and the letters that name their axes.

    E  environments in a rollout          B  transitions in a batch       C, H, W  channels, height, width of an image
    N  episodes that the replay holds     A  action components            G        components of the true goal state
    T  control steps of an episode        S  seeds trained in parallel    P        G plus components of ``full_states``

An observation is a planar image [C, H, W] uint8 or a state vector [S] float32; "..." stands for its own axes.
"""

import dataclasses
from typing import Any, NamedTuple, Self

import jax

Params = Any  # nested dict of arrays, as in flax.linen
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
        observations: [E, T+2, ...] observations after 0, 1, ..., T steps, then that of the goal.
        states: [E, T+2, G] float32, the true goal-space states at the same times.
        actions: [E, T, A] float32, as executed (with exploration noise).
        stored: [E, T, ...] uint8 or float32, values that auxiliary tasks computed for each step, by task (`AuxTask.episode`).
        full_states: [E, T+1, P - G] float32, observations of the task's state variant (`MjxGoalEnv.observe_state`), for critics
            that also observe these; None for others.
    """

    observations: jax.Array
    states: jax.Array
    actions: jax.Array
    stored: dict[str, jax.Array] = dataclasses.field(default_factory=dict)
    full_states: jax.Array | None = None


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ReplayState(Replaceable):
    """Ring buffer of N episodes. The arrays are those of `Episodes` with E = N, except that images are packed, and each image
    of a stack is stored once (`replay`).

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
        observations: [3, B, ...] observation before the action, of the goal (relabelled or original), and after the action;
            contiguous and in the order in which the networks process them, to avoid a copy.
        action: [B, A] float32.
        state_tp1: [B, G] float32, the true state after the action.
        goal_state: [B, G] float32, the true state depicted by the goal.
        reward: [B] float32 for reaching that goal, the discounted sum over the steps between the first and the last
            observation; None until it is computed, and if the learner itself computes it (methods autoencoder and classifier).
        discount: [B] float32, discount factor of the value after these steps; None for that of a single step.
        shift: [B, 2] int32, pixels by which to shift the images down and to the right; None for no shift.
        views: [B, ...] images in the observation's dtype, computed by auxiliary tasks, by task (`AuxTask.view`).
        targets: Targets of auxiliary tasks, by task.
        achieved_goal: [B, ...] the observation after the action in the form of a goal, if the forms differ (stacked images);
            else None.
        success: [B] float32, 1 where the true state after the action reaches the goal, else 0; for diagnostics only. None if
            rewards span several steps.
        full_states: [2, B, P - G] float32, `Episodes.full_states` before and after the action; None if not collected.
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
    achieved_goal: jax.Array | None = None
    success: jax.Array | None = None
    full_states: jax.Array | None = None

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
        sum_of_squares: [...] float32, sum of the squared deviations from the mean.
    """

    count: jax.Array
    mean: jax.Array
    sum_of_squares: jax.Array


class Statistics(NamedTuple):
    """Observation statistics of a learner.

    Attributes:
        observations: Statistics of observations; also used for goals, unless these have their own.
        own_goals: Separate statistics of goals; None if they share ``observations``.
        states: Statistics of true states [P], those of `Episodes.full_states` and then of `Episodes.states`; None if the
            critic does not observe them.
    """

    observations: NormalizerState
    own_goals: NormalizerState | None
    states: NormalizerState | None = None

    @property
    def goals(self) -> NormalizerState:
        """Statistics with which goals are normalised."""
        return self.observations if self.own_goals is None else self.own_goals


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TrainState(Replaceable):
    """State of the learner: an agent, and observation statistics.

    Attributes:
        agent: State of the algorithm, a pytree that it defines (`learner.algorithm`).
        normalizer: Observation statistics.
        goal_normalizer: Separate statistics of goals; None if they share ``normalizer``.
        state_normalizer: Statistics of true states (`Statistics.states`); None if the critic does not observe them.
    """

    agent: Any
    normalizer: NormalizerState
    goal_normalizer: NormalizerState | None = None
    state_normalizer: NormalizerState | None = None

    @property
    def statistics(self) -> Statistics:
        """Statistics of observations, goals and true states."""
        return Statistics(self.normalizer, self.goal_normalizer, self.state_normalizer)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class LoopState(Replaceable):
    """State carried from one training iteration to the next, with a leading seed axis S on every leaf except ``iteration``.

    Attributes:
        train: [S, ...] state of the learner.
        replay: [S, N, ...] stored episodes.
        key: [S] typed keys, constant: iteration k samples with ``fold_in(key, k)``, so that a resumed run is reproduced
            exactly.
        iteration: [] int32, number of completed iterations; shared by all seeds, so that the replay is written with one
            contiguous slice.
    """

    train: TrainState
    replay: ReplayState
    key: jax.Array
    iteration: jax.Array
