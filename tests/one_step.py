"""One physics step of a task's own model by MJX and by C MuJoCo, from identical states."""

import copy
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxrl_vis_envs.compilation import env_jit
from jaxrl_vis_envs.physics import mjx_model
from jaxrl_vis_envs.physics.mjx_model import mjx


class Visited(NamedTuple):
    """N states on the way, float32: all that a step depends on."""

    qpos: np.ndarray  # [N, nq]
    qvel: np.ndarray  # [N, nv]
    qacc_warmstart: np.ndarray  # [N, nv], where the solver starts from
    ctrl: np.ndarray  # [N, nu]
    mocap_pos: np.ndarray  # [N, nmocap, 3]
    mocap_quat: np.ndarray  # [N, nmocap, 4]


def visited_states(
    mj_model: mujoco.MjModel, starts: np.ndarray, controls: np.ndarray, every: int, mocap: np.ndarray | None = None
) -> Visited:
    """States that C MuJoCo passes through.

    Args:
        mj_model: The model.
        starts: [S, nq] joint positions, at rest.
        controls: [S, T, nu], each held for ``every`` physics steps.
        every: A state is kept before each control, after so many physics steps.
        mocap: [S, T, 3], positions of the only mocap body, held as the controls are.
    """
    states = []
    data = mujoco.MjData(mj_model)
    for row, start in enumerate(starts):
        mujoco.mj_resetData(mj_model, data)
        data.qpos[:] = start
        for time, control in enumerate(controls[row]):
            data.ctrl[:] = control
            if mocap is not None:
                data.mocap_pos[0] = mocap[row, time]
            states.append([getattr(data, field).astype(np.float32) for field in Visited._fields])
            mujoco.mj_step(mj_model, data, every)
    return Visited(*(np.stack(part) for part in zip(*states)))


def velocity_difference(mj_model: mujoco.MjModel, visited: Visited) -> tuple[np.ndarray, np.ndarray]:
    """Both engines take one step: MJX with the iterations of the model, C MuJoCo with as many as it takes.

    Returns:
        The greatest difference of the joint velocities, as a multiple of what is allowed (1e-4 of the greatest velocity +
        1e-5): [N]; and the number of contacts: [N].
    """
    model, still = mjx.put_model(mj_model), mjx_model.still_data(mj_model)

    def step(visited: Visited) -> jax.Array:
        with jax.default_matmul_precision("highest"):
            return mjx_model.step(model, still.replace(**visited._asdict())).qvel

    ours = np.asarray(env_jit(jax.vmap(step))(jax.tree.map(jnp.asarray, visited)))
    exact = copy.copy(mj_model)
    exact.opt.iterations, exact.opt.ls_iterations = 100, 50
    excess, contacts = np.empty(len(ours)), np.zeros(len(ours), int)
    data = mujoco.MjData(exact)
    for index, row in enumerate(zip(*visited)):
        for field, value in zip(Visited._fields, row):
            getattr(data, field)[:] = value
        if exact.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER:
            mujoco.mj_step1(exact, data)
            _forget_turning_of_equalities(data)
            mujoco.mj_step2(exact, data)
        else:
            mujoco.mj_step(exact, data)  # its two halves are Euler's
        contacts[index] = data.ncon
        excess[index] = np.abs(ours[index] - data.qvel).max() / (1e-4 * np.abs(data.qvel).max() + 1e-5)
    return excess, contacts


def _forget_turning_of_equalities(data: mujoco.MjData) -> None:
    """Takes from welds what MJX does not know: C MuJoCo 4 adds how fast their Jacobian turns to the acceleration they want."""
    rows = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
    stiffness, damping, impedance, _ = data.efc_KBIP[rows].T
    data.efc_aref[rows] = -damping * data.efc_vel[rows] - stiffness * impedance * data.efc_pos[rows]
