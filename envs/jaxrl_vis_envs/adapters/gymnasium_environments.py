"""N environments in step behind Gymnasium's interfaces: what the single and the vector environment are made of."""

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
    """The compiled half of an environment, for any number N of environments; shared by all environments with the same settings.

    Attributes:
        env: The environment.
        space: The observation space of one environment.
        reset: seeds [N] uint32 -> (State, observations, goals [N, ...] as the task shows them to its learner).
        step: (State, donated; actions [N, A] float32) -> (State, observations but for ``goal_pixels``, which stay).
    """

    env: GoalEnv
    space: spaces.Dict
    reset: Any
    step: Any


@functools.cache
def _make_cached(name: str, overrides: tuple[tuple[str, Any], ...]) -> GoalEnv:
    return make(name, **dict(overrides))


def _made(env: str | GoalEnv, overrides: dict[str, Any]) -> GoalEnv:
    """The environment of that name and those settings, made once where settings can be told apart: all are hashable.

    Raises:
        ValueError: As `jaxrl_vis_envs.make` and `goal_env`.
    """
    if not isinstance(env, str):
        return goal_env(env, overrides)
    pairs = ((key, tuple(value) if isinstance(value, list) else value) for key, value in sorted(overrides.items()))
    settings = tuple(pairs)
    try:
        hash(settings)
    except TypeError:  # the environment refuses them with a line of its own, or takes them
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
        # An environment of somebody else's making may have nothing but images.
        vector = state.achieved_state if observe_state is None else observe_state(state.data)
        return {"observation": vector, **observation, "pixels": _to_public(env.observe(state))}

    def reset(seeds: jax.Array) -> tuple[State, dict[str, jax.Array], jax.Array]:
        state = jax.vmap(lambda seed: env.reset(jax.random.key(seed)))(seeds)
        assert state.obs is not None
        goal = state.obs["desired_goal"]
        goals = {"goal_pixels": _to_public(goal)} if sees_images else {}
        # Images are handed out, not carried.
        state = state.replace(obs=None)
        return state, {**jax.vmap(observe)(state), **goals}, goal

    def step(state: State, actions: jax.Array) -> tuple[State, dict[str, jax.Array]]:
        state = jax.vmap(env.advance)(state, actions)
        return state, jax.vmap(observe)(state)

    _, shapes, _ = jax.eval_shape(reset, jax.ShapeDtypeStruct((1,), jnp.uint32))
    return _Programs(env, _space(shapes), jit(reset), jit(step, donate_argnums=0))


def _to_public(image: jax.Array) -> jax.Array:
    """[..., C, H, W] -> [..., H, W, C]."""
    return jnp.moveaxis(image, -3, -1)


def _space(shapes: dict[str, jax.ShapeDtypeStruct]) -> spaces.Dict:
    """The space of one environment's observations, whose batches of one have ``shapes``."""

    def box(shape: jax.ShapeDtypeStruct) -> spaces.Box:
        low, high = (0, 255) if shape.dtype == jnp.uint8 else (-np.inf, np.inf)
        return spaces.Box(low, high, shape.shape[1:], shape.dtype.type)

    return spaces.Dict({name: box(shape) for name, shape in shapes.items()})


@functools.cache
def _camera(env: GoalEnv, size: int) -> Any:
    """A compiled function from the physics of N environments, and what varies in each, to images [N, size, size, 3] uint8."""
    mj_model, camera = getattr(env, "mj_model", None), getattr(env, "camera", None)
    if mj_model is None or camera is None:
        raise ValueError(f"{type(env).__name__} has no MuJoCo model with a camera to render through")
    scene = render.Scene.from_mjmodel(mj_model, camera=camera, height=size, width=size)
    return jit(jax.vmap(lambda data, domain: render.render(varied_scene(scene, domain), data).rgb))


