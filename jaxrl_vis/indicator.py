"""Indicator rewards for your own robot: the method of section 5.1.4 of the thesis on plain arrays, without a simulator.

    goal_slots    choice of a later observation of the same episode as a transition's goal: relabelling and balancing
    rewards       positive if the achieved observation equals the goal, exactly or up to camera noise
    keep_mask     0 for negatives that the critic contradicts: the filter
    Learner       all of these in a learner trained on episodes, recorded or collected with its own policy
    learn         training of a learner on an .npz file of recorded episodes

Observations are images [H, W, C] uint8 or vectors [S] float32, actions [A] lie in [-1, 1], and all episodes have the same
number of steps.
"""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis.config import Config, preset, validate
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.plugins import build_component, find_component
from jaxrl_vis.learner import train_step
from jaxrl_vis.learner.algorithm import Algorithm, Setup
from jaxrl_vis.learner.auxtasks.auxiliary import make_auxiliary
from jaxrl_vis.learner.ddpg.losses import keep_mask
from jaxrl_vis.learner.iteration import choose_batches
from jaxrl_vis.learner.memory.relabel import choose_goal_slots as goal_slots
from jaxrl_vis.learner.memory.replay import Replay
from jaxrl_vis.learner.memory.sampling import Sampler
from jaxrl_vis.learner.networks import normalizer
from jaxrl_vis.learner.networks.networks import compute_dtype
from jaxrl_vis.learner.resolved import resolve
from jaxrl_vis.recordings.convert import read
from jaxrl_vis.types import Episodes, ReplayState, TrainState
from jaxrl_vis_envs.goals import indicator_reward as rewards

__all__ = ["Learner", "goal_slots", "keep_mask", "learn", "rewards"]

_CALL, _UPDATE = 0x696E73, 0x757064  # folded into the seed's key
# Metrics that compare rewards with true states, which are unknown here.
_NEED_TRUTH = ("false_", "filtered_false")


def _planar(images: np.ndarray) -> np.ndarray:
    """Convert uint8 images [..., H, W, C] to [..., C, H, W], and vectors to float32."""
    return np.moveaxis(images, -1, -3) if images.dtype == np.uint8 else images.astype(np.float32)


