"""Physics steps in scalars: joint positions and velocities from one physics step to the next.

As matrices, a step is a hundred operations that each take a GPU longer to start than to run; as scalars, all of them fit into
one kernel (`steps_kernel`). All properties of the model are constants (`scalar_model`).
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxrl_vis_envs.physics.scalar import contacts, dynamics, link_frames, links, scalar_model, welds
from jaxrl_vis_envs.physics.scalar.dynamics import JointTransform
from jaxrl_vis_envs.physics.scalar.link_frames import LinkFrames, MocapPose
from jaxrl_vis_envs.physics.scalar.partial_arithmetic import minus, plus, times
from jaxrl_vis_envs.physics.scalar.scalar_model import (
    ContactConstraint,
    FrictionConstraint,
    LimitConstraint,
    ScalarModel,
    WeldConstraint,
)
from jaxrl_vis_envs.physics.scalar.solver import scalar_newton
from jaxrl_vis_envs.physics.scalar.solver.scalar_newton import Problem
from jaxrl_vis_envs.physics.scalar.sparse_algebra import Column, Matrix, Row


class JointState(NamedTuple):
    """State before and after a step: one scalar per joint, or arrays of them.

    Attributes:
        position: Joint positions, rad or m.
        velocity: Joint velocities, rad/s or m/s.
        acceleration: Accelerations in the last step, the solver's warm start, rad/s^2 or m/s^2.
        force: Constraint forces on the joints in the last step, N m or N.
    """

    position: Any
    velocity: Any
    acceleration: Any
    force: Any


class StepInputs(NamedTuple):
    """Inputs that stay the same from step to step.

    Attributes:
        timestep: Time step, s.
        control: Controls of the actuators, clipped to their bounds.
        applied: Applied forces on the joints, N m or N.
        mocap: Poses of the mocap bodies, by link.
    """

    timestep: Any
    control: Column
    applied: Column
    mocap: dict[int, MocapPose]


class ConstraintRow(NamedTuple):
    """Row of a `scalar_newton.Problem`: ``jacobian`` entries and fields of that name; ``max_friction`` for dry friction."""

    entries: Row
    stiffness: Any
    target: Any
    max_friction: Any = None


def simulate(
    constants: ScalarModel,
    state: JointState,
    control: Column,
    applied: Column,
    timestep: Any,
    count: Any,
    exact: Any,
    in_kernel: bool = False,
    mocap: Sequence[Any] = (),
) -> JointState:
    """Take ``count`` physics steps with constant controls.

    ``timestep``, ``count`` and ``exact`` may be known only at run time; one program then serves all their values.

    Args:
        constants: Constants of the model.
        state: State before the steps.
        control: One scalar per actuator.
        applied: Applied forces on the joints, N m or N.
        timestep: Time step, s.
        count: Number of steps, an int or an int32 scalar.
        exact: Make forces as exact as float32 allows (see `mjx_model.step`), a bool or an int32 scalar, 1 or 0. Contacts are
            always exact.
        in_kernel: Generate code for a GPU kernel (see `scalar_newton.solve`).
        mocap: Seven scalars for each of ``constants.mocaps``: position, m, and a quaternion of any norm.

    Returns:
        The state after the steps.
    """
    control = clip_controls(constants, control)
    poses = link_frames.mocap_poses(tuple(links.mocap_link(index) for index in constants.mocaps), list(mocap))
    inputs = StepInputs(timestep, control, applied, poses)

    take_step = _runge_kutta_step if constants.runge_kutta else _euler_step

    def advance(_: Any, state: JointState) -> JointState:
        return take_step(constants, state, inputs, exact, in_kernel)

    return jax.lax.fori_loop(0, count, advance, state)


def clip_controls(constants: ScalarModel, control: Column) -> Column:
    """Clip the controls, one per actuator, to their bounds."""
    bounds = [actuator.control_bounds for actuator in constants.actuators]
    return [_clip(number, pair) for number, pair in zip(control, bounds, strict=True)]


def simulate_arrays(
    constants: ScalarModel,
    state: JointState,
    control: jax.Array,
    applied: jax.Array,
    timestep: float,
    count: int,
    exact: bool | None,
    mocap: jax.Array | None = None,
) -> JointState:
    """Call `simulate` with float32 arrays, outside of kernels: [N] each for N joints, controls [nu], mocap bodies [M, 7]."""
    start = JointState(*map(list, state))
    poses = [] if mocap is None else list(mocap.reshape(-1))
    end = simulate(constants, start, list(control), list(applied), timestep, count, bool(exact), mocap=poses)
    return JointState(*map(jnp.stack, end))


def _euler_step(constants: ScalarModel, state: JointState, inputs: StepInputs, exact: Any, in_kernel: bool) -> JointState:
    """Take one step of Euler's method, semi-implicit in the velocity and implicit in the damping."""
    damped, acceleration, force = _accelerations(constants, state, inputs, exact, in_kernel)
    timestep = inputs.timestep
    velocity = [rate + timestep * change for rate, change in zip(state.velocity, damped, strict=True)]
    position = [start + timestep * rate for start, rate in zip(state.position, velocity, strict=True)]
    return JointState(position, velocity, acceleration, force)


