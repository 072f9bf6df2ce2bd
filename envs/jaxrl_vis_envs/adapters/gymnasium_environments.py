"""N environments in lockstep: the shared implementation of the single and the vectorised Gymnasium environment."""

import functools
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces

from jaxrl_vis_envs import render
from jaxrl_vis_envs.adapters.environments import goal_env
from jaxrl_vis_envs.adapters.rewards import Reward, reward_function
from jaxrl_vis_envs.base import GoalEnv, State
from jaxrl_vis_envs.compiling.compilation import jit
from jaxrl_vis_envs.randomization import varied_scene
from jaxrl_vis_envs.registry import make

Observations = dict[str, np.ndarray]


class _Programs(NamedTuple):
    """Compiled functions for any number N of copies of an environment, shared by environments with the same settings.

    Attributes:
        env: The environment.
        space: Observation space of one environment.
        reset: Function from seeds [N] uint32 to State, observations, and goals [N, ...] in the form of the task.
        step: Function from State (donated) and actions [N, A] float32 to State and observations, without ``goal_pixels``, which
            do not change.
    """

    env: GoalEnv
    space: spaces.Dict
    reset: Any
    step: Any


@functools.cache
def _make_cached(name: str, overrides: tuple[tuple[str, Any], ...]) -> GoalEnv:
    return make(name, **dict(overrides))


def _find_or_make(env: str | GoalEnv, overrides: dict[str, Any]) -> GoalEnv:
    """Return the environment ``env``, built if it is a name; cached by name and settings if all settings are hashable.

    Raises:
        ValueError: As in `jaxrl_vis_envs.make` and `goal_env`.
    """
    if not isinstance(env, str):
        return goal_env(env, overrides)
    pairs = ((key, tuple(value) if isinstance(value, list) else value) for key, value in sorted(overrides.items()))
    settings = tuple(pairs)
    try:
        hash(settings)
    except TypeError:  # not hashable: the environment may accept them or reject them with its own message
        return goal_env(env, overrides)
    return _make_cached(env, settings)


@functools.cache
def _programs(env: GoalEnv) -> _Programs:
    spec = env.observation_spec
    sees_images = len(spec.shape) == 3
    observe_state = getattr(env, "observe_state", None)

    def observe(state: State) -> dict[str, jax.Array]:
        observation = {"achieved_goal": state.achieved_state, "desired_goal": state.goal_state}
        if not sees_images:
            return {"observation": env.observe(state), **observation}
        # A user's environment may observe only images.
        vector = state.achieved_state if observe_state is None else observe_state(state.data)
        return {"observation": vector, **observation, "pixels": _channels_last(env.observe(state))}

    def reset(seeds: jax.Array) -> tuple[State, dict[str, jax.Array], jax.Array]:
        state = jax.vmap(lambda seed: env.reset(jax.random.key(seed)))(seeds)
        assert state.obs is not None
        goal = state.obs["desired_goal"]
        goals = {"goal_pixels": _channels_last(goal)} if sees_images else {}
        # Images are returned separately, not stored in the state.
        state = state.replace(obs=None)
        return state, {**jax.vmap(observe)(state), **goals}, goal

    def step(state: State, actions: jax.Array) -> tuple[State, dict[str, jax.Array]]:
        state = jax.vmap(env.advance)(state, actions)
        return state, jax.vmap(observe)(state)

    _, shapes, _ = jax.eval_shape(reset, jax.ShapeDtypeStruct((1,), jnp.uint32))
    return _Programs(env, _space(shapes), jit(reset), jit(step, donate_argnums=0))


def _channels_last(image: jax.Array) -> jax.Array:
    """Move channels last: [..., C, H, W] -> [..., H, W, C]."""
    return jnp.moveaxis(image, -3, -1)


def _space(shapes: dict[str, jax.ShapeDtypeStruct]) -> spaces.Dict:
    """Return the observation space of one environment, given the shapes of a batch of one."""

    def box(shape: jax.ShapeDtypeStruct) -> spaces.Box:
        low, high = (0, 255) if shape.dtype == jnp.uint8 else (-np.inf, np.inf)
        return spaces.Box(low, high, shape.shape[1:], shape.dtype.type)

    return spaces.Dict({name: box(shape) for name, shape in shapes.items()})


@functools.cache
def _render_program(env: GoalEnv, size: int) -> Any:
    """Return a compiled function from the physics and domains of N environments to images [N, size, size, 3] uint8.

    Raises:
        ValueError: The environment has no MuJoCo model with a camera.
    """
    mj_model, camera = getattr(env, "mj_model", None), getattr(env, "camera", None)
    if mj_model is None or camera is None:
        raise ValueError(f"{type(env).__name__} has no MuJoCo model with a camera to render through")
    scene = render.Scene.from_mjmodel(mj_model, camera=camera, height=size, width=size)
    return jit(jax.vmap(lambda data, domain: render.render(varied_scene(scene, domain), data).rgb))


