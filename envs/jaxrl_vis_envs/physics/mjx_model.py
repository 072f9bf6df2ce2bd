"""What every MJX task needs: loading its model, and states without weak types."""

import functools
import pathlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx
from mujoco.mjx._src import math, sensor, smooth

from jaxrl_vis_envs.compiling.compilation import dispatch_by_platform, targets_cpu, use_gpu_kernels
from jaxrl_vis_envs.physics import constraints, mechanism, steps, steps_kernel
from jaxrl_vis_envs.physics.kinematics import kinematics
from jaxrl_vis_envs.physics.steps import State

__all__ = [
    "kinematics",
    "load_model",
    "mjx",
    "simulate",
    "start_data",
    "step",
    "still_data",
    "take_steps",
    "tip_jacobian",
]

# With more joints, steps number by number take longer on a CPU than as matrices, and several times as long to compile.
_FEW_JOINTS = 3
_ASSETS = pathlib.Path(__file__).resolve().parents[1] / "tasks" / "assets"


def load_model(file_name: str, edit: Callable[[mujoco.MjSpec], None] | None = None) -> mujoco.MjModel:
    """The MuJoCo model of ``tasks/assets/<file_name>``, after ``edit`` has changed what was read."""
    path = str(_ASSETS / file_name)
    if edit is None:
        return mujoco.MjModel.from_xml_path(path)
    spec = mujoco.MjSpec.from_file(path)
    edit(spec)
    return spec.compile()


def put_model(mj_model: mujoco.MjModel) -> mjx.Model:
    """`mjx.put_model`, on a device of this process: by itself, MJX takes the first device of all processes."""
    return mjx.put_model(mj_model, device=jax.local_devices()[0])


def start_data(mj_model: mujoco.MjModel, mj_data: mujoco.MjData) -> mjx.Data:
    """`mjx.put_data`, on a device of this process, with a strong type on every array.

    A weakly typed ``time`` changes its type in the first step, so that everything compiles twice (mujoco issue 2306).
    """
    data = mjx.put_data(mj_model, mj_data, device=jax.local_devices()[0])
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, leaf.dtype), data)


def still_data(mj_model: mujoco.MjModel, keyframe: str | None = None) -> mjx.Data:
    """`start_data` of a keyframe of the model, or of its own initial configuration, at rest."""
    mj_data = mujoco.MjData(mj_model)
    if keyframe is not None:
        mujoco.mj_resetDataKeyframe(mj_model, mj_data, mj_model.key(keyframe).id)
    mujoco.mj_forward(mj_model, mj_data)
    return start_data(mj_model, mj_data)


def simulate(model: mjx.Model, data: mjx.Data, substeps: int, exact: bool = False, undisturbed: bool = False) -> mjx.Data:
    """``substeps`` physics steps (`take_steps`), after which every pose belongs to the final ``qpos``.

    `mjx.step` leaves the poses of the state *before* its last integration, so `kinematics` is needed once more for the
    image, the true state and ``qpos`` to agree.
    """
    return kinematics(model, take_steps(model, data, substeps, exact, undisturbed))


def take_steps(
    model: mjx.Model,
    data: mjx.Data,
    count: int,
    exact: bool = False,
    undisturbed: bool = False,
    beside_exact: bool = False,
) -> mjx.Data:
    """``count`` physics steps; poses and true states are then older than ``qpos``.

    Args:
        model: What is simulated.
        data: Its state.
        count: How many steps.
        exact: See `step`.
        undisturbed: Nothing pushes bodies (``xfrc_applied`` is 0), and no weld is turned off (``eq_active``). Models that
            `mechanism` takes are then simulated number by number where that is faster: on a GPU that runs kernels, in one
            kernel (`steps_kernel`), and on a CPU those of few joints (`steps`). Contacts between capsules are then exact in any
            case, and if more pairs touch than ``max_contact_points`` or ``max_geom_pairs``, all of them count. If something
            does disturb them, positions are not a number.
        beside_exact: For steps that are not exact in a program that also has exact ones, of a model that is the same but for
            its time step: they share a kernel then, which is compiled once.

    Returns:
        The state after them. Number by number, nothing but positions, velocities, accelerations, time and the constraints'
        forces is new.
    """
    if not (undisturbed and mechanism.takes(model)):
        return _one_by_one(model, data, count, exact)

    def by_numbers_or_not(data: mjx.Data) -> mjx.Data:
        if use_gpu_kernels(steps_kernel.probe):
            return _in_one_kernel(model, data, count, exact, beside_exact)
        if targets_cpu() and model.nv <= _FEW_JOINTS:
            return _by_numbers(model, data, count, exact)
        return _one_by_one(model, data, count, exact)

    return dispatch_by_platform(by_numbers_or_not, data)


def _one_by_one(model: mjx.Model, data: mjx.Data, count: int, exact: bool) -> mjx.Data:
    def substep(data: mjx.Data, _: Any) -> tuple[mjx.Data, None]:
        return step(model, data, exact), None

    with _full_precision():
        return jax.lax.scan(substep, data, length=count)[0]


