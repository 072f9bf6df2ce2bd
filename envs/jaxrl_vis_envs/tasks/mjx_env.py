"""Base class of the MJX tasks. A task defines its start, goals, actions and true state.

A task is a subclass of `MjxGoalEnv` with five methods, and a frozen config with ``horizon`` and ``threshold``. It is the visual
task with a `pixels.Observer`, and the state task without one; `register_task` registers both.
"""

import abc
import copy
import functools
from collections.abc import Callable
from typing import Any, Self

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxrl_vis_envs import randomization
from jaxrl_vis_envs.base import GoalEnv, State, push_history, sanitize_action, start_history
from jaxrl_vis_envs.names import visual_name
from jaxrl_vis_envs.physics import mjx_model
from jaxrl_vis_envs.physics.mjx_model import mjx
from jaxrl_vis_envs.pixels import ImageObserver, Observer, image_observer
from jaxrl_vis_envs.registry import register
from jaxrl_vis_envs.render import Scene


class MjxGoalEnv(GoalEnv):
    """`GoalEnv` whose `State.data` is an `mjx.Data` with poses consistent with its ``qpos``."""

    camera: str  # model camera of the visual task, unless `select_camera` is overridden
    goal_box: tuple[np.ndarray, np.ndarray] | None = (
        None  # lower and upper corner [3] of the goals of `goal_configuration`, m in the world; None without that method
    )
    exact_contacts: bool = False  # take physics steps with ``exact`` (see `mjx_model.step`)

    def __init__(self, config: Any, mj_model: mujoco.MjModel, observer: Callable[[mujoco.MjModel], Observer] | None) -> None:
        """Store the attributes common to all tasks.

        Args:
            config: Settings of the task.
            mj_model: MuJoCo model; later changes to it have no effect.
            observer: Function that builds the observer (poses to images) from the model. If None, `observe_state` is used.

        Raises:
            ValueError: JAX runs in 64 bits, or ``config.randomization`` varies the appearance of a task that renders no scene.
        """
        if jax.config.jax_enable_x64:
            raise ValueError(
                f"{type(self).__name__} simulates in 32 bits and JAX is set to 64: unset JAX_ENABLE_X64, or call"
                " jax.config.update('jax_enable_x64', False) first"
            )
        self.config = config
        self.camera = self.select_camera(config)
        self.horizon = config.horizon
        self.threshold = config.threshold
        self.frame_stack = getattr(config, "frame_stack", 1)
        self.mj_model = mj_model
        self._model = mjx_model.put_model(mj_model)
        self._observer = observer(mj_model) if observer is not None else None
        self.marks_object = self._observer is not None and self.select_marked(config) is not None
        self._randomization: randomization.Randomization = getattr(config, "randomization", randomization.OFF)
        self._scene: Scene | None = getattr(self._observer, "scene", None)
        if self._randomization.varies_appearance and self._scene is None:
            raise ValueError("camera, lights and colours can only be randomized in a task that draws images")

    @classmethod
    def select_camera(cls, config: Any) -> str:
        """Return the name of the model camera that the visual task uses with these settings."""
        del config
        return cls.camera

    @classmethod
    def select_marked(cls, config: Any) -> str | None:
        """Return the name of the body that images mark with these settings (`goals.object_mask`); None for none."""
        del config
        return None

    @abc.abstractmethod
    def sample_start(self, key: jax.Array) -> mjx.Data:
        """Sample the start of the episode ``reset(key)``, with poses consistent with ``qpos``; ``key`` is one typed key."""

    @abc.abstractmethod
    def sample_goal(self, key: jax.Array) -> mjx.Data:
        """Sample the configuration in the goal image of ``reset(key)``, with its poses; ``key`` is one typed key."""

    @abc.abstractmethod
    def act(self, data: mjx.Data, action: jax.Array) -> mjx.Data:
        """Simulate one control step of ``self._model``, whose parameters may be randomised (see `randomization`).

        Args:
            data: Physics state, including poses.
            action: [A] float32, finite and within [-1, 1], or somewhat beyond if the action scale is randomised.

        Returns:
            Physics state `control_period` seconds later, including poses.
        """

    @abc.abstractmethod
    def achieved(self, data: mjx.Data) -> jax.Array:
        """Return the true quantity that goals constrain, `State.achieved_state`: [G] float32."""

    def goal_state(self, key: jax.Array, goal_data: mjx.Data) -> jax.Array:
        """Return the goal state [G] of ``reset(key)``, whose goal image shows ``goal_data``: by default, its achieved state."""
        return self.achieved(goal_data)

    def goal_configuration(self, goal: jax.Array) -> mjx.Data:
        """Return the robot at rest at a goal within `goal_box`, [3] float32 (m, world), with its poses.

        Raises:
            NotImplementedError: The goals of this task are not points in space.
        """
        raise NotImplementedError(f"goals of {type(self).__name__} are not points in space")

    @abc.abstractmethod
    def observe_state(self, data: mjx.Data) -> jax.Array:
        """Return the observation of the state task: [S] float32."""

    def reset(self, key: jax.Array) -> State:
        self.check_key(key)
        data, goal_data = self.sample_start(key), self.sample_goal(key)
        domain = randomization.sample(key, self._randomization, self._model, self.action_size, self._scene)
        state = self.state_at(data, self.goal_state(key, goal_data), domain)
        # Sequentially, in a loop: the renderer is compiled once, with the same trace as in `observe`.
        both = jax.tree.map(lambda *leaves: jnp.stack(leaves), data, goal_data)
        frame, goal = jax.lax.map(lambda data: self._observe(data, None, domain), both)
        return state.replace(obs={"observation": frame, "achieved_goal": self.as_goal(frame), "desired_goal": goal})

    def advance(self, state: State, action: jax.Array) -> State:
        self.check_action(action)
        action = randomization.varied_action(sanitize_action(action), state.domain)
        data = self._with_dynamics(state.domain).act(state.data, action)
        history = push_history(state.history, state.data.qpos)
        return self._measure(data, self.achieved(data), state.goal_state, state.obs, history, state.domain)

    def observe(self, state: State) -> jax.Array:
        return self._observe(state.data, state.history, state.domain)

    def state_at(self, data: mjx.Data, goal_state: jax.Array, domain: randomization.Domain | None = None) -> State:
        """Return the `State` of an episode that starts at ``data``, with ``goal_state`` [G] float32 and the randomisation
        ``domain`` (None for none); its ``obs`` is None.
        """
        history = start_history(data.qpos, self.frame_stack)
        return self._measure(data, self.achieved(data), goal_state, None, history, domain)

    @property
    def observation_spec(self) -> jax.ShapeDtypeStruct:
        """Shape and dtype of `observe`, without tracing physics or renderer."""
        if isinstance(self._observer, ImageObserver):
            return self._observer.spec
        shape = jax.eval_shape(
            lambda data: self._observe(data, start_history(data.qpos, self.frame_stack), None), self._data_shape
        )
        return jax.ShapeDtypeStruct(shape.shape, shape.dtype)

    @property
    def goal_state_size(self) -> int:
        return jax.eval_shape(self.achieved, self._data_shape).shape[0]

    @property
    def scene(self) -> Scene | None:
        """Scene and camera of the images, before randomisation; None if the task observes states."""
        return self._scene

    @functools.cached_property
    def _data_shape(self) -> mjx.Data:
        return jax.eval_shape(lambda: mjx.make_data(self.mj_model, device=jax.local_devices()[0]))

    def _with_dynamics(self, domain: randomization.Domain | None) -> Self:
        """Return a copy of this task with the randomised dynamics of an episode, so that `act` remains a pure function."""
        if not self._randomization.varies_model or domain is None:
            return self
        varied = copy.copy(self)
        varied._model = randomization.varied_model(self._model, domain)
        return varied

    def _observe(self, data: mjx.Data, history: jax.Array | None, domain: randomization.Domain | None) -> jax.Array:
        if self._observer is None:
            return self.observe_state(data)
        return self._observer(data, history) if self._scene is None else self._observer(data, history, domain)


def register_task(task: type[MjxGoalEnv], config_class: type, visual_config_class: type) -> None:
    """Register both environments of a task.

    Args:
        task: Task class, constructed from a config and an observer or None. Its name is that of the state variant.
        config_class: Configuration of the state variant.
        visual_config_class: Configuration of the visual variant: the same fields, and those of `pixels.PixelsConfig`.
    """
    build: Any = task  # subclasses build the model themselves and take no `mj_model`

    def build_visual(config: Any) -> MjxGoalEnv:
        camera, marked = task.select_camera(config), task.select_marked(config)
        return build(config, lambda mj_model: image_observer(mj_model, camera, config, marked))

    name = task.__name__
    register(name, lambda config: build(config, None), config_class)
    register(visual_name(name), build_visual, visual_config_class, state_variant=name)
