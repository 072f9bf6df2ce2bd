"""`steps.take` as one GPU kernel (Pallas, by Triton): a thread simulates one episode through all steps of a control step.

Positions and velocities stay on the chip from the first step to the last. In place of some 150 kernels a physics step there is
one for all of them.
"""

import functools
import os
import pickle
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx

from jaxrl_vis_envs.physics import lanes, steps
from jaxrl_vis_envs.physics.mechanism import Mechanism, mechanism_of
from jaxrl_vis_envs.physics.steps import State

VARIABLE = "JAXRL_VIS_STEPS_KERNEL"
"""Environment variable that asks for the kernel: 1 does, anything else does not."""


def is_wanted() -> bool:
    """Whether the kernel is used where it can be: not unless it is asked for, until it was measured on a GPU."""
    return os.environ.get(VARIABLE, "").strip() == "1"


def take(
    constants: Mechanism,
    state: State,
    control: jax.Array,
    applied: jax.Array,
    count: int,
    exact: bool,
    interpret: bool = False,
    mocap: jax.Array | None = None,
) -> State:
    """`steps.take` for arrays, float32; over all axes of `jax.vmap` in one kernel.

    Args:
        constants: Of the model, of N joints.
        state: [N] each; its ``force`` is not used.
        control: [nu].
        applied: [N].
        count: Physics steps.
        exact: See `steps.take`.
        interpret: Run the kernel without a GPU, slowly.
        mocap: [M, 7], for each of ``constants.mocaps``.

    Returns:
        The state after them, [N] each.
    """
    around = [applied, control] if mocap is None else [applied, control, mocap.reshape(-1)]
    inputs = jnp.concatenate([state.position, state.velocity, state.acceleration, *around])
    simulate = functools.partial(_simulate, pickle.dumps(constants), count, exact)
    joints = len(constants.links)
    kernel = lanes.as_kernel("take_physics_steps", simulate, len(State._fields) * joints, interpret)
    return State(*kernel(inputs[None])[0].reshape(len(State._fields), joints))


@functools.partial(jax.jit, static_argnums=(0, 1, 2))
def _simulate(pickled: bytes, count: int, exact: bool, rows: list[jax.Array]) -> list[jax.Array]:
    """Final numbers of an episode's numbers, in the order of `take`.

    Jitted so that it is traced once for all launches, in however many programs they are. The constants come as bytes, by which
    they are known again: they are made anew for every program.
    """
    constants: Mechanism = pickle.loads(pickled)
    joints = len(constants.links)
    position, velocity, acceleration, applied = (rows[first * joints :][:joints] for first in range(4))
    start = State(position, velocity, acceleration, [0.0 * number for number in position])
    controls = len(constants.actuators)
    control, mocap = rows[4 * joints :][:controls], rows[4 * joints + controls :]
    end = steps.take(constants, start, control, applied, count, exact, in_kernel=True, mocap=mocap)
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


def probe() -> None:
    """Compiles a small instance of the kernel for the device that is the default; raises what that raises."""
    probe_program().lower().compile()


def probe_program() -> Any:
    """A small instance of the kernel, traced (`jax.stages.Traced`): hinge and slide, dry friction, a limit, a contact."""
    constants = mechanism_of(mjx.put_model(mujoco.MjModel.from_xml_string(_PROBE)))
    joints = jnp.zeros((2, 2), jnp.float32)
    state = State(joints, joints, joints, joints)
    take_steps = functools.partial(take, constants, count=2, exact=True)
    return jax.jit(jax.vmap(lambda state, applied: take_steps(state, joints[0, :0], applied))).trace(state, joints)
