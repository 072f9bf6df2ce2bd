"""Inverse kinematics of chains of hinges by damped least squares, weighted by joint mobility as for a robot that is pulled."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxrl_vis_envs.physics import mjx_model
from jaxrl_vis_envs.physics.mjx_model import mjx

_SETTLING_STEPS = 3
# For translations (m^2) and rotations (rad^2). Near a singular pose, a pulled arm deviates in orientation before position.
_DAMPING = (3e-3, 3e-3, 3e-3, 3e-2, 3e-2, 3e-2)


def reach(
    mj_model: mujoco.MjModel,
    model: mjx.Model,
    start: mjx.Data,
    body: int,
    position: jax.Array,
    rotation: np.ndarray,
    damping: tuple[float, ...] = _DAMPING,
    steps: int = 10,
) -> mjx.Data:
    """Move ``body`` as near to a pose as the joints allow, and return ``start`` with that ``qpos`` and its poses.

    Damped least squares from ``start``, weighted by the joints' mobilities (1/damping), as in the physics.

    Args:
        mj_model: The model; the joints that move ``body`` are hinges. Other joints keep their positions.
        model: The same model for MJX.
        start: Initial state.
        body: Index of the last link.
        position: [3] float32 (m, world), target of the link's origin.
        rotation: [3, 3], target orientation; columns are the link's axes in the world.
        damping: Damping of three translations (m^2) and three rotations (rad^2); those with higher damping deviate first.
        steps: Number of steps, more than three; the target has arrived at the pose by the last three.
    """

    def improve(data: mjx.Data, fraction: jax.Array) -> tuple[mjx.Data, None]:
        target = start.xpos[body] + fraction * (position - start.xpos[body])
        return mjx_model.kinematics(
            model, data.replace(qpos=data.qpos + _step(mj_model, data, body, target, rotation, damping))
        ), None

    # The target moves to the goal, and is fixed there during the last steps.
    fractions = jnp.minimum(jnp.arange(1, steps + 1) / (steps - _SETTLING_STEPS), 1.0).astype(jnp.float32)
    return jax.lax.scan(improve, start, fractions)[0]


def _step(
    mj_model: mujoco.MjModel,
    data: mjx.Data,
    body: int,
    target: jax.Array,
    rotation: np.ndarray,
    damping: tuple[float, ...],
) -> jax.Array:
    """Return the change of joint angles [nv] (rad) of one step towards ``target`` [3] (m, world) and ``rotation`` [3, 3]."""
    position = data.xpos[body]
    jacobian = mjx_model.hinge_jacobian(mj_model, data, body, position)
    # Half the sum of cross products is the rotation vector to first order; its exact length does not matter here.
    turn = 0.5 * jnp.sum(jnp.cross(data.xmat[body].T, jnp.asarray(rotation.T, jnp.float32)), axis=0)
    error = jnp.concatenate([target - position, turn])
    moves = mjx_model.ancestor_joints(mj_model, body)
    mobility = jnp.asarray(mj_model.dof_damping[moves].max() / mj_model.dof_damping, jnp.float32)
    regularizer = jnp.diag(jnp.asarray(damping, jnp.float32))

    def solve(error: jax.Array, mobility: jax.Array) -> jax.Array:
        weighted = mobility[:, None] * jacobian
        return weighted @ jnp.linalg.solve(jacobian.T @ weighted + regularizer, error)

    # A joint stops at its limit, and the others take over the rest of its motion.
    limited = mj_model.jnt_limited.astype(bool)
    low = jnp.asarray(np.where(limited, mj_model.jnt_range[:, 0], -np.inf), jnp.float32) - data.qpos
    high = jnp.asarray(np.where(limited, mj_model.jnt_range[:, 1], np.inf), jnp.float32) - data.qpos
    change = solve(error, mobility)
    is_stopped = (change < low) | (change > high)
    stopped = jnp.where(is_stopped, jnp.clip(change, low, high), 0.0)
    rest = solve(error - stopped @ jacobian, jnp.where(is_stopped, 0.0, mobility))
    return jnp.clip(stopped + rest, low, high)
