"""The worlds as Gymnasium environments, single and vector, with the goal dictionaries of Gymnasium-Robotics.

    import gymnasium
    import jaxrl_vis_envs.adapters.gymnasium  # registers the names

    env = gymnasium.make("jaxrl_vis/VisualFetchReach-v0", image_size=64)
    envs = gymnasium.make_vec("jaxrl_vis/FetchReach-v0", num_envs=16)  # one compiled step moves all of them

Observations are dictionaries:

    observation     [S] float32, what the state variant of the task sees
    achieved_goal   [G] float32, the true state that goals are about
    desired_goal    [G] float32, the state that is asked for
    pixels          [H, W, C] uint8, what the robot sees (picture tasks only)
    goal_pixels     [H, W, C] uint8, the picture of the goal (picture tasks only)

Goals are states, not pictures, so that ``compute_reward`` is vectorised and right for goals that a learner puts in later
(hindsight relabelling). An agent that shall see pictures only is given those two keys, and none of the others, with
`gymnasium.wrappers.FilterObservation`.

Episodes have one length and end in truncation, never in termination.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

try:
    import gymnasium
    from gymnasium import spaces
    from gymnasium.utils import seeding
    from gymnasium.vector import AutoresetMode
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise ImportError("this adapter needs Gymnasium: pip install 'jaxrl-vis[gymnasium]'") from error

from jaxrl_vis_envs import render
from jaxrl_vis_envs.adapters.rewards import Reward, reward_function
from jaxrl_vis_envs.base import GoalEnv, State
from jaxrl_vis_envs.compilation import world_jit
from jaxrl_vis_envs.registry import list_envs, make

NAMESPACE = "jaxrl_vis"
Observation = dict[str, np.ndarray]


class _Programs(NamedTuple):
    """The compiled half of a world, for any number N of environments; shared by all environments with the same settings.

    Attributes:
        env: The world.
        space: The observation space of one environment.
        reset: seeds [N] uint32 -> (State, observations).
        step: (State, donated; actions [N, A] float32) -> (State, observations but for ``goal_pixels``, which stay).
    """

    env: GoalEnv
    space: spaces.Dict
    reset: Any
    step: Any


@functools.cache
def _make_cached(name: str, overrides: tuple[tuple[str, Any], ...]) -> GoalEnv:
    return make(name, **dict(overrides))


def _world(env: str | GoalEnv, overrides: dict[str, Any]) -> GoalEnv:
    """The world of that name and those settings, made once.

    Raises:
        ValueError: As `jaxrl_vis_envs.make`; or there are overrides for a world that exists already.
    """
    if isinstance(env, str):
        settings = ((key, tuple(value) if isinstance(value, list) else value) for key, value in sorted(overrides.items()))
        return _make_cached(env, tuple(settings))
    if overrides:
        raise ValueError(f"{', '.join(overrides)}: options go with the name of a world, not with one that is made already")
    return env


@functools.cache
def _programs(env: GoalEnv) -> _Programs:
    spec = env.observation_spec
    sees_pictures = len(spec.shape) == 3
    observe_state = getattr(env, "observe_state", None)

    def observe(state: State) -> dict[str, jax.Array]:
        observation = {"achieved_goal": state.achieved_state, "desired_goal": state.goal_state}
        if not sees_pictures:
            return {"observation": env.observe(state), **observation}
        # A world of somebody else's making may have nothing but pictures.
        vector = state.achieved_state if observe_state is None else observe_state(state.data)
        return {"observation": vector, **observation, "pixels": _to_public(env.observe(state))}

    def reset(seeds: jax.Array) -> tuple[State, dict[str, jax.Array]]:
        state = jax.vmap(lambda seed: env.reset(jax.random.key(seed)))(seeds)
        goals = {"goal_pixels": _to_public(state.obs["desired_goal"])} if sees_pictures else {}
        # Pictures are handed out, not carried.
        state = state.replace(obs=None)
        return state, {**jax.vmap(observe)(state), **goals}

    def step(state: State, actions: jax.Array) -> tuple[State, dict[str, jax.Array]]:
        state = jax.vmap(env.advance)(state, actions)
        return state, jax.vmap(observe)(state)

    _, shapes = jax.eval_shape(reset, jax.ShapeDtypeStruct((1,), jnp.uint32))
    return _Programs(env, _space(shapes), world_jit(reset), world_jit(step, donate_argnums=0))


def _to_public(picture: jax.Array) -> jax.Array:
    """[..., C, H, W] -> [..., H, W, C]."""
    return jnp.moveaxis(picture, -3, -1)


def _space(shapes: dict[str, jax.ShapeDtypeStruct]) -> spaces.Dict:
    """The space of one environment's observations, whose batches of one have ``shapes``."""

    def box(shape: jax.ShapeDtypeStruct) -> spaces.Box:
        low, high = (0, 255) if shape.dtype == jnp.uint8 else (-np.inf, np.inf)
        return spaces.Box(low, high, shape.shape[1:], shape.dtype.type)

    return spaces.Dict({name: box(shape) for name, shape in shapes.items()})