def _runge_kutta_step(constants: ScalarModel, state: JointState, inputs: StepInputs, exact: Any, in_kernel: bool) -> JointState:
    """Take one step of the classical Runge-Kutta method.

    Each of the four stages solves the constraints anew, from the warm start of the whole step. The stages are a loop, so that
    the program contains one copy of the forward dynamics.
    """
    zeros = [0.0 * number for number in state.position]

    def stage(index: Any, carry: tuple[JointState, Column, Column]) -> tuple[JointState, Column, Column]:
        previous, mean_velocity, mean_acceleration = carry
        half_steps = (index + 1) >> 1  # 0, 1, 1, 2; Pallas does not lower selections between scalars for Triton
        weight = (1 + half_steps * (2 - half_steps)) * (1.0 / 6.0)
        elapsed = (0.5 * half_steps) * inputs.timestep
        velocity = [start + elapsed * change for start, change in zip(state.velocity, previous.acceleration, strict=True)]
        position = [start + elapsed * rate for start, rate in zip(state.position, previous.velocity, strict=True)]
        current = JointState(position, velocity, state.acceleration, state.force)
        _, acceleration, force = _accelerations(constants, current, inputs, exact, in_kernel)
        mean_velocity = [mean + weight * rate for mean, rate in zip(mean_velocity, velocity, strict=True)]
        mean_acceleration = [mean + weight * change for mean, change in zip(mean_acceleration, acceleration, strict=True)]
        return JointState(position, velocity, acceleration, force), mean_velocity, mean_acceleration

    # The first stage multiplies these derivatives by 0.
    start = JointState(state.position, state.velocity, zeros, zeros)
    last, mean_velocity, mean_acceleration = jax.lax.fori_loop(0, 4, stage, (start, zeros, zeros))
    position = [start + inputs.timestep * rate for start, rate in zip(state.position, mean_velocity, strict=True)]
    velocity = [start + inputs.timestep * change for start, change in zip(state.velocity, mean_acceleration, strict=True)]
    return JointState(position, velocity, last.acceleration, last.force)


def _accelerations(
    constants: ScalarModel, state: JointState, inputs: StepInputs, exact: Any, in_kernel: bool
) -> tuple[Column, Column, Column]:
    """Return the damped accelerations, the accelerations and the constraint forces of all joints."""
    problem, order = constraint_problem(constants, state, inputs)
    solution = scalar_newton.solve(problem, constants.iterations, exact, in_kernel)
    place = {joint: index for index, joint in enumerate(order)}
    damped, acceleration, force = (
        [part[place[joint]] for joint in range(len(order))] for part in (solution.damped, solution.acceleration, solution.force)
    )
    return damped, acceleration, force


class TreeState(NamedTuple):
    """Dynamics of the joints before contacts.

    Attributes:
        mass: Mass matrix, nonzero entries on and below the diagonal.
        force: Forces on the joints without constraints.
        rows: Constraint rows: welds, dry friction, limits.
        equalities: Number of rows of welds.
        frames: Frames of links and joints.
    """

    mass: Matrix
    force: Column
    rows: list[ConstraintRow]
    equalities: int
    frames: LinkFrames


def tree_state(constants: ScalarModel, state: JointState, inputs: StepInputs) -> TreeState:
    """Return the dynamics of the joints before contacts."""
    displacement = [minus(position, rest) for position, rest in zip(state.position, constants.rest, strict=True)]
    welded = {
        joint
        for constraint in constants.welds
        for frame in constraint.weld.frames
        for joint in links.ancestor_joints(constants.links, frame.link)
    }
    joints = dynamics.joint_transforms(constants.links, displacement, welded)
    mass = dynamics.mass_matrix(constants.links, joints)
    for joint, armature in enumerate(constants.armature):
        mass[joint, joint] = plus(mass[joint, joint], armature)
    for coefficients, armature in constants.tendon_masses:
        _add_tendon(mass, coefficients, armature)
    frames = LinkFrames(constants.links, joints, scalar_model.base_link(constants), inputs.mocap)
    rows = [row for weld in constants.welds for row in _weld_rows(weld, frames, state)]
    equalities = len(rows)
    rows += [_friction_row(friction, state) for friction in constants.frictions]
    rows += [_limit_row(limit, state) for limit in constants.limits]
    return TreeState(mass, _smooth_forces(constants, state, joints, inputs), rows, equalities, frames)


