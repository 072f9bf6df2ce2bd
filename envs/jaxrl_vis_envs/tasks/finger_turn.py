"""Finger turn: turn a free spinner with a two-link finger until its tip is at its position in the goal image.

dm_control's finger as used by the authors of OL-AUX: any contact-free start, a goal angle of the spinner, a tolerance of .07 m
at its tip (31 degrees), and 21 physics steps of 10 ms per action. With dm_control's own two, random actions move the spinner in
16 % of the episodes; with 21, in 86 %. In the goal image the finger hangs straight down, where it touches nothing.

    VisualFingerTurn   observes three stacked RGB-D images from the side
    FingerTurn         observes joint angles, the spinner's tip and joint velocities

State: x and z of the spinner's tip relative to its hinge, m. Action: torques of the two finger joints, up to 30 and 15 N m.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxrl_vis_envs import checks
from jaxrl_vis_envs.physics import mjx_model
from jaxrl_vis_envs.physics.mjx_model import mjx
from jaxrl_vis_envs.pixels import Observer, PixelsConfig
from jaxrl_vis_envs.tasks.config import TaskConfig
from jaxrl_vis_envs.tasks.mjx_env import MjxGoalEnv, register_task

# Start candidates sampled together; the first without contact is used. Each is in contact with probability 0.1, so all 16 are
# with probability 1e-16.
_START_CANDIDATES = 16


@dataclasses.dataclass(frozen=True)
class FingerTurnConfig(TaskConfig):
    """Settings of the task. Lengths in m."""

    horizon: int = 50
    threshold: float = 0.07
    """Distance between the spinner's tip and its goal within which an episode succeeds, m."""
    substeps: int = 21
    """Physics steps of 10 ms per control step: 21 as in the authors' release, 2 as in dm_control."""
    solver_iterations: int = 4
    """Newton iterations per physics step."""
    line_search_iterations: int = 8
    """Line search iterations per Newton iteration of MJX's solver; the scalar engine ignores them (see `physics`)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.integers(self, "substeps", "solver_iterations", "line_search_iterations")


@dataclasses.dataclass(frozen=True)
class VisualFingerTurnConfig(PixelsConfig, FingerTurnConfig):
    """Settings of the task and its images."""

    depth_range: tuple[float, float] = (0.8, 1.3)
    """Depths encoded as 0 and 255, m: 2 mm per step; finger and spinner are between .85 and 1.25 m. Only for
    ``depth_encoding="metric"``."""
    frame_stack: int = 3
    """Number of most recent images stacked in an observation: three in the thesis, one in the authors' release."""


class FingerTurn(MjxGoalEnv):
    """Finger turn task (see the module docstring), observed as images or as state, depending on ``observer``."""

    action_size = 2
    action_meaning = "torques of the proximal and the distal joint, in multiples of 30 and 15 N m"
    camera = "side"
    distance_unit = "m"
    exact_contacts = True  # contacts are what moves the spinner
    chance, difficulty = 0.16, 2.4  # benchmarks/tasks/task_difficulty.py FingerTurn --episodes 1000

    def __init__(self, config: FingerTurnConfig, observer: Callable[[mujoco.MjModel], Observer] | None = None):
        """Build the model.

        Args:
            config: Settings of the task.
            observer: Function that builds the observer (poses to images) from the model. If None, `observe_state` is used.
        """
        mj_model = mjx_model.load_model("finger_turn.xml")
        mj_model.opt.iterations = config.solver_iterations
        mj_model.opt.ls_iterations = config.line_search_iterations
        self.control_period = config.substeps * float(mj_model.opt.timestep)
        self._tip = mj_model.site("tip").id
        self._hinge = mj_model.body("spinner").id
        self._rest = mjx_model.rest_data(mj_model)  # the finger hangs straight down
        super().__init__(config, mj_model, observer)

    def sample_start(self, key: jax.Array) -> mjx.Data:
        """Sample a contact-free start at rest, uniform over the joints' ranges and all angles of the spinner."""
        start_key, _ = jax.random.split(key)
        low = jnp.asarray(np.where(self.mj_model.jnt_limited, self.mj_model.jnt_range[:, 0], -np.pi), jnp.float32)
        high = jnp.asarray(np.where(self.mj_model.jnt_limited, self.mj_model.jnt_range[:, 1], np.pi), jnp.float32)
        candidates = jax.random.uniform(start_key, (_START_CANDIDATES, 3), jnp.float32, low, high)
        is_free = jax.vmap(lambda qpos: self._clearance(self.configuration(qpos)) > 0)(candidates)
        # Fallback if none is free: the finger hangs straight down, which is free at any angle of the spinner.
        hanging = self._rest.qpos.at[2].set(candidates[0, 2])
        return self.configuration(jnp.where(jnp.any(is_free), candidates[jnp.argmax(is_free)], hanging))

    def sample_goal(self, key: jax.Array) -> mjx.Data:
        _, goal_key = jax.random.split(key)
        angle = jax.random.uniform(goal_key, (), jnp.float32, -jnp.pi, jnp.pi)
        return self.configuration(self._rest.qpos.at[2].set(angle))

    def act(self, data: mjx.Data, action: jax.Array) -> mjx.Data:
        data = data.replace(ctrl=action)
        return mjx_model.simulate(self._model, data, self.config.substeps, self.exact_contacts)

    def achieved(self, data: mjx.Data) -> jax.Array:
        return (data.site_xpos[self._tip] - data.xpos[self._hinge])[jnp.array([0, 2])]

    def observe_state(self, data: mjx.Data) -> jax.Array:
        """Return finger joint angles (rad), x and z of the tip (m), joint velocities (rad/s): [7] float32, as in dm_control."""
        return jnp.concatenate([data.qpos[:2], self.achieved(data), data.qvel])

    def configuration(self, joint_angles: jax.Array) -> mjx.Data:
        """Return finger and spinner at rest with ``joint_angles`` [3] (rad): proximal (-pi/2 hangs down), distal, spinner."""
        return mjx_model.kinematics(self._model, self._rest.replace(qpos=joint_angles))

    def _clearance(self, data: mjx.Data) -> jax.Array:
        """Return the minimum distance between finger and spinner, m; negative if they overlap."""
        return jnp.min(mjx.collision(self._model, data)._impl.contact.dist)


register_task(FingerTurn, FingerTurnConfig, VisualFingerTurnConfig)