@functools.cache
def _camera(env: GoalEnv, size: int) -> Any:
    """A compiled function from the physics of N environments to their pictures [N, size, size, 3] uint8."""
    mj_model, camera = getattr(env, "mj_model", None), getattr(env, "camera", None)
    if mj_model is None or camera is None:
        raise ValueError(f"{env.name} has no MuJoCo model with a camera to render through")
    scene = render.Scene.from_mjmodel(mj_model, camera=camera, height=size, width=size)
    return world_jit(jax.vmap(lambda data: render.render(scene, data).rgb))


class _Worlds:
    """N environments in step, on the device. What both adapters are made of.

    Args:
        env: See `GymnasiumEnv`.
        reward: See `GymnasiumEnv`.
        render_mode: See `GymnasiumEnv`.
        render_size: See `GymnasiumEnv`.
        overrides: See `GymnasiumEnv`.
    """

    def __init__(
        self, env: str | GoalEnv, reward: Reward, render_mode: str | None, render_size: int, overrides: dict[str, Any]
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}")
        self.env = _world(env, overrides)
        self.programs = _programs(self.env)
        self.score = reward_function(reward, self.env.threshold)
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": max(1, round(1 / self.env.control_period))}
        self.action_space = spaces.Box(-1.0, 1.0, (self.env.action_size,), np.float32)
        self.steps = 0
        self._camera = None if render_mode is None else _camera(self.env, render_size)
        self._state: State | None = None
        self._goal_pixels: Observation = {}

    @property
    def is_over(self) -> bool:
        """Whether the episodes have had all their steps."""
        return self.steps >= self.env.horizon

    def reset(self, seeds: np.ndarray) -> Observation:
        """Starts the episodes of ``seeds`` [N] uint32."""
        self._state, observations = self.programs.reset(seeds)
        self.steps = 0
        observations = _to_host(observations)
        self._goal_pixels = {name: observations[name].copy() for name in observations if name == "goal_pixels"}
        return observations

    def step(self, actions: Any) -> tuple[Observation, np.ndarray]:
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
        observations = _to_host(observations) | {name: pictures.copy() for name, pictures in self._goal_pixels.items()}
        # Scored here, and not by the compiled step, so that it is `compute_reward` of what was handed out to the last bit.
        return observations, self.score(observations["achieved_goal"], observations["desired_goal"])

    def info(self, observations: Observation) -> dict[str, np.ndarray]:
        """``is_success`` [N] bool and ``goal_distance`` [N] float32."""
        distance = -reward_function("dense", self.env.threshold)(observations["achieved_goal"], observations["desired_goal"])
        return {"is_success": distance <= self.env.threshold, "goal_distance": distance}

    def render(self) -> np.ndarray | None:
        """Pictures [N, size, size, 3] uint8, or None where no render mode was asked for.

        Raises:
            gymnasium.error.ResetNeeded: There was no `reset`.
        """
        if self._camera is None:
            return None
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset() before render()")
        return np.array(self._camera(self._state.data))


def _to_host(observations: dict[str, jax.Array]) -> Observation:
    """Copies: what JAX hands out on a CPU is a view of memory that the next step is given back."""
    return {name: np.array(values) for name, values in observations.items()}


