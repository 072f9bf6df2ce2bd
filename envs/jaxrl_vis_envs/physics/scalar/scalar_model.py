"""Constants of a model for the scalar engine, and the subset of MuJoCo that the engine supports."""

from collections.abc import Hashable
from typing import Any, NamedTuple

import jax
import mujoco
import numpy as np
from mujoco import mjx
from mujoco.mjx._src import collision_driver

from jaxrl_vis_envs.physics.scalar import constraint_softness, contacts, links, welds
from jaxrl_vis_envs.physics.scalar.constraint_softness import Softness
from jaxrl_vis_envs.physics.scalar.contacts import GeomPair
from jaxrl_vis_envs.physics.scalar.links import WORLD, FixedFrame, Link
from jaxrl_vis_envs.physics.scalar.partial_arithmetic import floats
from jaxrl_vis_envs.physics.scalar.welds import Weld

# Maximum numbers: the code is unrolled over joints and pairs, and must fit into one kernel.
_MAX_JOINTS, _MAX_PAIRS = 32, 32
_ONE_DEGREE_OF_FREEDOM = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
_INTEGRATORS = (mujoco.mjtIntegrator.mjINT_EULER, mujoco.mjtIntegrator.mjINT_RK4)
_FLAG = mujoco.mjtDisableBit
# Flags that the engine implements, or that do not affect the models it supports.
_SUPPORTED_FLAGS = (
    _FLAG.mjDSBL_CONSTRAINT | _FLAG.mjDSBL_FRICTIONLOSS | _FLAG.mjDSBL_LIMIT | _FLAG.mjDSBL_CONTACT
    | _FLAG.mjDSBL_GRAVITY | _FLAG.mjDSBL_WARMSTART | _FLAG.mjDSBL_REFSAFE | _FLAG.mjDSBL_CLAMPCTRL
    | _FLAG.mjDSBL_EQUALITY | _FLAG.mjDSBL_SENSOR | _FLAG.mjDSBL_MIDPHASE | _FLAG.mjDSBL_FILTERPARENT
)  # fmt: skip
_SHAPES = (
    (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CAPSULE),
    (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_SPHERE),
)
_BY_CENTRE_OF_MASS = (mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM, mujoco.mjtCamLight.mjCAMLIGHT_TARGETBODYCOM)


class FrictionConstraint(NamedTuple):
    """Dry friction of a joint.

    Attributes:
        joint: Index of the joint.
        max_force: Maximum friction force, N m or N.
        inverse_weight: Approximate inverse inertia along the constraint.
        softness: Softness of the constraint.
    """

    joint: int
    max_force: float
    inverse_weight: float
    softness: Softness


class LimitConstraint(NamedTuple):
    """Range of a joint, or of a fixed tendon, whose length is a weighted sum of joint positions.

    Attributes:
        joints: Coefficient of each joint in the limited quantity.
        bounds: Lower and upper bound of the limited quantity, rad or m.
        margin: Distance from a bound below which the limit acts, rad or m.
        inverse_weight: Approximate inverse inertia along the constraint.
        softness: Softness of the constraint.
    """

    joints: dict[int, float]
    bounds: tuple[float, float]
    margin: float
    inverse_weight: float
    softness: Softness


class ContactConstraint(NamedTuple):
    """Contact of two geoms.

    Attributes:
        pair: The geoms.
        margin: Distance below which the contact acts, m.
        inverse_weights: Approximate inverse inertia of each row: along the normal and, for elliptic cones, the tangents. A
            pyramid's edges share one.
        softness: Softness of the same rows.
        cone: Friction of each row of an elliptic cone (`scalar_newton.Problem`); empty for other contacts.
        pyramid: Friction along the two tangents and, if torsional, about the normal, for a pyramid; empty for other contacts.
    """

    pair: GeomPair
    margin: float
    inverse_weights: tuple[float, ...]
    softness: tuple[Softness, ...]
    cone: tuple[float, ...]
    pyramid: tuple[float, ...]


class WeldConstraint(NamedTuple):
    """Weld of two bodies.

    Attributes:
        weld: The bodies and their relative pose.
        inverse_weights: Approximate inverse inertia of the position rows and of the rotation rows.
        softness: Softness of all rows.
    """

    weld: Weld
    inverse_weights: tuple[float, float]
    softness: Softness


