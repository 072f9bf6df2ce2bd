"""Fetch reach: move the gripper of a Fetch robot to a point over the table.

Follows the release of the authors of "Adaptive Auxiliary Task Weighting for Reinforcement Learning" (OL-AUX), itself a child of
OpenAI Gym's FetchReach. Differences, all deliberate, each with an option that undoes it: the goal image shows the grip *site*
at the goal (``goal_at="link"``: the gripper's link, so that the grip is 2 cm off); the mocap cross-hair, which stood at the
goal in the first image, is not drawn (``cross_hair``); fingers are orange (``finger_colour``); depth is metric
(``depth_encoding``).

    VisualFetchReach   sees RGB-D from a camera that faces the robot
    FetchReach         sees the grip's position and velocity

State: grip position in the world, m. Action: displacement of the gripper along x, y, z (1 = 5 cm asked, about 3 cm done), and a
fourth component, for the fingers, that is ignored.
"""

import dataclasses
from collections.abc import Callable
from typing import Literal, get_args

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

# The gripper points down. Added to the link's own unit quaternion, as the original does, it turns the target about 60 % of the
# way back to this orientation in each control step.
_DOWN = (1.0, 0.0, 1.0, 0.0)
# From the grip site of the stretched arm to the start of every episode, m.
_SETUP_OFFSET = (-0.498, 0.005, -0.231)
_SETTLING_SUBSTEPS = 200
_DOWN_ROTATION = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])  # of the gripper while it points down
_TABLE_TOP = 0.4  # m
_GREY = (0.356, 0.361, 0.376, 1.0)  # of the original's gripper
# Half-sizes (m) and opacity of the boxes at the original's mocap body.
_CROSS_HAIR = ((0.005, 0.005, 0.005, 0.7), (1.0, 0.005, 0.005, 0.1), (0.005, 1.0, 0.001, 0.1), (0.005, 0.005, 1.0, 0.1))
GoalAt = Literal["grip", "link"]
FingerColour = Literal["orange", "grey"]


@dataclasses.dataclass(frozen=True)
class FetchReachConfig(PulledArmConfig):
    """Settings of the task. Lengths in m."""

    horizon: int = 50
    threshold: float = 0.05
    """An episode succeeds within this distance of the goal, m."""
    goal_range: float = 0.15
    """Goals are uniform within this distance of the start along each axis, m."""
    solver_iterations: int = 4
    """Newton iterations in a physics step. One is enough in the air, but not where the fingers rub on the table."""
    goal_at: GoalAt = "grip"
    """What a goal image shows at the goal: the grip site or, as in the release, the gripper's link 2 cm above it."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.not_negative(self, "goal_range")
        checks.one_of(self, "goal_at", get_args(GoalAt))


@dataclasses.dataclass(frozen=True)
class VisualFetchReachConfig(PixelsConfig, FetchReachConfig):
    """Settings of the task and its images."""

    depth_range: tuple[float, float] = (0.4, 1.8)
    """Depths that bytes 0 and 255 stand for, m: 5.5 mm a step, from before the nearest gripper to behind the robot."""
    clip_range: tuple[float, float] = (0.026, 130.0)
    """The clipping planes of the release, m."""
    cross_hair: bool = False
    """Draws the release's cross-hair at the point that pulls the gripper. In an episode's first image it stands at the goal."""
    finger_colour: FingerColour = "orange"
    """Orange fingers, which stand out, or the original's grey ones."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.true_or_false(self, "cross_hair")
        checks.one_of(self, "finger_colour", get_args(FingerColour))