def _draw_seed(generator: np.random.Generator) -> np.uint32:
    return generator.integers(2**32, dtype=np.uint32)


class GymnasiumEnv(gymnasium.Env):
    """One environment.

    Args:
        env: The name of a world, or one that is made already.
        reward: ``oracle`` (0 at the goal, -1 elsewhere) or ``dense`` (minus the distance to the goal).
        render_mode: None, or ``rgb_array`` for pictures from the camera of the task, which state tasks have as well.
        render_size: Height and width of what `render` returns, px; it has nothing to do with ``pixels``.
        **overrides: Fields of the world's configuration to change, as in `jaxrl_vis_envs.make`.

    Raises:
        ValueError: There is no such world, option, reward or render mode.
    """

    metadata = {"render_modes": ["rgb_array"]}

    def __init__(
        self,
        env: str | GoalEnv,
        reward: Reward = "oracle",
        render_mode: str | None = None,
        render_size: int = 256,
        **overrides: Any,
    ) -> None:
        self._worlds = _Worlds(env, reward, render_mode, render_size, overrides)
        self.metadata = self._worlds.metadata
        self.render_mode = render_mode
        self.observation_space = self._worlds.programs.space
        self.action_space = self._worlds.action_space

    @property
    def goal_env(self) -> GoalEnv:
        """The world behind it."""
        return self._worlds.env

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        """Starts an episode; a ``seed`` settles it and all that follow. ``options`` has no meaning here."""
        super().reset(seed=seed)
        observations = self._worlds.reset(np.array([_draw_seed(self.np_random)]))
        return _first(observations), self._info(observations)

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Moves by ``action`` [A]: clipped to [-1, 1], and a NaN counts as 0.

        Returns:
            observation, reward, False, whether the episode has had all its steps, and ``is_success`` and ``goal_distance``.

        Raises:
            gymnasium.error.ResetNeeded: There was no `reset`.
            ValueError: ``action`` has another shape.
        """
        observations, reward = self._worlds.step(np.asarray(action)[None])
        return _first(observations), float(reward[0]), False, self._worlds.is_over, self._info(observations)

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any = None) -> np.ndarray:
        """Rewards of states [..., G] for goals [..., G]: [...] float32. ``info`` is not read."""
        return self._worlds.score(np.asarray(achieved_goal), np.asarray(desired_goal))

    def compute_terminated(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any = None) -> np.ndarray:
        """Whether states [..., G] end an episode with goals [..., G]: never, [...] bool."""
        return np.zeros(np.broadcast_shapes(np.shape(achieved_goal), np.shape(desired_goal))[:-1], bool)

    def compute_truncated(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any = None) -> np.ndarray:
        """Whether states cut an episode short: never, [...] bool. Only its length does, which a state does not tell."""
        return self.compute_terminated(achieved_goal, desired_goal, info)

    def render(self) -> Any:
        """A picture [size, size, 3] uint8, or None where no render mode was asked for."""
        pictures = self._worlds.render()
        return None if pictures is None else pictures[0]

    def _info(self, observations: Observation) -> dict[str, Any]:
        return {name: values[0].item() for name, values in self._worlds.info(observations).items()}


def _first(observations: Observation) -> Observation:
    return {name: values[0] for name, values in observations.items()}


class GymnasiumVectorEnv(gymnasium.vector.VectorEnv):
    """N environments, moved by one compiled program. It does what a `gymnasium.vector.SyncVectorEnv` of `GymnasiumEnv` does.

    All episodes have one length, so all end at once.

    Args:
        env: The name of a world, or one that is made already.
        num_envs: N.
        reward: See `GymnasiumEnv`.
        autoreset_mode: ``NextStep`` (the step after the last one starts new episodes, whatever the action) or ``SameStep`` (the
            last step does, and hands out the last observations as ``final_obs``).
        render_mode: See `GymnasiumEnv`.
        render_size: See `GymnasiumEnv`.
        **overrides: See `GymnasiumEnv`.

    Raises:
        ValueError: There is no such world, option, reward or mode.
    """

    def __init__(
        self,
        env: str | GoalEnv,
        num_envs: int = 1,
        reward: Reward = "oracle",
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        render_size: int = 256,
        **overrides: Any,
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, got {num_envs}")
        mode = AutoresetMode(autoreset_mode)
        if mode == AutoresetMode.DISABLED:
            raise ValueError("autoreset_mode must be NextStep or SameStep")
        self._worlds = _Worlds(env, reward, render_mode, render_size, overrides)
        self.num_envs = num_envs
        self.metadata = {**self._worlds.metadata, "autoreset_mode": mode}
        self.render_mode = render_mode
        self.single_observation_space = self._worlds.programs.space
        self.single_action_space = self._worlds.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._resets_in_step = mode == AutoresetMode.SAME_STEP
        self._generators: list[np.random.Generator] = []

    @property
    def goal_env(self) -> GoalEnv:
        """The world behind it."""
        return self._worlds.env

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Starts all episodes. Environment i is seeded with ``seed + i``, or with ``seed[i]``; ``options`` has no meaning here."""
        if isinstance(seed, int) or seed is None:
            super().reset(seed=seed)
            seeds = [None if seed is None else seed + i for i in range(self.num_envs)]
        else:
            seeds = list(seed)
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed must hold one number for each of {self.num_envs} environments, got {len(seeds)}")
        if not self._generators:
            self._generators = [seeding.np_random(given)[0] for given in seeds]
        else:
            pairs = zip(self._generators, seeds)
            self._generators = [old if given is None else seeding.np_random(given)[0] for old, given in pairs]
        return self._restart()

    def step(self, actions: np.ndarray) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Moves by ``actions`` [N, A]: clipped to [-1, 1], and a NaN counts as 0.

        Returns:
            observations, rewards [N] float64, terminations and truncations [N] bool, and the infos of `GymnasiumEnv` as arrays.

        Raises:
            gymnasium.error.ResetNeeded: There was no `reset`.
            ValueError: ``actions`` has another shape.
        """
        never, all_over = np.zeros(self.num_envs, bool), np.ones(self.num_envs, bool)
        if self._worlds.is_over and not self._resets_in_step:
            observations, infos = self._restart()
            return observations, np.zeros(self.num_envs), never, never.copy(), infos
        observations, reward = self._worlds.step(actions)
        infos, reward = self._infos(observations), reward.astype(np.float64)
        if not self._worlds.is_over:
            return observations, reward, never, never.copy(), infos
        if self._resets_in_step:
            final = np.empty(self.num_envs, object)
            final[:] = [{name: values[i] for name, values in observations.items()} for i in range(self.num_envs)]
            last_infos = {"final_obs": final, "final_info": infos, "_final_obs": all_over, "_final_info": all_over.copy()}
            observations, infos = self._restart()
            infos |= last_infos
        return observations, reward, never, all_over.copy(), infos

    def render(self) -> tuple[Any, ...] | None:
        """Pictures [size, size, 3] uint8, one for each environment, or None where no render mode was asked for."""
        pictures = self._worlds.render()
        return None if pictures is None else tuple(pictures)

    def _restart(self) -> tuple[Observation, dict[str, Any]]:
        observations = self._worlds.reset(np.array([_draw_seed(generator) for generator in self._generators]))
        return observations, self._infos(observations)

    def _infos(self, observations: Observation) -> dict[str, Any]:
        """Infos as arrays, each with a mask of the environments that have it: all."""
        infos = self._worlds.info(observations)
        return infos | {f"_{name}": np.ones(self.num_envs, bool) for name in infos}


def register_all() -> None:
    """Registers every world as ``jaxrl_vis/<name>-v0``; importing this module does it. For worlds that were added since then."""
    for name in list_envs():
        if f"{NAMESPACE}/{name}-v0" not in gymnasium.registry:
            gymnasium.register(
                id=f"{NAMESPACE}/{name}-v0",
                entry_point=f"{__name__}:GymnasiumEnv",
                vector_entry_point=f"{__name__}:GymnasiumVectorEnv",
                kwargs={"env": name},
            )


register_all()
