"""Physics steps with boxes: positions and velocities from one physics step to the next, with one contact per lane."""

from typing import Any

import jax
import jax.numpy as jnp

from jaxrl_vis_envs.physics.scalar import links, quaternions, steps
from jaxrl_vis_envs.physics.scalar.boxes import lane_newton, lane_rows
from jaxrl_vis_envs.physics.scalar.boxes.box_model import BoxModel, FreeBody, LaneContacts, with_rows
from jaxrl_vis_envs.physics.scalar.boxes.lane_newton import LaneProblem
from jaxrl_vis_envs.physics.scalar.dynamics import Pose
from jaxrl_vis_envs.physics.scalar.link_frames import MocapPose, mocap_poses
from jaxrl_vis_envs.physics.scalar.partial_arithmetic import cross, dot, minus, plus, sine_and_cosine, times
from jaxrl_vis_envs.physics.scalar.sparse_algebra import Column, solve_positive
from jaxrl_vis_envs.physics.scalar.steps import JointState, StepInputs


def simulate(
    model: BoxModel,
    table: list[Any],
    state: JointState,
    control: Column,
    applied: Column,
    timestep: float,
    count: int,
    mocap: Column,
) -> JointState:
    """Take ``count`` physics steps with constant controls. All scalars are arrays with 32 lanes as their last axis.

    Args:
        model: Constants of the model.
        table: Rows of ``model.table``.
        state: State before the steps: qpos of the joints and of the free body, and one scalar per degree of freedom.
        control: One scalar per actuator.
        applied: Applied forces, N m or N.
        timestep: Time step, s.
        count: Number of steps.
        mocap: Seven scalars for each of the tree's ``mocaps``: position, m, and a quaternion of any norm.

    Returns:
        The state after the steps.
    """
    contacts: LaneContacts = with_rows(model.contacts, table)
    tree = model.tree
    control = steps.clip_controls(tree, control)
    poses = mocap_poses(tuple(links.mocap_link(index) for index in tree.mocaps), mocap)
    inputs = StepInputs(timestep, control, applied, poses)

    def advance(_: Any, state: JointState) -> JointState:
        return _step(model, contacts, state, inputs)

    return jax.lax.fori_loop(0, count, advance, state)


def _step(model: BoxModel, contacts: LaneContacts, state: JointState, inputs: StepInputs) -> JointState:
    """Take one step of Euler's method, semi-implicit in the velocity and implicit in the damping."""
    tree, body, timestep = model.tree, model.body, inputs.timestep
    joints = len(tree.links)
    origin, quaternion = state.position[joints : joints + 3], state.position[joints + 3 :]
    free = links.mocap_link(model.free_index)
    pose = _free_pose(origin, quaternion)
    own = StepInputs(timestep, inputs.control, inputs.applied[:joints], {**inputs.mocap, free: pose})
    before = JointState(*(part[:joints] for part in state))
    dynamics = steps.tree_state(tree, before, own)
    mass = dict(dynamics.mass) | {(joints + part, joints + part): number for part, number in enumerate(body.mass)}
    pull = _free_forces(body, state.velocity[joints:], inputs.applied[joints:])
    force = [*dynamics.force, *pull]
    accelerations = [*solve_positive(dynamics.mass, dynamics.force), *(f / m for f, m in zip(pull, body.mass, strict=True))]
    problem = LaneProblem(
        mass=_as_arrays(mass, force[0]),
        force=force,
        jacobian=[row.entries for row in dynamics.rows],
        stiffness=[row.stiffness for row in dynamics.rows],
        target=[row.target for row in dynamics.rows],
        equalities=dynamics.equalities,
        contacts=lane_rows.contact_rows(model, contacts, dynamics.frames, state.velocity, free),
        coupled=model.coupled,
    )
    warm = state.acceleration if tree.warm_start else []
    acceleration, constraint = lane_newton.solve(problem, accelerations, warm, tree.iterations)
    pushed = [one + other for one, other in zip(force, constraint, strict=True)]
    damped_mass = dict(dynamics.mass)
    for joint, damping in enumerate(tree.damping):
        damped_mass[joint, joint] = plus(damped_mass[joint, joint], times(timestep, damping))
    inertias = [number + timestep * damping for number, damping in zip(body.mass, body.damping, strict=True)]
    damped = [*solve_positive(damped_mass, pushed[:joints]), *(f / m for f, m in zip(pushed[joints:], inertias, strict=True))]
    velocity = [rate + timestep * change for rate, change in zip(state.velocity, damped, strict=True)]
    moved = [start + timestep * rate for start, rate in zip(state.position, velocity[: joints + 3], strict=False)]
    position = [*moved, *_integrate_quaternion(quaternion, velocity[joints + 3 :], timestep)]
    return JointState(position, velocity, acceleration, constraint)


def _free_pose(position: Column, quaternion: Column) -> MocapPose:
    unit_quaternion = quaternions.normalize(quaternion)
    return MocapPose(Pose((position[0], position[1], position[2]), quaternions.rotation_axes(unit_quaternion)), unit_quaternion)


def _free_forces(body: FreeBody, velocity: Column, applied: Column) -> Column:
    """Return the forces on the free body without constraints, in the world, and torques, about its own axes."""
    omega = (velocity[3], velocity[4], velocity[5])
    x, y, z = (times(inertia, rate) for inertia, rate in zip(body.inertia, omega, strict=True))
    loads = [*body.weight, *(minus(0.0, part) for part in _gyroscopic(body, omega, (x, y, z)))]
    drags = [times(damping, rate) for damping, rate in zip(body.damping, velocity, strict=True)]
    return [minus(plus(load, push), drag) for load, push, drag in zip(loads, applied, drags, strict=True)]


def _gyroscopic(body: FreeBody, omega: tuple, momentum: tuple) -> tuple:
    if len(set(body.inertia)) == 1:
        return 0.0, 0.0, 0.0
    return cross(omega, momentum)


def _integrate_quaternion(quaternion: Column, omega: Column, timestep: float) -> Column:
    """Return the quaternion a time step later, at a constant angular velocity (rad/s) about the body's own axes."""
    axis = (omega[0], omega[1], omega[2])
    square = dot(axis, axis)
    norm = jnp.sqrt(square)
    inverse = 1.0 / jnp.where(norm > 0, norm, 1.0)
    sine, cosine = sine_and_cosine(0.5 * timestep * norm)
    step = (cosine, *(part * inverse * sine for part in axis))
    return list(quaternions.normalize(quaternions.multiply(tuple(quaternion), step)))  # type: ignore[arg-type] - of four


def _as_arrays(matrix: dict, like: Any) -> dict:
    """Convert known numbers to arrays, which loops can carry."""
    return {key: 0.0 * like + value if isinstance(value, float) else value for key, value in matrix.items()}
