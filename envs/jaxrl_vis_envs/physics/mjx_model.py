"""The MJX engine: loading models, stepping them, and Jacobians.

`take_steps` and `simulate` use the scalar engine where it is faster.
"""

import functools
import pathlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx
from mujoco.mjx._src import sensor, smooth

from jaxrl_vis_envs.compiling.compilation import dispatch_by_platform, targets_cpu, use_gpu_kernels
from jaxrl_vis_envs.physics import box_contacts, constraints, newton, rotations, scalar
from jaxrl_vis_envs.physics.kinematics import kinematics

__all__ = [
    "kinematics",
    "load_model",
    "mjx",
    "rest_data",
    "simulate",
    "start_data",
    "step",
    "take_steps",
    "tip_jacobian",
]

# With more joints, the scalar engine is slower than MJX on a CPU, and takes several times as long to compile.
_MAX_SCALAR_JOINTS_ON_CPU = 3
_ASSETS = pathlib.Path(__file__).resolve().parents[1] / "tasks" / "assets"


def load_model(file_name: str, edit: Callable[[mujoco.MjSpec], None] | None = None) -> mujoco.MjModel:
    """Load ``tasks/assets/<file_name>``, optionally after ``edit`` has modified its `mujoco.MjSpec`."""
    path = str(_ASSETS / file_name)
    if edit is None:
        return mujoco.MjModel.from_xml_path(path)
    spec = mujoco.MjSpec.from_file(path)
    edit(spec)
    return spec.compile()


def put_model(mj_model: mujoco.MjModel) -> mjx.Model:
    """Call `mjx.put_model` for a device of this process; by default MJX takes the first device of all processes."""
    return mjx.put_model(mj_model, device=jax.local_devices()[0])


def start_data(mj_model: mujoco.MjModel, mj_data: mujoco.MjData) -> mjx.Data:
    """Call `mjx.put_data` for a device of this process, and convert weakly typed arrays to strong types.

    A weakly typed ``time`` changes its type in the first step, so that programs compile twice (mujoco issue 2306).
    """
    data = mjx.put_data(mj_model, mj_data, device=jax.local_devices()[0])
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, leaf.dtype), data)


def rest_data(mj_model: mujoco.MjModel, keyframe: str | None = None) -> mjx.Data:
    """Return `start_data` at a ``keyframe`` of the model, or, if None, at rest at its initial configuration."""
    mj_data = mujoco.MjData(mj_model)
    if keyframe is not None:
        mujoco.mj_resetDataKeyframe(mj_model, mj_data, mj_model.key(keyframe).id)
    mujoco.mj_forward(mj_model, mj_data)
    return start_data(mj_model, mj_data)


def simulate(model: mjx.Model, data: mjx.Data, substeps: int, exact: bool | None = None, disturbed: bool = False) -> mjx.Data:
    """Take ``substeps`` physics steps (`take_steps`) and compute all poses at the final ``qpos``.

    `mjx.step` leaves the poses at the state *before* its last integration, so `kinematics` is needed once more for the image,
    the true state and ``qpos`` to agree.
    """
    return kinematics(model, take_steps(model, data, substeps, exact, disturbed))


def take_steps(model: mjx.Model, data: mjx.Data, count: int, exact: bool | None = None, disturbed: bool = False) -> mjx.Data:
    """Take ``count`` physics steps. Poses are then stale: older than ``qpos``.

    Models that the scalar engine supports are simulated by it where it is faster: on NVIDIA GPUs, and on CPUs those of up to
    three joints that `newton` does not support. Contacts between capsules are then always exact, contacts beyond
    ``max_contact_points`` and ``max_geom_pairs`` count as well, and only positions, velocities, accelerations, constraint
    forces on the joints and the time are updated.

    Args:
        model: The model.
        data: Its state.
        count: Number of steps.
        exact: Make contacts and forces as exact as float32 allows (see `step`). False and None both disable this. With False,
            the GPU kernel is shared with exact steps in the same program of a model that differs in its time step only, and
            compiled once; with None, the kernel cannot take exact steps and is smaller. Exact steps of models with boxes are
            always MJX's.
        disturbed: True if bodies are pushed (``xfrc_applied`` is not 0) or welds are switched off (``eq_active``), which the
            scalar engine does not support; MJX then takes the steps on all platforms. If a state is disturbed although this is
            False, the scalar engine sets its ``qpos`` to NaN.
    """
    if disturbed or not scalar.supports(model, exact):
        return _take_mjx_steps(model, data, count, bool(exact))

    def dispatch(data: mjx.Data) -> mjx.Data:
        if prefers_scalar_engine(model):
            return scalar.simulate(model, data, count, exact)
        return _take_mjx_steps(model, data, count, bool(exact))

    return dispatch_by_platform(dispatch, data)


