"""What the MJX tasks share. A task says how it starts, what its goals are, what an action does and what is true.

A task is a subclass of `MjxGoalEnv` with five methods, and a frozen config with ``horizon`` and ``threshold``. Seen through
a `pixels.Observer` it is the visual task, without one the state task.
"""

import abc
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco

from jaxrl_vis_envs.base import GoalEnv, State, push_history, sanitize_action, start_history
from jaxrl_vis_envs.pixels import Observer
from jaxrl_vis_envs.tasks.mjx_model import mjx


class MjxGoalEnv(GoalEnv):
    """A `GoalEnv` whose `State.data` is an `mjx.Data` with poses that belong to its ``qpos``."""

    camera: str  # the camera of the model that the visual task sees through

    def __init__(self, config: Any, mj_model: mujoco.MjModel, observer: Callable[[mujoco.MjModel], Observer] | None) -> None:
        """Keeps what is common.

        Args:
            config: The settings of the task.
            mj_model: The model; changes to it after this have no effect.
            observer: Given the model, returns the function from poses to pictures. None: `observe_state` is what is seen.
        """
        self.config = config
        self.horizon = config.horizon
        self.threshold = config.threshold
        self.frames = getattr(config, "frames", 1)
        self.mj_model = mj_model
        self._model = mjx.put_model(mj_model)
        self._draw = observer(mj_model) if observer is not None else None

    @abc.abstractmethod
    def sample_start(self, key: jax.Array) -> mjx.Data:
        """The start of the episode ``reset(key)``."""

    @abc.abstractmethod
    def sample_goal(self, key: jax.Array) -> mjx.Data:
        """The configuration that the goal picture of ``reset(key)`` shows."""

    @abc.abstractmethod
    def act(self, data: mjx.Data, action: jax.Array) -> mjx.Data:
        """The physics of one control step. ``action`` is [A] float32, all finite and within [-1, 1]."""

    @abc.abstractmethod
    def achieved(self, data: mjx.Data) -> jax.Array:
        """The true quantity that goals are about, `State.achieved_state`: [G] float32."""

    @abc.abstractmethod
    def observe_state(self, data: mjx.Data) -> jax.Array:
        """What the state task sees: [S] float32."""

    def reset(self, key: jax.Array) -> State:
        data, goal_data = self.sample_start(key), self.sample_goal(key)
        state = self.state_at(data, self.achieved(goal_data))
        # One program draws both: that halves what there is to compile.
        both = jax.tree.map(lambda *leaves: jnp.stack(leaves), data, goal_data)
        frame, goal = jax.vmap(lambda data: self._observe(data, None))(both)
        return state.replace(obs={"observation": frame, "achieved_goal": frame, "desired_goal": goal})

    def advance(self, state: State, action: jax.Array) -> State:
        data = self.act(state.data, sanitize_action(action))
        history = push_history(state.history, state.data.qpos)
        return self._measure(data, self.achieved(data), state.goal_state, state.obs, history)

    def observe(self, state: State) -> jax.Array:
        return self._observe(state.data, state.history)

    def state_at(self, data: mjx.Data, goal_state: jax.Array) -> State:
        """An episode that starts at ``data``, with a goal state [G] and no pictures."""
        return self._measure(data, self.achieved(data), goal_state, None, start_history(data.qpos, self.frames))

    def _observe(self, data: mjx.Data, history: jax.Array | None) -> jax.Array:
        return self.observe_state(data) if self._draw is None else self._draw(data, history)
