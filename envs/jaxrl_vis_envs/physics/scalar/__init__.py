"""The scalar engine: a subset of MuJoCo's physics written out in scalars, for GPUs with a thread or warp per episode.

    supports    checks if a model lies in the subset
    simulate    takes physics steps: on NVIDIA GPUs all of them in one kernel, elsewhere in plain JAX

These two functions, and the probes that kernels have, are all that the rest of the package uses. The modules, from the
bottom:

    partial_arithmetic, quaternions, sparse_algebra    scalars, vectors and matrices whose known entries generate no operations
    links, dynamics, link_frames                       kinematic tree, mass matrix and bias forces, poses and their derivatives
    contacts, welds, constraint_softness               residuals, Jacobians and softness of constraints
    solver/                                            friction cones, line search, Newton's method
    scalar_model                                       constants of a model, and the subset of MuJoCo
    steps, triton_scalars, steps_kernel                physics steps, in plain JAX and as a GPU kernel
    boxes/                                             the same with boxes, one of them free: a warp per episode
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx

from jaxrl_vis_envs.compiling.compilation import use_gpu_kernels
from jaxrl_vis_envs.physics.scalar import scalar_model, steps, steps_kernel
from jaxrl_vis_envs.physics.scalar.boxes import box_kernel, box_model
from jaxrl_vis_envs.physics.scalar.scalar_model import ScalarModel
from jaxrl_vis_envs.physics.scalar.steps import JointState

__all__ = ["probe_of", "simulate", "supports"]


def supports(model: mjx.Model, exact: bool | None = None) -> bool:
    """Return True if the engine can simulate a model; see `scalar_model.supports`, or with boxes `box_model.supports`.

    Args:
        model: The model.
        exact: True if steps have to be exact (see `mjx_model.take_steps`), which those with boxes are not.
    """
    return scalar_model.supports(model) or (not exact and box_model.supports(model))


def probe_of(model: mjx.Model) -> Callable[[], jax.stages.Traced]:
    """Return the function that traces a small instance of the kernel for a model, for `use_gpu_kernels`."""
    return box_kernel.probe if box_model.supports(model) else steps_kernel.probe


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
    has_kernel = use_gpu_kernels(probe_of(model))
    if box_model.supports(model):
        return _simulate_boxes_with(box_kernel.simulate if has_kernel else box_kernel.simulate_arrays, model, data, count)
    return _simulate_with(steps_kernel.simulate if has_kernel else steps.simulate_arrays, model, data, count, exact)


def _simulate_boxes_with(take_steps: Callable[..., JointState], model: mjx.Model, data: mjx.Data, count: int) -> mjx.Data:
    """Implement `simulate` of a model with boxes with ``take_steps``, which has the arguments of `box_kernel.simulate`."""
    constants = box_model.build_box_model(model)
    return _replace_state(model, data, count, constants.tree, functools.partial(take_steps, constants))


def _simulate_with(
    take_steps: Callable[..., JointState], model: mjx.Model, data: mjx.Data, count: int, exact: bool | None
) -> mjx.Data:
    """Implement `simulate` with ``take_steps``, a function with the arguments of `steps.simulate_arrays`."""
    constants = scalar_model.build_scalar_model(model)
    return _replace_state(model, data, count, constants, functools.partial(take_steps, constants, exact=exact))


def _replace_state(
    model: mjx.Model, data: mjx.Data, count: int, constants: ScalarModel, take_steps: Callable[..., JointState]
) -> mjx.Data:
    """Return ``data`` with the state after ``count`` steps of ``take_steps``; ``constants`` are those of the tree."""
    state = JointState(data.qpos, data.qvel, data.qacc_warmstart, data.qfrc_constraint)
    indices = np.array(constants.mocaps, int)
    mocap = jnp.concatenate([data.mocap_pos[indices], data.mocap_quat[indices]], axis=1) if len(indices) else None
    state = take_steps(state, data.ctrl, data.qfrc_applied, timestep=float(model.opt.timestep), count=count, mocap=mocap)
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