class Learner:
    """Off-policy learner trained on complete episodes that the caller adds.

    Example::

        learner = Learner((64, 64, 3), action_size=4, horizon=50)
        learner.add(observations, actions, goal)        # [T+1, 64, 64, 3], [T, 4], [64, 64, 3]
        learner.update(50)
        action = learner.act(observation, goal)

    Attributes:
        config: Validated configuration.
        episodes: Number of episodes added so far.
    """

    def __init__(
        self,
        observation_shape: tuple[int, ...],
        action_size: int,
        horizon: int,
        capacity: int = 1000,
        *,
        state_size: int = 0,
        threshold: float = 0.0,
        **options: Any,
    ) -> None:
        """Initialise networks and an empty replay.

        Args:
            observation_shape: (H, W, C) of images, or (S,) of vectors.
            action_size: A, number of action components.
            horizon: T, number of steps in an episode.
            capacity: Number of episodes that the replay holds.
            state_size: Size of true states, where they are known: for method ``oracle``, and for metrics of other rewards'
                errors. 0 if they are not.
            threshold: Distance of true states up to which a goal counts as reached, in their unit.
            **options: Options of `jaxrl-vis train`, by name: ``preset`` (``cpu`` if not given), ``seed``, ``method``
                (``indicator_balance_filter``, or with a ``tolerance`` ``indicator_tolerance``), ``algorithm``, ...

        Raises:
            RequestError: A size or an option is invalid, or an option needs true states.
        """
        if len(observation_shape) not in (1, 3) or min(*observation_shape, action_size, horizon, capacity, state_size + 1) < 1:
            raise RequestError(
                f"observations are images (H, W, C) or vectors (S,), not {observation_shape}; sizes are at least 1"
            )
        options.setdefault("method", "indicator_tolerance" if "tolerance" in options else "indicator_balance_filter")
        options.setdefault("env", "recordings")
        self.config: Config = validate(preset(str(options.pop("preset", "cpu")), **options))
        if self.config.run.seeds != 1 or self.config.run.devices != 1:
            raise RequestError("a learner on the host has one seed and one device")
        resolved = resolve(self.config, horizon)
        if resolved.method.reward == "oracle" and self.config.run.algorithm != "contrastive" and not state_size:
            raise RequestError(
                "method oracle needs true states: give state_size, threshold and states, or use indicator_balance_filter"
            )
        shape = observation_shape if len(observation_shape) == 1 else (observation_shape[2], *observation_shape[:2])
        self._spec = jax.ShapeDtypeStruct(shape, jnp.uint8 if len(shape) == 3 else jnp.float32)
        self._observation_shape, self._action_size, self._horizon = tuple(observation_shape), action_size, horizon
        self._state_size = state_size
        auxiliary = make_auxiliary(self.config, self._spec, action_size, 1, compute_dtype(self.config))
        if auxiliary.tasks:
            raise RequestError("a learner on the host has no auxiliary losses: leave out aux_tasks")
        setup = Setup(self.config, resolved, self._spec, action_size, auxiliary)
        algorithm = self.config.run.algorithm
        maker = find_component("algorithm", algorithm, train_step.ALGORITHMS, self.config.environment.env_folder)
        self._algorithm = build_component("algorithm", algorithm, maker, setup, expected_type=Algorithm)
        self._replay = Replay(capacity, 1, horizon)
        self._sampler = Sampler(self.config, resolved, self._replay, threshold)
        self._key = jax.random.key(self.config.run.seed)
        self._train_state = TrainState(jax.jit(self._algorithm.init)(self._key), normalizer.init(self._spec))
        self._replay_state: ReplayState = self._replay.init(self._spec, max(1, state_size), action_size)
        self._updates: dict[int, Callable[..., Any]] = {}
        self.episodes, self._calls = 0, 0

    def _check_array(self, name: str, array: Any, shape: tuple[int, ...], dtype: Any) -> np.ndarray:
        array = np.asarray(array)
        if array.shape != shape or (dtype == np.uint8) != (array.dtype == np.uint8) or not np.all(np.isfinite(array)):
            expected = "uint8" if dtype == np.uint8 else "finite numbers"
            raise RequestError(f"{name} must be {expected} of the shape {shape}, not {array.dtype} of {array.shape}")
        return array.astype(dtype)

    def add(self, observations: Any, actions: Any, goal: Any = None, states: Any = None) -> None:
        """Add an episode to the replay, replacing the oldest one once it is full, and update the observation statistics.

        Args:
            observations: [T+1, ...] observations before the first action and after each one.
            actions: [T, A] executed actions in [-1, 1]; others are clipped.
            goal: [...] goal of the episode; None if it had none: the last observation is used instead.
            states: [T+2, state_size] true states of the observations and, last, of the goal; None unless there is a
                ``state_size``.

        Raises:
            RequestError: A shape or dtype is wrong, a value is not finite, or ``states`` are missing or superfluous.
        """
        if (states is None) != (self._state_size == 0):
            raise RequestError("states are needed where a learner has a state_size, and only there")
        dtype = np.dtype(self._spec.dtype)
        checked = self._check_array("observations", observations, (self._horizon + 1, *self._observation_shape), dtype)
        done = self._check_array("actions", actions, (self._horizon, self._action_size), np.dtype(np.float32))
        aim = checked[-1] if goal is None else self._check_array("goal", goal, self._observation_shape, dtype)
        true = np.zeros((self._horizon + 2, 1)) if states is None else states
        shape = (self._horizon + 2, max(1, self._state_size))
        episode = Episodes(
            observations=_planar(np.concatenate([checked, aim[None]]))[None],  # type: ignore[arg-type]
            states=self._check_array("states", true, shape, np.dtype(np.float32))[None],  # type: ignore[arg-type]
            actions=np.clip(done, -1.0, 1.0)[None],  # type: ignore[arg-type]
        )
        self._replay_state, self._train_state = self._insert(self._replay_state, self._train_state, episode, self.episodes)
        self.episodes += 1

    @functools.cached_property
    def _insert(self) -> Callable[..., tuple[ReplayState, TrainState]]:
        def insert(
            state: ReplayState, train: TrainState, episode: Episodes, number: jax.Array
        ) -> tuple[ReplayState, TrainState]:
            statistics = normalizer.update(train.normalizer, episode.observations)
            return self._replay.insert(state, episode, number), train.replace(normalizer=statistics)

        return jax.jit(insert, donate_argnums=0)

    def update(self, count: int) -> dict[str, float]:
        """Take ``count`` gradient steps and return the means of their metrics (docs/learner.md).

        Raises:
            RequestError: No episode has been added yet, or ``count`` is invalid.
        """
        if self.episodes == 0:
            raise RequestError("there is nothing to learn from yet: add episodes first")
        config = self.config.replace(updates_per_iteration=count)
        validate(config)

        def update(train: TrainState, state: ReplayState, key: jax.Array, latest: jax.Array) -> Any:
            batches = choose_batches(config, self._sampler, state, key, latest)
            agent, metrics = self._algorithm.update(train.agent, train.statistics, batches, jax.random.fold_in(key, _UPDATE))
            return train.replace(agent=agent), metrics

        key = jax.random.fold_in(jax.random.fold_in(self._key, _CALL), self._calls)
        compiled = self._updates.setdefault(count, jax.jit(update, donate_argnums=0))
        self._train_state, metrics = compiled(self._train_state, self._replay_state, key, self.episodes - 1)
        self._calls += 1
        unknown = () if self._state_size else _NEED_TRUTH
        known = {name: value for name, value in metrics.items() if not name.removeprefix("train/").startswith(unknown)}
        return {name: float(value) for name, value in jax.device_get(known).items()}

    def act(self, observation: Any, goal: Any) -> np.ndarray:
        """Compute the policy's action [A] float32 in [-1, 1], without exploration, for an observation and a goal [...].

        Raises:
            RequestError: A shape or dtype is wrong, or a value is not finite.
        """
        dtype = np.dtype(self._spec.dtype)
        image, aim = (
            self._check_array(*pair, self._observation_shape, dtype) for pair in (("observation", observation), ("goal", goal))
        )
        return np.asarray(self._act(self._train_state, _planar(image)[None], _planar(aim)[None])[0])

    @functools.cached_property
    def _act(self) -> Callable[..., jax.Array]:
        def act(train: TrainState, observations: jax.Array, goals: jax.Array) -> jax.Array:
            policy = self._algorithm.policy_params(train.agent, train.statistics)
            return self._algorithm.act(policy, observations, self._algorithm.encode_goal(policy, goals))

        return jax.jit(act)


def learn(recordings: Path | str, updates: int = 5000, **options: Any) -> Learner:
    """Train a learner on recorded episodes.

    Args:
        recordings: An .npz file with ``observations`` [N, T+1, ...], ``actions`` [N, T, A] and optionally ``goals`` [N, ...];
            or the folder of a LeRobot dataset (`jaxrl_vis.recordings`).
        updates: Number of gradient steps, rounded up to a multiple of 100 if greater than 100.
        **options: As for `Learner`.

    Raises:
        RequestError: The file is missing or lacks these arrays, or an option is invalid.
    """
    recorded = read(recordings)
    count, shape = recorded.count, recorded.observations.shape[2:]
    learner = Learner(shape, recorded.actions.shape[2], recorded.horizon, capacity=count, **options)
    goals = [None] * count if recorded.goals is None else recorded.goals
    for episode in range(count):
        learner.add(recorded.observations[episode], recorded.actions[episode], goals[episode])
    together = min(updates, 100)
    for _ in range(-(-updates // together)):
        learner.update(together)
    return learner
