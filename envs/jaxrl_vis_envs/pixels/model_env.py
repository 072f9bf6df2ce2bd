"""Environment of a plain MuJoCo model and a function that steps it, with brax's interface."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
from brax.envs.base import State

from jaxrl_vis_envs.physics import mjx_model
from jaxrl_vis_envs.physics.mjx_model import mjx


class ModelEnv:
    """Environment without a task: rewards are 0, and episodes do not end. See `jaxrl_vis_envs.pixels.wrap`.

    States are brax's, with `mjx.Data` as ``pipeline_state``; observations are joint positions and velocities, [nq + nv].

    Args:
        mj_model: MuJoCo model. Episodes start from its initial configuration, at rest.
        step: Function ``step(data, action)`` from `mjx.Data` to `mjx.Data`. If None, one `mjx.step` with the action as
            ``ctrl``.

    Attributes:
        mj_model: The model.
        mjx_model: The same model for MJX.
        action_size: Number of actuators.
        backend: Name of the physics engine: ``mjx``.
    """

    backend = "mjx"

    def __init__(self, mj_model: mujoco.MjModel, step: Callable[[Any, jax.Array], Any] | None = None) -> None:
        self.mj_model, self.mjx_model = mj_model, mjx_model.put_model(mj_model)
        self.action_size = mj_model.nu
        self._start = mjx_model.rest_data(mj_model)
        self._step = step

    def reset(self, rng: jax.Array) -> State:
        """Return the state at the model's initial configuration. ``rng`` is ignored."""
        return State(self._start, self._observe(self._start), jnp.zeros(()), jnp.zeros(()))  # type: ignore[arg-type]

    def step(self, state: State, action: jax.Array) -> State:
        """Step the physics with ``action`` [nu]."""
        data: Any = state.pipeline_state
        data = mjx.step(self.mjx_model, data.replace(ctrl=action)) if self._step is None else self._step(data, action)
        return state.replace(pipeline_state=data, obs=self._observe(data))  # type: ignore[attr-defined] - added by flax

    @property
    def unwrapped(self) -> "ModelEnv":
        """This environment."""
        return self

    def _observe(self, data: mjx.Data) -> jax.Array:
        return jnp.concatenate([data.qpos, data.qvel])
