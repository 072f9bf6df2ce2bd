"""`box_steps.simulate` as one GPU kernel: a warp simulates one episode through all steps of a control step."""

import dataclasses
from collections.abc import Hashable

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx

from jaxrl_vis_envs.physics.scalar import scalar_model, triton_scalars
from jaxrl_vis_envs.physics.scalar.boxes import box_steps
from jaxrl_vis_envs.physics.scalar.boxes.box_model import LANES, BoxModel, build_box_model
from jaxrl_vis_envs.physics.scalar.steps import JointState


def simulate(
    model: BoxModel,
    state: JointState,
    control: jax.Array,
    applied: jax.Array,
    timestep: float,
    count: int,
    mocap: jax.Array | None = None,
    interpret: bool = False,
) -> JointState:
    """Call `box_steps.simulate` with float32 arrays, as one kernel over all axes of `jax.vmap`.

    Args:
        model: Constants of the model with N degrees of freedom.
        state: ``position`` [N + 1], the others [N]; its ``force`` is not used.
        control: [nu].
        applied: [N].
        timestep: Time step, s.
        count: Number of physics steps.
        mocap: [M, 7], one row for each of the tree's ``mocaps``; None for none.
        interpret: Run the kernel without a GPU, slowly.

    Returns:
        The state after the steps.
    """
    poses = [] if mocap is None else [mocap.reshape(-1)]
    inputs = jnp.concatenate([state.position, state.velocity, state.acceleration, applied, control, *poses])
    known = _KernelConstants(scalar_model.fingerprint(model), model, timestep, count)
    sizes = [state.position.size] + [state.velocity.size] * 3
    kernel = triton_scalars.warp_kernel("take_box_steps", _simulate_episode, known, model.table, sum(sizes), interpret)
    results, parts = kernel(inputs[None])[0], []
    for size in sizes:
        parts.append(results[:size])
        results = results[size:]
    return JointState(*parts)


def simulate_arrays(
    model: BoxModel,
    state: JointState,
    control: jax.Array,
    applied: jax.Array,
    timestep: float,
    count: int,
    mocap: jax.Array | None = None,
) -> JointState:
    """Implement `simulate` in plain JAX."""

    def broadcast(numbers: jax.Array) -> list[jax.Array]:
        return [jnp.broadcast_to(number, (LANES,)) for number in numbers]

    start, poses = JointState(*map(broadcast, state)), [] if mocap is None else broadcast(mocap.reshape(-1))
    table = list(jnp.asarray(model.table, jnp.float32))
    end = box_steps.simulate(model, table, start, broadcast(control), broadcast(applied), timestep, count, poses)
    return JointState(*(jnp.stack([number[0] for number in part]) for part in end))


@dataclasses.dataclass(frozen=True)
class _KernelConstants:
    """Constants of a kernel; the model is compared by its fingerprint."""

    fingerprint: Hashable
    model: BoxModel = dataclasses.field(compare=False)
    timestep: float
    count: int


def _simulate_episode(constants: _KernelConstants, rows: list[jax.Array], table: list[jax.Array]) -> list[jax.Array]:
    """Compute the final `JointState` of an episode from its inputs, both as flat lists of scalars."""
    tree, freedoms = constants.model.tree, len(constants.model.contacts.signs)
    sizes = (freedoms + 1, freedoms, freedoms, freedoms, len(tree.actuators), 7 * len(tree.mocaps))
    parts = []
    for size in sizes:
        parts.append(rows[:size])
        rows = rows[size:]
    position, velocity, acceleration, applied, control, mocap = parts
    start = JointState(position, velocity, acceleration, [0.0 * number for number in velocity])
    end = box_steps.simulate(constants.model, table, start, control, applied, constants.timestep, constants.count, mocap)
    return [number for part in end for number in part]


_PROBE = """
<mujoco>
  <option solver="Newton" iterations="1"/>
  <default><geom type="box" size=".02 .02 .02" contype="0" conaffinity="0"/></default>
  <worldbody>
    <geom name="table" size=".2 .2 .02"/>
    <body pos="0 0 .1"><joint type="slide" axis="1 0 0" limited="true" range="-.1 .1"/><geom name="finger"/></body>
    <body name="box" pos="0 0 .04"><freejoint/><geom name="box"/></body>
  </worldbody>
  <contact><pair geom1="table" geom2="box"/><pair geom1="finger" geom2="box" condim="4"/></contact>
</mujoco>
"""


def probe() -> jax.stages.Traced:
    """Trace a small instance of the kernel: a box on a table beside a finger on a slide."""
    model = build_box_model(mjx.put_model(mujoco.MjModel.from_xml_string(_PROBE), device=jax.local_devices()[0]))
    position, rates = jnp.zeros((2, 8), jnp.float32), jnp.zeros((2, 7), jnp.float32)

    def take_steps(position: jax.Array, rates: jax.Array) -> JointState:
        return simulate(model, JointState(position, rates, rates, rates), rates[:0], rates, timestep=0.002, count=2)

    return jax.jit(jax.vmap(take_steps)).trace(position, rates)