class Environments:
    """N environments in step, on the device. The arguments are those of `gymnasium.GymnasiumEnv`.

    Attributes:
        env: The environment.
        programs: Its compiled half.
        score: Rewards of states [..., G] for goals [..., G]: [...] float32.
        metadata: As Gymnasium wants it.
        action_space: Of one environment.
        steps: Since `reset`.
    """

    def __init__(
        self, env: str | GoalEnv, reward: Reward, render_mode: str | None, render_size: int, overrides: dict[str, Any]
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}")
        self._given, self._render_size = (env, overrides), None if render_mode is None else render_size
        self._make()
        self.score = reward_function(reward, self.env.threshold)
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": max(1, round(1 / self.env.control_period))}
        self.action_space = spaces.Box(-1.0, 1.0, (self.env.action_size,), np.float32)
        self.steps = 0
        self._state: State | None = None
        self._goal_pixels: Observations = {}
        self._view: tuple[np.ndarray, np.ndarray] | None = None

    def _make(self) -> None:
        """Makes the environment and what is compiled for it, or takes those that there are with the same settings."""
        self.env = _made(*self._given)
        self.programs = _programs(self.env)
        self._camera = None if self._render_size is None else _camera(self.env, self._render_size)

    def __getstate__(self) -> dict[str, Any]:
        # Compiled programs stay in their process: whoever gets this makes them anew. Episodes go on where they are.
        return {name: value for name, value in vars(self).items() if name not in ("env", "programs", "_camera")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._make()

    @property
    def is_over(self) -> bool:
        """Whether the episodes have had all their steps."""
        return self.steps >= self.env.horizon

    def reset(self, seeds: np.ndarray) -> Observations:
        """Starts the episodes of ``seeds`` [N] uint32."""
        self._state, observations, goal = self.programs.reset(seeds)
        self.steps = 0
        observations = _to_host(observations)
        self._goal_pixels = {name: observations[name].copy() for name in observations if name == "goal_pixels"}
        self._view = _planar(observations), np.array(goal)
        return observations

    def step(self, actions: Any) -> tuple[Observations, np.ndarray]:
        """Moves by ``actions`` [N, A]; returns observations and rewards [N] float32.

        Raises:
            gymnasium.error.ResetNeeded: There was no `reset`.
            ValueError: ``actions`` has another shape.
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
        # Scored here, and not by the compiled step, so that it is `compute_reward` of what was handed out to the last bit.
        return observations, self.score(observations["achieved_goal"], observations["desired_goal"])

    def info(self, observations: Observations) -> dict[str, np.ndarray]:
        """``is_success`` [N] bool and ``goal_distance`` [N] float32."""
        distance = -reward_function("dense", self.env.threshold)(observations["achieved_goal"], observations["desired_goal"])
        return {"is_success": distance <= self.env.threshold, "goal_distance": distance}

    def learner_view(self) -> tuple[np.ndarray, np.ndarray]:
        """Observations and goals [N, ...] as the task itself shows them to a learner, see `GymnasiumEnv.learner_view`.

        Raises:
            gymnasium.error.ResetNeeded: There was no `reset`.
        """
        if self._view is None:
            raise gymnasium.error.ResetNeeded("call reset() before learner_view()")
        return self._view

    def render(self) -> np.ndarray | None:
        """Images [N, size, size, 3] uint8, or None where no render mode was asked for.

        Raises:
            gymnasium.error.ResetNeeded: There was no `reset`.
        """
        if self._camera is None:
            return None
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset() before render()")
        return np.array(self._camera(self._state.data, self._state.domain))


def _planar(observations: Observations) -> np.ndarray:
    """What a learner sees: copies of images [N, C, H, W] uint8, or of vectors [N, S] float32."""
    if "pixels" in observations:
        return np.array(np.moveaxis(observations["pixels"], -1, -3), order="C")
    return observations["observation"].copy()


def _to_host(observations: dict[str, jax.Array]) -> Observations:
    """Copies: what JAX hands out on a CPU is a view of memory that the next step is given back."""
    return {name: np.array(values) for name, values in observations.items()}
