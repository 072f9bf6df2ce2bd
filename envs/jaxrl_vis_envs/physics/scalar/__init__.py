"""The scalar engine: a subset of MuJoCo's physics written out in scalars, for GPUs with one thread per episode.

    supports    checks if a model lies in the subset
    simulate    takes physics steps: on NVIDIA GPUs all of them in one kernel, elsewhere in plain JAX

These two functions, and the probe that every kernel has, are all that the rest of the package uses. The modules, from the
bottom:

    partial_arithmetic, quaternions, sparse_algebra    scalars, vectors and matrices whose known entries generate no operations
    links, dynamics, link_frames                       kinematic tree, mass matrix and bias forces, poses and their derivatives
    contacts, welds, constraint_softness               residuals, Jacobians and softness of constraints
    solver/                                            friction cones, line search, Newton's method
    scalar_model                                       constants of a model, and the subset of MuJoCo
    steps, triton_scalars, steps_kernel                physics steps, in plain JAX and as a GPU kernel
"""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from mujoco import mjx

from jaxrl_vis_envs.compiling.compilation import use_gpu_kernels
from jaxrl_vis_envs.physics.scalar import scalar_model, steps, steps_kernel
from jaxrl_vis_envs.physics.scalar.scalar_model import supports
from jaxrl_vis_envs.physics.scalar.steps import JointState
from jaxrl_vis_envs.physics.scalar.steps_kernel import probe

__all__ = ["probe", "simulate", "supports"]


def simulate(model: mjx.Model, data: mjx.Data, count: int, exact: bool | None = None) -> mjx.Data:
    """Take ``count`` physics steps with constant controls.

    Args:
        model: A model that the engine `supports`.
        data: State of one episode, without ``xfrc_applied`` and with all welds active.
        count: Number of steps.
        exact: Make forces as exact as float32 allows (see `mjx_model.take_steps`).

    Returns:
        ``data`` with new ``qpos``, ``qvel``, ``qacc``, ``qacc_warmstart``, ``qfrc_constraint`` and ``time``. All other fields,
        body poses included, are unchanged and thus stale. ``qpos`` is NaN if ``xfrc_applied`` is not 0 or a weld is inactive.
    """
    take = steps_kernel.simulate if use_gpu_kernels(probe) else steps.simulate_arrays
    return _simulate_with(take, model, data, count, exact)


def _simulate_with(
    take: Callable[..., JointState], model: mjx.Model, data: mjx.Data, count: int, exact: bool | None
) -> mjx.Data:
    """Implement `simulate` with ``take``, a function with the arguments of `steps.simulate_arrays`."""
    constants, timestep = scalar_model.build_scalar_model(model), float(model.opt.timestep)
    state = JointState(data.qpos, data.qvel, data.qacc_warmstart, data.qfrc_constraint)
    indices = np.array(constants.mocaps, int)
    mocap = jnp.concatenate([data.mocap_pos[indices], data.mocap_quat[indices]], axis=1) if len(indices) else None
    state = take(constants, state, data.ctrl, data.qfrc_applied, timestep, count, exact, mocap=mocap)
    is_disturbed = jnp.any(data.xfrc_applied != 0)
    if constants.welds:
        is_disturbed = is_disturbed | ~jnp.all(data.eq_active)
    return data.replace(
        qpos=jnp.where(is_disturbed, jnp.nan, state.position),
        qvel=state.velocity,
        qacc=state.acceleration,
        qacc_warmstart=state.acceleration,
        qfrc_constraint=state.force,
        time=data.time + count * model.opt.timestep,
    )