def _in_one_kernel(
    model: mjx.Model, data: mjx.Data, count: int, exact: bool, beside_exact: bool = False, interpret: bool = False
) -> mjx.Data:
    return _with_steps(
        model, data, count, functools.partial(steps_kernel.take, exact=exact, beside_exact=beside_exact, interpret=interpret)
    )


def _by_numbers(model: mjx.Model, data: mjx.Data, count: int, exact: bool) -> mjx.Data:
    return _with_steps(model, data, count, functools.partial(steps.take_arrays, exact=exact))


def _with_steps(model: mjx.Model, data: mjx.Data, count: int, take: Callable[..., State]) -> mjx.Data:
    """The data after steps by ``take``, which has the arguments of `steps.take_arrays`."""
    constants, timestep = mechanism.mechanism_of(model), float(model.opt.timestep)
    state = State(data.qpos, data.qvel, data.qacc_warmstart, data.qfrc_constraint)
    used = np.array(constants.mocaps, int)
    mocap = jnp.concatenate([data.mocap_pos[used], data.mocap_quat[used]], axis=1) if len(used) else None
    state = take(constants, state, data.ctrl, data.qfrc_applied, timestep, count, mocap=mocap)
    is_unlike = jnp.any(data.xfrc_applied != 0)
    if constants.holds:
        is_unlike = is_unlike | ~jnp.all(data.eq_active)
    return data.replace(
        qpos=jnp.where(is_unlike, jnp.nan, state.position),
        qvel=state.velocity,
        qacc=state.acceleration,
        qacc_warmstart=state.acceleration,
        qfrc_constraint=state.force,
        time=data.time + count * model.opt.timestep,
    )


def _full_precision() -> Any:
    """Accelerators multiply float32 matrices with ten bits of mantissa unless they are told not to."""
    return jax.default_matmul_precision("highest")


@functools.partial(jax.jit, static_argnums=2)
def step(model: mjx.Model, data: mjx.Data, exact: bool = True) -> mjx.Data:
    """`mjx.step` in fewer operations; if ``exact``, with contacts and forces as exact as float32 allows.

    Jitted so that it is traced once, in however many programs it is: tracing takes as long as compiling.

    Exactness costs nearly as much again, so tasks ask for it where contacts decide. Two things are then better than in MJX.
    Its contacts between capsules lie up to .1 mm off along short capsules (it adds 1e-6 to a squared length). And its solver
    accepts a step only where it lowers the cost, and in float32 the cost cannot tell forces apart that differ by less than the
    square root of the rounding error, some 3e-4. Where large forces balance, at a joint's limit say, that is the velocity's
    first digit. One more Newton step, judged by the gradient, leaves the rounding error.
    """
    if model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER:
        data, damped = _forward(model, data, exact)
        if damped is not None:
            return constraints.euler(model, data, damped)
        return mjx.euler(model, constraints.one_factorization_at_a_time(data))
    if model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4 and model.na == 0 and model.nq == model.nv:
        return _runge_kutta_4(model, data, exact)
    return mjx.step(model, data)


def _forward(model: mjx.Model, data: mjx.Data, exact: bool) -> tuple[mjx.Data, jax.Array | None]:
    """`mjx.forward`: accelerations from positions, velocities and controls; for ``exact`` see `step`.

    With them come those with which Euler's method goes on [nv], if `constraints` takes the model.
    """
    data = smooth.com_pos(model, kinematics(model, data))
    data = smooth.crb(model, smooth.tendon(model, data))
    data = mjx.collision(model, smooth.tendon_armature(model, data))
    pairs = np.stack([model.pair_geom1, model.pair_geom2])
    if exact and np.any(np.all(model.geom_type[pairs] == mujoco.mjtGeom.mjGEOM_CAPSULE, axis=0)):
        data = _place_capsule_contacts(model, data)
    data = smooth.transmission(model, mjx.make_constraint(model, data))
    data = mjx.fwd_velocity(model, sensor.sensor_pos(model, data))
    data = mjx.fwd_actuation(model, sensor.sensor_vel(model, data))
    if constraints.takes(model):
        data, damped = constraints.solve(model, data, exact)
    else:
        data, damped = constraints.by_mjx(model, data, exact), None
    return sensor.sensor_acc(model, data), damped


