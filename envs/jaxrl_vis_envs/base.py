"""Base class and state of goal-reaching environments.

    state = env.reset(key)              one environment; vmap it for a batch
    state = env.advance(state, action)  physics, reward, success; no pixels
    frame = env.observe(state)          the agent's observation
    state = env.step(state, action)     advance, then observe, with ``state.obs`` filled in

An environment object holds only constants (model, camera, configuration); a `State` holds everything that changes, so every
method is a pure function that can be jitted, vmapped, scanned and differentiated, in forward and reverse mode. On a GPU,
differentiate inside ``compiling.compilation.kernels(False)``, because the physics kernels define no derivatives. Episodes have
a fixed length (`GoalEnv.horizon`), ``done`` is always 0, and nothing resets automatically, so the final observation is never
lost.
"""

import abc
import dataclasses
import functools
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, NoReturn, Self

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs import goals

_ONE_STATE = "reset and step return one State, with attributes obs, reward and metrics"


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class State:
    """State of one environment: everything that changes.

    Attributes:
        data: Physics state (`mujoco.mjx.Data` for the MuJoCo tasks).
        achieved_state: [G] float32, true value of the quantity that the goal constrains (metres or radians, see each task).
        goal_state: [G] float32, desired value of that quantity. Image tasks show neither to the agent.
        reward: [] float32, `goals.oracle_reward` of the two.
        done: [] float32, always 0: all episodes have the same length, and their end is a truncation.
        metrics: ``success`` ([] float32, 0 or 1), ``goal_distance`` ([] float32, unit of the state), and any others listed in
            `GoalEnv.metric_names`.
        obs: ``observation`` from `GoalEnv.observe`, ``achieved_goal`` and ``desired_goal`` in the form of `GoalEnv.as_goal`;
            None if the caller asked for no images (`GoalEnv.advance` passes it through unchanged).
        history: [F - 1, nq] float32, joint positions one, two, ... control steps ago, if an observation stacks F > 1 images;
            else None. The robot is assumed to have been at rest before the first step.
        domain: Domain randomisation sampled for this episode (see `randomization`); None if it is off.
    """

    data: Any
    achieved_state: jax.Array
    goal_state: jax.Array
    reward: jax.Array
    done: jax.Array
    metrics: dict[str, jax.Array]
    obs: dict[str, jax.Array] | None = None
    history: jax.Array | None = None
    domain: dict[str, jax.Array] | None = None

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some fields changed."""
        return dataclasses.replace(self, **changes)

    def __iter__(self) -> Iterator[Any]:
        raise TypeError(f"{_ONE_STATE}; Gymnasium's tuples come from jaxrl_vis_envs.adapters.gymnasium.GymnasiumEnv")

    def __getitem__(self, key: Any) -> Any:
        raise TypeError(f"{_ONE_STATE}, such as state.obs['observation']")


class GoalEnv(abc.ABC):
    """Abstract goal-reaching environment. Subclasses define start, motion and appearance; success and reward are shared."""

    # Set by each task.
    name: str
    horizon: int  # control steps in an episode
    action_size: int  # A
    threshold: float  # an episode succeeds if goal_distance <= threshold, in `distance_unit`
    distance_unit: str = "m"
    control_period: float  # simulated seconds of one control step
    action_meaning: str = ""  # meaning and units of an action's components, for builders of the real robot
    # Difficulty of the task before learning, measured by benchmarks/tasks/task_difficulty.py; None if not measured.
    chance: float | None = None  # success rate of uniformly random actions
    difficulty: float | None = None  # mean distance from start to goal, in multiples of `threshold`
    metric_names: tuple[str, ...] = ("success", "goal_distance")  # keys of `State.metrics` logged at the last step, as means
    frame_stack: int = 1  # F, number of most recent images stacked in an observation
    marks_object: bool = False  # images mark the pixels of the object that goals are about (`goals.object_mask`)

    if not TYPE_CHECKING:  # with this method, type checkers would accept any attribute

        def __getattr__(self, name: str) -> NoReturn:
            message = f"{type(self).__name__!r} object has no attribute {name!r}"
            if name in ("render", "action_space", "observation_space", "seed", "close"):
                message += "; Gymnasium's interface is jaxrl_vis_envs.adapters.gymnasium.GymnasiumEnv(name)"
            raise AttributeError(message)

    @abc.abstractmethod
    def reset(self, key: jax.Array) -> State:
        """Start an episode: sample a start and a goal, and fill in `State.obs`.

        Args:
            key: One typed JAX key.

        Raises:
            ValueError: ``key`` is a seed, or a batch of keys (`check_key`).
        """

    @abc.abstractmethod
    def advance(self, state: State, action: jax.Array) -> State:
        """Advance the physics by one control step, without rendering.

        Args:
            state: Current state.
            action: [A] float32 in [-1, 1]; values outside are clipped, and NaN counts as 0.

        Raises:
            ValueError: ``action`` has the wrong shape (`check_action`).
        """

    @abc.abstractmethod
    def observe(self, state: State) -> jax.Array:
        """Render the agent's observation of ``state``: planar [C, H, W] uint8, or [S] float32 for the state variants.

        If images are stacked, C is F times the channels of one image, newest first. The older images are the newest ones of the
        preceding observations, or repeat the episode's first image, so a replay needs to store only the newest image of each.
        """

    @property
    def converts_goals(self) -> bool:
        """True if `as_goal` changes observations: if they stack images, or contain more than the goal constrains."""
        return self.frame_stack > 1

    def as_goal(self, frame: jax.Array) -> jax.Array:
        """Convert an observation to the goal of reaching it, with the same shape: its newest image, repeated F times.

        A goal does not move, so relabelling with an observation must go through this function.
        """
        if self.frame_stack == 1:
            return frame
        return jnp.tile(frame[: frame.shape[0] // self.frame_stack], (self.frame_stack, 1, 1))

    def step(self, state: State, action: jax.Array) -> State:
        """Advance and observe; convenient if the image of every step is needed.

        Raises:
            ValueError: ``action`` does not have the shape [A].
        """
        self.check_action(action)
        state = self.advance(state, action)
        frame = self.observe(state)
        achieved_goal = self.as_goal(frame)
        desired_goal = achieved_goal if state.obs is None else state.obs["desired_goal"]
        return state.replace(obs={"observation": frame, "achieved_goal": achieved_goal, "desired_goal": desired_goal})

    def check_key(self, key: Any) -> None:
        """Check that ``key`` is a single JAX key.

        Raises:
            ValueError: ``key`` is a seed, or a batch of keys.
        """
        is_typed = hasattr(key, "dtype") and jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
        if not is_typed and getattr(key, "dtype", None) != np.uint32:
            raise ValueError(f"reset takes a JAX key, such as jax.random.key(0), not {key!r}")
        # An untyped key is [2], or [4] if JAX is configured for another generator.
        one = jax.eval_shape(lambda: jax.random.key(0) if is_typed else jax.random.PRNGKey(0))
        if key.shape != one.shape:
            raise ValueError(f"reset takes one JAX key, not an array of shape {key.shape}; vmap over a batch")

    def check_action(self, action: jax.Array) -> None:
        """Check the size of an action, which NumPy might otherwise broadcast silently.

        Raises:
            ValueError: ``action`` does not have the shape [A].
        """
        if np.shape(action) != (self.action_size,):
            task = type(self).__name__  # `name` is only set by `make`
            raise ValueError(
                f"{task} takes an action of shape ({self.action_size},), got {np.shape(action)}; vmap over a batch"
            )

    @functools.cached_property
    def _reset_shape(self) -> State:
        return jax.eval_shape(self.reset, jax.random.key(0))

    @property
    def observation_spec(self) -> jax.ShapeDtypeStruct:
        """Shape and dtype of `observe`, derived by tracing `reset` so that it cannot go stale."""
        obs = self._reset_shape.obs
        assert obs is not None
        return jax.ShapeDtypeStruct(obs["observation"].shape, obs["observation"].dtype)

    @property
    def goal_state_size(self) -> int:
        """Size G of `State.achieved_state`."""
        return self._reset_shape.goal_state.shape[0]

    def _measure(
        self,
        data: Any,
        achieved_state: jax.Array,
        goal_state: jax.Array,
        obs: dict | None,
        history: jax.Array | None = None,
        domain: dict[str, jax.Array] | None = None,
    ) -> State:
        """Build a State, with reward and metrics computed from the true states."""
        distance = goals.goal_distance(achieved_state, goal_state)
        return State(
            data=data,
            achieved_state=achieved_state,
            goal_state=goal_state,
            reward=goals.oracle_reward(achieved_state, goal_state, self.threshold),
            done=jnp.zeros((), jnp.float32),
            metrics={"success": goals.success(achieved_state, goal_state, self.threshold), "goal_distance": distance},
            obs=obs,
            history=history,
            domain=domain,
        )


def start_history(qpos: jax.Array, frame_stack: int) -> jax.Array | None:
    """Return `State.history` [frame_stack - 1, nq] of an episode that starts at rest at ``qpos`` [nq]; None if not stacking."""
    return None if frame_stack == 1 else jnp.tile(qpos, (frame_stack - 1, 1))


def push_history(history: jax.Array | None, qpos: jax.Array) -> jax.Array | None:
    """Push ``qpos`` [nq], the positions before the latest control step, onto ``history`` and drop the oldest entry."""
    return None if history is None else jnp.concatenate([qpos[None], history[:-1]])


def sanitize_action(action: jax.Array) -> jax.Array:
    """Clip an action [A] to [-1, 1] as float32 and replace NaN by 0, so that a broken policy cannot poison the physics."""
    action = jnp.asarray(action, jnp.float32)
    return jnp.clip(jnp.where(jnp.isnan(action), 0.0, action), -1.0, 1.0)
