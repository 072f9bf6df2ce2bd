"""Fetch reach: move the gripper of a Fetch robot to a point above the table.

Follows the release of the authors of "Adaptive Auxiliary Task Weighting for Reinforcement Learning" (OL-AUX), itself derived
from OpenAI Gym's FetchReach. The differences are deliberate, and each has an option that reverts it: the goal image shows the
grip *site* at the goal (``goal_at="link"``: the gripper's link, which puts the grip 2 cm off); the mocap cross-hair, which
stood at the goal in the first image, is not rendered (``cross_hair``); fingers are orange (``finger_colour``); depth is metric
(``depth_encoding``). ``view="contrastive_rl"`` is the task of contrastive RL (Eysenbach et al., 2022): another camera, and goal
images taken after ten steps towards the goal.

    VisualFetchReach   observes RGB-D from a camera facing the robot
    FetchReach         observes the grip's position and velocity

State: grip position in the world, m. Action: displacement of the gripper along x, y, z (1 commands 5 cm and achieves about
3 cm), and a fourth component, for the fingers, that is ignored.
"""

import dataclasses
import functools
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
from jaxrl_vis_envs.tasks.fetch_arm import FetchArm
from jaxrl_vis_envs.tasks.mjx_env import register_task
from jaxrl_vis_envs.tasks.mocap_arm import MocapArmConfig

# Offset of every episode's start from the grip site of the stretched arm, m.
_SETUP_OFFSET = (-0.498, 0.005, -0.231)
_DOWN_ROTATION = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])  # rotation matrix of the gripper pointing down
_TABLE_TOP = 0.4  # m
_GREY = (0.356, 0.361, 0.376, 1.0)  # colour of the original's gripper
# Half-sizes (m) and alpha of the boxes of the original's mocap body.
_CROSS_HAIR = ((0.005, 0.005, 0.005, 0.7), (1.0, 0.005, 0.005, 0.1), (0.005, 1.0, 0.001, 0.1), (0.005, 0.005, 1.0, 0.1))
# Camera of Eysenbach et al. (2022, arXiv 2206.07568), which looks at a point (m) like MuJoCo's free camera; angles in degrees.
_CONTRASTIVE_RL_CAMERA = "contrastive_rl"
_LOOK_AT, _DISTANCE, _AZIMUTH, _ELEVATION, _FOVY = (1.2, 0.8, 0.5), 0.8, 180.0, -30.0, 45.0
_GOAL_STEPS, _GOAL_GAIN = 10, 10.0  # control steps towards the goal before their goal image is taken; actions per metre
GoalAt = Literal["grip", "link"]
View = Literal["front", "contrastive_rl"]
FingerColour = Literal["orange", "grey"]


@dataclasses.dataclass(frozen=True)
class FetchReachConfig(MocapArmConfig):
    """Settings of the task. Lengths in m."""

    horizon: int = 50
    threshold: float = 0.05
    """Distance to the goal within which an episode succeeds, m."""
    goal_range: float = 0.15
    """Maximum distance of goals (uniform) from the start along each axis, m."""
    solver_iterations: int = 4
    """Newton iterations per physics step. One is enough in free space, but not while the fingers rub on the table."""
    goal_at: GoalAt = "grip"
    """Point of the gripper at the goal in a goal image: the grip site or, as in the release, the link 2 cm above it."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.not_negative(self, "goal_range")
        checks.choice(self, "goal_at", get_args(GoalAt))


@dataclasses.dataclass(frozen=True)
class VisualFetchReachConfig(PixelsConfig, FetchReachConfig):
    """Settings of the task and its images."""

    depth_range: tuple[float, float] = (0.4, 1.8)
    """Depths encoded as 0 and 255, m: 5.5 mm per step, from in front of the nearest gripper to behind the robot. Only for
    ``depth_encoding="metric"``."""
    clip_range: tuple[float, float] = (0.026, 130.0)
    """Near and far clipping planes of the release, m. Only for ``depth_encoding="zbuffer"``."""
    cross_hair: bool = False
    """Render the release's cross-hair at the mocap body that pulls the gripper; in an episode's first image, at the goal."""
    view: View = "front"
    """Camera and goal images. front: facing the robot. contrastive_rl: those of contrastive RL's ``fetch_reach_image``, with
    goal images taken after ten proportional steps towards the goal; its images are ``pixels="rgb"``."""
    finger_colour: FingerColour = "orange"
    """Colour of the fingers: orange, which stands out, or grey as in the original."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.boolean(self, "cross_hair")
        checks.choice(self, "view", get_args(View))
        if self.view == "contrastive_rl" and (self.cross_hair or self.goal_at != "grip"):
            raise ValueError('view="contrastive_rl" has goal images of its own: leave out cross_hair and goal_at')
        checks.choice(self, "finger_colour", get_args(FingerColour))


