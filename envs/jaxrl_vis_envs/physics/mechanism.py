"""What is known of a model before it runs, for physics steps number by number (`steps`); and which models have such steps."""

from collections.abc import Hashable
from typing import Any, NamedTuple

import jax
import mujoco
import numpy as np
from mujoco import mjx
from mujoco.mjx._src import collision_driver

from jaxrl_vis_envs.physics import capsules, links, reference, welds
from jaxrl_vis_envs.physics.capsules import Pair
from jaxrl_vis_envs.physics.folding import floats
from jaxrl_vis_envs.physics.links import WORLD, Link
from jaxrl_vis_envs.physics.reference import Reference
from jaxrl_vis_envs.physics.welds import Weld

# What is written out for each joint and for each pair of capsules has to fit into one kernel.
_MOST_JOINTS, _MOST_PAIRS = 32, 32
_ONE_DEGREE_OF_FREEDOM = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
_FLAG = mujoco.mjtDisableBit
# Flags that steps heed, or that make no difference to the models that they take.
_HEEDED = (
    _FLAG.mjDSBL_CONSTRAINT | _FLAG.mjDSBL_FRICTIONLOSS | _FLAG.mjDSBL_LIMIT | _FLAG.mjDSBL_CONTACT
    | _FLAG.mjDSBL_GRAVITY | _FLAG.mjDSBL_WARMSTART | _FLAG.mjDSBL_REFSAFE | _FLAG.mjDSBL_CLAMPCTRL
    | _FLAG.mjDSBL_EQUALITY | _FLAG.mjDSBL_SENSOR | _FLAG.mjDSBL_MIDPHASE | _FLAG.mjDSBL_FILTERPARENT
)  # fmt: skip
_SHAPES = (
    (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CAPSULE),
    (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_SPHERE),
)
_BY_CENTRE_OF_MASS = (mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM, mujoco.mjtCamLight.mjCAMLIGHT_TARGETBODYCOM)


class Friction(NamedTuple):
    """Dry friction in a joint."""

    joint: int
    most: float  # N m or N
    inverse_weight: float
    reference: Reference


class Limit(NamedTuple):
    """Ends of the range of a joint or of a tendon, which is a sum of joints."""

    joints: dict[int, float]  # joint -> its share in what is limited
    ends: tuple[float, float]
    margin: float
    inverse_weight: float
    reference: Reference


class Contact(NamedTuple):
    """What two geoms do where they touch."""

    pair: Pair
    margin: float
    inverse_weights: tuple[float, ...]  # for each row: along the normal, and across it where there is an elliptic cone
    references: tuple[Reference, ...]
    cone: tuple[float, ...]  # see `descent.Problem`; empty if the cone is not elliptic
    pyramid: tuple[float, ...]  # friction along two directions and about the normal, which all edges of a pyramid share


class Hold(NamedTuple):
    """A weld, and how hard it is: for what is apart, and for what is turned."""

    weld: Weld
    inverse_weights: tuple[float, float]
    reference: Reference


class Actuator(NamedTuple):
    """A motor or servo of one joint: its force is linear in its control and, by both gain and bias, in length and velocity."""

    joint: int
    gear: float
    gain: tuple[float, ...]
    bias: tuple[float, ...]
    control_ends: tuple[float, float]
    force_ends: tuple[float, float]


class Mechanism(NamedTuple):
    """The constants of a model. Tuples are over joints where nothing else is said."""

    links: list[Link]
    rest: tuple[float, ...]
    armature: tuple[float, ...]
    damping: tuple[float, ...]
    springs: tuple[tuple[float, float], ...]  # stiffness and the position without force
    tendon_masses: tuple[tuple[dict[int, float], float], ...]  # of each tendon: shares of joints, and armature
    gravity: np.ndarray
    actuators: tuple[Actuator, ...]
    frictions: tuple[Friction, ...]
    limits: tuple[Limit, ...]
    contacts: tuple[Contact, ...]
    holds: tuple[Hold, ...]
    mocaps: tuple[int, ...]  # those that something hangs on
    iterations: int
    warm: bool


