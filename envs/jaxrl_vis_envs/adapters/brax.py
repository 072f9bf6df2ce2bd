"""Adapter to brax environments, for brax's own agents.

    from brax.training.agents.ppo import train as ppo
    from jaxrl_vis_envs.adapters.brax import BraxEnv, share_jax_with_brax

    env = BraxEnv("FetchReach", reward="dense")
    with share_jax_with_brax():
        make_policy, params, metrics = ppo.train(env, episode_length=env.episode_length, num_envs=256, ...)

`BraxEnv` never sets ``done``: brax's EpisodeWrapper, configured with ``episode_length``, ends episodes and marks them as
truncated.

Two properties of brax matter here. Its AutoResetWrapper restarts all episodes of an environment from the start of its first
one, with the same goal: use many environments, or set ``num_resets_per_eval``. And it compiles without the option that physics
needs on a CPU with JAX 0.10 (see `compilation`): there, set ``XLA_FLAGS=--xla_cpu_use_fusion_emitters=false`` before JAX is
initialised.
"""

import contextlib
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs.adapters.environments import goal_env
from jaxrl_vis_envs.adapters.rewards import Reward, reward_function
from jaxrl_vis_envs.base import GoalEnv, State

try:
    from brax.envs.base import Env
    from brax.envs.base import State as BraxState
except ImportError as error:
    raise ImportError("this adapter needs brax, which comes with jaxrl-vis, but it is missing: pip install brax") from error


class BraxEnv(Env):
    """Environment with brax's interface.

    For a state task, observations are one vector [2 S] float32: observation, then goal. For an image task they are a dictionary
    of ``pixels/observation`` and ``pixels/goal``, [H, W, C] float32 from 0 to 1, as brax's PPO expects images (its SAC accepts
    vectors only).

    Args:
        env: Name of an environment, or a `GoalEnv`.
        reward: ``oracle`` (0 at the goal, -1 elsewhere) or ``dense`` (negative distance to the goal). Brax's agents do not
            relabel goals, and learn little from ``oracle`` without that.
        **overrides: Fields of the environment's configuration to change, as in `jaxrl_vis_envs.make`.

    Raises:
        ValueError: There is no such environment, option or reward.
    """

    def __init__(self, env: str | GoalEnv, reward: Reward = "oracle", **overrides: Any) -> None:
        self.goal_env = goal_env(env, overrides)
        self._score = reward_function(reward, self.goal_env.threshold)
        self._sees_images = len(self.goal_env.observation_spec.shape) == 3

    def reset(self, rng: jax.Array) -> BraxState:
        """Start an episode from a key, [2] uint32 as in brax, or typed.

        Brax's wrappers read the batch shape from an untyped key, so wrapped environments need untyped keys.
        """
        self.goal_env.check_key(rng)
        is_typed = jnp.issubdtype(rng.dtype, jax.dtypes.prng_key)
        episode = self.goal_env.reset(rng if is_typed else jax.random.wrap_key_data(rng))
        physics: Any = episode  # annotated as brax's own physics state, which brax never inspects
        return BraxState(physics, self._observe(episode), self._reward(episode), jnp.zeros(()), dict(episode.metrics))

    def step(self, state: BraxState, action: jax.Array) -> BraxState:
        """Step with ``action`` [A] in [-1, 1]. ``done`` stays 0, and ``info`` is passed through.

        ``metrics`` are those of the task: ``success`` (0 or 1), ``goal_distance`` (in its `distance_unit`) and any others.
        Brax's evaluation sums them over an episode.
        """
        episode: Any = state.pipeline_state
        episode = self.goal_env.step(episode, action)
        return state.replace(  # type: ignore[attr-defined] - added by flax
            pipeline_state=episode,
            obs=self._observe(episode),
            reward=self._reward(episode),
            done=jnp.zeros(()),
            metrics={**state.metrics, **episode.metrics},
        )

    @property
    def episode_length(self) -> int:
        """Number of control steps in an episode, for brax's argument of that name."""
        return self.goal_env.horizon

    @property
    def observation_size(self) -> Any:
        """Size 2 S of an observation or, for images, the shape by key."""
        shape = self.goal_env.observation_spec.shape
        if not self._sees_images:
            return 2 * shape[0]
        height_width_channels = (*shape[1:], shape[0])
        return {"pixels/observation": height_width_channels, "pixels/goal": height_width_channels}

    @property
    def action_size(self) -> int:
        """Size A of an action."""
        return self.goal_env.action_size

    @property
    def dt(self) -> float:
        """Duration of one control step, s of simulated time."""
        return self.goal_env.control_period

    @property
    def mj_model(self) -> Any:
        """The task's `mujoco.MjModel`, so that `jaxrl_vis_envs.pixels.wrap` can give images to a state task."""
        return self.goal_env.mj_model  # type: ignore[attr-defined] - of MJX tasks

    @property
    def backend(self) -> str:
        """Name of the physics engine: ``mjx``."""
        return "mjx"

    def _observe(self, state: State) -> Any:
        assert state.obs is not None
        observation, goal = state.obs["observation"], state.obs["desired_goal"]
        if not self._sees_images:
            return jnp.concatenate([observation, goal])
        images = {"pixels/observation": observation, "pixels/goal": goal}
        return {name: jnp.moveaxis(image, 0, -1).astype(jnp.float32) / 255.0 for name, image in images.items()}

    def _reward(self, state: State) -> jax.Array:
        return self._score(state.achieved_state, state.goal_state)


@contextlib.contextmanager
def share_jax_with_brax() -> Iterator[None]:
    """Restore ``jax.device_put_replicated``, which brax's agents call and JAX 0.10 has removed, within the context.

    Does nothing if JAX still has it. PPO and SAC need it up to brax 0.14.2.
    """
    if hasattr(jax, "device_put_replicated"):
        yield
        return
    jax.device_put_replicated = _device_put_replicated
    try:
        yield
    finally:
        del jax.device_put_replicated


def _device_put_replicated(tree: Any, devices: list[Any]) -> Any:
    """Return ``tree`` with a new first axis along which each of ``devices`` holds a copy."""
    # Sharded as brax's own pmap returns it, over an axis "i": with another name every program is compiled twice.
    mesh = jax.sharding.Mesh(np.array(devices), ("i",))
    sharding = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("i"))
    return jax.tree.map(lambda leaf: jax.device_put(jnp.stack([jnp.asarray(leaf)] * len(devices)), sharding), tree)
