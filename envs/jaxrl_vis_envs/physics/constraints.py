"""Accelerations under constraints for the MJX engine.

Small trees with pyramidal cones are solved by `newton`, in small matrices: on CPUs MJX's Newton iterations take several times
as long. Other models are left to MJX's own solver.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx
from mujoco.mjx._src import smooth, solver, support

from jaxrl_vis_envs.physics import newton, rotations

# Maximum number of rows of contacts and equalities. Above it, MJX's own step is used: the recorded grasping results, with more
# contacts, were obtained with that, and the shorter step rounds differently.
_MAX_COUPLED_ROWS = 12


def solve(model: mjx.Model, data: mjx.Data, exact: bool) -> mjx.Data:
    """Return ``data`` with accelerations under and without constraints (``qacc``, ``qacc_smooth``) and constraint forces
    (``qfrc_constraint``).

    Args:
        model: Model that takes ``model.opt.iterations`` Newton steps.
        data: State with its constraints and with all joint forces except those of the constraints. The first step starts from
            the unconstrained accelerations, or from ``qacc_warmstart`` where that has a lower cost and warm starts are enabled.
        exact: Take one more, full Newton step where it reduces the gradient (see `mjx_model.step`).
    """
    if newton.supports(model):
        applied = data.qfrc_applied + support.xfrc_accumulate(model, data)
        solved = data.replace(qfrc_smooth=data.qfrc_passive - data.qfrc_bias + data.qfrc_actuator + applied)
        solved = solved.replace(qacc_smooth=newton.unconstrained_accelerations(model, solved))
    else:
        solved = mjx.fwd_acceleration(model, smooth.factor_m(model, data))
    if data._impl.nefc == 0:
        solved = solved.replace(qacc=solved.qacc_smooth)
    else:
        solved = newton.solve(model, solved) if newton.supports(model) else mjx.solve(model, solved)
        solved = _polish(model, solved) if exact else solved
    if not _takes_own_step(model, data):
        return solved
    # Copying these fields only: MJX's factorized mass matrix, which nothing reads, would otherwise be an output of every step.
    names = ("qfrc_smooth", "qacc_smooth", "qacc", "qfrc_constraint")
    return data.replace(**{name: getattr(solved, name) for name in names})


def _polish(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Take one full Newton step where it reduces the gradient."""
    old = solver.Context.create(model, data)
    new = solver.Context.create(model, data.replace(qacc=data.qacc - old.Mgrad), grad=False)
    new_gradient = new.Ma - data.qfrc_smooth - new.qfrc_constraint
    is_better = jnp.sum(jnp.square(new_gradient)) < jnp.sum(jnp.square(old.grad))
    return data.replace(
        qacc=jnp.where(is_better, new.qacc, data.qacc),
        qfrc_constraint=jnp.where(is_better, new.qfrc_constraint, data.qfrc_constraint),
    )


def euler(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Take a step of Euler's method, implicit in the joints' damping, with the accelerations and forces of `solve`."""
    if not _takes_own_step(model, data):
        return mjx.euler(model, _add_dependency(data))
    timestep = model.opt.timestep
    velocity = data.qvel + timestep * _damped_accelerations(model, data)
    position = _integrate(model, data.qpos, velocity)
    return data.replace(qpos=position, qvel=velocity, time=data.time + timestep, qacc_warmstart=data.qacc)


def _integrate(model: mjx.Model, position: jax.Array, velocity: jax.Array) -> jax.Array:
    """Return ``qpos`` [nq] one time step later, at constant velocities [nv]."""
    timestep = model.opt.timestep
    if model.nq == model.nv:
        return position + timestep * velocity
    places, speeds = model.jnt_qposadr, model.jnt_dofadr
    is_free = np.asarray(model.jnt_type) == mujoco.mjtJoint.mjJNT_FREE
    moved = position.at[places[~is_free]].add(timestep * velocity[speeds[~is_free]])
    for place, speed in zip(places[is_free], speeds[is_free], strict=True):
        turn = velocity[speed + 3 : speed + 6]
        axis, rate = rotations.normalize_with_norm(turn)
        rotated = rotations.quat_mul(position[place + 3 : place + 7], rotations.axis_angle_to_quat(axis, timestep * rate))
        moved = moved.at[place : place + 3].add(timestep * velocity[speed : speed + 3])
        moved = moved.at[place + 3 : place + 7].set(rotations.normalize(rotated))
    return moved


def _takes_own_step(model: mjx.Model, data: mjx.Data) -> bool:
    """Return True if `euler` takes its own step instead of MJX's.

    It does, unless implicit damping is disabled, for models that `newton` supports, and for others of hinges and slides only,
    without actuator activations, with a dense mass matrix and few contacts.
    """
    is_damped = not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    if newton.supports(model):
        return is_damped
    has_only_hinges_and_slides = model.nq == model.nv and not model.na
    coupled_rows = int(data._impl.nefc - data._impl.nf - data._impl.nl)
    is_small = coupled_rows <= _MAX_COUPLED_ROWS and not support.is_sparse(model)
    return is_damped and has_only_hinges_and_slides and is_small


def _damped_accelerations(model: mjx.Model, data: mjx.Data) -> jax.Array:
    """Return accelerations for Euler's method, implicit in the joints' damping: [nv]."""
    if newton.supports(model):
        return newton.damped_accelerations(model, data)
    mass = data._impl.M + jnp.diag(model.opt.timestep * model.dof_damping)
    damped = _add_dependency(data.tree_replace({"_impl.M": mass}))  # type: ignore[dict-item] - a tree of arrays
    return smooth.solve_m(model, smooth.factor_m(model, damped), data.qfrc_smooth + data.qfrc_constraint)


def _add_dependency(data: mjx.Data) -> mjx.Data:
    """Make the mass matrix depend on the accelerations from XLA's point of view, to order the two factorizations.

    With damping, the mass matrix is factorized a second time, which XLA on a CPU would do concurrently with the first. In a
    batch, both factorizations wait in threads of XLA's pool for work that they have handed to the same pool: on two cores,
    forever.
    """
    return data.tree_replace({"_impl.M": data._impl.M + 0.0 * data.qacc[:, None]})  # type: ignore[dict-item] - a tree of arrays