def takes(model: mjx.Model) -> bool:
    """Whether a model has steps number by number.

    It has if its numbers are known, if its joints have one degree of freedom, if all contacts are of explicit pairs of two
    capsules, or of a plane and a sphere, without friction or with elliptic or pyramidal cones, the latter also with friction
    about the normal; and if it has limits, dry friction of joints, tendons that are sums of joints, actuators of joints without
    activation, mocap bodies, and welds of bodies that act from the start, but no other equalities, sensors, fluid or gravity
    compensation; with MuJoCo's Newton solver and Euler's method, implicit in the damping.
    """
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(model)):
        return False
    parts = (_is_simple, _has_simple_tendons, _has_simple_actuators, _has_simple_equalities, _has_simple_contacts)
    return all(is_so(model) for is_so in parts)


def _is_simple(model: mjx.Model) -> bool:
    joints = model.nq == model.nv <= _MOST_JOINTS and model.nv > 0
    if not joints or not np.isin(model.jnt_type, _ONE_DEGREE_OF_FREEDOM).all():
        return False
    option = model.opt
    is_newton = option.solver == mujoco.mjtSolver.mjSOL_NEWTON and option.integrator == mujoco.mjtIntegrator.mjINT_EULER
    is_plain = not (int(option.disableflags) & ~int(_HEEDED)) and option.enableflags == 0
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
    if len(pairs) > _MOST_PAIRS:
        return False
    for one, other, index in pairs:
        bodies = int(model.geom_bodyid[one]), int(model.geom_bodyid[other])
        moves = model.body_weldid[bodies[0]] != model.body_weldid[bodies[1]] and _is_any_carried(model, bodies)
        shapes = int(model.geom_type[one]), int(model.geom_type[other])
        if index < 0 or shapes not in _SHAPES or not moves or model.pair_dim[index] not in dims:
            return False
    return True


def _has_simple_equalities(model: mjx.Model) -> bool:
    if not model.neq or int(model.opt.disableflags) & _without(_FLAG.mjDSBL_EQUALITY):
        return True
    is_weld = (model.eq_type == mujoco.mjtEq.mjEQ_WELD) & (model.eq_objtype == mujoco.mjtObj.mjOBJ_BODY)
    bodies = zip(model.eq_obj1id, model.eq_obj2id, strict=True)
    return bool(np.all(is_weld & model.eq_active0)) and all(_is_any_carried(model, pair) for pair in bodies)


def _is_any_carried(model: mjx.Model, bodies: tuple[int, int]) -> bool:
    """Whether joints move one of two bodies."""
    for body in map(int, bodies):
        while body:
            if model.body_jntnum[body]:
                return True
            body = int(model.body_parentid[body])
    return False


def mechanism_of(model: mjx.Model) -> Mechanism:
    """The constants of a model that this module `takes`."""
    tree, frames = links.links_of(model)
    flags = int(model.opt.disableflags)
    tendons = [_joints_of_tendon(model, tendon) for tendon in range(model.ntendon)]
    armature = np.asarray(model.tendon_armature)
    has_gravity = not flags & _FLAG.mjDSBL_GRAVITY
    contacts = _contacts(model, tree, frames) if not flags & _without(_FLAG.mjDSBL_CONTACT) else []
    holds = _holds(model, tree, frames) if not flags & _without(_FLAG.mjDSBL_EQUALITY) else []
    placed = [frame for contact in contacts for frame in contact.pair.frames]
    placed += [frame for hold in holds for frame in hold.weld.frames]
    used = {link.parent for link in tree} | {frame.link for frame in placed}
    return Mechanism(
        links=tree,
        rest=floats(np.asarray(model.qpos0)),
        armature=floats(np.asarray(model.dof_armature)),
        damping=floats(np.asarray(model.dof_damping)),
        springs=tuple(zip(floats(np.asarray(model.jnt_stiffness)), floats(np.asarray(model.qpos_spring)), strict=True)),
        tendon_masses=tuple((joints, float(mass)) for joints, mass in zip(tendons, armature, strict=True)),
        gravity=np.asarray(model.opt.gravity, np.float64) * has_gravity,
        actuators=tuple(_actuator(model, index) for index in range(model.nu)),
        frictions=tuple(_frictions(model)) if not flags & _without(_FLAG.mjDSBL_FRICTIONLOSS) else (),
        limits=tuple(_limits(model, tendons)) if not flags & _without(_FLAG.mjDSBL_LIMIT) else (),
        contacts=tuple(contacts),
        holds=tuple(holds),
        mocaps=tuple(sorted(links.link_of_mocap(link) for link in used if link < WORLD)),
        iterations=int(model.opt.iterations),
        warm=not flags & _FLAG.mjDSBL_WARMSTART,
    )


