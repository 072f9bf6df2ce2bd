"""Environment that compiles quickly, written as a user would write one: a ball on two sliders.

Actions are velocities; in `SimulatedPointMass` they are forces of motors, for tests of what a physics step does.
"""

import contextlib
import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import pytest

from jaxrl_vis.run.compiled import programs, trace_cache
from jaxrl_vis_envs import registry
from jaxrl_vis_envs.physics import mjx_model
from jaxrl_vis_envs.pixels import PixelsConfig, image_observer
from jaxrl_vis_envs.randomization import OFF, Randomization
from jaxrl_vis_envs.tasks.mjx_env import MjxGoalEnv

XML = """
<mujoco>
  <option timestep=".05"><flag contact="disable" constraint="disable"/></option>
  <visual><headlight ambient=".3 .3 .3" diffuse=".4 .4 .4" specular="0 0 0"/></visual>
  <worldbody>
    <camera name="above" pos="0 -.3 1" xyaxes="1 0 0 0 1 .3" fovy="50"/>
    <light directional="true" dir=".2 .3 -.9" diffuse=".3 .3 .3" specular="0 0 0"/>
    <light pos="-.5 0 .7" dir="0 0 -1" cutoff="100" diffuse=".2 .2 .2" specular="0 0 0"/>
    <geom name="ground" type="plane" size="1 1 .1" rgba=".3 .5 .6 1"/>
    <body name="ball" pos="0 0 .1">
      <joint name="x" type="slide" axis="1 0 0" damping="1"/>
      <joint name="y" type="slide" axis="0 1 0" damping="1"/>
      <geom name="ball" type="sphere" size=".1" mass="1" rgba=".8 .3 .2 1"/>
    </body>
  </worldbody>
  <actuator><motor joint="x" gear="10"/><motor joint="y" gear="10"/></actuator>
</mujoco>
"""


@dataclasses.dataclass(frozen=True)
class PointMassConfig(PixelsConfig):
    horizon: int = 5
    threshold: float = 0.1
    image_size: int = 8
    depth_range: tuple[float, float] = (0.5, 1.5)
    randomization: Randomization = OFF


class PointMass(MjxGoalEnv):
    """Point mass whose actions are velocities: without a physics step, tracing and compiling take half the time."""

    action_size, camera, control_period = 2, "above", 0.05

    def __init__(self, config: PointMassConfig):
        self._rest = mjx_model.rest_data(mujoco.MjModel.from_xml_string(XML))
        super().__init__(config, mujoco.MjModel.from_xml_string(XML), self._observer(config))

    def _observer(self, config: PointMassConfig) -> Any:
        return lambda model: image_observer(model, self.camera, config)

    def sample_start(self, key: jax.Array) -> Any:
        return self.configuration(jnp.zeros(2))

    def sample_goal(self, key: jax.Array) -> Any:
        return self.configuration(jax.random.uniform(key, (2,), minval=-0.3, maxval=0.3))

    def act(self, data: Any, action: jax.Array) -> Any:
        velocity = 0.5 * action
        data = data.replace(qpos=data.qpos + self.control_period * velocity, qvel=velocity)
        return mjx_model.mjx.kinematics(self._model, data)

    def achieved(self, data: Any) -> jax.Array:
        return data.qpos

    def observe_state(self, data: Any) -> jax.Array:
        return data.qpos

    def configuration(self, qpos: jax.Array) -> Any:
        return mjx_model.mjx.kinematics(self._model, self._rest.replace(qpos=qpos))


class StatePointMass(PointMass):
    """Point mass whose observation is its position and velocity [4] instead of an image."""

    def _observer(self, config: PointMassConfig) -> Any:
        return None

    def observe_state(self, data: Any) -> jax.Array:
        return jnp.concatenate([data.qpos, data.qvel])


class SimulatedPointMass(PointMass):
    """Point mass whose actions are the forces of its motors, in a physics step."""

    def act(self, data: Any, action: jax.Array) -> Any:
        return mjx_model.simulate(self._model, data.replace(ctrl=action), 1)


class SimulatedStatePointMass(SimulatedPointMass, StatePointMass):
    """State point mass with physics."""


@contextlib.contextmanager
def registered(programs_folder: Path | None = None, task: type[PointMass] = PointMass) -> Iterator[None]:
    """Register the environment as VisualPoint within the context.

    Args:
        programs_folder: Folder in which traced programs are cached, as those of built-in environments are; None for no cache.
        task: Class of the environment.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(registry._ENTRIES, "VisualPoint", registry._Entry(task, PointMassConfig))
        if programs_folder is not None:
            patch.setattr(task, "__module__", "jaxrl_vis_envs.tasks.point_mass")
            patch.setenv(trace_cache.CACHE_VARIABLE, "1")
            patch.setattr(programs, "enable_compilation_cache", lambda: str(programs_folder))
        yield