class Actuator(NamedTuple):
    """Motor or servo of one joint, with a force of gain * control + bias.

    Attributes:
        joint: Index of the joint.
        gear: Factor from joint position to actuator length, and from actuator force to joint force.
        gain: Constant, and coefficients of length and velocity, of the gain.
        bias: Constant, and coefficients of length and velocity, of the bias.
        control_bounds: Lower and upper bound of the control; infinite if unbounded.
        force_bounds: Lower and upper bound of the force; infinite if unbounded.
    """

    joint: int
    gear: float
    gain: tuple[float, ...]
    bias: tuple[float, ...]
    control_bounds: tuple[float, float]
    force_bounds: tuple[float, float]


class ScalarModel(NamedTuple):
    """Constants of a model with N joints.

    Attributes:
        links: [N], links of the kinematic tree.
        rest: [N], joint positions ``qpos0``, rad or m.
        armature: [N], armature inertias of the joints, kg m^2 or kg.
        damping: [N], damping of the joints, N m s/rad or N s/m.
        springs: [N], stiffness (N m/rad or N/m) and rest position (rad or m) of each joint.
        tendon_masses: Coefficients of the joints, and armature, of each tendon.
        gravity: [3] float64, m/s^2, in the world; 0 if disabled.
        actuators: All actuators, in the order of the controls.
        frictions: Dry friction of joints.
        limits: Limits of joints and tendons.
        contacts: Contacts of geom pairs.
        welds: Welds of bodies.
        mocaps: Indices of the mocap bodies that links or constrained geoms and bodies depend on.
        iterations: Newton iterations per step.
        warm_start: True to start the solver from the last step's accelerations.
        runge_kutta: True for the classical Runge-Kutta method, False for Euler's, implicit in the damping.
    """

    links: list[Link]
    rest: tuple[float, ...]
    armature: tuple[float, ...]
    damping: tuple[float, ...]
    springs: tuple[tuple[float, float], ...]
    tendon_masses: tuple[tuple[dict[int, float], float], ...]
    gravity: np.ndarray
    actuators: tuple[Actuator, ...]
    frictions: tuple[FrictionConstraint, ...]
    limits: tuple[LimitConstraint, ...]
    contacts: tuple[ContactConstraint, ...]
    welds: tuple[WeldConstraint, ...]
    mocaps: tuple[int, ...]
    iterations: int
    warm_start: bool
    runge_kutta: bool


def supports(model: mjx.Model) -> bool:
    """Return True if the scalar engine can simulate a model.

    The subset of MuJoCo: concrete numbers, no tracers; up to 32 hinges and slides; up to 32 explicit contact pairs, each of two
    capsules or of a plane and a sphere, frictionless or with elliptic or pyramidal cones, the latter also with torsional
    friction; limits; dry friction of joints; fixed tendons; joint actuators without activation; mocap bodies; and welds of
    bodies that are active from the start. Exponents of impedances are integers up to 6. Not supported: other equalities,
    sensors, fluids, gravity compensation, and limits of the actuator force on a joint. The solver is Newton's; the integrator
    is Euler's, implicit in the damping, or RK4.
    """
    if not is_concrete(model):
        return False
    is_small = model.nq == model.nv <= _MAX_JOINTS and model.nv > 0
    if not is_small or not np.isin(model.jnt_type, _ONE_DEGREE_OF_FREEDOM).all():
        return False
    return has_simple_tree(model) and _has_simple_contacts(model)


def is_concrete(model: mjx.Model) -> bool:
    """Return True if all numbers of a model are known."""
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(model))


def has_simple_tree(model: mjx.Model) -> bool:
    """Return True if the engine supports a model apart from the types of its joints and its contacts."""
    checks = (_has_simple_joints, _has_simple_tendons, _has_simple_actuators, _has_simple_equalities)
    return all(is_simple(model) for is_simple in checks)


