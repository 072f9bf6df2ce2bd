"""Fetch push: push a box across a table to its position in the goal image, with the closed gripper of a Fetch robot.

Follows FetchPush of Gymnasium-Robotics (version 4; Plappert et al., 2018, arXiv 1802.09464): starts, goals, actions, threshold,
horizon and the observation of the state task. Arm and camera are those of `fetch_reach`; box, table and fingers have the
original's shapes, masses, frictions and softness.

    VisualFetchPush   observes RGB-D from a camera facing the robot
    FetchPush         observes the original's 25-dimensional state

State: position of the box's centre in the world, m. Action: as in FetchReach.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
import mujoco

from jaxrl_vis_envs import checks
from jaxrl_vis_envs.base import State
from jaxrl_vis_envs.physics import mjx_model
from jaxrl_vis_envs.physics.mjx_model import mjx
from jaxrl_vis_envs.pixels import Observer, PixelsConfig
from jaxrl_vis_envs.randomization import Domain
from jaxrl_vis_envs.tasks.fetch_arm import FetchArm
from jaxrl_vis_envs.tasks.mjx_env import register_task
from jaxrl_vis_envs.tasks.mocap_arm import MocapArmConfig

_HALF_SIZE, _MASS = 0.025, 2.0  # of the box, m and kg
# The original's state after its set-up: joints of arm and fingers (rad, m) in the model's order, and the settling box (m).
_START_JOINTS = (0.0123826, -0.5894173, -0.0054354, 1.4531368, 0.0021391, 0.6991474, 0.0075805, -0.0000025, 0.0012136)
_START_VELOCITIES = (0.0053221, 0.0027478, -0.0039692, 0.0077923, 0.000282, 0.0216374, 0.0030754, 0.0000063, 0.0018714)
_START_BOX, _START_BOX_VELOCITY = (1.25, 0.53, 0.4247021), (0.0, 0.0, 0.0011707)
_FINGER_HALF_SIZE = (0.0385, 0.007, 0.0135)  # m
# The original's mixtures of the softness and friction of two shapes. MuJoCo up to 3.2 took half the distance between two boxes
# for their distance: twice the margin and width, and a damping ratio that halves the stiffness, make up for that.
_DAMPING_RATIO = 2**0.5
_FINGER_CONTACT = dict(
    condim=4,
    friction=(1, 1, 0.05, 0.01, 0.01),
    solref=(0.015, _DAMPING_RATIO),
    solimp=(0.945, 0.97, 0.011, 0.5, 2),
    margin=0.002,
)
_BOX_ON_TABLE = dict(
    condim=3, friction=(1, 1, 0.005, 0.0001, 0.0001), solref=(0.02, _DAMPING_RATIO), solimp=(0.9, 0.95, 0.002, 0.5, 2)
)
_BOX_ON_FLOOR = dict(condim=3, friction=(1, 1, 0.005, 0.0001, 0.0001), solref=(0.02, 1), solimp=(0.9, 0.95, 0.001, 0.5, 2))
_MOVE_THRESHOLD = 0.001  # displacement in a control step that counts as a move of the box, m; it settles by less
_CANDIDATES = 32  # positions sampled at once; the probability that none is acceptable is 2e-15


@dataclasses.dataclass(frozen=True)
class FetchPushConfig(MocapArmConfig):
    """Settings of the task. Lengths in m."""

    horizon: int = 50
    threshold: float = 0.05
    """Distance between box and goal within which an episode succeeds, m."""
    object_range: float = 0.15
    """Maximum distance of the box's start (uniform) from the gripper's start along x and y, m."""
    object_distance: float = 0.1
    """Minimum distance between the starts of box and gripper, m."""
    goal_range: float = 0.15
    """Maximum distance of goals (uniform) from the gripper's start along x and y, m."""
    met_goals: bool = True
    """Also sample goals that the box already meets at its start, as in the original. False excludes them."""
    goal_lift: float = 0.14
    """Height of the gripper above its start in a goal image, m."""
    solver_iterations: int = 6
    """Newton iterations per physics step."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.positive(self, "object_range")
        checks.not_negative(self, "object_distance", "goal_range", "goal_lift")
        checks.boolean(self, "met_goals")
        # Within these bounds at least a fifth of the square is left to sample from.
        if self.object_distance > self.object_range:
            raise ValueError(f"object_distance must be at most object_range, {self.object_range}, got {self.object_distance}")
        if not self.met_goals and self.threshold > self.goal_range:
            raise ValueError(f"met_goals=False needs a goal_range of at least the threshold, {self.threshold}")


@dataclasses.dataclass(frozen=True)
class VisualFetchPushConfig(PixelsConfig, FetchPushConfig):
    """Settings of the task and its images."""

    depth_range: tuple[float, float] = (0.4, 1.8)
    """Depths encoded as 0 and 255, m: 5.5 mm per step, from in front of the nearest gripper to behind the robot. Only for
    ``depth_encoding="metric"``."""
    goal_mask: Literal["none", "object"] = "none"
    """Part of the images that indicator rewards compare: all (none), or the box's pixels by segmentation (object), which the
    lowest bit of the first channel then marks."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.choice(self, "goal_mask", ("none", "object"))


