"""Reacher: move the fingertip of a two-link arm to its position in the goal image.

As used by the authors of "Reinforcement Learning without Ground-Truth State": joint velocities are overwritten at the start of
a control step and then decay, and the goal is the fingertip position of a random configuration. ``control="torque"`` selects
the motors of Gym's Reacher instead.

    VisualReacher   observes RGB-D from above
    Reacher         observes joint angles, fingertip position and joint velocities

State: fingertip position in the plane of the table, m. Action: one component per joint.
"""

import dataclasses
from collections.abc import Callable
from typing import Literal

import jax
import jax.numpy as jnp
import mujoco

from jaxrl_vis_envs import checks
from jaxrl_vis_envs.physics import mjx_model
from jaxrl_vis_envs.physics.mjx_model import mjx
from jaxrl_vis_envs.pixels import Observer, PixelsConfig
from jaxrl_vis_envs.tasks.config import TaskConfig
from jaxrl_vis_envs.tasks.mjx_env import MjxGoalEnv, register_task

_DEFAULT_SUBSTEPS = {"velocity": 10, "torque": 2}


@dataclasses.dataclass(frozen=True)
class ReacherConfig(TaskConfig):
    """Settings of the task. Lengths in m, angles in rad."""

    horizon: int = 50
    threshold: float = 0.01
    """Distance between fingertip and goal within which an episode succeeds, m."""
    start_range: float = 0.1
    """Maximum magnitude of the start angles of both joints (uniform), rad."""
    control: Literal["velocity", "torque"] = "velocity"
    """Meaning of an action: the joint velocity at the start of the control step, or the torque during it."""
    velocity_scale: float = 10.0
    """Joint velocity of an action of 1 under velocity control, rad/s (one control step then turns the joint by .95 rad)."""
    substeps: int | None = None
    """Physics steps of 10 ms per control step; if None, 10 under velocity control and 2 under torque control."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.choice(self, "control", _DEFAULT_SUBSTEPS)
        checks.not_negative(self, "start_range")
        checks.positive(self, "velocity_scale")
        if self.substeps is not None:
            checks.integers(self, "substeps")


@dataclasses.dataclass(frozen=True)
class VisualReacherConfig(PixelsConfig, ReacherConfig):
    """Settings of the task and its images."""

    depth_range: tuple[float, float] = (0.8, 1.1)
    """Depths encoded as 0 and 255, m: 1.2 mm per step; the arm is between .82 and 1.04 m. Only for
    ``depth_encoding="metric"``."""


class Reacher(MjxGoalEnv):
    """Reacher task (see the module docstring), observed as images or as state, depending on ``observer``."""

    action_size = 2
    action_meaning = (
        "of shoulder and elbow: velocities that a control step begins with, in multiples of velocity_scale (rad/s); with "
        "control=torque the controls of their motors"
    )
    camera = "above"
    distance_unit = "m"
    chance, difficulty = 0.004, 23.7  # benchmarks/tasks/task_difficulty.py Reacher --episodes 20000

    def __init__(self, config: ReacherConfig, observer: Callable[[mujoco.MjModel], Observer] | None = None):
        """Build the model.

        Args:
            config: Settings of the task.
            observer: Function that builds the observer (poses to images) from the model. If None, `observe_state` is used.
        """
        mj_model = mjx_model.load_model("reacher.xml")
        self._substeps = config.substeps or _DEFAULT_SUBSTEPS[config.control]
        self.control_period = self._substeps * float(mj_model.opt.timestep)
        self._fingertip = mj_model.site("fingertip").id
        self._rest = mjx_model.rest_data(mj_model)
        super().__init__(config, mj_model, observer)

    def sample_start(self, key: jax.Array) -> mjx.Data:
        start_key, _ = jax.random.split(key)
        return self.configuration(
            jax.random.uniform(start_key, (2,), jnp.float32, -self.config.start_range, self.config.start_range)
        )

    def sample_goal(self, key: jax.Array) -> mjx.Data:
        _, goal_key = jax.random.split(key)
        return self.configuration(jax.random.uniform(goal_key, (2,), jnp.float32, -2 * jnp.pi, 2 * jnp.pi))

    def act(self, data: mjx.Data, action: jax.Array) -> mjx.Data:
        if self.config.control == "velocity":
            data = data.replace(qvel=self.config.velocity_scale * action)
        else:
            data = data.replace(ctrl=action)
        return mjx_model.simulate(self._model, data, self._substeps)

    def achieved(self, data: mjx.Data) -> jax.Array:
        return data.site_xpos[self._fingertip, :2]

    def observe_state(self, data: mjx.Data) -> jax.Array:
        """Return cosines and sines of both joint angles, fingertip x and y (m), joint velocities (rad/s): [8] float32."""
        return jnp.concatenate([jnp.cos(data.qpos), jnp.sin(data.qpos), self.achieved(data), data.qvel])

    def configuration(self, joint_angles: jax.Array) -> mjx.Data:
        """Return the arm at rest with ``joint_angles`` [2] float32, rad."""
        return mjx_model.kinematics(self._model, self._rest.replace(qpos=joint_angles))


register_task(Reacher, ReacherConfig, VisualReacherConfig)
