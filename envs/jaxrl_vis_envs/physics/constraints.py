"""What joints do under constraints: which solver finds it, and Euler's step with what it has found.

Solvers differ in how they go about the same problem, and in what they take:

    numbers    `descent`, written out number by number: one kernel on GPUs that run ours (`newton_kernel`). On a CPU it is
               faster than MJX for few joints, slower than `newton`, and takes minutes to compile for the 24 joints of a hand.
    matrices   `newton`, for few joints and pyramidal cones.
    mjx        MJX's own. On a GPU its loops and its library calls are hundreds of kernels in a physics step, each of which
               takes longer to start than to run.
"""

import functools
from typing import Literal

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx
from mujoco.mjx._src import collision_driver, constraint, smooth, solver, support

from jaxrl_vis_envs.compiling.compilation import dispatch_by_platform, use_gpu_kernels
from jaxrl_vis_envs.physics import descent, newton, newton_kernel
from jaxrl_vis_envs.physics.descent import Motion, Problem, Structure

# Written out, a factorization has a sixth of the cube of this many operations; in a tree of more joints, few of these are left.
_MOST_JOINTS, _MOST_JOINTS_OF_A_TREE = 12, 32
# Numbers that may differ from 0 in the constraints' Jacobian, and rows that are added to a tree's factorized matrix one by one.
_MOST_ENTRIES, _MOST_APART = 600, 12


def solver_of(model: mjx.Model) -> Literal["numbers", "matrices", "mjx"]:
    """Which solver a model has on the platform that is being traced for (`jaxrl_vis_envs.compiling.compilation`)."""
    fits_numbers = _fits_numbers(model)
    if fits_numbers and use_gpu_kernels(newton_kernel.probe):
        return "numbers"
    if newton.fits(model):
        return "matrices"
    return "numbers" if fits_numbers and model.nv <= _MOST_JOINTS else "mjx"


def takes(model: mjx.Model) -> bool:
    """Whether `solve` and `euler` can take the place of MJX's, with whichever solver.

    They can for up to 32 joints of one degree of freedom and few constraints, without activations, with the Euler (and
    implicit damping of joints, MuJoCo's default) or the Runge-Kutta integrator. In a tree of more than 12 joints, no more than
    12 rows may be contacts or equalities, and no cone elliptic. Warm starts may be on or off.
    """
    return newton.fits(model) or _fits_numbers(model)


def _fits_numbers(model: mjx.Model) -> bool:
    is_simple = model.nq == model.nv <= _MOST_JOINTS_OF_A_TREE and model.na == 0
    is_newton = model.opt.solver == mujoco.mjtSolver.mjSOL_NEWTON
    is_explicit = model.opt.integrator in (mujoco.mjtIntegrator.mjINT_EULER, mujoco.mjtIntegrator.mjINT_RK4)
    is_damped = not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    if not (is_simple and is_newton and is_explicit and is_damped):
        return False
    structure = structure_of(model, exact=False)
    is_few = model.nv <= _MOST_JOINTS or (len(structure.apart) <= _MOST_APART and not structure.cones)
    return is_few and sum(map(len, structure.rows)) <= _MOST_ENTRIES


