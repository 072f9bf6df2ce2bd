"""MuJoCo's constraint solver for small trees, without loops that wait for the slowest episode of a batch.

MJX's Newton iterations and line searches are loops that end when the last episode of a batch is done, and each iteration calls
a library for one small matrix. On a GPU that is hundreds of kernels in a physics step, each of which takes longer to start than
to run. Here a step is a fixed number of operations on whole batches (`descent`), and on GPUs that run our kernels it is one
kernel (`newton_kernel`).

`mjx_model.solver_of` says which models are solved here, and which by MJX.

Source: the primal problem of MuJoCo's documentation, "Computation", constraint model; Newton's method as there.
"""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxrl_vis_envs.compilation import by_platform, runs_gpu_kernels
from jaxrl_vis_envs.physics import newton_kernel
from jaxrl_vis_envs.physics.descent import Motion, Problem, Structure, numbers_of
from jaxrl_vis_envs.physics.descent import solve as solve_numbers
from jaxrl_vis_envs.physics.quiet_mjx import collision_driver, constraint, mjx, support

# Written out, a factorization has a sixth of the cube of this many operations; in a tree of more joints, few of these are left.
_MOST_JOINTS, _MOST_JOINTS_OF_A_TREE = 12, 32
# Numbers that may differ from 0 in the constraints' Jacobian, and rows that are added to a tree's factorized matrix one by one.
_MOST_ENTRIES, _MOST_APART = 600, 12


def fits(model: mjx.Model) -> bool:
    """Whether the functions here can take the place of MJX's.

    They can for few joints of one degree of freedom and few constraints, no activations, and the Euler (with implicit damping of
    joints, MuJoCo's default) or Runge-Kutta integrator. In a tree of more than 12 joints, no more than 12 rows may be contacts
    or equalities, and no cone elliptic. Warm starts may be on or off.
    """
    is_simple = model.nq == model.nv <= _MOST_JOINTS_OF_A_TREE and model.na == 0
    is_newton = model.opt.solver == mujoco.mjtSolver.mjSOL_NEWTON
    is_explicit = model.opt.integrator in (mujoco.mjtIntegrator.mjINT_EULER, mujoco.mjtIntegrator.mjINT_RK4)
    is_damped = not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    if not (is_simple and is_newton and is_explicit and is_damped):
        return False
    structure = structure_of(model, exact=False)
    entries = sum(map(len, structure.rows))
    is_few = model.nv <= _MOST_JOINTS or (len(structure.apart) <= _MOST_APART and not structure.cones)
    return is_few and entries <= _MOST_ENTRIES


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
        iterations=model.opt.iterations,
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
        model: A model that `fits`; it takes ``model.opt.iterations`` Newton steps, each with a line search.
        data: With constraints, and with all forces on the joints that do not come from them. The first step starts from the
            accelerations without constraints, or from ``qacc_warmstart`` where that costs less and the model does not disable
            warm starts.
        exact: Whether one more Newton step is taken, whole, where it makes the gradient smaller (see `mjx_model.step`).

    Returns:
        ``data`` with these; and the accelerations [nv] with which Euler's method goes on, implicit in the damping of joints.
    """
    structure, constraints = structure_of(model, exact), data._impl
    applied = data.qfrc_applied + support.xfrc_accumulate(model, data)
    force = data.qfrc_passive - data.qfrc_bias + data.qfrc_actuator + applied
    problem = Problem(
        mass=support.full_m(model, data),
        force=force,
        warm=data.qacc_warmstart,
        damping=model.opt.timestep * model.dof_damping,
        jacobian=constraints.efc_J,
        stiffness=constraints.efc_D,
        target=constraints.efc_aref,
        most=constraints.efc_frictionloss,
        cone=_cone_friction(model, data, structure),
    )
    motion = Motion(*by_platform(functools.partial(_solve, structure), *problem))
    data = data.replace(
        qfrc_smooth=force, qacc_smooth=motion.free, qacc=motion.acceleration, qfrc_constraint=motion.force
    )
    return data, motion.damped


def _cone_friction(model: mjx.Model, data: mjx.Data, structure: Structure) -> jax.Array:
    """`Problem.cone`."""
    if not structure.cones:
        return jnp.zeros((0, 6), jnp.float32)
    friction = data._impl.contact.friction[data._impl.contact.dim > 1]
    return jnp.concatenate([friction[:, :1] / jnp.sqrt(model.opt.impratio), friction], axis=1)


def _solve(structure: Structure, *arrays: jax.Array) -> tuple[jax.Array, ...]:
    problem = Problem(*arrays)
    if runs_gpu_kernels(newton_kernel.probe):
        return newton_kernel.solve(structure, problem)
    motion = solve_numbers(structure, numbers_of(structure, lambda name, *place: getattr(problem, name)[place]))
    return tuple(jnp.stack([jnp.asarray(number, jnp.float32) for number in part]) for part in motion)


def euler(model: mjx.Model, data: mjx.Data, damped: jax.Array) -> mjx.Data:
    """`mjx.euler` of a model that `fits`: one step, with the accelerations [nv] from `solve` that are implicit in the damping."""
    timestep = model.opt.timestep
    velocity = data.qvel + timestep * damped
    position = data.qpos + timestep * velocity
    return data.replace(qpos=position, qvel=velocity, time=data.time + timestep, qacc_warmstart=data.qacc)
