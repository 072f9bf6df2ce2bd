"""What every goal-reaching environment has in common: its state, and the four functions that move it.

    state = env.reset(key)              one environment; vmap it for a batch
    state = env.advance(state, action)  physics, reward, success; no pixels
    frame = env.observe(state)          what the agent sees
    state = env.step(state, action)     advance, then observe, with ``state.obs`` filled in

An environment object holds only constants (model, camera, configuration); a `State` holds everything that changes, so every
method is a pure function that can be jitted, vmapped, scanned and differentiated through: forwards and in reverse, on a GPU
within ``compilation.kernels(False)``, for physics has no derivatives in its kernels. Episodes have a fixed length
(`GoalEnv.horizon`), ``done`` is always 0, and nothing resets by itself: no final observation is ever lost.
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

_ONE_STATE = "reset and step return one State, whose parts are attributes: obs, reward, metrics"


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class State:
    """Everything that changes in one environment.

    Attributes:
        data: The physics state (`mujoco.mjx.Data` for the MuJoCo tasks).
        achieved_state: [G] float32, the true quantity that the goal is about (metres or radians; each task says which).
        goal_state: [G] float32, the value of that quantity that the goal image shows. Neither is shown to the agent.
        reward: [] float32, `goals.oracle_reward` of the two.
        done: [] float32, always 0: episodes have one length, and ending one is a truncation.
        metrics: ``success`` ([] float32, 0 or 1) and ``goal_distance`` ([] float32, unit of the state).
        obs: ``observation``, as `GoalEnv.observe` makes it, ``achieved_goal`` and ``desired_goal``, as `GoalEnv.as_goal` does;
            None where the caller asked for no images (`GoalEnv.advance` passes it through untouched).
        history: [F - 1, nq] float32, the joint positions one, two, ... control steps ago, where an observation stacks F > 1
            images; else None. Before the first step everything stood still.
        domain: What domain randomisation drew for this episode (see `randomization`); None where it is off.
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
        """A copy with some fields changed."""
        return dataclasses.replace(self, **changes)

    def __iter__(self) -> Iterator[Any]:
        raise TypeError(f"{_ONE_STATE}; Gymnasium's tuples come from jaxrl_vis_envs.adapters.gymnasium.GymnasiumEnv")

    def __getitem__(self, key: Any) -> Any:
        raise TypeError(f"{_ONE_STATE}, such as state.obs['observation']")


