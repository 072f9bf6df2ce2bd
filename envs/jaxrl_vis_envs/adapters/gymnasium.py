"""Adapter to Gymnasium environments, single and vectorised, with the goal dictionaries of Gymnasium-Robotics.

    import gymnasium
    import jaxrl_vis_envs.adapters.gymnasium  # registers the names

    env = gymnasium.make("jaxrl_vis/VisualFetchReach-v0", image_size=64)
    envs = gymnasium.make_vec("jaxrl_vis/FetchReach-v0", num_envs=16)  # one compiled step for all of them

Observations are dictionaries:

    observation     [S] float32, observation of the task's state variant
    achieved_goal   [G] float32, true state that goals constrain
    desired_goal    [G] float32, desired state
    pixels          [H, W, C] uint8, image observation (image tasks only)
    goal_pixels     [H, W, C] uint8, goal image (image tasks only)

Goals are states, not images, so that ``compute_reward`` is vectorised and correct for goals substituted by a learner (hindsight
relabelling). To restrict an agent to images, select ``pixels`` and ``goal_pixels`` with
`gymnasium.wrappers.FilterObservation`.

All episodes have the same length and end by truncation, never by termination.
"""

import numbers
from collections.abc import Iterable
from typing import Any

import numpy as np

try:
    import gymnasium
    from gymnasium.utils import seeding
    from gymnasium.vector import AutoresetMode
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise ImportError(
        "this adapter needs Gymnasium: pip install 'jaxrl-vis[gymnasium]' (in a clone: pip install '.[gymnasium]')"
    ) from error

from jaxrl_vis_envs.adapters.gymnasium_environments import Environments, Observations
from jaxrl_vis_envs.adapters.rewards import Reward
from jaxrl_vis_envs.base import GoalEnv
from jaxrl_vis_envs.registry import list_envs

NAMESPACE = "jaxrl_vis"