def _without(flag: mujoco.mjtDisableBit) -> int:
    return int(flag | _FLAG.mjDSBL_CONSTRAINT)


def _joints_of_tendon(model: mjx.Model, tendon: int) -> dict[int, float]:
    first = model.tendon_adr[tendon]
    joints: dict[int, float] = {}
    for wrap in range(first, first + model.tendon_num[tendon]):
        joint = int(model.wrap_objid[wrap])
        joints[joint] = joints.get(joint, 0.0) + float(model.wrap_prm[wrap])
    return joints


def _actuator(model: mjx.Model, index: int) -> Actuator:
    endless = (-np.inf, np.inf)
    clamps = model.actuator_ctrllimited[index] and not int(model.opt.disableflags) & _FLAG.mjDSBL_CLAMPCTRL
    gain, bias = floats(np.asarray(model.actuator_gainprm)[index, :3]), floats(np.asarray(model.actuator_biasprm)[index, :3])
    if model.actuator_gaintype[index] == mujoco.mjtGain.mjGAIN_FIXED:
        gain = (gain[0], 0.0, 0.0)
    if model.actuator_biastype[index] == mujoco.mjtBias.mjBIAS_NONE:
        bias = (0.0, 0.0, 0.0)
    control = floats(np.asarray(model.actuator_ctrlrange)[index]) if clamps else endless
    force = floats(np.asarray(model.actuator_forcerange)[index]) if model.actuator_forcelimited[index] else endless
    gear = float(np.asarray(model.actuator_gear)[index, 0])
    return Actuator(int(model.actuator_trnid[index, 0]), gear, gain, bias, (control[0], control[1]), (force[0], force[1]))


def _reference(model: mjx.Model, solref: object, solimp: object) -> Reference:
    is_safe = not int(model.opt.disableflags) & _FLAG.mjDSBL_REFSAFE
    return reference.reference_of(np.asarray(solref), np.asarray(solimp), float(model.opt.timestep), is_safe)


def _frictions(model: mjx.Model) -> list[Friction]:
    most, weight = np.asarray(model.dof_frictionloss), np.asarray(model.dof_invweight0)
    solref, solimp = np.asarray(model.dof_solref), np.asarray(model.dof_solimp)
    return [
        Friction(int(joint), float(most[joint]), float(weight[joint]), _reference(model, solref[joint], solimp[joint]))
        for joint in np.flatnonzero(model._impl.dof_hasfrictionloss)
    ]