def structure_of(model: mjx.Model, exact: bool) -> Structure:
    """What is known of the constraint problem of a model of joints of one degree of freedom; for ``exact`` see `solve`."""
    dims = collision_driver.make_condim(model)
    types = constraint.make_efc_type(model, dims)
    equalities, frictions, limits, contacts = map(int, constraint.counts(types))
    flags, disabled = model.opt.disableflags, mujoco.mjtDisableBit
    everywhere, tendons = tuple(range(model.nv)), [_joints_of_tendon(model, tendon) for tendon in range(model.ntendon)]
    rows = [everywhere] * equalities
    if not flags & disabled.mjDSBL_FRICTIONLOSS:
        rows += [(int(joint),) for joint in np.flatnonzero(model._impl.dof_hasfrictionloss)]
        rows += [tendons[tendon] for tendon in np.flatnonzero(model._impl.tendon_hasfrictionloss)]
    if not flags & disabled.mjDSBL_LIMIT:
        rows += [(int(model.jnt_dofadr[joint]),) for joint in np.flatnonzero(model.jnt_limited)]
        rows += [tendons[tendon] for tendon in np.flatnonzero(model.tendon_limited)]
    rows = rows if len(types) else []
    assert len(rows) == equalities + frictions + limits
    rows += [everywhere] * contacts
    addresses = constraint.make_efc_address(model, dims, types)
    is_elliptic = model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    cones = [(int(first), int(dim)) for first, dim in zip(addresses, dims, strict=True) if is_elliptic and dim > 1]
    return Structure(
        joints=model.nv,
        mass=_mass_places(model, tendons),
        rows=tuple(rows),
        equalities=equalities,
        frictions=frictions,
        cones=tuple(cones),
        apart=(*range(equalities), *range(len(rows) - contacts, len(rows))) if model.nv > _MOST_JOINTS else (),
        iterations=int(model.opt.iterations),
        warm=not flags & disabled.mjDSBL_WARMSTART,
        exact=exact,
    )


def _joints_of_tendon(model: mjx.Model, tendon: int) -> tuple[int, ...]:
    """The joints that a tendon runs over: any, if it is not simply a sum of joints."""
    wraps = slice(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon])
    if np.any(model.wrap_type[wraps] != mujoco.mjtWrap.mjWRAP_JOINT):
        return tuple(range(model.nv))
    return tuple(sorted({int(model.jnt_dofadr[joint]) for joint in model.wrap_objid[wraps]}))


def _mass_places(model: mjx.Model, tendons: list[tuple[int, ...]]) -> tuple[tuple[int, int], ...]:
    """Where the mass matrix is not zero: between each joint and those it hangs on, and between joints of one tendon."""
    places = set()
    for joint in range(model.nv):
        ancestor = joint
        while ancestor >= 0:
            places.add((joint, ancestor))
            ancestor = int(model.dof_parentid[ancestor])
    places |= {(one, other) for joints in tendons for one in joints for other in joints if other <= one}
    return tuple(sorted(places))


def solve(model: mjx.Model, data: mjx.Data, exact: bool) -> tuple[mjx.Data, jax.Array]:
    """The accelerations without and under constraints (``qacc_smooth``, ``qacc``), and the constraints' ``qfrc_constraint``.

    Args:
        model: A model that this module `takes`; it takes ``model.opt.iterations`` Newton steps, each with a line search.
        data: With constraints, and with all forces on the joints that do not come from them. The first step starts from the
            accelerations without constraints, or from ``qacc_warmstart`` where that costs less and the model does not disable
            warm starts.
        exact: Whether one more Newton step is taken, whole, where it makes the gradient smaller (see `mjx_model.step`).

    Returns:
        ``data`` with these; and the accelerations [nv] with which Euler's method goes on, implicit in the damping of joints.
    """
    applied = data.qfrc_applied + support.xfrc_accumulate(model, data)
    data = data.replace(qfrc_smooth=data.qfrc_passive - data.qfrc_bias + data.qfrc_actuator + applied)
    motion = dispatch_by_platform(functools.partial(_motion, exact=exact), model, data)
    return data.replace(qacc_smooth=motion.free, qacc=motion.acceleration, qfrc_constraint=motion.force), motion.damped