def prefers_scalar_engine(model: mjx.Model) -> bool:
    """Return True if the scalar engine is faster than MJX for a model that it supports, on the platform traced for."""
    if targets_cpu():
        return model.nv <= _MAX_SCALAR_JOINTS_ON_CPU and not newton.supports(model)
    return use_gpu_kernels(scalar.probe_of(model))


def _take_mjx_steps(model: mjx.Model, data: mjx.Data, count: int, exact: bool) -> mjx.Data:
    def substep(data: mjx.Data, _: Any) -> tuple[mjx.Data, None]:
        return step(model, data, exact), None

    with _full_precision():
        return jax.lax.scan(substep, data, length=count)[0]


def _full_precision() -> Any:
    """Return a context in which accelerators multiply float32 matrices with all bits of the mantissa, not ten."""
    return jax.default_matmul_precision("highest")


@functools.partial(jax.jit, static_argnums=2)
def step(model: mjx.Model, data: mjx.Data, exact: bool = True) -> mjx.Data:
    """Take one physics step as `mjx.step` does, in fewer operations; if ``exact``, as exactly as float32 allows.

    The function is jitted so that it is traced once for all programs that contain it: tracing takes as long as compiling.

    Exact steps cost nearly twice as much and improve on MJX in two respects. MJX's contacts between capsules lie up to .1 mm
    off along short capsules (it adds 1e-6 to a squared length). And its solver accepts a step only if the cost decreases, but a
    float32 cost does not resolve forces that differ by less than the square root of the rounding error, some 3e-4: where large
    forces balance, as at a joint's limit, that is the velocity's first digit. One more Newton step, accepted by the gradient,
    reduces this to the rounding error.
    """
    if model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER:
        return constraints.euler(model, _forward(model, data, exact))
    if model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4 and model.na == 0 and model.nq == model.nv:
        return _runge_kutta_4(model, data, exact)
    return mjx.step(model, data)


def _forward(model: mjx.Model, data: mjx.Data, exact: bool) -> mjx.Data:
    """Compute accelerations from positions, velocities and controls, as `mjx.forward` does; for ``exact`` see `step`."""
    data = smooth.com_pos(model, kinematics(model, data))
    data = smooth.crb(model, smooth.tendon(model, data))
    data = smooth.tendon_armature(model, data)
    data = box_contacts.collide(model, data) if box_contacts.supports(model) else mjx.collision(model, data)
    pairs = np.stack([model.pair_geom1, model.pair_geom2])
    if exact and np.any(np.all(model.geom_type[pairs] == mujoco.mjtGeom.mjGEOM_CAPSULE, axis=0)):
        data = _place_capsule_contacts(model, data)
    data = smooth.transmission(model, mjx.make_constraint(model, data))
    data = mjx.fwd_velocity(model, sensor.sensor_pos(model, data))
    data = mjx.fwd_actuation(model, sensor.sensor_vel(model, data))
    return sensor.sensor_acc(model, constraints.solve(model, data, exact))


def _runge_kutta_4(model: mjx.Model, data: mjx.Data, exact: bool) -> mjx.Data:
    """Take one step of the classical Runge-Kutta method, for hinges, slides and actuators without activation.

    MJX's own method puts four copies of the forward dynamics into the program; with one it compiles in a third of the time.
    """
    timestep, start = model.opt.timestep, data

    def stage(carry: tuple[mjx.Data, jax.Array, jax.Array], row: jax.Array) -> tuple[Any, None]:
        data, mean_velocity, mean_acceleration = carry
        fraction, weight = row  # elapsed fraction of the step, and weight in the mean
        velocity = start.qvel + fraction * timestep * data.qacc
        position = start.qpos + fraction * timestep * data.qvel
        data = data.replace(qpos=position, qvel=velocity, time=start.time + fraction * timestep)
        data = _forward(model, data, exact)
        return (data, mean_velocity + weight * velocity, mean_acceleration + weight * data.qacc), None

    tableau = jnp.array([[0.0, 1 / 6], [0.5, 1 / 3], [0.5, 1 / 3], [1.0, 1 / 6]], jnp.float32)
    zeros = jnp.zeros_like(data.qvel)
    data, velocity, acceleration = jax.lax.scan(stage, (data, zeros, zeros), tableau)[0]
    return data.replace(
        qpos=start.qpos + timestep * velocity,
        qvel=start.qvel + timestep * acceleration,
        time=start.time + timestep,
        qacc_warmstart=data.qacc,
    )