class FetchReach(FetchArm):
    """Fetch reach task (see the module docstring), observed as images or as state, depending on ``observer``."""

    config: FetchReachConfig
    camera = "front"
    chance, difficulty = 0.008, 2.8  # benchmarks/tasks/task_difficulty.py FetchReach --episodes 1000

    def __init__(self, config: FetchReachConfig, observer: Callable[[mujoco.MjModel], Observer] | None = None):
        """Build the model and compute the start state.

        Args:
            config: Settings of the task.
            observer: Function that builds the observer (poses to images) from the model. If None, `observe_state` is used.
        """
        self._has_cross_hair = isinstance(config, VisualFetchReachConfig) and config.cross_hair
        self._is_contrastive_view = self.select_camera(config) == _CONTRASTIVE_RL_CAMERA
        change = _add_cross_hair if self._has_cross_hair else _add_contrastive_rl_camera if self._is_contrastive_view else None
        mj_model = mjx_model.load_model("fetch_reach.xml", change)
        if isinstance(config, VisualFetchReachConfig) and config.finger_colour == "grey":
            for name in ("left_finger", "right_finger"):
                mj_model.geom(name).rgba = _GREY
        super().__init__(config, mj_model, observer)

    @classmethod
    def select_camera(cls, config: FetchReachConfig) -> str:
        is_contrastive_rl = isinstance(config, VisualFetchReachConfig) and config.view == "contrastive_rl"
        return _CONTRASTIVE_RL_CAMERA if is_contrastive_rl else cls.camera

    @functools.cached_property
    def goal_box(self) -> tuple[np.ndarray, np.ndarray]:
        centre = np.asarray(self._start.site_xpos[self._grip])
        return centre - self.config.goal_range, centre + self.config.goal_range

    def _settled(self, mj_model: mujoco.MjModel, config: MocapArmConfig) -> mujoco.MjData:
        """Pull the stretched arm to the setup point, as Gym does once at construction.

        The arm is still moving slightly afterwards, as it is at the start of Gym's episodes.
        """
        mj_data = mujoco.MjData(mj_model)
        mujoco.mj_forward(mj_model, mj_data)
        self._pull_grip(mj_model, mj_data, mj_data.site("grip").xpos + np.array(_SETUP_OFFSET))
        return mj_data

    def sample_start(self, key: jax.Array) -> mjx.Data:
        if not self._has_cross_hair:
            return self._start
        # The release left its mocap body at the goal it had just rendered. It does not pull: each action sets a new target.
        return self._place_cross_hair(self._start, self._link_position(self._sample_goal_position(key)))

    def sample_goal(self, key: jax.Array) -> mjx.Data:
        goal = self._sample_goal_position(key)
        return self._drive_towards(goal) if self._is_contrastive_view else self.goal_configuration(goal)

    def goal_state(self, key: jax.Array, goal_data: mjx.Data) -> jax.Array:
        is_shown = self.config.goal_at == "grip" and not self._is_contrastive_view
        return self.achieved(goal_data) if is_shown else self._sample_goal_position(key)

    def _drive_towards(self, goal: jax.Array) -> mjx.Data:
        """Return the state after ten actions proportional to the distance from the grip to ``goal`` [3] (m, world)."""

        def drive(data: mjx.Data, _: None) -> tuple[mjx.Data, None]:
            towards = jnp.clip(_GOAL_GAIN * (goal - self.achieved(data)), -1.0, 1.0)
            return self.act(data, jnp.append(towards, 0.0)), None

        return jax.lax.scan(drive, self._start, length=_GOAL_STEPS)[0]

    def _sample_goal_position(self, key: jax.Array) -> jax.Array:
        """Sample the goal position [3] (m, world) of an episode."""
        offset = jax.random.uniform(key, (3,), jnp.float32, -self.config.goal_range, self.config.goal_range)
        return self._start.site_xpos[self._grip] + offset

    def _link_position(self, goal: jax.Array) -> jax.Array:
        """Return the position [3] (m, world) of the downward gripper's link for a ``goal`` [3] (m, world); see ``goal_at``."""
        if self.config.goal_at == "link":
            return goal
        return goal - jnp.asarray(_DOWN_ROTATION @ self.mj_model.site_pos[self._grip], jnp.float32)

    def _place_cross_hair(self, data: mjx.Data, position: jax.Array) -> mjx.Data:
        """Return ``data`` with the mocap body at ``position`` [3] (m, world)."""
        return mjx_model.kinematics(self._model, data.replace(mocap_pos=position[None]))

    def goal_configuration(self, goal: jax.Array) -> mjx.Data:
        """Return the robot at rest with its grip as near to ``goal`` [3] (m, world) as joints and table allow, pointing down.

        With ``goal_at="link"``, the gripper's link is at the goal instead of the grip.

        For 300 goals, the joint angles differ from those after driving the arm there for 200 substeps by .002 rad (median) and
        .02 rad (99th percentile), and a reset costs a hundredth of that.
        """
        fingertip = self.mj_model.geom("right_fingertip").id
        lowest = _TABLE_TOP + float(self.mj_model.geom_pos[fingertip, 0] + self.mj_model.geom_size[fingertip, 0])
        goal_link = self._link_position(goal)
        rest = self._close_fingers(self._start.replace(qvel=jnp.zeros_like(self._start.qvel)))
        reachable = goal_link.at[2].max(lowest)
        data = inverse_kinematics.reach(self.mj_model, self._model, rest, self._hand, reachable, _DOWN_ROTATION)
        return self._place_cross_hair(data, goal_link) if self._has_cross_hair else data


def _add_cross_hair(spec: mujoco.MjSpec) -> None:
    """Add Gym's mocap body: a small cube and three bars with a half-length of 1 m, without collisions."""
    for *size, alpha in _CROSS_HAIR:
        spec.body("mocap").add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX, size=size, rgba=(0.0, 0.5, 0.0, alpha), contype=0, conaffinity=0, mass=0.0
        )


def _add_contrastive_rl_camera(spec: mujoco.MjSpec) -> None:
    """Add the camera of contrastive RL's task, fixed in the world."""
    azimuth, elevation = np.deg2rad([_AZIMUTH, _ELEVATION])
    level = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    forward = np.cos(elevation) * level + [0.0, 0.0, np.sin(elevation)]
    right = np.cross(forward, [0.0, 0.0, 1.0]) / np.cos(elevation)
    camera = spec.worldbody.add_camera(name=_CONTRASTIVE_RL_CAMERA, pos=np.array(_LOOK_AT) - _DISTANCE * forward, fovy=_FOVY)
    camera.alt.type = mujoco.mjtOrientation.mjORIENTATION_XYAXES
    camera.alt.xyaxes = np.concatenate([right, np.cross(right, forward)])


register_task(FetchReach, FetchReachConfig, VisualFetchReachConfig)
