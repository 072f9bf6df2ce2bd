"""Fetch reach: move the gripper of a Fetch robot to a point over the table.

Follows the release of the authors of "Adaptive Auxiliary Task Weighting for Reinforcement Learning" (OL-AUX), itself a child of
OpenAI Gym's FetchReach. Differences, all deliberate: the goal image shows the grip *site* at the goal (the release showed the
gripper's link there, 2 cm off); the mocap cross-hair, which stood at the goal in the first frame, is not drawn.

    VisualFetchReach   sees RGB-D from a camera that faces the robot
    FetchReach         sees the grip's position and velocity

State: grip position in the world, m. Action: displacement of the gripper along x, y, z (1 = 5 cm asked, about 3 cm done), and a
fourth component, for the fingers, that is ignored.
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

# The gripper points down. Added to the link's own unit quaternion, as the original does, it turns the target about 60 % of the
# way back to this orientation in each control step.
_DOWN = (1.0, 0.0, 1.0, 0.0)
# From the grip site of the stretched arm to the start of every episode, m.
_SETUP_OFFSET = (-0.498, 0.005, -0.231)
_SETTLING_SUBSTEPS = 200
_DOWN_ROTATION = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])  # of the gripper while it points down
_TABLE_TOP = 0.4  # m
_CONTROL_PERIOD = 0.04  # s


@dataclasses.dataclass(frozen=True)
class FetchReachConfig:
    """Settings of the task. Lengths in m."""

    horizon: int = 50
    """Control steps in an episode."""
    threshold: float = 0.05
    """An episode succeeds within this distance of the goal, m."""
    goal_range: float = 0.15
    """Goals are uniform within this distance of the start along each axis, m."""
    action_scale: float = 0.05
    """Displacement that an action of 1 asks for, m."""
    substeps: int = 20
    """Physics steps in a control step of 40 ms (20 is the original's 2 ms; 10 is nearly twice as fast)."""
    solver_iterations: int = 4
    """Newton iterations in a physics step. One is enough in the air, but not where the fingers rub on the table."""
    randomization: Randomization = OFF
    """What varies between episodes, and how far."""

    def __post_init__(self) -> None:
        for field in ("horizon", "solver_iterations"):
            if getattr(self, field) < 1:
                raise ValueError(f"{field} must be at least 1, got {getattr(self, field)}")
        if self.substeps < 4:
            raise ValueError(f"substeps must be at least 4, got {self.substeps}: the weld's time constant is 20 ms")


@dataclasses.dataclass(frozen=True)
class VisualFetchReachConfig(PixelsConfig, FetchReachConfig):
    """Settings of the task and its images."""

    depth_range: tuple[float, float] = (0.4, 1.8)
    """Depths that bytes 0 and 255 stand for, m: 5.5 mm a step, from before the nearest gripper to behind the robot."""

    def __post_init__(self) -> None:
        FetchReachConfig.__post_init__(self)
        PixelsConfig.__post_init__(self)


class FetchReach(MjxGoalEnv):
    """The task; what the agent sees of it is up to ``observer``."""

    action_size = 4
    camera = "front"
    distance_unit = "m"
    chance, difficulty = 0.008, 2.8  # benchmarks/task_difficulty.py FetchReach --episodes 1000

    def __init__(self, config: FetchReachConfig, observer: Callable[[mujoco.MjModel], Observer] | None = None):
        """Builds the model and finds the start.

        Args:
            config: The settings.
            observer: Given the model, returns the function from poses to images. Default: `observe_state`.
        """
        mj_model = mjx_model.load_model("fetch_reach.xml")
        mj_model.opt.iterations = config.solver_iterations
        self.control_period = _CONTROL_PERIOD
        self._gripper = mj_model.body("gripper").id
        self._grip = mj_model.site("grip").id
        self._fingers = np.array([mj_model.joint(name).qposadr[0] for name in ("right_finger", "left_finger")])
        # The start is found with the timestep of the model file, so that it does not depend on `substeps`.
        self._start = mjx_model.start_data(mj_model, _settle_at_start(mj_model))
        mj_model.opt.timestep = _CONTROL_PERIOD / config.substeps
        super().__init__(config, mj_model, observer)

    def sample_start(self, key: jax.Array) -> mjx.Data:
        return self._start

    def sample_goal(self, key: jax.Array) -> mjx.Data:
        offset = jax.random.uniform(key, (3,), jnp.float32, -self.config.goal_range, self.config.goal_range)
        return self.goal_configuration(self._start.site_xpos[self._grip] + offset)

    def act(self, data: mjx.Data, action: jax.Array) -> mjx.Data:
        # The target starts from where the gripper is, not from the last target, so that what was not reached is forgotten.
        position = data.xpos[self._gripper] + self.config.action_scale * action[:3]
        quaternion = data.xquat[self._gripper] + jnp.asarray(_DOWN, jnp.float32)
        data = data.replace(mocap_pos=position[None], mocap_quat=quaternion[None])
        data = mjx_model.take_steps(self._model, data, self.config.substeps)
        return mjx_model.kinematics(self._model, self._with_closed_fingers(data))

    def _with_closed_fingers(self, data: mjx.Data) -> mjx.Data:
        """After each control step the original puts the fingers back, but leaves them their velocity."""
        return data.replace(qpos=data.qpos.at[self._fingers].set(0.0))

    def achieved(self, data: mjx.Data) -> jax.Array:
        return data.site_xpos[self._grip]

    def observe_state(self, data: mjx.Data) -> jax.Array:
        """Position of the grip (m) and its displacement in a control step at its present speed (m): [6] float32, as in Gym."""
        position = data.site_xpos[self._grip]
        velocity = mjx_model.point_velocity(self.mj_model, data, self._gripper, position)
        return jnp.concatenate([position, self.control_period * velocity])

    def goal_configuration(self, goal: jax.Array) -> mjx.Data:
        """The robot at rest with its grip as near to ``goal`` [3] (m, world) as joints and table let it, the gripper down.

        The joint angles agree with those after driving the arm there for 200 substeps within .002 rad in the median and .02
        rad at the 99th percentile of 300 goals, and a reset costs a hundredth.
        """
        fingertip = self.mj_model.geom("right_fingertip").id
        lowest = _TABLE_TOP + float(self.mj_model.geom_pos[fingertip, 0] + self.mj_model.geom_size[fingertip, 0])
        goal_link = goal - jnp.asarray(_DOWN_ROTATION @ self.mj_model.site_pos[self._grip], jnp.float32)
        goal_link = goal_link.at[2].max(lowest)
        rest = self._with_closed_fingers(self._start.replace(qvel=jnp.zeros_like(self._start.qvel)))
        return inverse_kinematics.reach(self.mj_model, self._model, rest, self._gripper, goal_link, _DOWN_ROTATION)


def _settle_at_start(mj_model: mujoco.MjModel) -> mujoco.MjData:
    """The start of every episode: the stretched arm pulled to the setup point, as Gym does once at construction.

    There it still moves a little, and so it does at the start of Gym's episodes.
    """
    mj_data = mujoco.MjData(mj_model)
    mujoco.mj_forward(mj_model, mj_data)
    mj_data.mocap_pos[0] = mj_data.site("grip").xpos + np.array(_SETUP_OFFSET)
    mj_data.mocap_quat[0] = np.array(_DOWN) / np.linalg.norm(_DOWN)
    for _ in range(_SETTLING_SUBSTEPS):
        mujoco.mj_step(mj_model, mj_data)
    mj_data.qacc_warmstart[:] = 0.0
    mj_data.time = 0.0
    mujoco.mj_forward(mj_model, mj_data)
    return mj_data


def _visual(config: VisualFetchReachConfig) -> FetchReach:
    return FetchReach(config, lambda mj_model: image_observer(mj_model, FetchReach.camera, config))


register("FetchReach", FetchReach, FetchReachConfig)
register("VisualFetchReach", _visual, VisualFetchReachConfig)
