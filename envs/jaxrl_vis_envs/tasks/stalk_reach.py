"""Stalk reach: bring the open jaws of a grasping arm around one of several stalks that sway in the wind.

The arm of chapter 4 of the thesis in front of a stretch of a row: a slide and two revolute joints, position-controlled. An
episode samples the positions and lean of the stalks, the wind, a target stalk and a height. In the goal image the air is still
and the gripper is at that stalk. Stalks bend when they are pushed. The jaws stay open; closing them is not part of the task.

    VisualStalkReach   observes RGB-D from behind the arm's shoulder
    StalkReach         observes the grip, its velocity, and the displacement of the target stalk

State: position of the grip in the world minus the displacement of the target stalk from rest at the height of the grip, m. The
distance to the goal is therefore that of the jaws to the stalk's current position. Action: displacement of the position that
the grip is driven to.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxrl_vis_envs import checks
from jaxrl_vis_envs.physics import mjx_model, rotations
from jaxrl_vis_envs.physics.mjx_model import mjx
from jaxrl_vis_envs.pixels import Observer, PixelsConfig
from jaxrl_vis_envs.plants import bending
from jaxrl_vis_envs.tasks import stalk_arm
from jaxrl_vis_envs.tasks.config import TaskConfig
from jaxrl_vis_envs.tasks.mjx_env import MjxGoalEnv, register_task

_CONTROL_PERIOD = 0.04  # s
HOME = (0.0, stalk_arm.SHOULDER[1] + 0.36, 0.75)
"""Position of the grip at the start of an episode, m in the world."""
_HEIGHTS = (0.45, 1.05)  # m, range in which the grip may be driven
_RADII, _MAX_BEARING = (0.35, 0.69), 0.7  # m and rad, the same in the horizontal plane
_GUST_FREQUENCIES = (0.17, 0.29, 0.53)  # Hz


@dataclasses.dataclass(frozen=True)
class StalkReachConfig(TaskConfig):
    """Settings of the task. Lengths in m."""

    horizon: int = 50
    threshold: float = 0.02
    """Distance between the middle of the jaws and the stalk within which an episode succeeds, m: the stalk is between them."""
    stalks: int = 4
    """Number of stalks, from 1 to 4."""
    spacing: tuple[float, float] = (0.05, 0.09)
    """Range of the uniform distance between neighbours along the row, m."""
    offset: float = 0.03
    """Maximum distance of stalks from the row's centre line (uniform), m."""
    lean: float = 5.0
    """Maximum lean of stalks along and across the row (uniform), degrees."""
    goal_heights: tuple[float, float] = (0.6, 0.9)
    """Range of goal heights, m above the ground."""
    wind: float = 0.01
    """Amplitude of the stalks' sway 0.7 m above the ground, m."""
    action_scale: float = 0.03
    """Displacement commanded by an action of 1, m."""
    substeps: int = 10
    """Physics steps per control step of 40 ms; at least 8."""
    solver_iterations: int = 2
    """Newton iterations per physics step."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.positive(self, "action_scale")
        checks.not_negative(self, "offset", "lean", "wind")
        checks.integers(self, "stalks", "solver_iterations")
        checks.integers(self, "substeps", minimum=8)
        if self.stalks > 4:
            raise ValueError(f"stalks must be from 1 to 4, got {self.stalks}")
        if self.lean > 20:
            raise ValueError(f"lean must be from 0 to 20 degrees, got {self.lean}")
        for field, minimum, maximum in (("spacing", 0.0, 0.15), ("goal_heights", *_HEIGHTS)):
            low, high = checks.vector(self, field, 2)
            if not minimum <= low <= high <= maximum:
                raise ValueError(f"{field} must be within {minimum:g} to {maximum:g} m, got {getattr(self, field)}")


@dataclasses.dataclass(frozen=True)
class VisualStalkReachConfig(PixelsConfig, StalkReachConfig):
    """Settings of the task and its images."""

    depth_range: tuple[float, float] = (0.4, 1.4)
    """Depths encoded as 0 and 255, m: 4 mm per step, from in front of the raised arm to behind the row. Only for
    ``depth_encoding="metric"``."""


class _Episode(NamedTuple):
    """Random quantities of an episode.

    Attributes:
        foot: [N, 3] float32, positions of the stalks' feet, m.
        rotation: [N, 4] float32, orientations of the stalks: unit quaternions, scalar first.
        wind: [3] float32, heading and phase of the wind (rad) and the index of the target stalk, as `_gusts` and
            `_displacement` read them.
        height: [] float32, height of the goal, m.
    """

    foot: jax.Array
    rotation: jax.Array
    wind: jax.Array
    height: jax.Array


class StalkReach(MjxGoalEnv):
    """Stalk reach task (see the module docstring), observed as images or as state, depending on ``observer``."""

    config: StalkReachConfig
    action_size = 3
    action_meaning = (
        "displacement along x, y and z of the position that the grip is driven to, in multiples of action_scale (m)"
    )
    camera = "shoulder"
    distance_unit = "m"
    control_period = _CONTROL_PERIOD
    chance, difficulty = 0.003, 11.1  # benchmarks/tasks/task_difficulty.py StalkReach --episodes 1000

    def __init__(self, config: StalkReachConfig, observer: Callable[[mujoco.MjModel], Observer] | None = None):
        """Build the model.

        Args:
            config: Settings of the task.
            observer: Function that builds the observer (poses to images) from the model. If None, `observe_state` is used.
        """
        mj_model = stalk_arm.build_servoed(config.stalks)
        mj_model.opt.iterations = config.solver_iterations
        mj_model.opt.timestep = _CONTROL_PERIOD / config.substeps
        self._layout = bending.read_layout(mj_model)
        self._wind = int(mj_model.body_mocapid[mj_model.body("wind").id])
        self._forearm = mj_model.body("forearm").id
        self._rest = mjx_model.rest_data(mj_model)
        super().__init__(config, mj_model, observer)

    def sample_start(self, key: jax.Array) -> mjx.Data:
        episode = self._sample(key)
        displacement = bending.displacement(self._gusts(episode.wind), episode.foot, 0.0)
        data = self.configuration(episode, jnp.asarray(HOME, jnp.float32), displacement)
        return data.replace(ctrl=data.qpos[:3])

    def sample_goal(self, key: jax.Array) -> mjx.Data:
        episode = self._sample(key)
        still = jnp.zeros((self.config.stalks, 2), jnp.float32)
        position = _rest_points(episode.foot, episode.rotation, episode.height)[episode.wind[2].astype(int)]
        return self.configuration(episode, position, still)

    def act(self, data: mjx.Data, action: jax.Array) -> mjx.Data:
        position = clamp_to_workspace(stalk_arm.grip_at(data.ctrl) + self.config.action_scale * action)
        gusts = self._gusts(data.mocap_pos[self._wind])
        foot = data.mocap_pos[self._layout.mocap]
        wind = bending.wind_torque(self._model, self._layout, gusts, foot, data.time)
        data = data.replace(ctrl=stalk_arm.joints_at(position, 1.0), qfrc_applied=wind)
        return mjx_model.simulate(self._model, data, self.config.substeps)

    def achieved(self, data: mjx.Data) -> jax.Array:
        return stalk_arm.grip_at(data.qpos[:3]) - self._displacement(data)

    def observe_state(self, data: mjx.Data) -> jax.Array:
        """Return `achieved` (m), the grip's displacement per control step at its current velocity (m), and the displacement of
        the target stalk along and across the row (m): [8] float32.
        """
        grip = stalk_arm.grip_at(data.qpos[:3])
        velocity = mjx_model.point_velocity(self.mj_model, data, self._forearm, grip).at[2].set(data.qvel[0])
        return jnp.concatenate([self.achieved(data), self.control_period * velocity, self._displacement(data)[:2]])

    def configuration(self, episode: _Episode, grip: jax.Array, displacement: jax.Array) -> mjx.Data:
        """Return the arm at rest with its grip at ``grip`` [3] (m, world), among stalks with ``displacement`` [N, 2] from rest,
        m.
        """
        data = self._rest.replace(
            mocap_pos=self._rest.mocap_pos.at[self._layout.mocap].set(episode.foot).at[self._wind].set(episode.wind),
            mocap_quat=self._rest.mocap_quat.at[self._layout.mocap].set(episode.rotation),
        )
        hinges = bending.hinge_angles(self._layout, self.mj_model.nv, displacement)
        joints = stalk_arm.joints_at(grip, 1.0)
        return mjx_model.kinematics(self._model, data.replace(qpos=hinges.at[:3].set(joints)))

    def _displacement(self, data: mjx.Data) -> jax.Array:
        """Return the displacement of the target stalk from rest at the height of the grip: [3] float32, m."""
        stalk = data.mocap_pos[self._wind][2].astype(int)
        height = data.qpos[0]
        rest = _rest_points(data.mocap_pos[self._layout.mocap], data.mocap_quat[self._layout.mocap], height)
        return (bending.at_height(data, self._layout, height) - rest)[stalk]

    def _gusts(self, wind: jax.Array) -> bending.Gusts:
        """Build the wind of an episode from `_Episode.wind` [3]."""
        return bending.Gusts(
            heading=jnp.stack([jnp.cos(wind[0]), jnp.sin(wind[0])]),
            strength=jnp.asarray(self.config.wind, jnp.float32),
            frequency=jnp.asarray(_GUST_FREQUENCIES, jnp.float32),
            phase=wind[1] * jnp.array([1.0, 2.0, 3.0], jnp.float32),
        )

    def _sample(self, key: jax.Array) -> _Episode:
        spacing_key, offset_key, lean_key, wind_key, stalk_key, height_key = jax.random.split(key, 6)
        count, config = self.config.stalks, self.config
        gaps = jax.random.uniform(spacing_key, (count,), jnp.float32, *config.spacing).at[0].set(0.0)
        along = jnp.cumsum(gaps)
        along = along - 0.5 * along[-1]
        across = config.offset * jax.random.uniform(offset_key, (count,), jnp.float32, -1.0, 1.0)
        lean = math.radians(config.lean) * jax.random.uniform(lean_key, (count, 2), jnp.float32, -1.0, 1.0)
        rotation = jax.vmap(rotations.quat_mul)(_axis_quaternions(0, lean[:, 0]), _axis_quaternions(1, lean[:, 1]))
        # Stalks are at their sampled positions at `SWAY_HEIGHT`, where the arm works, and not at the ground.
        upright = jnp.stack([along, across, jnp.zeros(count)], axis=-1)
        foot = upright.at[:, :2].add(-_rest_points(jnp.zeros_like(upright), rotation, bending.SWAY_HEIGHT)[:, :2])
        stalk = jax.random.randint(stalk_key, (), 0, count).astype(jnp.float32)
        angles = jax.random.uniform(wind_key, (2,), jnp.float32, 0.0, 2 * np.pi)
        height = jax.random.uniform(height_key, (), jnp.float32, *config.goal_heights)
        return _Episode(foot, rotation, jnp.append(angles, stalk), height)


def _axis_quaternions(axis: int, angle: jax.Array) -> jax.Array:
    """Return quaternions [N, 4] (scalar first) of rotations by ``angle`` [N] (rad) about a coordinate axis."""
    quaternion = jnp.zeros((*angle.shape, 4), jnp.float32)
    return quaternion.at[:, 0].set(jnp.cos(0.5 * angle)).at[:, 1 + axis].set(jnp.sin(0.5 * angle))


def _rest_points(foot: jax.Array, rotation: jax.Array, height: jax.Array | float) -> jax.Array:
    """Return the points [N, 3] (m, world) of stalks at rest at a ``height`` (m)."""
    axis = jax.vmap(lambda quaternion: rotations.rotate(jnp.array([0.0, 0.0, 1.0]), quaternion))(rotation)
    return foot + height / axis[:, 2:] * axis


def clamp_to_workspace(position: jax.Array) -> jax.Array:
    """Clamp a position [3] (m, world) to the grip's workspace, in radius and bearing around the shoulder and in height."""
    shoulder = jnp.asarray(stalk_arm.SHOULDER, jnp.float32)
    offset = position[:2] - shoulder
    radius = jnp.clip(jnp.linalg.norm(offset), *_RADII)
    bearing = jnp.clip(jnp.arctan2(offset[0], offset[1]), -_MAX_BEARING, _MAX_BEARING)
    horizontal = shoulder + radius * jnp.stack([jnp.sin(bearing), jnp.cos(bearing)])
    return jnp.append(horizontal, jnp.clip(position[2], *_HEIGHTS))


register_task(StalkReach, StalkReachConfig, VisualStalkReachConfig)