def constraint_problem(constants: ScalarModel, state: JointState, inputs: StepInputs) -> tuple[Problem, list[int]]:
    """Return the constraint problem of one step, and the joint at each index of the problem.

    The joints are reordered for little fill-in when the problem's matrices are factorized from the last row up.
    """
    mass, force, rows, equalities, frames = tree_state(constants, state, inputs)
    cones = {}
    for contact in constants.contacts:
        if contact.cone:
            cones[len(rows)] = contact.cone
        rows += _contact_rows(contact, frames, state)
    order = elimination_order(len(force), list(mass), [tuple(row.entries) for row in rows])
    place = {joint: index for index, joint in enumerate(order)}
    problem = Problem(
        mass={_below_diagonal(place[one], place[other]): number for (one, other), number in mass.items()},
        force=[force[joint] for joint in order],
        warm=[state.acceleration[joint] for joint in order] if constants.warm_start else [],
        damping=[] if constants.runge_kutta else [times(inputs.timestep, constants.damping[joint]) for joint in order],
        jacobian=[{place[joint]: entry for joint, entry in row.entries.items()} for row in rows],
        stiffness=[row.stiffness for row in rows],
        target=[row.target for row in rows],
        equalities=equalities,
        max_friction={index: row.max_friction for index, row in enumerate(rows) if row.max_friction is not None},
        cones=cones,
    )
    return problem, order