class FetchReach(PulledArm):
    """The task; what the agent sees of it is up to ``observer``."""

    config: FetchReachConfig
    action_size = 4
    camera = "front"
    chance, difficulty = 0.008, 2.8  # benchmarks/tasks/task_difficulty.py FetchReach --episodes 1000

    def __init__(self, config: FetchReachConfig, observer: Callable[[mujoco.MjModel], Observer] | None = None):
        """Builds the model and finds the start.

        Args:
            config: The settings.
            observer: Given the model, returns the function from poses to images. Default: `observe_state`.
        """
        self._has_cross_hair = isinstance(config, VisualFetchReachConfig) and config.cross_hair
        mj_model = mjx_model.load_model("fetch_reach.xml", _add_cross_hair if self._has_cross_hair else None)
        if isinstance(config, VisualFetchReachConfig) and config.finger_colour == "grey":
            for name in ("left_finger", "right_finger"):
                mj_model.geom(name).rgba = _GREY
        self._fingers = np.array([mj_model.joint(name).qposadr[0] for name in ("right_finger", "left_finger")])
        super().__init__(config, mj_model, "gripper", observer)

    def _settled(self, mj_model: mujoco.MjModel, config: PulledArmConfig) -> mujoco.MjData:
        """The stretched arm pulled to the setup point, as Gym does once at construction.

        There it still moves a little, and so it does at the start of Gym's episodes.
        """
        mj_data = mujoco.MjData(mj_model)
        mujoco.mj_forward(mj_model, mj_data)
        position = mj_data.site("grip").xpos + np.array(_SETUP_OFFSET)
        pull(mj_model, mj_data, position, np.array(_DOWN) / np.linalg.norm(_DOWN), _SETTLING_SUBSTEPS)
        mujoco.mj_forward(mj_model, mj_data)
        return mj_data

    def sample_start(self, key: jax.Array) -> mjx.Data:
        if not self._has_cross_hair:
            return self._start
        # The release left its mocap body at the goal that it had just drawn. Nothing is pulled there: actions start anew.
        return self._with_cross_hair(self._start, self._link_at(self._goal_point(key)))

    def sample_goal(self, key: jax.Array) -> mjx.Data:
        return self.goal_configuration(self._goal_point(key))

    def goal_state_of(self, key: jax.Array, goal_data: mjx.Data) -> jax.Array:
        return self.achieved(goal_data) if self.config.goal_at == "grip" else self._goal_point(key)

    def _goal_point(self, key: jax.Array) -> jax.Array:
        """The point [3] (m, world) that an episode asks for."""
        offset = jax.random.uniform(key, (3,), jnp.float32, -self.config.goal_range, self.config.goal_range)
        return self._start.site_xpos[self._grip] + offset

    def _link_at(self, goal: jax.Array) -> jax.Array:
        """Where the gripper's link is to be, the gripper down, for a ``goal`` [3]: [3] (m, world)."""
        if self.config.goal_at == "link":
            return goal
        return goal - jnp.asarray(_DOWN_ROTATION @ self.mj_model.site_pos[self._grip], jnp.float32)

    def _with_cross_hair(self, data: mjx.Data, position: jax.Array) -> mjx.Data:
        """``data`` with the mocap body at ``position`` [3] (m, world)."""
        return mjx_model.kinematics(self._model, data.replace(mocap_pos=position[None]))

    def act(self, data: mjx.Data, action: jax.Array) -> mjx.Data:
        # The target starts from where the gripper is, not from the last target, so that what was not reached is forgotten.
        position = data.xpos[self._hand] + self.config.action_scale * action[:3]
        quaternion = data.xquat[self._hand] + jnp.asarray(_DOWN, jnp.float32)
        data = data.replace(mocap_pos=position[None], mocap_quat=quaternion[None])
        data = mjx_model.take_steps(self._model, data, self.config.substeps, undisturbed=True)
        return mjx_model.kinematics(self._model, self._with_closed_fingers(data))

    def _with_closed_fingers(self, data: mjx.Data) -> mjx.Data:
        """After each control step the original puts the fingers back, but leaves them their velocity."""
        return data.replace(qpos=data.qpos.at[self._fingers].set(0.0))

    def goal_configuration(self, goal: jax.Array) -> mjx.Data:
        """The robot at rest with its grip as near to ``goal`` [3] (m, world) as joints and table let it, the gripper down.

        With ``goal_at="link"`` it is the gripper's link.

        The joint angles agree with those after driving the arm there for 200 substeps within .002 rad in the median and .02
        rad at the 99th percentile of 300 goals, and a reset costs a hundredth.
        """
        fingertip = self.mj_model.geom("right_fingertip").id
        lowest = _TABLE_TOP + float(self.mj_model.geom_pos[fingertip, 0] + self.mj_model.geom_size[fingertip, 0])
        goal_link = self._link_at(goal)
        rest = self._with_closed_fingers(self._start.replace(qvel=jnp.zeros_like(self._start.qvel)))
        reachable = goal_link.at[2].max(lowest)
        data = inverse_kinematics.reach(self.mj_model, self._model, rest, self._hand, reachable, _DOWN_ROTATION)
        return self._with_cross_hair(data, goal_link) if self._has_cross_hair else data


def _add_cross_hair(spec: mujoco.MjSpec) -> None:
    """Gym's mocap body: a small cube and three bars, of half a length of 1 m, that nothing touches."""
    for *size, alpha in _CROSS_HAIR:
        spec.body("mocap").add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX, size=size, rgba=(0.0, 0.5, 0.0, alpha), contype=0, conaffinity=0, mass=0.0
        )


register_task(FetchReach, FetchReachConfig, VisualFetchReachConfig)
