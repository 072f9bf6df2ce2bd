"""Physics steps number by number: from positions, velocities and controls to those after a step, all in one program.

As matrices, a step is a hundred operations of which each takes a GPU longer to start than to run; as numbers, all of them fit
into one kernel (`steps_kernel`). Of the model everything is a constant (`mechanism`).
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxrl_vis_envs.physics import capsules, descent, dynamics, links, mechanism, places, welds
from jaxrl_vis_envs.physics.algebra import Matrix, Numbers
from jaxrl_vis_envs.physics.descent import Problem, Structure
from jaxrl_vis_envs.physics.folding import minus, plus, times
from jaxrl_vis_envs.physics.mechanism import Contact, Hold, Limit, Mechanism
from jaxrl_vis_envs.physics.places import Places, Root


class State(NamedTuple):
    """What a step begins and ends with: numbers for each joint, or arrays of them.

    Attributes:
        position: rad or m.
        velocity: rad/s or m/s.
        acceleration: Of the last step, where the constraint solver may start from, rad/s^2 or m/s^2.
        force: Of the constraints on the joints in the last step, N m or N.
    """

    position: Any
    velocity: Any
    acceleration: Any
    force: Any


class Surroundings(NamedTuple):
    """What stays the same from step to step.

    Attributes:
        timestep: s.
        control: Of the actuators, within their ends.
        applied: Further forces on the joints, N m or N.
        roots: The mocap bodies.
    """

    timestep: Any
    control: Numbers
    applied: Numbers
    roots: dict[int, Root]


class _Row(NamedTuple):
    """One constraint: see `descent.Problem`. ``most`` is that of dry friction."""

    entries: dict[int, Any]
    stiffness: Any
    target: Any
    most: Any = None


def take(
    constants: Mechanism,
    state: State,
    control: Numbers,
    applied: Numbers,
    timestep: Any,
    count: Any,
    exact: Any,
    in_kernel: bool = False,
    mocap: Sequence[Any] = (),
) -> State:
    """``count`` physics steps, with the same controls.

    How long and how many steps are, and how exact, may be known or not: one program then serves all of it.

    Args:
        constants: Of the model.
        state: Before them.
        control: One number for each actuator.
        applied: Further forces on the joints, N m or N.
        timestep: s.
        count: How many; a whole number or an int32.
        exact: Whether forces are as exact as float32 allows (see `mjx_model.step`); contacts always are. A bool, or an int32,
            1 or 0.
        in_kernel: See `descent.solve`.
        mocap: Seven numbers for each of ``constants.mocaps``: position, m, and quaternion, of any length.

    Returns:
        The state after them.
    """
    ends = [actuator.control_ends for actuator in constants.actuators]
    control = [_clipped(number, pair) for number, pair in zip(control, ends, strict=True)]
    roots = places.roots_of(tuple(links.link_of_mocap(index) for index in constants.mocaps), list(mocap))

    def advance(_: Any, state: State) -> State:
        return _step(constants, state, Surroundings(timestep, control, applied, roots), exact, in_kernel)

    return jax.lax.fori_loop(0, count, advance, state)


def take_arrays(
    constants: Mechanism,
    state: State,
    control: jax.Array,
    applied: jax.Array,
    timestep: float,
    count: int,
    exact: bool,
    mocap: jax.Array | None = None,
) -> State:
    """`take` for arrays: of N joints, [N] each; controls [nu]; mocap bodies [M, 7] or None."""
    start = State(*map(list, state))
    poses = [] if mocap is None else list(mocap.reshape(-1))
    end = take(constants, start, list(control), list(applied), timestep, count, exact, mocap=poses)
    return State(*map(jnp.stack, end))


def _step(constants: Mechanism, state: State, around: Surroundings, exact: Any, in_kernel: bool = False) -> State:
    structure, problem, order = problem_of(constants, state, around, exact is not False)
    motion = descent.solve(structure, problem, in_kernel, exact)
    place = {joint: index for index, joint in enumerate(order)}
    damped, acceleration, force = (
        [part[place[joint]] for joint in range(len(order))] for part in (motion.damped, motion.acceleration, motion.force)
    )
    timestep = around.timestep
    velocity = [rate + timestep * change for rate, change in zip(state.velocity, damped, strict=True)]
    position = [there + timestep * rate for there, rate in zip(state.position, velocity, strict=True)]
    return State(position, velocity, acceleration, force)


def problem_of(constants: Mechanism, state: State, around: Surroundings, exact: bool) -> tuple[Structure, Problem, list[int]]:
    """The constraint problem of one step.

    Its joints come in an order of their own, so that its matrices fill in little as they are factorized from the last row on:
    of each place in this order, the joint that stands there comes with it.
    """
    displacement = [minus(there, rest) for there, rest in zip(state.position, constants.rest, strict=True)]
    turned = {joint for hold in constants.holds for frame in hold.weld.frames for joint in _chain(constants, frame.link)}
    joints = dynamics.joints_at(constants.links, displacement, turned)
    mass = dynamics.mass_matrix(constants.links, joints)
    for joint, armature in enumerate(constants.armature):
        mass[joint, joint] = plus(mass[joint, joint], armature)
    for shares, armature in constants.tendon_masses:
        _add_tendon(mass, shares, armature)
    where = Places(constants.links, joints, mechanism.common_link(constants), around.roots)
    rows = [row for hold in constants.holds for row in _hold_rows(hold, where, state)]
    equalities = len(rows)
    rows += [_friction_row(friction, state) for friction in constants.frictions]
    rows += [_limit_row(limit, state) for limit in constants.limits]
    cones = []
    for contact in constants.contacts:
        if contact.cone:
            cones.append((len(rows), len(contact.references)))
        rows += _contact_rows(contact, where, state)
    force = _forces(constants, state, joints, around)
    order = elimination_order(len(joints), list(mass), [tuple(row.entries) for row in rows])
    place = {joint: index for index, joint in enumerate(order)}
    ordered = {_below_diagonal(place[one], place[other]): number for (one, other), number in mass.items()}
    problem = Problem(
        mass=ordered,
        force=[force[joint] for joint in order],
        warm=[state.acceleration[joint] for joint in order],
        damping=[times(around.timestep, constants.damping[joint]) for joint in order],
        jacobian=[{place[joint]: entry for joint, entry in row.entries.items()} for row in rows],
        stiffness=[row.stiffness for row in rows],
        target=[row.target for row in rows],
        most={index: row.most for index, row in enumerate(rows) if row.most is not None},
        cone=[contact.cone for contact in constants.contacts if contact.cone],
    )
    structure = Structure(
        joints=len(joints),
        mass=tuple(sorted(ordered)),
        rows=tuple(tuple(sorted(entries)) for entries in problem.jacobian),
        equalities=equalities,
        frictions=len(constants.frictions),
        cones=tuple(cones),
        apart=(),
        iterations=constants.iterations,
        warm=constants.warm,
        exact=exact,
        corners=bool(constants.frictions or cones),
    )
    return structure, problem, order


def elimination_order(size: int, mass: list[tuple[int, int]], rows: list[tuple[int, ...]]) -> list[int]:
    """An order of joints in which a matrix fills in little if it is factorized from the last row on: greedily.

    Args:
        size: How many joints there are.
        mass: Places of the mass matrix, (joint, ancestor) and others. A joint comes after those that it hangs on, in which
            order this matrix itself does not fill in at all.
        rows: The joints that each constraint ties to each other.
    """
    neighbours: list[set[int]] = [set() for _ in range(size)]
    for joints in [*mass, *rows]:
        for joint in joints:
            neighbours[joint] |= set(joints) - {joint}
    below: list[set[int]] = [set() for _ in range(size)]
    for joint, ancestor in mass:
        if ancestor < joint:
            below[ancestor].add(joint)
    left, backwards = set(range(size)), []
    while left:
        joint = min((j for j in left if not below[j] & left), key=lambda j: (len(neighbours[j] & left), -j))
        left.remove(joint)
        backwards.append(joint)
        tied = neighbours[joint] & left
        for other in tied:
            neighbours[other] |= tied - {other}
    return backwards[::-1]


def _below_diagonal(one: int, other: int) -> tuple[int, int]:
    return (one, other) if one > other else (other, one)


def _add_tendon(mass: Matrix, shares: dict[int, float], armature: float) -> None:
    """Adds the armature of a tendon; its places are there without any, too, as in `constraints.structure_of`."""
    if armature == 0.0:
        return
    for one, share in shares.items():
        for other, factor in shares.items():
            if other <= one:
                mass[one, other] = plus(mass.get((one, other), 0.0), armature * share * factor)


def _chain(constants: Mechanism, link: int) -> list[int]:
    return links.carriers(constants.links, link)


def _forces(constants: Mechanism, state: State, joints: list[dynamics.Joint], around: Surroundings) -> Numbers:
    """On the joints, without constraints."""
    poses = {link: root.pose for link, root in around.roots.items()}
    bias = dynamics.bias(constants.links, joints, state.velocity, constants.gravity, poses)
    forces = []
    for joint, (there, rate) in enumerate(zip(state.position, state.velocity, strict=True)):
        stiffness, rest = constants.springs[joint]
        spring = times(stiffness, minus(there, rest)) if stiffness else 0.0
        passive = plus(spring, times(constants.damping[joint], rate))
        forces.append(minus(minus(around.applied[joint], bias[joint]), passive))
    for actuator, signal in zip(constants.actuators, around.control, strict=True):
        length = times(actuator.gear, state.position[actuator.joint])
        speed = times(actuator.gear, state.velocity[actuator.joint])
        gain, bias_force = (
            plus(level, times(slope, length), times(drag, speed)) for level, slope, drag in (actuator.gain, actuator.bias)
        )
        force = _clipped(plus(times(gain, signal), bias_force), actuator.force_ends)
        forces[actuator.joint] = plus(forces[actuator.joint], times(actuator.gear, force))
    return forces


def _friction_row(friction: mechanism.Friction, state: State) -> _Row:
    reference = friction.reference
    stiffness = reference.softness(friction.inverse_weight, reference.impedance(0.0))
    target = times(-reference.damping, state.velocity[friction.joint])
    return _Row({friction.joint: 1.0}, stiffness, target, friction.most)


def _limit_row(limit: Limit, state: State) -> _Row:
    """Pushes back from the nearer end."""
    low, high = limit.ends
    length = plus(*(times(share, state.position[joint]) for joint, share in limit.joints.items()))
    speed = plus(*(times(share, state.velocity[joint]) for joint, share in limit.joints.items()))
    above, below = minus(length, low), minus(high, length)
    is_low = above < below
    distance = minus(jnp.minimum(above, below), limit.margin)
    entries = {joint: jnp.where(is_low, share, -share) for joint, share in limit.joints.items()}
    reference, speed = limit.reference, jnp.where(is_low, speed, -speed)
    impedance = reference.impedance(distance)
    stiffness = jnp.where(distance < 0, reference.softness(limit.inverse_weight, impedance), 0.0)
    pull = plus(times(reference.damping, speed), times(reference.stiffness, impedance, distance))
    return _Row(entries, stiffness, minus(0.0, pull))


def _hold_rows(hold: Hold, where: Places, state: State) -> list[_Row]:
    """Three rows for the position and three for the turn, all as hard as their common length says."""
    apart, reference = welds.apartness(hold.weld, where), hold.reference
    impedance = reference.impedance(apart.length)
    softness = [reference.softness(weight, impedance) for weight in hold.inverse_weights]
    rows = []
    for index, (error, entries) in enumerate(zip(apart.errors, apart.entries, strict=True)):
        pull = plus(times(reference.damping, _speed(entries, state)), times(reference.stiffness, impedance, error))
        rows.append(_Row(entries, softness[index // 3], minus(0.0, pull)))
    return rows


def _speed(entries: dict[int, Any], state: State) -> Any:
    return plus(*(times(entry, state.velocity[joint]) for joint, entry in entries.items()))


def _contact_rows(contact: Contact, where: Places, state: State) -> list[_Row]:
    """One row along the normal, and those of friction across it; with a pyramid, one for each edge."""
    touch = capsules.touch(contact.pair, where)
    distance = minus(touch.distance, contact.margin)
    if contact.pyramid:
        return _edge_rows(contact, touch, distance, where, state)
    directions = capsules.frame_about(touch.normal) if contact.cone else (touch.normal,)
    rows = []
    for direction, weight, reference in zip(directions, contact.inverse_weights, contact.references, strict=True):
        entries = capsules.levers(contact.pair, where, direction, touch.position)
        impedance = reference.impedance(distance)
        stiffness = jnp.where(distance < 0, reference.softness(weight, impedance), 0.0)
        pull = times(reference.damping, _speed(entries, state))
        if not rows:
            pull = plus(pull, times(reference.stiffness, impedance, distance))
        rows.append(_Row(entries, stiffness, minus(0.0, pull)))
    return rows


def _edge_rows(contact: Contact, touch: capsules.Touch, distance: Any, where: Places, state: State) -> list[_Row]:
    """Two rows for each direction of friction: along the normal and, to either side, as far across as friction goes."""
    reference = contact.references[0]
    impedance = reference.impedance(distance)
    stiffness = jnp.where(distance < 0, reference.softness(contact.inverse_weights[0], impedance), 0.0)
    normal, *across = capsules.frame_about(touch.normal)
    ahead = capsules.levers(contact.pair, where, normal, touch.position)
    aside = [capsules.levers(contact.pair, where, direction, touch.position) for direction in across]
    aside = [*aside, capsules.spins(contact.pair, where, normal)][: len(contact.pyramid)]
    pull = plus(times(reference.damping, _speed(ahead, state)), times(reference.stiffness, impedance, distance))
    rows = []
    for friction, entries in zip(contact.pyramid, aside, strict=True):
        slid = {joint: times(friction, entry) for joint, entry in entries.items()}
        drag = times(reference.damping, _speed(slid, state))
        for combine in (plus, minus):
            edge = {joint: combine(entry, slid[joint]) for joint, entry in ahead.items()}
            rows.append(_Row(edge, stiffness, minus(0.0, combine(pull, drag))))
    return rows


def _clipped(number: Any, ends: tuple[float, float]) -> Any:
    """``number`` between two ends, either of which may be infinite."""
    low, high = ends
    if low > -jnp.inf:
        number = jnp.maximum(number, low)
    return jnp.minimum(number, high) if high < jnp.inf else number