def _runge_kutta_4(model: mjx.Model, data: mjx.Data, exact: bool) -> mjx.Data:
    """`mjx.step` with the classical Runge-Kutta method, for joints of one degree of freedom and actuators without a state.

    MJX's own puts four copies of the forward dynamics into the program; with one it compiles in a third of the time.
    """
    timestep, start = model.opt.timestep, data

    def stage(carry: tuple[mjx.Data, jax.Array, jax.Array], row: jax.Array) -> tuple[Any, None]:
        data, mean_velocity, mean_acceleration = carry
        reach, weight = row  # how far into the step the stage lies, and its share in the mean
        velocity = start.qvel + reach * timestep * data.qacc
        position = start.qpos + reach * timestep * data.qvel
        data = data.replace(qpos=position, qvel=velocity, time=start.time + reach * timestep)
        data, _ = _forward(model, data, exact)
        return (data, mean_velocity + weight * velocity, mean_acceleration + weight * data.qacc), None

    tableau = jnp.array([[0.0, 1 / 6], [0.5, 1 / 3], [0.5, 1 / 3], [1.0, 1 / 6]], jnp.float32)
    nothing = jnp.zeros_like(data.qvel)
    data, velocity, acceleration = jax.lax.scan(stage, (data, nothing, nothing), tableau)[0]
    return data.replace(
        qpos=start.qpos + timestep * velocity,
        qvel=start.qvel + timestep * acceleration,
        time=start.time + timestep,
        qacc_warmstart=data.qacc,
    )


def _place_capsule_contacts(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Contacts between two capsules again, at their closest points (Ericson, "Real-Time Collision Detection", 5.1.9)."""
    contact = data._impl.contact
    types = jnp.asarray(model.geom_type)[contact.geom]
    is_of_capsules = jnp.all(types == int(mujoco.mjtGeom.mjGEOM_CAPSULE), axis=-1)

    def place(geom: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        (middle_1, middle_2), (axis_1, axis_2) = data.geom_xpos[geom], data.geom_xmat[geom][:, :, 2]
        (radius_1, half_1), (radius_2, half_2) = model.geom_size[geom, :2]
        between = middle_1 - middle_2
        cosine, along_1, along_2 = axis_1 @ axis_2, axis_1 @ between, axis_2 @ between
        squared_sine = jnp.sum(jnp.square(jnp.cross(axis_1, axis_2)))
        # Of lines without end, then with the ends of one, of the other, and of the first again. 0 for parallel ones.
        at_1 = jnp.where(squared_sine > 0, (cosine * along_2 - along_1) / jnp.where(squared_sine > 0, squared_sine, 1.0), 0.0)
        at_1 = jnp.clip(at_1, -half_1, half_1)
        at_2 = jnp.clip(cosine * at_1 + along_2, -half_2, half_2)
        at_1 = jnp.clip(cosine * at_2 - along_1, -half_1, half_1)
        point_1, point_2 = middle_1 + at_1 * axis_1, middle_2 + at_2 * axis_2
        normal, length = math.normalize_with_norm(point_2 - point_1)
        distance = length - radius_1 - radius_2
        return distance, point_1 + (radius_1 + 0.5 * distance) * normal, math.make_frame(normal)

    distance, position, frame = jax.vmap(place)(jnp.asarray(contact.geom))
    contact = contact.replace(
        dist=jnp.where(is_of_capsules, distance, contact.dist),
        pos=jnp.where(is_of_capsules[:, None], position, contact.pos),
        frame=jnp.where(is_of_capsules[:, None, None], frame, contact.frame),
    )
    return data.tree_replace({"_impl.contact": contact})  # type: ignore[dict-item] - a Contact is a tree of arrays


def carriers(mj_model: mujoco.MjModel, body: int) -> np.ndarray:
    """Which joints of a tree of joints of one degree of freedom move ``body``: [nv] bool."""
    moves = np.zeros(mj_model.nv, bool)
    while body > 0:
        first, count = mj_model.body_jntadr[body], mj_model.body_jntnum[body]
        moves[first : first + count] = True
        body = mj_model.body_parentid[body]
    return moves


def tip_jacobian(mj_model: mujoco.MjModel, data: mjx.Data, sites: np.ndarray) -> jax.Array:
    """Change of the positions of ``sites`` [S] (m, world) per radian of each hinge of a tree: [nv, S, 3] float32, m/rad."""
    moves = np.stack([carriers(mj_model, mj_model.site_bodyid[site]) for site in sites], axis=1)
    arms = data.site_xpos[sites][None] - data.xanchor[:, None]
    return jnp.where(moves[..., None], jnp.cross(data.xaxis[:, None], arms), 0.0)


def point_velocity(mj_model: mujoco.MjModel, data: mjx.Data, body: int, point: jax.Array) -> jax.Array:
    """Velocity of a ``point`` [3] (m, world) that moves with ``body``, which hinges carry: [3] float32, m/s."""
    return data.qvel @ hinge_jacobian(mj_model, data, body, point)[:, :3]


def hinge_jacobian(mj_model: mujoco.MjModel, data: mjx.Data, body: int, point: jax.Array) -> jax.Array:
    """Change of a ``point`` [3] (m, world) of ``body`` (m/rad), and its turn, per radian of each hinge: [nv, 6] float32."""
    moves = carriers(mj_model, body)[:, None]
    return jnp.where(moves, jnp.concatenate([jnp.cross(data.xaxis, point - data.xanchor), data.xaxis], axis=1), 0.0)
