"""`steps.take` as one GPU kernel (Pallas, by Triton): a thread simulates one episode through all steps of a control step.

Positions and velocities stay on the chip from the first step to the last. In place of some 150 kernels a physics step there is
one for all of them.
"""

import dataclasses
import functools
from collections.abc import Hashable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx

from jaxrl_vis_envs.physics import lanes, mechanism, steps
from jaxrl_vis_envs.physics.mechanism import Mechanism, mechanism_of
from jaxrl_vis_envs.physics.steps import State


def take(
    constants: Mechanism,
    state: State,
    control: jax.Array,
    applied: jax.Array,
    timestep: float,
    count: int,
    exact: bool,
    beside_exact: bool = False,
    interpret: bool = False,
    mocap: jax.Array | None = None,
) -> State:
    """`steps.take` for arrays, float32; over all axes of `jax.vmap` in one kernel.

    How long and how many steps are, and whether they are exact, the kernel reads: calls in one program with the same constants
    for as many episodes are one kernel, which is compiled once.

    Args:
        constants: Of the model, of N joints.
        state: [N] each; its ``force`` is not used.
        control: [nu].
        applied: [N].
        timestep: s.
        count: Physics steps.
        exact: See `steps.take`.
        beside_exact: Whether steps that are not exact share the kernel of those that are, which is a little larger.
        interpret: Run the kernel without a GPU, slowly.
        mocap: [M, 7], for each of ``constants.mocaps``.

    Returns:
        The state after them, [N] each.
    """
    pace = jnp.array([timestep, count, exact], jnp.float32)
    around = [applied, control] if mocap is None else [applied, control, mocap.reshape(-1)]
    inputs = jnp.concatenate([pace, state.position, state.velocity, state.acceleration, *around])
    known = _Known(mechanism.content(constants), constants, exact or beside_exact)
    joints = len(constants.links)
    kernel = lanes.as_kernel("take_physics_steps", _simulate, known, len(State._fields) * joints, interpret)
    return State(*kernel(inputs[None])[0].reshape(len(State._fields), joints))


@dataclasses.dataclass(frozen=True)
class _Known:
    """Constants, which are equal to others where their content is, and whether steps may be exact."""

    content: Hashable
    constants: Mechanism = dataclasses.field(compare=False)
    may_be_exact: bool


def _simulate(known: _Known, rows: list[jax.Array]) -> list[jax.Array]:
    """Final numbers of an episode's numbers, in the order of `take`."""
    constants = known.constants
    joints = len(constants.links)
    (timestep, *pace), rows = rows[:3], rows[3:]
    # The same for all threads of a warp, which go through the same loops.
    count, is_exact = (jnp.max(number).astype(jnp.int32) for number in pace)
    exact = is_exact if known.may_be_exact else False
    position, velocity, acceleration, applied = (rows[first * joints :][:joints] for first in range(4))
    start = State(position, velocity, acceleration, [0.0 * number for number in position])
    controls = len(constants.actuators)
    control, mocap = rows[4 * joints :][:controls], rows[4 * joints + controls :]
    end = steps.take(constants, start, control, applied, timestep, count, exact, in_kernel=True, mocap=mocap)
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
    model = mujoco.MjModel.from_xml_string(_PROBE)
    constants = mechanism_of(mjx.put_model(model, device=jax.local_devices()[0]))
    joints = jnp.zeros((2, 2), jnp.float32)
    state = State(joints, joints, joints, joints)
    take_steps = functools.partial(take, constants, timestep=0.01, count=2, exact=True)
    return jax.jit(jax.vmap(lambda state, applied: take_steps(state, joints[0, :0], applied))).trace(state, joints)