def _place_capsule_contacts(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Recompute contacts between capsules at their closest points (Ericson, "Real-Time Collision Detection", 5.1.9)."""
    contact = data._impl.contact
    types = jnp.asarray(model.geom_type)[contact.geom]
    is_of_capsules = jnp.all(types == int(mujoco.mjtGeom.mjGEOM_CAPSULE), axis=-1)

    def closest_points(geom: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        (middle_1, middle_2), (axis_1, axis_2) = data.geom_xpos[geom], data.geom_xmat[geom][:, :, 2]
        (radius_1, half_1), (radius_2, half_2) = model.geom_size[geom, :2]
        between = middle_1 - middle_2
        cosine, along_1, along_2 = axis_1 @ axis_2, axis_1 @ between, axis_2 @ between
        squared_sine = jnp.sum(jnp.square(jnp.cross(axis_1, axis_2)))
        # Closest points of infinite lines, clipped to the first segment, to the second, and to the first again; 0 if parallel.
        at_1 = jnp.where(squared_sine > 0, (cosine * along_2 - along_1) / jnp.where(squared_sine > 0, squared_sine, 1.0), 0.0)
        at_1 = jnp.clip(at_1, -half_1, half_1)
        at_2 = jnp.clip(cosine * at_1 + along_2, -half_2, half_2)
        at_1 = jnp.clip(cosine * at_2 - along_1, -half_1, half_1)
        point_1, point_2 = middle_1 + at_1 * axis_1, middle_2 + at_2 * axis_2
        normal, length = rotations.normalize_with_norm(point_2 - point_1)
        distance = length - radius_1 - radius_2
        return distance, point_1 + (radius_1 + 0.5 * distance) * normal, rotations.make_frame(normal)

    distance, position, frame = jax.vmap(closest_points)(jnp.asarray(contact.geom))
    contact = contact.replace(
        dist=jnp.where(is_of_capsules, distance, contact.dist),
        pos=jnp.where(is_of_capsules[:, None], position, contact.pos),
        frame=jnp.where(is_of_capsules[:, None, None], frame, contact.frame),
    )
    return data.tree_replace({"_impl.contact": contact})  # type: ignore[dict-item] - a Contact is a tree of arrays


def ancestor_joints(mj_model: mujoco.MjModel, body: int) -> np.ndarray:
    """Return a mask of the hinges and slides that move ``body``: [nv] bool."""
    moves = np.zeros(mj_model.nv, bool)
    while body > 0:
        first, count = mj_model.body_jntadr[body], mj_model.body_jntnum[body]
        moves[first : first + count] = True
        body = mj_model.body_parentid[body]
    return moves


def tip_jacobian(mj_model: mujoco.MjModel, data: mjx.Data, sites: np.ndarray) -> jax.Array:
    """Return the derivative of the positions of ``sites`` [S] (world) with respect to each hinge: [nv, S, 3] float32, m/rad."""
    moves = np.stack([ancestor_joints(mj_model, mj_model.site_bodyid[site]) for site in sites], axis=1)
    arms = data.site_xpos[sites][None] - data.xanchor[:, None]
    return jnp.where(moves[..., None], jnp.cross(data.xaxis[:, None], arms), 0.0)


def point_velocity(mj_model: mujoco.MjModel, data: mjx.Data, body: int, point: jax.Array) -> jax.Array:
    """Return the velocity of a ``point`` [3] (m, world) fixed to ``body``, which hinges move: [3] float32, m/s."""
    return data.qvel @ hinge_jacobian(mj_model, data, body, point)[:, :3]


def hinge_jacobian(mj_model: mujoco.MjModel, data: mjx.Data, body: int, point: jax.Array) -> jax.Array:
    """Return the derivatives of a ``point`` [3] (m, world) on ``body`` and of the body's rotation with respect to each hinge.

    Returns:
        [nv, 6] float32: translations (m/rad), then rotations (rad/rad), in the world; 0 for joints that do not move ``body``.
    """
    moves = ancestor_joints(mj_model, body)
    axis, anchor = data.xaxis, data.xanchor
    if mj_model.nv > mj_model.njnt:  # free joints elsewhere have one axis for six degrees of freedom
        axis, anchor = axis[mj_model.dof_jntid], anchor[mj_model.dof_jntid]
    return jnp.where(moves[:, None], jnp.concatenate([jnp.cross(axis, point - anchor), axis], axis=1), 0.0)