def elimination_order(size: int, mass: list[tuple[int, int]], rows: list[tuple[int, ...]]) -> list[int]:
    """Order joints greedily for little fill-in when a matrix is factorized from the last row up.

    Args:
        size: Number of joints.
        mass: Nonzero entries of the mass matrix, (joint, ancestor) and others. Joints come after their ancestors; in that
            order, the mass matrix alone has no fill-in.
        rows: Joints that each constraint couples.
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
        coupled = neighbours[joint] & left
        for other in coupled:
            neighbours[other] |= coupled - {other}
    return backwards[::-1]


def _below_diagonal(row: int, column: int) -> tuple[int, int]:
    return (row, column) if row > column else (column, row)


def _add_tendon(mass: Matrix, coefficients: dict[int, float], armature: float) -> None:
    """Add the armature of a tendon to the mass matrix."""
    if armature == 0.0:
        return
    for one, coefficient in coefficients.items():
        for other, factor in coefficients.items():
            if other <= one:
                mass[one, other] = plus(mass.get((one, other), 0.0), armature * coefficient * factor)


def _smooth_forces(constants: ScalarModel, state: JointState, joints: list[JointTransform], inputs: StepInputs) -> Column:
    """Return the forces on the joints without constraints."""
    poses = {link: body.pose for link, body in inputs.mocap.items()}
    bias = dynamics.bias_forces(constants.links, joints, state.velocity, constants.gravity, poses)
    forces = []
    for joint, (position, rate) in enumerate(zip(state.position, state.velocity, strict=True)):
        stiffness, rest = constants.springs[joint]
        spring = times(stiffness, minus(position, rest)) if stiffness else 0.0
        passive = plus(spring, times(constants.damping[joint], rate))
        forces.append(minus(minus(inputs.applied[joint], bias[joint]), passive))
    for actuator, signal in zip(constants.actuators, inputs.control, strict=True):
        length = times(actuator.gear, state.position[actuator.joint])
        speed = times(actuator.gear, state.velocity[actuator.joint])
        gain, bias_force = (
            plus(level, times(slope, length), times(drag, speed)) for level, slope, drag in (actuator.gain, actuator.bias)
        )
        force = _clip(plus(times(gain, signal), bias_force), actuator.force_bounds)
        forces[actuator.joint] = plus(forces[actuator.joint], times(actuator.gear, force))
    return forces


def _friction_row(friction: FrictionConstraint, state: JointState) -> ConstraintRow:
    softness = friction.softness
    stiffness = softness.row_stiffness(friction.inverse_weight, softness.impedance(0.0))
    target = times(-softness.damping, state.velocity[friction.joint])
    return ConstraintRow({friction.joint: 1.0}, stiffness, target, friction.max_force)


def _limit_row(limit: LimitConstraint, state: JointState) -> ConstraintRow:
    """Return the row of the nearer bound."""
    low, high = limit.bounds
    length = plus(*(times(coefficient, state.position[joint]) for joint, coefficient in limit.joints.items()))
    speed = plus(*(times(coefficient, state.velocity[joint]) for joint, coefficient in limit.joints.items()))
    above, below = minus(length, low), minus(high, length)
    is_low = above < below
    distance = minus(jnp.minimum(above, below), limit.margin)
    entries = {joint: jnp.where(is_low, coefficient, -coefficient) for joint, coefficient in limit.joints.items()}
    softness, speed = limit.softness, jnp.where(is_low, speed, -speed)
    impedance = softness.impedance(distance)
    stiffness = jnp.where(distance < 0, softness.row_stiffness(limit.inverse_weight, impedance), 0.0)
    pull = plus(times(softness.damping, speed), times(softness.stiffness, impedance, distance))
    return ConstraintRow(entries, stiffness, minus(0.0, pull))


def _weld_rows(constraint: WeldConstraint, frames: LinkFrames, state: JointState) -> list[ConstraintRow]:
    """Return three position rows and three rotation rows, with one impedance at the norm of all six errors."""
    residual, softness = welds.weld_residual(constraint.weld, frames), constraint.softness
    impedance = softness.impedance(residual.norm)
    stiffness = [softness.row_stiffness(weight, impedance) for weight in constraint.inverse_weights]
    rows = []
    for index, (error, entries) in enumerate(zip(residual.errors, residual.entries, strict=True)):
        pull = plus(times(softness.damping, _speed(entries, state)), times(softness.stiffness, impedance, error))
        rows.append(ConstraintRow(entries, stiffness[index // 3], minus(0.0, pull)))
    return rows


def _speed(entries: Row, state: JointState) -> Any:
    return plus(*(times(entry, state.velocity[joint]) for joint, entry in entries.items()))


def _contact_rows(contact: ContactConstraint, frames: LinkFrames, state: JointState) -> list[ConstraintRow]:
    """Return a row along the normal and, with an elliptic cone, rows along the tangents; with a pyramid, a row per edge."""
    point = contacts.contact_point(contact.pair, frames)
    distance = minus(point.distance, contact.margin)
    if contact.pyramid:
        return _edge_rows(contact, point, distance, frames, state)
    directions = contacts.contact_axes(point.normal) if contact.cone else (point.normal,)
    rows = []
    for direction, weight, softness in zip(directions, contact.inverse_weights, contact.softness, strict=True):
        entries = contacts.translation_jacobian(contact.pair, frames, direction, point.position)
        impedance = softness.impedance(distance)
        stiffness = jnp.where(distance < 0, softness.row_stiffness(weight, impedance), 0.0)
        pull = times(softness.damping, _speed(entries, state))
        if not rows:
            pull = plus(pull, times(softness.stiffness, impedance, distance))
        rows.append(ConstraintRow(entries, stiffness, minus(0.0, pull)))
    return rows


def _edge_rows(
    contact: ContactConstraint, point: contacts.ContactPoint, distance: Any, frames: LinkFrames, state: JointState
) -> list[ConstraintRow]:
    """Return two rows per direction of friction: the normal plus and minus friction times the tangent or torsional
    direction.
    """
    softness = contact.softness[0]
    impedance = softness.impedance(distance)
    stiffness = jnp.where(distance < 0, softness.row_stiffness(contact.inverse_weights[0], impedance), 0.0)
    normal, *across = contacts.contact_axes(point.normal)
    ahead = contacts.translation_jacobian(contact.pair, frames, normal, point.position)
    aside = [contacts.translation_jacobian(contact.pair, frames, direction, point.position) for direction in across]
    aside = [*aside, contacts.rotation_jacobian(contact.pair, frames, normal)][: len(contact.pyramid)]
    pull = plus(times(softness.damping, _speed(ahead, state)), times(softness.stiffness, impedance, distance))
    rows = []
    for friction, entries in zip(contact.pyramid, aside, strict=True):
        tangential = {joint: times(friction, entry) for joint, entry in entries.items()}
        drag = times(softness.damping, _speed(tangential, state))
        for combine in (plus, minus):
            edge = {joint: combine(entry, tangential[joint]) for joint, entry in ahead.items()}
            rows.append(ConstraintRow(edge, stiffness, minus(0.0, combine(pull, drag))))
    return rows


def _clip(number: Any, bounds: tuple[float, float]) -> Any:
    """Clip to two bounds, either of which may be infinite."""
    low, high = bounds
    if low > -jnp.inf:
        number = jnp.maximum(number, low)
    return jnp.minimum(number, high) if high < jnp.inf else number
