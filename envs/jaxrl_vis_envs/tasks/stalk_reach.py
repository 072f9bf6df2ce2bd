"""Stalk reach: bring the open jaws of a grasping arm around one of several stalks that sway in the wind.

The arm of chapter 4 of the thesis before a stretch of a row: a slide and two revolute joints, by position control. An episode
draws where the stalks stand and lean, the wind, a stalk and a height. In the goal image the air is still and the gripper is at
that stalk. Stalks bend when they are pushed. The jaws stay open: closing them around what is between them is not learned.

    VisualStalkReach   sees RGB-D from behind the arm's shoulder
    StalkReach         sees the grip, its displacement, and how far the stalk has moved

State: position of the grip in the world less how far the stalk of the goal is from rest at the height of the grip, m. So the
distance to the goal is that of the jaws from where the stalk is now. Action: displacement of where the grip is driven to.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco.mjx._src import math as mjx_math

from jaxrl_vis_envs import checks
from jaxrl_vis_envs.physics import mjx_model
from jaxrl_vis_envs.physics.mjx_model import mjx
from jaxrl_vis_envs.pixels import Observer, PixelsConfig
from jaxrl_vis_envs.plants import bending
from jaxrl_vis_envs.tasks import stalk_arm
from jaxrl_vis_envs.tasks.config import TaskConfig
from jaxrl_vis_envs.tasks.mjx_env import MjxGoalEnv, register_task

_CONTROL_PERIOD = 0.04  # s
HOME = (0.0, stalk_arm.SHOULDER[1] + 0.36, 0.75)
"""Where the grip is when an episode starts, m in the world."""
_HEIGHTS = (0.45, 1.05)  # m, between which the grip may be driven
_RADII, _MOST_BEARING = (0.35, 0.69), 0.7  # m and rad, the same in the plane
_GUST_FREQUENCIES = (0.17, 0.29, 0.53)  # Hz


@dataclasses.dataclass(frozen=True)
class StalkReachConfig(TaskConfig):
    """Settings of the task. Lengths in m."""

    horizon: int = 50
    threshold: float = 0.02
    """An episode succeeds where the middle of the jaws is within this distance of the stalk, m: it is between them."""
    stalks: int = 4
    """Stalks of the stretch: from 1 to 4."""
    spacing: tuple[float, float] = (0.05, 0.09)
    """Distances along the row between neighbours are uniform from and to, m."""
    offset: float = 0.03
    """Stalks stand uniform within this distance of the row's middle line, m."""
    lean: float = 5.0
    """They lean uniformly by up to this angle, in the row and across it, degrees."""
    goal_heights: tuple[float, float] = (0.6, 0.9)
    """Heights of goals, m above the ground."""
    wind: float = 0.01
    """How far stalks sway 0.7 m above the ground, m."""
    action_scale: float = 0.03
    """Displacement that an action of 1 asks for, m."""
    substeps: int = 10
    """Physics steps in a control step of 40 ms; at least 8."""
    solver_iterations: int = 2
    """Newton iterations in a physics step."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.positive(self, "action_scale")
        checks.not_negative(self, "offset", "lean", "wind")
        checks.whole(self, "stalks", "solver_iterations")
        checks.whole(self, "substeps", least=8)
        if self.stalks > 4:
            raise ValueError(f"stalks must be from 1 to 4, got {self.stalks}")
        if self.lean > 20:
            raise ValueError(f"lean must be from 0 to 20 degrees, got {self.lean}")
        for field, least, most in (("spacing", 0.0, 0.15), ("goal_heights", *_HEIGHTS)):
            low, high = checks.vector(self, field, 2)
            if not least <= low <= high <= most:
                raise ValueError(f"{field} must run from {least:g} to {most:g} m at most, got {getattr(self, field)}")


@dataclasses.dataclass(frozen=True)
class VisualStalkReachConfig(PixelsConfig, StalkReachConfig):
    """Settings of the task and its images."""

    depth_range: tuple[float, float] = (0.4, 1.4)
    """Depths that bytes 0 and 255 stand for, m: 4 mm a step, from before the raised arm to behind the row."""


class _Draw(NamedTuple):
    """What an episode draws: where stalks stand [N, 3] m, how they are turned [N, 4], the wind as `_gusts` reads it [3] with
    the number of the goal's stalk in the third place, and the height of the goal, m.
    """

    foot: jax.Array
    turn: jax.Array
    wind: jax.Array
    height: jax.Array


class StalkReach(MjxGoalEnv):
    """The task; what the agent sees of it is up to ``observer``."""

    config: StalkReachConfig
    action_size = 3
    camera = "shoulder"
    distance_unit = "m"
    control_period = _CONTROL_PERIOD
    chance, difficulty = 0.003, 11.1  # benchmarks/tasks/task_difficulty.py StalkReach --episodes 1000

    def __init__(self, config: StalkReachConfig, observer: Callable[[mujoco.MjModel], Observer] | None = None):
        """Builds the model.

        Args:
            config: The settings.
            observer: Given the model, returns the function from poses to images. Default: `observe_state`.
        """
        mj_model = stalk_arm.build_servoed(config.stalks)
        mj_model.opt.iterations = config.solver_iterations
        mj_model.opt.timestep = _CONTROL_PERIOD / config.substeps
        self._layout = bending.layout_of(mj_model)
        self._wind = int(mj_model.body_mocapid[mj_model.body("wind").id])
        self._forearm = mj_model.body("forearm").id
        self._still = mjx_model.still_data(mj_model)
        super().__init__(config, mj_model, observer)

    def sample_start(self, key: jax.Array) -> mjx.Data:
        draw = self._sample(key)
        moved = bending.displacement(self._gusts(draw.wind), draw.foot, 0.0)
        data = self.configuration(draw, jnp.asarray(HOME, jnp.float32), moved)
        return data.replace(ctrl=data.qpos[:3])

    def sample_goal(self, key: jax.Array) -> mjx.Data:
        draw = self._sample(key)
        still = jnp.zeros((self.config.stalks, 2), jnp.float32)
        place = _along(draw.foot, draw.turn, draw.height)[draw.wind[2].astype(int)]
        return self.configuration(draw, place, still)

    def act(self, data: mjx.Data, action: jax.Array) -> mjx.Data:
        place = within_reach(stalk_arm.grip_at(data.ctrl) + self.config.action_scale * action)
        gusts = self._gusts(data.mocap_pos[self._wind])
        foot = data.mocap_pos[self._layout.mocap]
        wind = bending.wind_torque(self._model, self._layout, gusts, foot, data.time)
        data = data.replace(ctrl=stalk_arm.joints_at(place, 1.0), qfrc_applied=wind)
        return mjx_model.simulate(self._model, data, self.config.substeps, undisturbed=True)

    def achieved(self, data: mjx.Data) -> jax.Array:
        return stalk_arm.grip_at(data.qpos[:3]) - self._moved(data)

    def observe_state(self, data: mjx.Data) -> jax.Array:
        """`achieved` (m), displacement of the grip in a control step at its present speed (m), and how far the stalk of the
        goal has moved along and across the row (m): [8] float32.
        """
        grip = stalk_arm.grip_at(data.qpos[:3])
        velocity = mjx_model.point_velocity(self.mj_model, data, self._forearm, grip).at[2].set(data.qvel[0])
        return jnp.concatenate([self.achieved(data), self.control_period * velocity, self._moved(data)[:2]])

    def configuration(self, draw: _Draw, grip: jax.Array, moved: jax.Array) -> mjx.Data:
        """The arm at rest with its grip at ``grip`` [3] (m, world), among stalks ``moved`` [N, 2] m from rest."""
        data = self._still.replace(
            mocap_pos=self._still.mocap_pos.at[self._layout.mocap].set(draw.foot).at[self._wind].set(draw.wind),
            mocap_quat=self._still.mocap_quat.at[self._layout.mocap].set(draw.turn),
        )
        hinges = bending.hinge_angles(self._layout, self.mj_model.nv, moved)
        joints = stalk_arm.joints_at(grip, 1.0)
        return mjx_model.kinematics(self._model, data.replace(qpos=hinges.at[:3].set(joints)))

    def _moved(self, data: mjx.Data) -> jax.Array:
        """How far the stalk of the goal is from rest at the height of the grip: [3] float32, m."""
        stalk = data.mocap_pos[self._wind][2].astype(int)
        height = data.qpos[0]
        rest = _along(data.mocap_pos[self._layout.mocap], data.mocap_quat[self._layout.mocap], height)
        return (bending.at_height(data, self._layout, height) - rest)[stalk]

    def _gusts(self, wind: jax.Array) -> bending.Gusts:
        """The wind of an episode, from its heading (rad), phase (rad) and something else [3]."""
        return bending.Gusts(
            heading=jnp.stack([jnp.cos(wind[0]), jnp.sin(wind[0])]),
            strength=jnp.asarray(self.config.wind, jnp.float32),
            frequency=jnp.asarray(_GUST_FREQUENCIES, jnp.float32),
            phase=wind[1] * jnp.array([1.0, 2.0, 3.0], jnp.float32),
        )

    def _sample(self, key: jax.Array) -> _Draw:
        spacing_key, offset_key, lean_key, wind_key, stalk_key, height_key = jax.random.split(key, 6)
        count, config = self.config.stalks, self.config
        gaps = jax.random.uniform(spacing_key, (count,), jnp.float32, *config.spacing).at[0].set(0.0)
        along = jnp.cumsum(gaps)
        along = along - 0.5 * along[-1]
        across = config.offset * jax.random.uniform(offset_key, (count,), jnp.float32, -1.0, 1.0)
        lean = math.radians(config.lean) * jax.random.uniform(lean_key, (count, 2), jnp.float32, -1.0, 1.0)
        turn = jax.vmap(mjx_math.quat_mul)(_turn(0, lean[:, 0]), _turn(1, lean[:, 1]))
        # Where the arm works, the row is about where its feet are: stalks lean about their middles.
        upright = jnp.stack([along, across, jnp.zeros(count)], axis=-1)
        foot = upright.at[:, :2].add(-_along(jnp.zeros_like(upright), turn, bending.SWAY_HEIGHT)[:, :2])
        stalk = jax.random.randint(stalk_key, (), 0, count).astype(jnp.float32)
        angles = jax.random.uniform(wind_key, (2,), jnp.float32, 0.0, 2 * np.pi)
        height = jax.random.uniform(height_key, (), jnp.float32, *config.goal_heights)
        return _Draw(foot, turn, jnp.append(angles, stalk), height)


def _turn(axis: int, angle: jax.Array) -> jax.Array:
    """Quaternions [N, 4] of turns by ``angle`` [N] (rad) about a coordinate axis."""
    whole = jnp.zeros((*angle.shape, 4), jnp.float32)
    return whole.at[:, 0].set(jnp.cos(0.5 * angle)).at[:, 1 + axis].set(jnp.sin(0.5 * angle))


def _along(foot: jax.Array, turn: jax.Array, height: jax.Array | float) -> jax.Array:
    """Where stalks at rest are at a height in m: [N, 3] float32, m."""
    axis = jax.vmap(lambda quaternion: mjx_math.rotate(jnp.array([0.0, 0.0, 1.0]), quaternion))(turn)
    return foot + height / axis[:, 2:] * axis


def within_reach(place: jax.Array) -> jax.Array:
    """The nearest place [3] (m, world), along the arm's own coordinates, to which the grip may be driven."""
    shoulder = jnp.asarray(stalk_arm.SHOULDER, jnp.float32)
    away = place[:2] - shoulder
    radius = jnp.clip(jnp.linalg.norm(away), *_RADII)
    bearing = jnp.clip(jnp.arctan2(away[0], away[1]), -_MOST_BEARING, _MOST_BEARING)
    plane = shoulder + radius * jnp.stack([jnp.sin(bearing), jnp.cos(bearing)])
    return jnp.append(plane, jnp.clip(place[2], *_HEIGHTS))


register_task(StalkReach, StalkReachConfig, VisualStalkReachConfig)
