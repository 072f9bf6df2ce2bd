"""Joint angles that bring the last link of a chain of hinges to a pose, as a robot that is pulled there takes them."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxrl_vis_envs.physics import mjx_model
from jaxrl_vis_envs.physics.mjx_model import mjx

_SETTLING_STEPS = 3
# Of the three directions (m^2) and the three turns (rad^2). Near a singular pose a real arm gives up orientation before
# position, and so does this.
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
    """The arm at rest with ``body`` as near to a pose as the joints let it.

    Damped least squares from ``start``, weighted by the joints' mobilities (1/damping), as the physics moves them.

    Args:
        mj_model: The model; the joints on the way to ``body`` are hinges. Others stay as they are.
        model: The same for MJX.
        start: Where the arm comes from.
        body: The last link.
        position: [3] float32 (m, world), where the link's origin shall be.
        rotation: [3, 3], how it shall be turned; columns are its axes in the world.
        damping: Of the three directions (m^2) and the three turns (rad^2): the larger, the sooner they are given up.
        steps: Steps on the way; the last three settle.
    """

    def improve(data: mjx.Data, share: jax.Array) -> tuple[mjx.Data, None]:
        target = start.xpos[body] + share * (position - start.xpos[body])
        return mjx_model.kinematics(
            model, data.replace(qpos=data.qpos + _step(mj_model, data, body, target, rotation, damping))
        ), None

    # The target moves to the goal first, then the last steps settle there.
    shares = jnp.minimum(jnp.arange(1, steps + 1) / (steps - _SETTLING_STEPS), 1.0).astype(jnp.float32)
    return jax.lax.scan(improve, start, shares)[0]


def _step(
    mj_model: mujoco.MjModel,
    data: mjx.Data,
    body: int,
    target: jax.Array,
    rotation: np.ndarray,
    damping: tuple[float, ...],
) -> jax.Array:
    """Change of joint angles [nv] (rad) that brings ``body`` nearer to ``target`` [3] (m, world) and ``rotation`` [3, 3]."""
    position = data.xpos[body]
    jacobian = mjx_model.hinge_jacobian(mj_model, data, body, position)
    # Half the sum of cross products is the rotation vector to first order; its exact length does not matter here.
    turn = 0.5 * jnp.sum(jnp.cross(data.xmat[body].T, jnp.asarray(rotation.T, jnp.float32)), axis=0)
    error = jnp.concatenate([target - position, turn])
    carries = mjx_model.carriers(mj_model, body)
    mobility = jnp.asarray(mj_model.dof_damping[carries].max() / mj_model.dof_damping, jnp.float32)
    regularizer = jnp.diag(jnp.asarray(damping, jnp.float32))

    def solve(error: jax.Array, mobility: jax.Array) -> jax.Array:
        weighted = mobility[:, None] * jacobian
        return weighted @ jnp.linalg.solve(jacobian.T @ weighted + regularizer, error)

    # A joint at its limit stays there, and the others take over what it leaves.
    limited = mj_model.jnt_limited.astype(bool)
    low = jnp.asarray(np.where(limited, mj_model.jnt_range[:, 0], -np.inf), jnp.float32) - data.qpos
    high = jnp.asarray(np.where(limited, mj_model.jnt_range[:, 1], np.inf), jnp.float32) - data.qpos
    change = solve(error, mobility)
    is_stopped = (change < low) | (change > high)
    stopped = jnp.where(is_stopped, jnp.clip(change, low, high), 0.0)
    rest = solve(error - stopped @ jacobian, jnp.where(is_stopped, 0.0, mobility))
    return jnp.clip(stopped + rest, low, high)