def _motion(model: mjx.Model, data: mjx.Data, exact: bool) -> Motion:
    name = solver_of(model)
    if name == "numbers":
        return _by_numbers(model, data, exact)
    if name == "matrices":
        data = data.replace(qacc_smooth=newton.without_constraints(model, data))
        if data._impl.nefc == 0:
            data = data.replace(qacc=data.qacc_smooth)
        else:
            data = _polish(model, newton.solve(model, data)) if exact else newton.solve(model, data)
        return Motion(data.qacc_smooth, data.qacc, data.qfrc_constraint, newton.damped(model, data))
    data = by_mjx(model, data, exact)
    damped_mass = data._impl.M + jnp.diag(model.opt.timestep * model.dof_damping)
    damped = one_factorization_at_a_time(data.tree_replace({"_impl.M": damped_mass}))  # type: ignore[dict-item] - a tree of arrays
    damped = smooth.solve_m(model, smooth.factor_m(model, damped), data.qfrc_smooth + data.qfrc_constraint)
    return Motion(data.qacc_smooth, data.qacc, data.qfrc_constraint, damped)


def _by_numbers(model: mjx.Model, data: mjx.Data, exact: bool) -> Motion:
    structure, rows = structure_of(model, exact), data._impl
    problem = Problem(
        mass=support.full_m(model, data),
        force=data.qfrc_smooth,
        warm=data.qacc_warmstart,
        damping=model.opt.timestep * model.dof_damping,
        jacobian=rows.efc_J,
        stiffness=rows.efc_D,
        target=rows.efc_aref,
        most=rows.efc_frictionloss,
        cone=_cone_friction(model, data, structure),
    )
    if use_gpu_kernels(newton_kernel.probe):
        return newton_kernel.solve(structure, problem)
    motion = descent.solve(structure, descent.numbers_of(structure, lambda name, *place: getattr(problem, name)[place]))
    return Motion(*(jnp.stack([jnp.asarray(number, jnp.float32) for number in part]) for part in motion))


def _cone_friction(model: mjx.Model, data: mjx.Data, structure: Structure) -> jax.Array:
    """`Problem.cone`."""
    if not structure.cones:
        return jnp.zeros((0, 6), jnp.float32)
    friction = data._impl.contact.friction[data._impl.contact.dim > 1]
    return jnp.concatenate([friction[:, :1] / jnp.sqrt(model.opt.impratio), friction], axis=1)


def by_mjx(model: mjx.Model, data: mjx.Data, exact: bool) -> mjx.Data:
    """`solve` by MJX, for any model, with its factorized mass matrix."""
    data = mjx.fwd_acceleration(model, smooth.factor_m(model, data))
    if data._impl.nefc == 0:
        return data.replace(qacc=data.qacc_smooth)
    data = mjx.solve(model, data)
    return _polish(model, data) if exact else data


def _polish(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """One Newton step of the constraint solver, taken whole, where it makes the gradient smaller."""
    old = solver.Context.create(model, data)
    new = solver.Context.create(model, data.replace(qacc=data.qacc - old.Mgrad), grad=False)
    new_gradient = new.Ma - data.qfrc_smooth - new.qfrc_constraint
    is_better = jnp.sum(jnp.square(new_gradient)) < jnp.sum(jnp.square(old.grad))
    return data.replace(
        qacc=jnp.where(is_better, new.qacc, data.qacc),
        qfrc_constraint=jnp.where(is_better, new.qfrc_constraint, data.qfrc_constraint),
    )


def one_factorization_at_a_time(data: mjx.Data) -> mjx.Data:
    """The same, with a mass matrix that depends on the accelerations, as far as XLA can see.

    With damping, the mass matrix is factorized once more, and XLA on a CPU would do so beside the first time. With a batch,
    each of the two waits in a thread of XLA's pool for work that it has handed to that same pool: on two cores they wait for
    ever.
    """
    return data.tree_replace({"_impl.M": data._impl.M + 0.0 * data.qacc[:, None]})  # type: ignore[dict-item] - a tree of arrays


def euler(model: mjx.Model, data: mjx.Data, damped: jax.Array) -> mjx.Data:
    """`mjx.euler` of a model that this module `takes`: one step, with ``damped`` accelerations [nv] from `solve`."""
    timestep = model.opt.timestep
    velocity = data.qvel + timestep * damped
    position = data.qpos + timestep * velocity
    return data.replace(qpos=position, qvel=velocity, time=data.time + timestep, qacc_warmstart=data.qacc)