def _has_simple_joints(model: mjx.Model) -> bool:
    option = model.opt
    is_newton = option.solver == mujoco.mjtSolver.mjSOL_NEWTON and option.integrator in _INTEGRATORS
    is_plain = not (int(option.disableflags) & ~int(_SUPPORTED_FLAGS)) and option.enableflags == 0
    has_more = model.na or model.nsensor or option._impl.has_fluid_params or model.flg_gravcomp
    follows = np.isin(np.concatenate([model.cam_mode, model.light_mode]), [int(mode) for mode in _BY_CENTRE_OF_MASS]).any()
    powers = [model.jnt_solimp, model.tendon_solimp_lim, model.pair_solimp, model.dof_solimp, model.eq_solimp]
    curves = np.concatenate([np.asarray(rows, np.float64).reshape(-1, 5) for rows in powers])
    is_whole = np.all((curves[:, 4] == np.round(curves[:, 4])) & (curves[:, 4] <= 6) & (curves[:, 0] <= curves[:, 1]))
    return bool(is_newton and is_plain and not has_more and not follows and is_whole) and not np.any(model.jnt_actfrclimited)


def _has_simple_tendons(model: mjx.Model) -> bool:
    if not model.ntendon:
        return True
    forces = [model.tendon_stiffness, model.tendon_damping]
    is_passive = not any(np.any(np.asarray(force)) for force in forces)
    is_limited = np.any(model._impl.tendon_hasfrictionloss) or np.any(model.tendon_actfrclimited)
    return bool(np.all(model.wrap_type == mujoco.mjtWrap.mjWRAP_JOINT) and is_passive and not is_limited)


def _has_simple_actuators(model: mjx.Model) -> bool:
    is_of_joint = model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
    gain = np.isin(model.actuator_gaintype, [int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtGain.mjGAIN_AFFINE)])
    bias = np.isin(model.actuator_biastype, [int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE)])
    return bool(np.all(is_of_joint & gain & bias & (model.actuator_dyntype == mujoco.mjtDyn.mjDYN_NONE)))


def _has_simple_contacts(model: mjx.Model) -> bool:
    flags = int(model.opt.disableflags)
    if flags & int(_FLAG.mjDSBL_CONTACT | _FLAG.mjDSBL_CONSTRAINT):
        return True
    is_elliptic = model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    dims = (1, 3) if is_elliptic else (1, 3, 4)
    pairs = list(collision_driver.geom_pairs(model))
    if len(pairs) > _MAX_PAIRS:
        return False
    for one, other, index in pairs:
        bodies = int(model.geom_bodyid[one]), int(model.geom_bodyid[other])
        moves = model.body_weldid[bodies[0]] != model.body_weldid[bodies[1]] and _has_joint_above(model, bodies)
        shapes = int(model.geom_type[one]), int(model.geom_type[other])
        if index < 0 or shapes not in _SHAPES or not moves or model.pair_dim[index] not in dims:
            return False
    return True


def _has_simple_equalities(model: mjx.Model) -> bool:
    if not model.neq or int(model.opt.disableflags) & _disabling(_FLAG.mjDSBL_EQUALITY):
        return True
    is_weld = (model.eq_type == mujoco.mjtEq.mjEQ_WELD) & (model.eq_objtype == mujoco.mjtObj.mjOBJ_BODY)
    bodies = zip(model.eq_obj1id, model.eq_obj2id, strict=True)
    return bool(np.all(is_weld & model.eq_active0)) and all(_has_joint_above(model, pair) for pair in bodies)


def _has_joint_above(model: mjx.Model, bodies: tuple[int, int]) -> bool:
    """Return True if any joint moves at least one of two bodies."""
    for body in map(int, bodies):
        while body:
            if model.body_jntnum[body]:
                return True
            body = int(model.body_parentid[body])
    return False


