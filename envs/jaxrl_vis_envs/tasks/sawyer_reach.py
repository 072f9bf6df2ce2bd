"""Sawyer reach: move the hand of a Sawyer arm, by position control, to a point in a large box above the table.

The real-robot task of the thesis (5.1.5.2) in simulation: 25 steps of at most 5 cm along each axis, goals uniform in a box with
a diagonal of 1.30 m, success within 10 cm at the last step. The thesis gives neither the sides nor the position of the box.
Here it is 1.00 x 0.70 x 0.45 m, around the middle of the workspace of the authors' simulated Sawyer, and entirely reachable.
Episodes start at its centre. A hand that stays there succeeds in 1.3 % of the episodes.

    VisualSawyerReach   observes RGB-D from above the far edge of the table
    SawyerReach         observes the hand's position and velocity

State: position of the grip between the fingers in the world, m. Action: displacement of the target that pulls the hand.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxrl_vis_envs import checks
from jaxrl_vis_envs.physics import inverse_kinematics, mjx_model
from jaxrl_vis_envs.physics.mjx_model import mjx
from jaxrl_vis_envs.pixels import Observer, PixelsConfig
from jaxrl_vis_envs.tasks.mjx_env import register_task
from jaxrl_vis_envs.tasks.mocap_arm import MocapArm, MocapArmConfig, pull

_SETTLING_SUBSTEPS = 1000
_DOWN_ROTATION = np.diag([1.0, -1.0, -1.0])  # rotation matrix of the hand pointing down
# Inverse kinematics of goals: within 6 mm for 99 % of the box, 6 cm in its far corners, where the arm is nearly stretched.
_IK_DAMPING = (1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3)
_IK_STEPS = 20


@dataclasses.dataclass(frozen=True)
class SawyerReachConfig(MocapArmConfig):
    """Settings of the task. Lengths in m."""

    horizon: int = 25
    threshold: float = 0.1
    """Distance to the goal within which an episode succeeds, m."""
    goal_centre: tuple[float, float, float] = (-0.055, 0.485, 0.975)
    """Centre of the goal box, where every episode starts, m in the world."""
    goal_size: tuple[float, float, float] = (1.0, 0.7, 0.45)
    """Sides of the goal box, m."""
    workspace_margin: float = 0.05
    """Margin around the goal box in which the hand may also be pulled, m. The table is 5 cm below the box."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.vector(self, "goal_centre", 3)
        if min(checks.vector(self, "goal_size", 3)) <= 0:
            raise ValueError(f"goal_size must be above 0 along each axis, got {self.goal_size}")
        checks.not_negative(self, "workspace_margin")


@dataclasses.dataclass(frozen=True)
class VisualSawyerReachConfig(PixelsConfig, SawyerReachConfig):
    """Settings of the task and its images."""

    depth_range: tuple[float, float] = (1.4, 2.6)
    """Depths encoded as 0 and 255, m: 4.7 mm per step, from in front of the highest hand to the table behind the lowest. Only
    for ``depth_encoding="metric"``."""


class SawyerReach(MocapArm):
    """Sawyer reach task (see the module docstring), observed as images or as state, depending on ``observer``."""

    config: SawyerReachConfig
    action_size = 3
    action_meaning = (
        "displacement along the world's x, y and z of the target that pulls the hand, in multiples of action_scale (m)"
    )
    camera = "above"
    chance, difficulty = 0.010, 3.5  # benchmarks/tasks/task_difficulty.py SawyerReach --episodes 1000

    def __init__(self, config: SawyerReachConfig, observer: Callable[[mujoco.MjModel], Observer] | None = None):
        """Build the model and compute the start state.

        Args:
            config: Settings of the task.
            observer: Function that builds the observer (poses to images) from the model. If None, `observe_state` is used.
        """
        super().__init__(config, mjx_model.load_model("sawyer_reach.xml"), "hand", observer)
        centre, half = np.array(config.goal_centre), np.array(config.goal_size) / 2
        self.goal_box = (centre - half, centre + half)

    def _settled(self, mj_model: mujoco.MjModel, config: SawyerReachConfig) -> mujoco.MjData:
        """Pull the arm from its ready pose until its grip is at the centre of the goals, and stop it there."""
        mj_data = mujoco.MjData(mj_model)
        mujoco.mj_resetDataKeyframe(mj_model, mj_data, mj_model.key("ready").id)
        down = mj_model.body_quat[mj_model.body("mocap").id]
        pull(mj_model, mj_data, np.array(config.goal_centre), down, _SETTLING_SUBSTEPS)
        mj_data.qvel[:] = 0.0
        mujoco.mj_forward(mj_model, mj_data)
        return mj_data

    def sample_goal(self, key: jax.Array) -> mjx.Data:
        half = 0.5 * jnp.asarray(self.config.goal_size, jnp.float32)
        offset = half * jax.random.uniform(key, (3,), jnp.float32, -1.0, 1.0)
        return self.goal_configuration(jnp.asarray(self.config.goal_centre, jnp.float32) + offset)

    def act(self, data: mjx.Data, action: jax.Array) -> mjx.Data:
        centre = jnp.asarray(self.config.goal_centre, jnp.float32)
        reach = 0.5 * jnp.asarray(self.config.goal_size, jnp.float32) + self.config.workspace_margin
        target = jnp.clip(data.mocap_pos[0] + self.config.action_scale * action, centre - reach, centre + reach)
        data = data.replace(mocap_pos=target[None])
        return mjx_model.simulate(self._model, data, self.config.substeps)

    def goal_configuration(self, goal: jax.Array) -> mjx.Data:
        """Return the arm at rest with its grip at or near ``goal`` [3] (m, world), the hand pointing down."""
        hand = goal - jnp.asarray(_DOWN_ROTATION @ self.mj_model.site_pos[self._grip], jnp.float32)
        return inverse_kinematics.reach(
            self.mj_model, self._model, self._start, self._hand, hand, _DOWN_ROTATION, _IK_DAMPING, _IK_STEPS
        )


register_task(SawyerReach, SawyerReachConfig, VisualSawyerReachConfig)