class Environments:
    """N environments in lockstep on the device. The arguments are those of `gymnasium.GymnasiumEnv`.

    Attributes:
        env: The environment.
        programs: Its compiled functions.
        score: Function from states [..., G] and goals [..., G] to rewards [...] float32.
        metadata: Gymnasium metadata.
        action_space: Action space of one environment.
        steps: Number of steps since `reset`.

    Raises:
        ValueError: There is no such environment, option, reward, render mode or camera.
    """

    def __init__(
        self, env: str | GoalEnv, reward: Reward, render_mode: str | None, render_size: int, overrides: dict[str, Any]
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}")
        self._env_arguments, self._render_size = (env, overrides), None if render_mode is None else render_size
        self._make()
        self.score = reward_function(reward, self.env.threshold)
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": max(1, round(1 / self.env.control_period))}
        self.action_space = spaces.Box(-1.0, 1.0, (self.env.action_size,), np.float32)
        self.steps = 0
        self._state: State | None = None
        self._goal_pixels: Observations = {}
        self._view: tuple[np.ndarray, np.ndarray] | None = None

    def _make(self) -> None:
        """Build the environment and its compiled functions, or reuse those with the same settings."""
        self.env = _find_or_make(*self._env_arguments)
        self.programs = _programs(self.env)
        self._render_images = None if self._render_size is None else _render_program(self.env, self._render_size)

    def __getstate__(self) -> dict[str, Any]:
        # Compiled programs cannot be pickled: the receiver builds them again. Episodes continue from their current state.
        return {name: value for name, value in vars(self).items() if name not in ("env", "programs", "_render_images")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._make()

    @property
    def is_over(self) -> bool:
        """True if the episodes have reached their horizon."""
        return self.steps >= self.env.horizon

    def reset(self, seeds: np.ndarray) -> Observations:
        """Start an episode for each of ``seeds`` [N] uint32; return observations."""
        self._state, observations, goal = self.programs.reset(seeds)
        self.steps = 0
        observations = _to_host(observations)
        self._goal_pixels = {name: observations[name].copy() for name in observations if name == "goal_pixels"}
        self._view = _planar(observations), np.array(goal)
        return observations

    def step(self, actions: Any) -> tuple[Observations, np.ndarray]:
        """Step with ``actions`` [N, A]; return observations and rewards [N] float32.

        Raises:
            gymnasium.error.ResetNeeded: `reset` has not been called.
            ValueError: ``actions`` has the wrong shape.
        """
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset() before step()")
        actions, expected = np.asarray(actions, np.float32), (*self._state.done.shape, self.env.action_size)
        if actions.shape != expected:
            raise ValueError(f"actions must have the shape {expected}, got {actions.shape}")
        self._state, observations = self.programs.step(self._state, actions)
        self.steps += 1
        observations = _to_host(observations)
        assert self._view is not None
        self._view = _planar(observations), self._view[1]
        observations |= {name: images.copy() for name, images in self._goal_pixels.items()}
        # Scored here, not in the compiled step, so that it equals `compute_reward` of the returned observations bit for bit.
        return observations, self.score(observations["achieved_goal"], observations["desired_goal"])

    def info(self, observations: Observations) -> dict[str, np.ndarray]:
        """Return ``is_success`` [N] bool and ``goal_distance`` [N] float32."""
        distance = -reward_function("dense", self.env.threshold)(observations["achieved_goal"], observations["desired_goal"])
        return {"is_success": distance <= self.env.threshold, "goal_distance": distance}

    def learner_view(self) -> tuple[np.ndarray, np.ndarray]:
        """Return observations and goals [N, ...] in the form of the task, see `GymnasiumEnv.learner_view`.

        Raises:
            gymnasium.error.ResetNeeded: `reset` has not been called.
        """
        if self._view is None:
            raise gymnasium.error.ResetNeeded("call reset() before learner_view()")
        return self._view

    def render(self) -> np.ndarray | None:
        """Return images [N, size, size, 3] uint8, or None without a render mode.

        Raises:
            gymnasium.error.ResetNeeded: `reset` has not been called.
        """
        if self._render_images is None:
            return None
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset() before render()")
        return np.array(self._render_images(self._state.data, self._state.domain))


def _planar(observations: Observations) -> np.ndarray:
    """Return copies of a learner's observations: images [N, C, H, W] uint8, or vectors [N, S] float32."""
    if "pixels" in observations:
        return np.array(np.moveaxis(observations["pixels"], -1, -3), order="C")
    return observations["observation"].copy()


def _to_host(observations: dict[str, jax.Array]) -> Observations:
    """Copy observations to the host: on a CPU, JAX returns views of memory that the next step reuses."""
    return {name: np.array(values) for name, values in observations.items()}
