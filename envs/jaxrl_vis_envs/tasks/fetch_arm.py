"""Fetch arm of Gymnasium-Robotics: start state, and actions that displace the gripper, which always points down."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxrl_vis_envs.physics import mjx_model
from jaxrl_vis_envs.physics.mjx_model import mjx
from jaxrl_vis_envs.pixels import Observer
from jaxrl_vis_envs.tasks.mocap_arm import MocapArm, MocapArmConfig, pull

# Quaternion of the gripper pointing down. Adding it to the link's unit quaternion, as the original does, turns the target about
# 60 % of the rotation back to this orientation in each control step.
_DOWN = (1.0, 0.0, 1.0, 0.0)
_SETTLING_SUBSTEPS = 200


class FetchArm(MocapArm):
    """Base class of the Fetch tasks: an arm with closed fingers, in a model that extends ``fetch_reach.xml``."""

    action_size = 4
    action_meaning = (
        "displacement of the gripper along the world's x, y and z from where it is, in multiples of action_scale (m); the last "
        "component is ignored"
    )

    def __init__(
        self, config: MocapArmConfig, mj_model: mujoco.MjModel, observer: Callable[[mujoco.MjModel], Observer] | None
    ) -> None:
        """Compute the start state.

        Args:
            config: Settings of the task.
            mj_model: Model with the arm.
            observer: Function that builds the observer (poses to images) from the model. If None, `observe_state` is used.
        """
        self._fingers = np.array([mj_model.joint(name).qposadr[0] for name in ("right_finger", "left_finger")])
        super().__init__(config, mj_model, "gripper", observer)

    def _pull_grip(self, mj_model: mujoco.MjModel, mj_data: mujoco.MjData, position: np.ndarray) -> None:
        """Pull the gripper, pointing down, to ``position`` [3] (m, world) for 200 physics steps; modify ``mj_data``."""
        pull(mj_model, mj_data, position, np.array(_DOWN) / np.linalg.norm(_DOWN), _SETTLING_SUBSTEPS)
        mujoco.mj_forward(mj_model, mj_data)

    def act(self, data: mjx.Data, action: jax.Array) -> mjx.Data:
        # The target is relative to the gripper, not to the previous target, so tracking errors do not accumulate.
        position = data.xpos[self._hand] + self.config.action_scale * action[:3]
        quaternion = data.xquat[self._hand] + jnp.asarray(_DOWN, jnp.float32)
        data = data.replace(mocap_pos=position[None], mocap_quat=quaternion[None])
        data = mjx_model.take_steps(self._model, data, self.config.substeps)
        return mjx_model.kinematics(self._model, self._close_fingers(data))

    def _close_fingers(self, data: mjx.Data) -> mjx.Data:
        """Reset the finger positions but not their velocities, as the original does after each control step."""
        return data.replace(qpos=data.qpos.at[self._fingers].set(0.0))