class GymnasiumEnv(gymnasium.Env):
    """Gymnasium interface of one environment.

    Args:
        env: Name of an environment, or a `GoalEnv`.
        reward: ``oracle`` (0 at the goal, -1 elsewhere) or ``dense`` (negative distance to the goal).
        render_mode: ``rgb_array`` for images from the task's camera, also for state tasks, with the episode's appearance if it
            is randomised; None for no images.
        render_size: Height and width of images from `render`, px; independent of ``pixels``.
        **overrides: Fields of the environment's configuration to change, as in `jaxrl_vis_envs.make`.

    Raises:
        ValueError: There is no such environment, option, reward or render mode, or no camera to render from.
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
        self._environments = Environments(env, reward, render_mode, render_size, overrides)
        self.metadata = self._environments.metadata
        self.render_mode = render_mode
        self.observation_space = self._environments.programs.space
        self.action_space = self._environments.action_space

    @property
    def goal_env(self) -> GoalEnv:
        """Underlying environment."""
        return self._environments.env

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observations, dict[str, Any]]:
        """Start an episode. A ``seed`` determines this and all following episodes; ``options`` is ignored.

        Returns:
            Observation, and an info as from `step`.

        Raises:
            gymnasium.error.Error: ``seed`` is negative or not a Python integer.
        """
        super().reset(seed=seed)
        observations = self._environments.reset(np.array([_sample_seed(self.np_random)]))
        return _unbatch(observations), self._info(observations)

    def step(self, action: np.ndarray) -> tuple[Observations, float, bool, bool, dict[str, Any]]:
        """Step with ``action`` [A], which is clipped to [-1, 1]; NaN counts as 0.

        Returns:
            Observation, reward, False (never terminated), truncated, and an info with ``is_success`` and ``goal_distance``.

        Raises:
            gymnasium.error.ResetNeeded: `reset` has not been called.
            ValueError: ``action`` has the wrong shape.
        """
        observations, reward = self._environments.step(np.asarray(action)[None])
        return _unbatch(observations), float(reward[0]), False, self._environments.is_over, self._info(observations)

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any = None) -> np.ndarray:
        """Compute rewards of states [..., G] for goals [..., G]: [...] float32. ``info`` is ignored.

        Raises:
            ValueError: States or goals do not have G elements, or their leading axes do not broadcast.
        """
        states = [np.asarray(state, np.float32) for state in (achieved_goal, desired_goal)]
        one = self._environments.programs.space["desired_goal"].shape
        if any(state.shape[-1:] != one for state in states):
            shapes = " and ".join(str(state.shape) for state in states)
            raise ValueError(f"one state and one goal have the shape {one}, got arrays of the shapes {shapes}")
        return self._environments.score(*states)

    def compute_terminated(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any = None) -> np.ndarray:
        """Return False for all states [..., G] and goals [..., G]: [...] bool. Episodes never terminate."""
        return np.zeros(np.broadcast_shapes(np.shape(achieved_goal), np.shape(desired_goal))[:-1], bool)

    def compute_truncated(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any = None) -> np.ndarray:
        """Return False for all states and goals: [...] bool. Truncation depends on the step count alone."""
        return self.compute_terminated(achieved_goal, desired_goal, info)

    def learner_view(self) -> tuple[np.ndarray, np.ndarray]:
        """Return observation and goal in the form that this package's policies take: planar [C, H, W] uint8, or [S] float32.

        Raises:
            gymnasium.error.ResetNeeded: `reset` has not been called.
        """
        observation, goal = self._environments.learner_view()
        return observation[0], goal[0]

    def render(self) -> Any:
        """Return an image [size, size, 3] uint8, or None without a render mode.

        Raises:
            gymnasium.error.ResetNeeded: `reset` has not been called.
        """
        images = self._environments.render()
        return None if images is None else images[0]

    def _info(self, observations: Observations) -> dict[str, Any]:
        return {name: values[0].item() for name, values in self._environments.info(observations).items()}


def _unbatch(observations: Observations) -> Observations:
    return {name: values[0] for name, values in observations.items()}


class GymnasiumVectorEnv(gymnasium.vector.VectorEnv):
    """N environments stepped by one compiled program, equivalent to a `gymnasium.vector.SyncVectorEnv` of `GymnasiumEnv`.

    All episodes have the same length, so they all end together.

    Args:
        env: Name of an environment, or a `GoalEnv`.
        num_envs: Number N of environments.
        reward: See `GymnasiumEnv`.
        autoreset_mode: ``NextStep`` (the step after the last one starts new episodes, whatever the action) or ``SameStep`` (the
            last step does, and returns the final observations as ``final_obs``).
        render_mode: See `GymnasiumEnv`.
        render_size: See `GymnasiumEnv`.
        **overrides: See `GymnasiumEnv`.

    Raises:
        ValueError: There is no such environment, option, reward or mode, ``num_envs`` is not a positive integer, or as in
            `GymnasiumEnv`.
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
        if isinstance(num_envs, bool) or not isinstance(num_envs, numbers.Integral) or num_envs < 1:
            raise ValueError(f"num_envs must be a whole number of at least 1, got {num_envs!r}")
        mode = AutoresetMode(autoreset_mode)
        if mode == AutoresetMode.DISABLED:
            raise ValueError("autoreset_mode must be NextStep or SameStep")
        self._environments = Environments(env, reward, render_mode, render_size, overrides)
        self.num_envs = int(num_envs)
        self.metadata = {**self._environments.metadata, "autoreset_mode": mode}
        self.render_mode = render_mode
        self.single_observation_space = self._environments.programs.space
        self.single_action_space = self._environments.action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._resets_in_step = mode == AutoresetMode.SAME_STEP
        self._generators: list[np.random.Generator] = []

    @property
    def goal_env(self) -> GoalEnv:
        """Underlying environment."""
        return self._environments.env

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start all episodes. Environment i is seeded with ``seed + i`` or ``seed[i]``; ``options`` is ignored.

        Returns:
            Observations, and infos as from `step`.

        Raises:
            ValueError: ``seed`` is neither an integer nor one per environment.
            gymnasium.error.Error: A seed is negative or not a Python integer.
        """
        if seed is None or isinstance(seed, int | np.integer):
            seed = None if seed is None else int(seed)
            super().reset(seed=seed)
            seeds = [None if seed is None else seed + i for i in range(self.num_envs)]
        else:
            if not isinstance(seed, Iterable):
                raise ValueError(f"seed must be a whole number, or one for each of {self.num_envs} environments, got {seed!r}")
            seeds = list(seed)
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed must hold one number for each of {self.num_envs} environments, got {len(seeds)}")
        if not self._generators:
            self._generators = [seeding.np_random(env_seed)[0] for env_seed in seeds]
        else:
            pairs = zip(self._generators, seeds)
            self._generators = [old if env_seed is None else seeding.np_random(env_seed)[0] for old, env_seed in pairs]
        return self._restart()

    def step(self, actions: np.ndarray) -> tuple[Observations, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Step with ``actions`` [N, A], which are clipped to [-1, 1]; NaN counts as 0.

        Returns:
            Observations, rewards [N] float64, terminations and truncations [N] bool, and the infos of `GymnasiumEnv` as arrays.

        Raises:
            gymnasium.error.ResetNeeded: `reset` has not been called.
            ValueError: ``actions`` has the wrong shape.
        """
        none_over, all_over = np.zeros(self.num_envs, bool), np.ones(self.num_envs, bool)
        if self._environments.is_over and not self._resets_in_step:
            observations, infos = self._restart()
            return observations, np.zeros(self.num_envs), none_over, none_over.copy(), infos
        observations, reward = self._environments.step(actions)
        infos, reward = self._infos(observations), reward.astype(np.float64)
        if not self._environments.is_over:
            return observations, reward, none_over, none_over.copy(), infos
        if self._resets_in_step:
            final = np.empty(self.num_envs, object)
            final[:] = [{name: values[i] for name, values in observations.items()} for i in range(self.num_envs)]
            last_infos = {"final_obs": final, "final_info": infos, "_final_obs": all_over, "_final_info": all_over.copy()}
            observations, infos = self._restart()
            infos |= last_infos
        return observations, reward, none_over, all_over.copy(), infos

    def learner_view(self) -> tuple[np.ndarray, np.ndarray]:
        """Return observations and goals of all environments, [N, ...]; see `GymnasiumEnv.learner_view`.

        Raises:
            gymnasium.error.ResetNeeded: `reset` has not been called.
        """
        return self._environments.learner_view()

    def render(self) -> tuple[Any, ...] | None:
        """Return images [size, size, 3] uint8, one per environment, or None without a render mode.

        Raises:
            gymnasium.error.ResetNeeded: `reset` has not been called.
        """
        images = self._environments.render()
        return None if images is None else tuple(images)

    def _restart(self) -> tuple[Observations, dict[str, Any]]:
        observations = self._environments.reset(np.array([_sample_seed(generator) for generator in self._generators]))
        return observations, self._infos(observations)

    def _infos(self, observations: Observations) -> dict[str, Any]:
        """Return infos as arrays, each with a mask [N] of the environments that have it, which is all True."""
        infos = self._environments.info(observations)
        return infos | {f"_{name}": np.ones(self.num_envs, bool) for name in infos}


def _sample_seed(generator: np.random.Generator) -> np.uint32:
    return generator.integers(2**32, dtype=np.uint32)


def register_all() -> None:
    """Register every environment as ``jaxrl_vis/<name>-v0``. Called on import; call it again after adding environments."""
    for name in list_envs():
        if f"{NAMESPACE}/{name}-v0" not in gymnasium.registry:
            gymnasium.register(
                id=f"{NAMESPACE}/{name}-v0",
                entry_point=f"{__name__}:GymnasiumEnv",
                vector_entry_point=f"{__name__}:GymnasiumVectorEnv",
                kwargs={"env": name},
            )


register_all()