def build_scalar_model(model: mjx.Model) -> ScalarModel:
    """Return the constants of a model that the engine `supports`, or of the hinges and slides of one with a free body."""
    tree, frames = links.build_links(model)
    joints, flags = len(tree), int(model.opt.disableflags)
    tendons = [_tendon_coefficients(model, tendon) for tendon in range(model.ntendon)]
    armature = np.asarray(model.tendon_armature)
    has_gravity = not flags & _FLAG.mjDSBL_GRAVITY
    has_contacts = len(tree) == model.nv and not flags & _disabling(_FLAG.mjDSBL_CONTACT)
    contact_list = _contacts(model, tree, frames) if has_contacts else []
    weld_list = _welds(model, tree, frames) if not flags & _disabling(_FLAG.mjDSBL_EQUALITY) else []
    constrained = [frame for contact in contact_list for frame in contact.pair.frames]
    constrained += [frame for weld in weld_list for frame in weld.weld.frames]
    parents = {link.parent for link in tree} | {frame.link for frame in constrained}
    return ScalarModel(
        links=tree,
        rest=floats(np.asarray(model.qpos0)[:joints]),
        armature=floats(np.asarray(model.dof_armature)[:joints]),
        damping=floats(np.asarray(model.dof_damping)[:joints]),
        springs=tuple(
            zip(floats(np.asarray(model.jnt_stiffness)[:joints]), floats(np.asarray(model.qpos_spring)[:joints]), strict=True)
        ),
        tendon_masses=tuple((joints, float(mass)) for joints, mass in zip(tendons, armature, strict=True)),
        gravity=np.asarray(model.opt.gravity, np.float64) * has_gravity,
        actuators=tuple(_actuator(model, index) for index in range(model.nu)),
        frictions=tuple(_frictions(model)) if not flags & _disabling(_FLAG.mjDSBL_FRICTIONLOSS) else (),
        limits=tuple(_limits(model, tendons)) if not flags & _disabling(_FLAG.mjDSBL_LIMIT) else (),
        contacts=tuple(contact_list),
        welds=tuple(weld_list),
        mocaps=tuple(sorted(links.mocap_link(link) for link in parents if link < WORLD)),
        iterations=int(model.opt.iterations),
        warm_start=not flags & _FLAG.mjDSBL_WARMSTART,
        runge_kutta=bool(model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4),
    )


def _disabling(flag: mujoco.mjtDisableBit) -> int:
    """Return a mask of the flags that disable a kind of constraint: its own, and that of all constraints."""
    return int(flag | _FLAG.mjDSBL_CONSTRAINT)


def _tendon_coefficients(model: mjx.Model, tendon: int) -> dict[int, float]:
    first = model.tendon_adr[tendon]
    joints: dict[int, float] = {}
    for wrap in range(first, first + model.tendon_num[tendon]):
        joint = int(model.wrap_objid[wrap])
        joints[joint] = joints.get(joint, 0.0) + float(model.wrap_prm[wrap])
    return joints


def _actuator(model: mjx.Model, index: int) -> Actuator:
    unbounded = (-np.inf, np.inf)
    clamps = model.actuator_ctrllimited[index] and not int(model.opt.disableflags) & _FLAG.mjDSBL_CLAMPCTRL
    gain, bias = floats(np.asarray(model.actuator_gainprm)[index, :3]), floats(np.asarray(model.actuator_biasprm)[index, :3])
    if model.actuator_gaintype[index] == mujoco.mjtGain.mjGAIN_FIXED:
        gain = (gain[0], 0.0, 0.0)
    if model.actuator_biastype[index] == mujoco.mjtBias.mjBIAS_NONE:
        bias = (0.0, 0.0, 0.0)
    control = floats(np.asarray(model.actuator_ctrlrange)[index]) if clamps else unbounded
    force = floats(np.asarray(model.actuator_forcerange)[index]) if model.actuator_forcelimited[index] else unbounded
    gear = float(np.asarray(model.actuator_gear)[index, 0])
    return Actuator(int(model.actuator_trnid[index, 0]), gear, gain, bias, (control[0], control[1]), (force[0], force[1]))


def build_softness(model: mjx.Model, solref: object, solimp: object) -> Softness:
    """Return the softness of a constraint with MuJoCo's parameters ``solref`` [2] and ``solimp`` [5], in a model."""
    is_safe = not int(model.opt.disableflags) & _FLAG.mjDSBL_REFSAFE
    return constraint_softness.make_softness(np.asarray(solref), np.asarray(solimp), float(model.opt.timestep), is_safe)


def _frictions(model: mjx.Model) -> list[FrictionConstraint]:
    max_force, weight = np.asarray(model.dof_frictionloss), np.asarray(model.dof_invweight0)
    solref, solimp = np.asarray(model.dof_solref), np.asarray(model.dof_solimp)
    return [
        FrictionConstraint(
            int(joint), float(max_force[joint]), float(weight[joint]), build_softness(model, solref[joint], solimp[joint])
        )
        for joint in np.flatnonzero(model._impl.dof_hasfrictionloss)
    ]