class FetchPush(FetchArm):
    """Fetch push task (see the module docstring), observed as images or as state, depending on ``observer``."""

    config: FetchPushConfig
    camera = "front"
    chance, difficulty = 0.073, 3.4  # benchmarks/tasks/task_difficulty.py FetchPush --episodes 1000
    metric_names = ("success", "goal_distance", "moved")

    def __init__(self, config: FetchPushConfig, observer: Callable[[mujoco.MjModel], Observer] | None = None):
        """Build the model and compute the start state.

        Args:
            config: Settings of the task.
            observer: Function that builds the observer (poses to images) from the model. If None, `observe_state` is used.
        """
        mj_model = mjx_model.load_model("fetch_reach.xml", _add_box)
        self._box = mj_model.body("box").id
        self._box_position = int(mj_model.joint("box").qposadr[0])
        self._box_velocity = int(mj_model.joint("box").dofadr[0])
        super().__init__(config, mj_model, observer)
        self._goal_pose, self._goal_grip = self._lift_gripper(mj_model)

    @classmethod
    def select_marked(cls, config: Any) -> str | None:
        return "box" if getattr(config, "goal_mask", "none") == "object" else None

    def _settled(self, mj_model: mujoco.MjModel, config: MocapArmConfig) -> mujoco.MjData:
        """Return the original's start, in which the fingers still penetrate the table by 2.5 mm."""
        mj_data = mujoco.MjData(mj_model)
        mj_data.qpos[:] = (*_START_JOINTS, *_START_BOX, 1.0, 0.0, 0.0, 0.0)
        mj_data.qvel[:] = (*_START_VELOCITIES, *_START_BOX_VELOCITY, 0.0, 0.0, 0.0)
        mujoco.mj_forward(mj_model, mj_data)
        return mj_data

    def _lift_gripper(self, mj_model: mujoco.MjModel) -> tuple[jax.Array, jax.Array]:
        """Return ``qpos`` for goal images, except for the box's position, and the position [3] (m, world) of the grip there."""
        mj_data = mujoco.MjData(mj_model)
        mj_data.qpos[:] = self._start.qpos
        mujoco.mj_forward(mj_model, mj_data)
        box = mj_data.joint("box").qpos.copy()
        self._pull_grip(mj_model, mj_data, mj_data.body("gripper").xpos + [0.0, 0.0, self.config.goal_lift])
        mj_data.joint("box").qpos[:] = box
        mj_data.qpos[self._fingers] = 0.0
        mujoco.mj_kinematics(mj_model, mj_data)
        return jnp.asarray(mj_data.qpos, jnp.float32), jnp.asarray(mj_data.site("grip").xpos, jnp.float32)

    def sample_start(self, key: jax.Array) -> mjx.Data:
        position, _ = self._sample_positions(key)
        return self.start_with_box(position)

    def state_at(self, data: mjx.Data, goal_state: jax.Array, domain: Domain | None = None) -> State:
        state = super().state_at(data, goal_state, domain)
        return state.replace(metrics={**state.metrics, "moved": jnp.zeros(())})

    def advance(self, state: State, action: jax.Array) -> State:
        """Advance by one control step; ``metrics["moved"]`` is 1 once the box has moved by over 1 mm in a step."""
        after = super().advance(state, action)
        moves = jnp.linalg.norm(after.achieved_state - state.achieved_state) > _MOVE_THRESHOLD
        moved = jnp.maximum(state.metrics["moved"], moves.astype(jnp.float32))
        return after.replace(metrics={**after.metrics, "moved": moved})

    def start_with_box(self, position: jax.Array) -> mjx.Data:
        """Return the start of an episode with the box at ``position`` [2] float32 (m, world)."""
        return self._with_box(self._start, self._start.qpos, position)

    def sample_goal(self, key: jax.Array) -> mjx.Data:
        _, position = self._sample_positions(key)
        still = self._start.replace(qvel=jnp.zeros_like(self._start.qvel))
        return self._with_box(still, self._goal_pose, position)

    def _sample_positions(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Sample the start and the goal of the box: [2] each, m in the world."""
        config = self.config
        start_key, goal_key = jax.random.split(key)
        middle = self._start.site_xpos[self._grip, :2]

        def sample_position(key: jax.Array, reach: float, origin: jax.Array, distance: float) -> jax.Array:
            positions = middle + jax.random.uniform(key, (_CANDIDATES, 2), jnp.float32, -reach, reach)
            return positions[jnp.argmax(jnp.linalg.norm(positions - origin, axis=-1) >= distance)]

        start = sample_position(start_key, config.object_range, middle, config.object_distance)
        # Slightly above the threshold, since the box meets its goal at the threshold itself.
        away = 0.0 if config.met_goals else config.threshold + 1e-4
        return start, sample_position(goal_key, config.goal_range, start, away)

    def _with_box(self, data: mjx.Data, qpos: jax.Array, position: jax.Array) -> mjx.Data:
        """Return ``data`` with the joints at ``qpos`` and the box at ``position`` [2] (m, world)."""
        qpos = jax.lax.dynamic_update_slice(qpos, position, (self._box_position,))
        return mjx_model.kinematics(self._model, data.replace(qpos=qpos))

    def achieved(self, data: mjx.Data) -> jax.Array:
        return data.xpos[self._box]

    @property
    def converts_goals(self) -> bool:
        return self._observer is None or super().converts_goals

    def as_goal(self, frame: jax.Array) -> jax.Array:
        """Return the goal that ``frame`` achieves.

        For a state observation [25], that is the position of its box, with the arm at rest as in goal images: from a goal, a
        policy thus learns only where the box should be, as in the original. For images see `GoalEnv.as_goal`.
        """
        if self._observer is not None:
            return super().as_goal(frame)
        box = frame[3:6]
        return jnp.concatenate([self._goal_grip, box, box - self._goal_grip, jnp.zeros(frame.shape[0] - 9, frame.dtype)])

    def observe_state(self, data: mjx.Data) -> jax.Array:
        """Return the original's observation: [25] float32, lengths in m, angles in rad, velocities per control step.

        Positions of the grip, the box, the box relative to the grip, and the two fingers, and the box's Euler angles; then the
        velocity of the box relative to the grip, its angular velocity, and the velocities of the grip and the fingers.
        """
        grip, box = data.site_xpos[self._grip], data.xpos[self._box]
        grip_velocity = mjx_model.point_velocity(self.mj_model, data, self._hand, grip)
        velocity, spin = jnp.split(data.qvel[self._box_velocity : self._box_velocity + 6], 2)
        moving = [velocity - grip_velocity, data.xmat[self._box] @ spin, grip_velocity, data.qvel[self._fingers]]
        still = [grip, box, box - grip, data.qpos[self._fingers], _euler_angles(data.xmat[self._box])]
        return jnp.concatenate([*still, self.control_period * jnp.concatenate(moving)])


def _euler_angles(rotation: jax.Array) -> jax.Array:
    """Convert a rotation matrix [3, 3] to angles [3] (rad) about x, y and z, as the original's ``mat2euler`` does."""
    cosine = jnp.hypot(rotation[2, 2], rotation[1, 2])
    is_regular = cosine > 1e-6
    roll = jnp.where(is_regular, -jnp.arctan2(rotation[1, 2], rotation[2, 2]), 0.0)
    yaw = jnp.where(is_regular, -jnp.arctan2(rotation[0, 1], rotation[0, 0]), -jnp.arctan2(-rotation[1, 0], rotation[1, 1]))
    return jnp.stack([roll, jnp.arctan2(rotation[0, 2], cosine), yaw])


def _add_box(spec: mujoco.MjSpec) -> None:
    """Add the box and a floor on which it can land, and replace the fingers of FetchReach's arm by the original's."""
    for side in ("right", "left"):
        spec.delete(spec.pair(f"{side}_finger_on_table"))
        for name in (f"{side}_finger", f"{side}_fingertip"):
            spec.delete(spec.geom(name))
        link = spec.body(f"{side}_finger_link")
        inwards = -0.008 if side == "right" else 0.008
        _add_solid(link, f"{side}_finger", (0.0, inwards, 0.0), _FINGER_HALF_SIZE, (0.9, 0.35, 0.1, 1.0))
    spec.delete(spec.geom("table_top"))
    box = spec.worldbody.add_body(name="box")
    box.add_joint(name="box", type=mujoco.mjtJoint.mjJNT_FREE, damping=(0.01, 0.0, 0.0), armature=0.0)
    _add_solid(box, "box", (0.0, 0.0, 0.0), (_HALF_SIZE,) * 3, (0.1, 0.35, 0.8, 1.0), _MASS)
    spec.add_pair(name="box_on_table", geomname1="table", geomname2="box", **_BOX_ON_TABLE)
    # A box instead of the floor's plane, on which a box pushed off the table can land.
    _add_solid(spec.worldbody, "ground", (0.0, 0.0, -0.5), (3.0, 3.0, 0.5), (0.0, 0.0, 0.0, 0.0))
    spec.geom("ground").group = 3
    spec.add_pair(name="box_on_floor", geomname1="ground", geomname2="box", **_BOX_ON_FLOOR)
    for side in ("right", "left"):
        for other in ("table", "box"):
            spec.add_pair(name=f"{side}_finger_on_{other}", geomname1=other, geomname2=f"{side}_finger", **_FINGER_CONTACT)


def _add_solid(body: Any, name: str, position: Any, half_size: Any, colour: Any, mass: float = 0.0) -> None:
    kind = mujoco.mjtGeom.mjGEOM_BOX
    body.add_geom(name=name, type=kind, pos=position, size=half_size, rgba=colour, mass=mass, contype=0, conaffinity=0)


register_task(FetchPush, FetchPushConfig, VisualFetchPushConfig)
