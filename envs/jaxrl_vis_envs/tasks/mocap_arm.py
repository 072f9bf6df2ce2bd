"""Base of the tasks whose arm is pulled by a weld to a mocap body: settings, start, achieved state and state observation."""

import abc
import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxrl_vis_envs import checks
from jaxrl_vis_envs.physics import mjx_model
from jaxrl_vis_envs.physics.mjx_model import mjx
from jaxrl_vis_envs.pixels import Observer
from jaxrl_vis_envs.tasks.config import TaskConfig
from jaxrl_vis_envs.tasks.mjx_env import MjxGoalEnv

CONTROL_PERIOD = 0.04  # s


@dataclasses.dataclass(frozen=True)
class MocapArmConfig(TaskConfig):
    """Settings of the task. Lengths in m."""

    action_scale: float = 0.05
    """Displacement commanded by an action of 1, m."""
    substeps: int = 20
    """Physics steps per control step of 40 ms, at least 4 (20 as in the authors' simulations; 10 is nearly twice as fast)."""
    solver_iterations: int = 1
    """Newton iterations per physics step."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.positive(self, "action_scale")
        checks.integers(self, "solver_iterations")
        checks.integers(self, "substeps", minimum=4)  # the weld's time constant is 20 ms


class MocapArm(MjxGoalEnv):
    """Base class of tasks with an arm without motors, pulled by its hand. By default, goals are grip positions (m, world)."""

    distance_unit = "m"
    control_period = CONTROL_PERIOD

    def __init__(
        self,
        config: MocapArmConfig,
        mj_model: mujoco.MjModel,
        hand: str,
        observer: Callable[[mujoco.MjModel], Observer] | None,
    ) -> None:
        """Compute the start state.

        Args:
            config: Settings of the task.
            mj_model: Model with a site called "grip" and a single mocap body.
            hand: Name of the body that is pulled.
            observer: Function that builds the observer (poses to images) from the model. If None, `observe_state` is used.
        """
        mj_model.opt.iterations = config.solver_iterations
        self._hand = mj_model.body(hand).id
        self._grip = mj_model.site("grip").id
        # The start is computed with the timestep of the model file, so that it does not depend on `substeps`.
        self._start = mjx_model.start_data(mj_model, self._settled(mj_model, config))
        mj_model.opt.timestep = CONTROL_PERIOD / config.substeps
        super().__init__(config, mj_model, observer)

    @abc.abstractmethod
    def _settled(self, mj_model: mujoco.MjModel, config: MocapArmConfig) -> mujoco.MjData:
        """Return the physics state in which every episode starts, after the arm was pulled there; it may still be moving."""

    def sample_start(self, key: jax.Array) -> mjx.Data:
        return self._start

    def achieved(self, data: mjx.Data) -> jax.Array:
        return data.site_xpos[self._grip]

    def observe_state(self, data: mjx.Data) -> jax.Array:
        """Return the grip's position (m) and its displacement per control step at its current velocity (m): [6] float32, as in
        Gym.
        """
        position = data.site_xpos[self._grip]
        velocity = mjx_model.point_velocity(self.mj_model, data, self._hand, position)
        return jnp.concatenate([position, self.control_period * velocity])


def pull(mj_model: mujoco.MjModel, mj_data: mujoco.MjData, position: np.ndarray, quaternion: np.ndarray, substeps: int) -> None:
    """Hold the mocap body at a pose for ``substeps`` physics steps, then clear the solver's warm start and the time.

    Args:
        mj_model: Model with a single mocap body.
        mj_data: Physics state, changed in place.
        position: [3], m in the world.
        quaternion: [4], scalar first.
        substeps: Number of physics steps.
    """
    mj_data.mocap_pos[0], mj_data.mocap_quat[0] = position, quaternion
    for _ in range(substeps):
        mujoco.mj_step(mj_model, mj_data)
    mj_data.qacc_warmstart[:] = 0.0
    mj_data.time = 0.0