class GoalEnv(abc.ABC):
    """An environment with a goal. Subclasses say how it starts, moves and appears; success and reward are the same for all."""

    # Set by each task.
    name: str
    horizon: int  # control steps in an episode
    action_size: int  # A
    threshold: float  # an episode succeeds where goal_distance <= threshold, in `distance_unit`
    distance_unit: str = "m"
    control_period: float  # simulated seconds of one control step
    # How hard the task is before anything is learned, as measured by benchmarks/tasks/task_difficulty.py; None: not measured.
    chance: float | None = None  # share of episodes that uniformly random actions end in success
    difficulty: float | None = None  # mean distance from start to goal, in thresholds
    frame_stack: int = 1  # F, images of the latest control steps that an observation stacks

    if not TYPE_CHECKING:  # a type checker would take it for every attribute

        def __getattr__(self, name: str) -> NoReturn:
            message = f"{type(self).__name__!r} object has no attribute {name!r}"
            if name in ("render", "action_space", "observation_space", "seed", "close"):
                message += "; Gymnasium's interface is jaxrl_vis_envs.adapters.gymnasium.GymnasiumEnv(name)"
            raise AttributeError(message)

    @abc.abstractmethod
    def reset(self, key: jax.Array) -> State:
        """Starts an episode: samples a start and a goal, and fills in `State.obs`.

        Args:
            key: [] a typed JAX key.
        """

    @abc.abstractmethod
    def advance(self, state: State, action: jax.Array) -> State:
        """Moves the physics by one control step, without making an image.

        Args:
            state: The state to start from.
            action: [A] float32 in [-1, 1]; values outside are clipped, and a NaN counts as 0.

        Raises:
            ValueError: ``action`` has another shape (`check_action`).
        """

    @abc.abstractmethod
    def observe(self, state: State) -> jax.Array:
        """What the agent sees of ``state``: planar [C, H, W] uint8, or [S] float32 for the state variants.

        Where images are stacked, C is F times the channels of one, and the newest comes first. The others are the newest ones
        of the observations before, or of the first one where the episode began: a replay keeps the newest alone.
        """

    def as_goal(self, frame: jax.Array) -> jax.Array:
        """The goal that says "be where ``frame`` was", in the shape of ``frame``: its newest image, F times.

        A goal stands still, so whoever relabels with an observation passes it through this function.
        """
        if self.frame_stack == 1:
            return frame
        return jnp.tile(frame[: frame.shape[0] // self.frame_stack], (self.frame_stack, 1, 1))

    def step(self, state: State, action: jax.Array) -> State:
        """`advance`, then `observe`: the one to use where every step's image is wanted.

        Raises:
            ValueError: ``action`` has another shape than [A].
        """
        self.check_action(action)
        state = self.advance(state, action)
        frame = self.observe(state)
        achieved_goal = self.as_goal(frame)
        desired_goal = achieved_goal if state.obs is None else state.obs["desired_goal"]
        return state.replace(obs={"observation": frame, "achieved_goal": achieved_goal, "desired_goal": desired_goal})

    def check_key(self, key: Any) -> None:
        """Refuses what is not one JAX key.

        Raises:
            ValueError: ``key`` is a seed, or several keys.
        """
        is_typed = hasattr(key, "dtype") and jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
        if not is_typed and getattr(key, "dtype", None) != np.uint32:
            raise ValueError(f"reset takes a JAX key, such as jax.random.key(0), not {key!r}")
        # An untyped one is [2], or [4] where JAX is set to another generator.
        one = jax.eval_shape(lambda: jax.random.key(0) if is_typed else jax.random.PRNGKey(0))
        if key.shape != one.shape:
            raise ValueError(f"reset takes one JAX key, not an array of shape {key.shape}; vmap over a batch")

    def check_action(self, action: jax.Array) -> None:
        """Refuses an action of the wrong size, which NumPy's rules might broadcast.

        Raises:
            ValueError: ``action`` has another shape than [A].
        """
        if np.shape(action) != (self.action_size,):
            task = type(self).__name__  # an environment that was not made by its name has none
            raise ValueError(
                f"{task} takes an action of shape ({self.action_size},), got {np.shape(action)}; vmap over a batch"
            )

    @functools.cached_property
    def _reset_shape(self) -> State:
        return jax.eval_shape(self.reset, jax.random.key(0))

    @property
    def observation_spec(self) -> jax.ShapeDtypeStruct:
        """Shape and dtype of `observe`, derived by tracing `reset`, so it cannot go stale."""
        obs = self._reset_shape.obs
        assert obs is not None
        return jax.ShapeDtypeStruct(obs["observation"].shape, obs["observation"].dtype)

    @property
    def goal_state_size(self) -> int:
        """G, the length of `State.achieved_state`."""
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
        """A State with its reward and metrics filled in from the truth."""
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
    """`State.history` [frame_stack - 1, nq] of an episode that starts at rest at ``qpos`` [nq]; None for a stack of one."""
    return None if frame_stack == 1 else jnp.tile(qpos, (frame_stack - 1, 1))


def push_history(history: jax.Array | None, qpos: jax.Array) -> jax.Array | None:
    """``history`` after one more control step, which began at ``qpos`` [nq]; the oldest is forgotten."""
    return None if history is None else jnp.concatenate([qpos[None], history[:-1]])


def sanitize_action(action: jax.Array) -> jax.Array:
    """[A] -> [A] float32 in [-1, 1], with NaN read as 0: a broken policy must not poison the physics."""
    action = jnp.asarray(action, jnp.float32)
    return jnp.clip(jnp.where(jnp.isnan(action), 0.0, action), -1.0, 1.0)
