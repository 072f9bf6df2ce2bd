"""`steps.simulate` as one GPU kernel (Pallas, by Triton): a thread simulates one episode through all steps of a control step.

Positions and velocities stay on the chip from the first step to the last. As XLA operations, a physics step is some 150
kernels.
"""

import dataclasses
import functools
from collections.abc import Hashable

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx

from jaxrl_vis_envs.physics.scalar import scalar_model, steps, triton_scalars
from jaxrl_vis_envs.physics.scalar.scalar_model import ScalarModel
from jaxrl_vis_envs.physics.scalar.steps import JointState


def simulate(
    constants: ScalarModel,
    state: JointState,
    control: jax.Array,
    applied: jax.Array,
    timestep: float,
    count: int,
    exact: bool | None,
    mocap: jax.Array | None = None,
    interpret: bool = False,
) -> JointState:
    """Call `steps.simulate` with float32 arrays, as one kernel over all axes of `jax.vmap`.

    The kernel reads the time step, the number of steps and ``exact`` at run time. Calls within one program with equal constants
    and batch sizes therefore share one kernel, compiled once.

    Args:
        constants: Constants of the model with N joints.
        state: [N] each; its ``force`` is not used.
        control: [nu].
        applied: [N].
        timestep: Time step, s.
        count: Number of physics steps.
        exact: True to take exact steps (see `steps.simulate`), False not to, with the same kernel; None for a smaller kernel
            that cannot.
        mocap: [M, 7], one row for each of ``constants.mocaps``.
        interpret: Run the kernel without a GPU, slowly.

    Returns:
        The state after the steps, [N] each.
    """
    settings = jnp.array([timestep, count, bool(exact)], jnp.float32)
    constant_inputs = [applied, control] if mocap is None else [applied, control, mocap.reshape(-1)]
    inputs = jnp.concatenate([settings, state.position, state.velocity, state.acceleration, *constant_inputs])
    known = _KernelConstants(scalar_model.fingerprint(constants), constants, exact is not None)
    joints = len(constants.links)
    kernel = triton_scalars.episode_kernel(
        "take_physics_steps", _simulate_episode, known, len(JointState._fields) * joints, interpret
    )
    return JointState(*kernel(inputs[None])[0].reshape(len(JointState._fields), joints))


@dataclasses.dataclass(frozen=True)
class _KernelConstants:
    """Constants of a model, compared by their fingerprint, and whether the kernel can take exact steps."""

    fingerprint: Hashable
    constants: ScalarModel = dataclasses.field(compare=False)
    may_be_exact: bool


def _simulate_episode(kernel_constants: _KernelConstants, rows: list[jax.Array]) -> list[jax.Array]:
    """Compute the final `JointState` of an episode from its inputs, both as flat lists of scalars."""
    constants = kernel_constants.constants
    joints = len(constants.links)
    (timestep, *loops), rows = rows[:3], rows[3:]
    # Equal in all threads of a warp, which execute the same loops.
    count, is_exact = (jnp.max(number).astype(jnp.int32) for number in loops)
    exact = is_exact if kernel_constants.may_be_exact else False
    position, velocity, acceleration, applied = (rows[first * joints :][:joints] for first in range(4))
    start = JointState(position, velocity, acceleration, [0.0 * number for number in position])
    controls = len(constants.actuators)
    control, mocap = rows[4 * joints :][:controls], rows[4 * joints + controls :]
    end = steps.simulate(constants, start, control, applied, timestep, count, exact, in_kernel=True, mocap=mocap)
    return [number for part in end for number in part]


_PROBE = """
<mujoco>
  <option solver="Newton" cone="elliptic" iterations="1"/>
  <default><geom type="capsule" fromto="0 0 0 0 0 .2" size=".02"/><pair condim="3"/></default>
  <worldbody>
    <body><joint axis="0 1 0" frictionloss=".1"/><geom name="one"/></body>
    <body pos=".1 0 0"><joint type="slide" axis="1 0 0" limited="true" range="-.1 .1"/><geom name="other"/></body>
  </worldbody>
  <contact><pair geom1="one" geom2="other"/></contact>
</mujoco>
"""


def probe() -> jax.stages.Traced:
    """Trace a small instance of the kernel: a hinge, a slide, dry friction, a limit and a contact."""
    model = mujoco.MjModel.from_xml_string(_PROBE)
    constants = scalar_model.build_scalar_model(mjx.put_model(model, device=jax.local_devices()[0]))
    joints = jnp.zeros((2, 2), jnp.float32)
    state = JointState(joints, joints, joints, joints)
    take_steps = functools.partial(simulate, constants, timestep=0.01, count=2, exact=True)
    return jax.jit(jax.vmap(lambda state, applied: take_steps(state, joints[0, :0], applied))).trace(state, joints)