def _limits(model: mjx.Model, tendons: list[dict[int, float]]) -> list[Limit]:
    def limit(joints: dict[int, float], index: int, ends: object, margin: object, weight: object, *reference: object) -> Limit:
        low, high = floats(np.asarray(ends)[index])
        constants = _reference(model, *(np.asarray(each)[index] for each in reference))
        return Limit(joints, (low, high), float(np.asarray(margin)[index]), float(np.asarray(weight)[index]), constants)

    of_joints = (model.jnt_range, model.jnt_margin, model.dof_invweight0, model.jnt_solref, model.jnt_solimp)
    of_tendons = (model.tendon_range, model.tendon_margin, model.tendon_invweight0)
    of_tendons += (model.tendon_solref_lim, model.tendon_solimp_lim)
    found = [limit({int(joint): 1.0}, int(joint), *of_joints) for joint in np.flatnonzero(model.jnt_limited)]
    return found + [limit(tendons[tendon], int(tendon), *of_tendons) for tendon in np.flatnonzero(model.tendon_limited)]


def _contacts(model: mjx.Model, tree: list[Link], frames: list[links.Frame]) -> list[Contact]:
    """The contacts of all pairs, those with the fewest rows first."""
    weight, impratio = np.asarray(model.body_invweight0, np.float64)[:, 0], float(model.opt.impratio)
    frictions = np.maximum(np.asarray(model.pair_friction, np.float64), mujoco.mjMINVAL)
    is_elliptic = model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    found: list[tuple[int, Contact]] = []
    for one, other, index in collision_driver.geom_pairs(model):
        pair = capsules.pair_of(model, tree, frames, (int(one), int(other)))
        dim, friction = int(model.pair_dim[index]), frictions[index]
        inverse = float(weight[model.geom_bodyid[one]] + weight[model.geom_bodyid[other]])
        solref, across = np.asarray(model.pair_solref)[index], np.asarray(model.pair_solreffriction)[index]
        across = across if across.any() else solref
        solimp = np.asarray(model.pair_solimp)[index]
        reference = _reference(model, solref, solimp)
        contact = Contact(pair, float(np.asarray(model.pair_margin)[index]), (inverse,), (reference,), (), ())
        if dim > 1 and is_elliptic:
            ratios = [friction[0] ** 2 / friction[row - 1] ** 2 / impratio for row in range(1, dim)]
            contact = contact._replace(
                inverse_weights=(inverse, *(float(inverse * ratio) for ratio in ratios)),
                references=(reference, *[_reference(model, across, solimp)] * (dim - 1)),
                cone=(float(friction[0] / np.sqrt(impratio)), *floats(friction[: dim - 1])),
            )
        elif dim > 1:
            square = float(friction[0] ** 2)
            inverse = inverse * (1.0 + square) * 2.0 * square / impratio
            contact = contact._replace(inverse_weights=(inverse,), pyramid=floats(friction[: dim - 1]))
        found.append((dim, contact))
    return [contact for _, contact in sorted(found, key=lambda each: each[0])]


def _holds(model: mjx.Model, tree: list[Link], frames: list[links.Frame]) -> list[Hold]:
    weights = np.asarray(model.body_invweight0, np.float64)
    found = []
    for index in range(model.neq):
        weight = weights[model.eq_obj1id[index]] + weights[model.eq_obj2id[index]]
        constants = _reference(model, np.asarray(model.eq_solref)[index], np.asarray(model.eq_solimp)[index])
        weld = welds.weld_of(model, tree, frames, index)
        found.append(Hold(weld, (float(weight[0]), float(weight[1])), constants))
    return found


def content(part: Any) -> Hashable:
    """The numbers of a mechanism or of a part of it: mechanisms are the same where these are equal."""
    if isinstance(part, np.ndarray):
        return part.shape, part.tobytes()
    if isinstance(part, dict):
        return tuple((key, content(value)) for key, value in part.items())
    return tuple(map(content, part)) if isinstance(part, list | tuple) else part


def common_link(mechanism: Mechanism) -> int:
    """The link in whose frame contacts are found: the last that all hang on, or the world, by which friction has its axes.

    Welds, too, are in the world, where mocap bodies are.
    """
    if mechanism.holds or mechanism.mocaps or any(contact.cone or contact.pyramid for contact in mechanism.contacts):
        return WORLD
    return capsules.common_link(mechanism.links, [contact.pair for contact in mechanism.contacts])
