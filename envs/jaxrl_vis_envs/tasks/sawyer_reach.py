"""Sawyer reach: move the hand of a Sawyer arm, by position control, to a point in a wide box over the table.

The real-robot task of the thesis (5.1.5.2) in simulation: 25 steps of at most 5 cm along each axis, goals uniform in a box
whose diagonal is 1.30 m, success within 10 cm at the last step. The thesis gives neither the box's sides nor where it stands;
ours are 1.00 x 0.70 x 0.45 m, over the middle of the workspace of the authors' simulated Sawyer, and every point of it can be
reached. An episode starts at its centre. A hand that stays there succeeds in 1.3 % of the episodes.

    VisualSawyerReach   sees RGB-D from above the far edge of the table
    SawyerReach         sees the hand's position and velocity

State: position of the grip between the fingers in the world, m. Action: displacement of where the hand is pulled to.
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
from jaxrl_vis_envs.tasks.pulled_arm import PulledArm, PulledArmConfig, pull

_SETTLING_SUBSTEPS = 1000
_DOWN_ROTATION = np.diag([1.0, -1.0, -1.0])  # of the hand
# Joint angles at a goal: within 6 mm for 99 % of the box, 6 cm in its far corners, where the arm is nearly stretched.
_IK_DAMPING = (1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3)
_IK_STEPS = 20


@dataclasses.dataclass(frozen=True)
class SawyerReachConfig(PulledArmConfig):
    """Settings of the task. Lengths in m."""

    horizon: int = 25
    threshold: float = 0.1
    """An episode succeeds within this distance of the goal, m."""
    goal_centre: tuple[float, float, float] = (-0.055, 0.485, 0.975)
    """Centre of the box of goals, where every episode starts, m in the world."""
    goal_size: tuple[float, float, float] = (1.0, 0.7, 0.45)
    """Sides of the box of goals, m."""
    workspace_margin: float = 0.05
    """How far the hand may be pulled out of the box on each side, m. The table is 5 cm below it."""

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
    """Depths that bytes 0 and 255 stand for, m: 4.7 mm a step, from before the highest hand to the table behind the lowest."""


class SawyerReach(PulledArm):
    """The task; what the agent sees of it is up to ``observer``."""

    config: SawyerReachConfig
    action_size = 3
    camera = "above"
    chance, difficulty = 0.010, 3.5  # benchmarks/tasks/task_difficulty.py SawyerReach --episodes 1000

    def __init__(self, config: SawyerReachConfig, observer: Callable[[mujoco.MjModel], Observer] | None = None):
        """Builds the model and finds the start.

        Args:
            config: The settings.
            observer: Given the model, returns the function from poses to images. Default: `observe_state`.
        """
        super().__init__(config, mjx_model.load_model("sawyer_reach.xml"), "hand", observer)

    def _settled(self, mj_model: mujoco.MjModel, config: SawyerReachConfig) -> mujoco.MjData:
        """The arm at rest with its grip at the centre of the goals, after it was pulled there from its ready pose."""
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
        return mjx_model.simulate(self._model, data, self.config.substeps, undisturbed=True)

    def goal_configuration(self, goal: jax.Array) -> mjx.Data:
        """The arm at rest with its grip at or near ``goal`` [3] (m, world), the hand down."""
        hand = goal - jnp.asarray(_DOWN_ROTATION @ self.mj_model.site_pos[self._grip], jnp.float32)
        return inverse_kinematics.reach(
            self.mj_model, self._model, self._start, self._hand, hand, _DOWN_ROTATION, _IK_DAMPING, _IK_STEPS
        )


register_task(SawyerReach, SawyerReachConfig, VisualSawyerReachConfig)