def _limits(model: mjx.Model, tendons: list[dict[int, float]]) -> list[LimitConstraint]:
    def limit(
        joints: dict[int, float], index: int, bounds: object, margin: object, weight: object, *parameters: object
    ) -> LimitConstraint:
        low, high = floats(np.asarray(bounds)[index])
        softness = build_softness(model, *(np.asarray(parameter)[index] for parameter in parameters))
        return LimitConstraint(
            joints, (low, high), float(np.asarray(margin)[index]), float(np.asarray(weight)[index]), softness
        )

    of_joints = (model.jnt_range, model.jnt_margin, model.dof_invweight0, model.jnt_solref, model.jnt_solimp)
    of_tendons = (model.tendon_range, model.tendon_margin, model.tendon_invweight0)
    of_tendons += (model.tendon_solref_lim, model.tendon_solimp_lim)
    limits = [limit({int(joint): 1.0}, int(joint), *of_joints) for joint in np.flatnonzero(model.jnt_limited)]
    return limits + [limit(tendons[tendon], int(tendon), *of_tendons) for tendon in np.flatnonzero(model.tendon_limited)]


def _contacts(model: mjx.Model, tree: list[Link], frames: list[FixedFrame]) -> list[ContactConstraint]:
    """Return the contacts of all pairs, those with the fewest rows first."""
    weight, impratio = np.asarray(model.body_invweight0, np.float64)[:, 0], float(model.opt.impratio)
    frictions = np.maximum(np.asarray(model.pair_friction, np.float64), mujoco.mjMINVAL)
    is_elliptic = model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    sized: list[tuple[int, ContactConstraint]] = []
    for one, other, index in collision_driver.geom_pairs(model):
        pair = contacts.build_pair(model, tree, frames, (int(one), int(other)))
        dim, friction = int(model.pair_dim[index]), frictions[index]
        inverse = float(weight[model.geom_bodyid[one]] + weight[model.geom_bodyid[other]])
        solref, across = np.asarray(model.pair_solref)[index], np.asarray(model.pair_solreffriction)[index]
        across = across if across.any() else solref
        solimp = np.asarray(model.pair_solimp)[index]
        softness = build_softness(model, solref, solimp)
        contact = ContactConstraint(pair, float(np.asarray(model.pair_margin)[index]), (inverse,), (softness,), (), ())
        if dim > 1 and is_elliptic:
            ratios = [friction[0] ** 2 / friction[row - 1] ** 2 / impratio for row in range(1, dim)]
            contact = contact._replace(
                inverse_weights=(inverse, *(float(inverse * ratio) for ratio in ratios)),
                softness=(softness, *[build_softness(model, across, solimp)] * (dim - 1)),
                cone=(float(friction[0] / np.sqrt(impratio)), *floats(friction[: dim - 1])),
            )
        elif dim > 1:
            square = float(friction[0] ** 2)
            inverse = inverse * (1.0 + square) * 2.0 * square / impratio
            contact = contact._replace(inverse_weights=(inverse,), pyramid=floats(friction[: dim - 1]))
        sized.append((dim, contact))
    return [contact for _, contact in sorted(sized, key=lambda item: item[0])]


def _welds(model: mjx.Model, tree: list[Link], frames: list[FixedFrame]) -> list[WeldConstraint]:
    weights = np.asarray(model.body_invweight0, np.float64)
    constraints = []
    for index in range(model.neq):
        weight = weights[model.eq_obj1id[index]] + weights[model.eq_obj2id[index]]
        softness = build_softness(model, np.asarray(model.eq_solref)[index], np.asarray(model.eq_solimp)[index])
        weld = welds.build_weld(model, tree, frames, index)
        constraints.append(WeldConstraint(weld, (float(weight[0]), float(weight[1])), softness))
    return constraints


def fingerprint(value: Any) -> Hashable:
    """Convert a `ScalarModel` or a part of it to a hashable value that is equal for equal contents."""
    if isinstance(value, np.ndarray):
        return value.shape, value.tobytes()
    if isinstance(value, dict):
        return tuple((key, fingerprint(item)) for key, item in value.items())
    return tuple(map(fingerprint, value)) if isinstance(value, list | tuple) else value


def base_link(constants: ScalarModel) -> int:
    """Return the link in whose frame constraints are computed: the last common ancestor of all contacts, or the world.

    It is the world for models with contact friction, mocap bodies or welds, whose axes and poses are defined there.
    """
    if constants.welds or constants.mocaps or any(contact.cone or contact.pyramid for contact in constants.contacts):
        return WORLD
    return contacts.common_ancestor(constants.links, [contact.pair for contact in constants.contacts])
