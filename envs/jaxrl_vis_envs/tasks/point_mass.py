"""PointMass: push a ball to its position in the goal image, the smallest task.

The idea is that of dm_control's ``point_mass``. Friction is strong, so that a single image shows nearly all of the ball's
state: without a push it loses 86 % of its velocity within two control steps.

    VisualPointMass   observes RGB-D from above
    PointMass         observes position and velocity

State: position of the ball on the table, m. Action: one force per axis.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco

from jaxrl_vis_envs import checks
from jaxrl_vis_envs.physics import mjx_model
from jaxrl_vis_envs.physics.mjx_model import mjx
from jaxrl_vis_envs.pixels import Observer, PixelsConfig
from jaxrl_vis_envs.tasks.config import TaskConfig
from jaxrl_vis_envs.tasks.mjx_env import MjxGoalEnv, register_task

_RANGE = 0.3  # m: maximum coordinate of starts and goals


@dataclasses.dataclass(frozen=True)
class PointMassConfig(TaskConfig):
    """Settings of the task. Lengths in m."""

    horizon: int = 50
    threshold: float = 0.03
    """Distance between ball and goal within which an episode succeeds, m."""
    substeps: int = 5
    """Physics steps of 10 ms per control step."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.integers(self, "substeps")


@dataclasses.dataclass(frozen=True)
class VisualPointMassConfig(PixelsConfig, PointMassConfig):
    """Settings of the task and its images."""

    depth_range: tuple[float, float] = (0.85, 1.25)
    """Depths encoded as 0 and 255, m. Only for ``depth_encoding="metric"``."""


class PointMass(MjxGoalEnv):
    """PointMass task (see the module docstring), observed as images or as state, depending on ``observer``."""

    action_size = 2
    action_meaning = "forces along x and y, in multiples of 12 N"
    camera = "above"
    distance_unit = "m"
    chance, difficulty = 0.006, 10.4  # benchmarks/tasks/task_difficulty.py PointMass --episodes 20000

    def __init__(self, config: PointMassConfig, observer: Callable[[mujoco.MjModel], Observer] | None = None):
        """Build the model.

        Args:
            config: Settings of the task.
            observer: Function that builds the observer (poses to images) from the model. If None, `observe_state` is used.
        """
        mj_model = mjx_model.load_model("point_mass.xml")
        self.control_period = config.substeps * float(mj_model.opt.timestep)
        self._rest = mjx_model.rest_data(mj_model)
        super().__init__(config, mj_model, observer)

    def sample_start(self, key: jax.Array) -> mjx.Data:
        start_key, _ = jax.random.split(key)
        return self.configuration(jax.random.uniform(start_key, (2,), jnp.float32, -_RANGE, _RANGE))

    def sample_goal(self, key: jax.Array) -> mjx.Data:
        _, goal_key = jax.random.split(key)
        return self.configuration(jax.random.uniform(goal_key, (2,), jnp.float32, -_RANGE, _RANGE))

    def act(self, data: mjx.Data, action: jax.Array) -> mjx.Data:
        return mjx_model.simulate(self._model, data.replace(ctrl=action), self.config.substeps)

    def achieved(self, data: mjx.Data) -> jax.Array:
        return data.qpos

    def observe_state(self, data: mjx.Data) -> jax.Array:
        """Return position (m) and velocity (m/s): [4] float32."""
        return jnp.concatenate([data.qpos, data.qvel])

    def configuration(self, position: jax.Array) -> mjx.Data:
        """Return the ball at rest at ``position`` [2] float32, m."""
        return mjx_model.kinematics(self._model, self._rest.replace(qpos=position))


register_task(PointMass, PointMassConfig, VisualPointMassConfig)
