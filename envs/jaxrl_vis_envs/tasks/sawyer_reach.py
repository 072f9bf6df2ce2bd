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

from jaxrl_vis_envs.physics import inverse_kinematics, mjx_model
from jaxrl_vis_envs.physics.mjx_model import mjx
from jaxrl_vis_envs.pixels import Observer, PixelsConfig, image_observer
from jaxrl_vis_envs.randomization import OFF, Randomization
from jaxrl_vis_envs.registry import register
from jaxrl_vis_envs.tasks.mjx_env import MjxGoalEnv

_CONTROL_PERIOD = 0.04  # s
_SETTLING_SUBSTEPS = 1000
_DOWN_ROTATION = np.diag([1.0, -1.0, -1.0])  # of the hand
# Joint angles at a goal: within 6 mm for 99 % of the box, 6 cm in its far corners, where the arm is nearly stretched.
_IK_DAMPING = (1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3)
_IK_STEPS = 20


@dataclasses.dataclass(frozen=True)
class SawyerReachConfig:
    """Settings of the task. Lengths in m."""

    horizon: int = 25
    """Control steps in an episode."""
    threshold: float = 0.1
    """An episode succeeds within this distance of the goal, m."""
    goal_centre: tuple[float, float, float] = (-0.055, 0.485, 0.975)
    """Centre of the box of goals, where every episode starts, m in the world."""
    goal_size: tuple[float, float, float] = (1.0, 0.7, 0.45)
    """Sides of the box of goals, m."""
    workspace_margin: float = 0.05
    """How far the hand may be pulled out of the box on each side, m. The table is 5 cm below it."""
    action_scale: float = 0.05
    """Displacement of an action of 1, m."""
    substeps: int = 20
    """Physics steps in a control step of 40 ms (20 as in the authors' simulation; 10 is nearly twice as fast)."""
    solver_iterations: int = 1
    """Newton iterations in a physics step."""
    randomization: Randomization = OFF
    """What varies between episodes, and how far."""

    def __post_init__(self) -> None:
        for field in ("horizon", "solver_iterations"):
            if getattr(self, field) < 1:
                raise ValueError(f"{field} must be at least 1, got {getattr(self, field)}")
        if self.substeps < 4:
            raise ValueError(f"substeps must be at least 4, got {self.substeps}: the weld's time constant is 20 ms")
        if min(self.goal_size) <= 0 or self.workspace_margin < 0:
            raise ValueError(
                f"goal_size must be positive and workspace_margin not negative, got {self.goal_size}, {self.workspace_margin}"
            )


@dataclasses.dataclass(frozen=True)
class VisualSawyerReachConfig(PixelsConfig, SawyerReachConfig):
    """Settings of the task and its images."""

    depth_range: tuple[float, float] = (1.4, 2.6)
    """Depths that bytes 0 and 255 stand for, m: 4.7 mm a step, from before the highest hand to the table behind the lowest."""

    def __post_init__(self) -> None:
        SawyerReachConfig.__post_init__(self)
        PixelsConfig.__post_init__(self)


class SawyerReach(MjxGoalEnv):
    """The task; what the agent sees of it is up to ``observer``."""

    action_size = 3
    camera = "above"
    distance_unit = "m"
    chance, difficulty = 0.010, 3.5  # benchmarks/task_difficulty.py SawyerReach --episodes 1000

    def __init__(self, config: SawyerReachConfig, observer: Callable[[mujoco.MjModel], Observer] | None = None):
        """Builds the model and finds the start.

        Args:
            config: The settings.
            observer: Given the model, returns the function from poses to images. Default: `observe_state`.
        """
        mj_model = mjx_model.load_model("sawyer_reach.xml")
        mj_model.opt.iterations = config.solver_iterations
        self.control_period = _CONTROL_PERIOD
        self._hand = mj_model.body("hand").id
        self._grip = mj_model.site("grip").id
        # The start is found with the timestep of the model file, so that it does not depend on `substeps`.
        self._start = mjx_model.start_data(mj_model, _settle_at(mj_model, config.goal_centre))
        mj_model.opt.timestep = _CONTROL_PERIOD / config.substeps
        super().__init__(config, mj_model, observer)

    def sample_start(self, key: jax.Array) -> mjx.Data:
        return self._start

    def sample_goal(self, key: jax.Array) -> mjx.Data:
        half = 0.5 * jnp.asarray(self.config.goal_size, jnp.float32)
        offset = half * jax.random.uniform(key, (3,), jnp.float32, -1.0, 1.0)
        return self.goal_configuration(jnp.asarray(self.config.goal_centre, jnp.float32) + offset)

    def act(self, data: mjx.Data, action: jax.Array) -> mjx.Data:
        centre = jnp.asarray(self.config.goal_centre, jnp.float32)
        reach = 0.5 * jnp.asarray(self.config.goal_size, jnp.float32) + self.config.workspace_margin
        target = jnp.clip(data.mocap_pos[0] + self.config.action_scale * action, centre - reach, centre + reach)
        return mjx_model.simulate(self._model, data.replace(mocap_pos=target[None]), self.config.substeps)

    def achieved(self, data: mjx.Data) -> jax.Array:
        return data.site_xpos[self._grip]

    def observe_state(self, data: mjx.Data) -> jax.Array:
        """Position of the grip (m), its displacement in a control step at its present speed (m): [6] float32."""
        position = data.site_xpos[self._grip]
        velocity = mjx_model.point_velocity(self.mj_model, data, self._hand, position)
        return jnp.concatenate([position, self.control_period * velocity])

    def goal_configuration(self, goal: jax.Array) -> mjx.Data:
        """The arm at rest with its grip at or near ``goal`` [3] (m, world), the hand down."""
        hand = goal - jnp.asarray(_DOWN_ROTATION @ self.mj_model.site_pos[self._grip], jnp.float32)
        return inverse_kinematics.reach(
            self.mj_model, self._model, self._start, self._hand, hand, _DOWN_ROTATION, _IK_DAMPING, _IK_STEPS
        )


def _settle_at(mj_model: mujoco.MjModel, position: tuple[float, float, float]) -> mujoco.MjData:
    """The arm at rest with its grip at ``position`` (m, world), after it was pulled there from its ready pose."""
    mj_data = mujoco.MjData(mj_model)
    mujoco.mj_resetDataKeyframe(mj_model, mj_data, mj_model.key("ready").id)
    mj_data.mocap_pos[0] = position
    mj_data.mocap_quat[0] = mj_model.body_quat[mj_model.body("mocap").id]
    for _ in range(_SETTLING_SUBSTEPS):
        mujoco.mj_step(mj_model, mj_data)
    mj_data.qvel[:] = 0.0
    mj_data.qacc_warmstart[:] = 0.0
    mj_data.time = 0.0
    mujoco.mj_forward(mj_model, mj_data)
    return mj_data


def _visual(config: VisualSawyerReachConfig) -> SawyerReach:
    return SawyerReach(config, lambda mj_model: image_observer(mj_model, SawyerReach.camera, config))


register("SawyerReach", SawyerReach, SawyerReachConfig)
register("VisualSawyerReach", _visual, VisualSawyerReachConfig)
