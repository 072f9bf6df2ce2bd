"""Steps of the scalar engine with boxes, one of them free, in NumPy, because compilation for a CPU takes a minute."""

import contextlib
from collections.abc import Iterator
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from nvidia import lowered_for_nvidia
from test_steps import arithmetic_of, loop_of_numpy, open_loop_of_numpy

from benchmarks.tasks import environments, one_step
from jaxrl_vis_envs.compiling.compilation import KERNELS_VARIABLE, kernels, tracing_for
from jaxrl_vis_envs.physics import mjx_model, scalar
from jaxrl_vis_envs.physics.mjx_model import mjx
from jaxrl_vis_envs.physics.scalar import dynamics, triton_scalars
from jaxrl_vis_envs.physics.scalar.boxes import box_faces, box_kernel, box_model, box_steps, lane_newton, lane_rows, own_block
from jaxrl_vis_envs.physics.scalar.boxes.box_model import LANES
from jaxrl_vis_envs.physics.scalar.steps import JointState

# A free box on a tilted table, and a finger on a turning arm beside it.
BOXES = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.002" iterations="20" gravity="1 0 -9"/>
  <default><geom type="box" contype="0" conaffinity="0" density="800"/></default>
  <worldbody>
    <geom name="table" size=".3 .2 .05" pos=".1 0 0" euler="0 .1 0"/>
    <body name="arm" pos="-.1 .1 .3" euler="0 0 .2">
      <joint name="swing" axis="0 1 .2" damping=".3" armature=".01"/>
      <geom size=".01 .01 .1" pos="0 0 -.1"/>
      <body name="slider" pos="0 0 -.2">
        <joint name="slide" type="slide" axis="0 0 1" range="-.01 .02" damping="2"/>
        <geom name="finger" size=".012 .01 .008"/>
      </body>
    </body>
    <body name="box" pos="0 0 .1">
      <joint name="free" type="free" damping=".01" armature=".002"/>
      <geom name="box" size=".03 .02 .025"/>
    </body>
  </worldbody>
  <contact>
    <pair geom1="table" geom2="box" condim="3" friction=".7 .7 .01 .01 .01"/>
    <pair geom1="finger" geom2="box" condim="4" friction=".9 .5 .05 .01 .01" margin=".004" solref=".03 .8"/>
  </contact>
  <actuator><position joint="swing" kp="20" ctrlrange="-.5 .5"/></actuator>
</mujoco>
"""


@contextlib.contextmanager
def lanes_of_numpy() -> Iterator[None]:
    """Let NumPy compute the arithmetic of lanes, in double precision, within the context."""
    lax = SimpleNamespace(fori_loop=loop_of_numpy, while_loop=open_loop_of_numpy)
    with arithmetic_of(np), pytest.MonkeyPatch.context() as patch:
        for module in (box_faces, lane_newton, lane_rows, box_steps):
            patch.setattr(module, "jnp", np)
        for module in (lane_newton, own_block, box_steps):
            patch.setattr(module, "jax", SimpleNamespace(lax=lax, tree=jax.tree))
        for module in (dynamics, box_steps):
            patch.setattr(module, "sine_and_cosine", lambda angle: (np.sin(angle), np.cos(angle)))
        yield


def step_of(mj_model: mujoco.MjModel, drawn: dict[str, np.ndarray]) -> JointState:
    """Return N states, [N, nq] and [N, nv], after a step with as many iterations as it needs."""
    with jax.enable_x64(True):  # or MJX rounds the model
        model = box_model.build_box_model(mjx.put_model(mj_model))
    model = model._replace(tree=model.tree._replace(iterations=50))

    def spread(name: str) -> list[np.ndarray]:
        return [np.repeat(column[:, None], LANES, axis=1) for column in np.float64(drawn[name]).T]

    state = JointState(*(spread(name) for name in ("qpos", "qvel", "qacc_warmstart", "qvel")))
    table = list(np.broadcast_to(model.table[:, None], (len(model.table), len(drawn["qpos"]), LANES)).astype(np.float64))
    nothing = [0.0 * column for column in state.velocity]
    with lanes_of_numpy():
        after = box_steps.simulate(model, table, state, spread("ctrl"), nothing, mj_model.opt.timestep, 1, spread("mocap"))
    assert all(np.ptp(number, axis=1).max() == 0 for part in after for number in part)  # the same in all lanes
    return JointState(*(np.stack([number[:, 0] for number in part], axis=1) for part in after))


def drawn_states(count: int) -> dict[str, np.ndarray]:
    """Return states of `BOXES`: the box on the table or up to 1 mm above it, the finger on top of the box or beside it."""
    rng = np.random.default_rng(0)
    mj_model = mujoco.MjModel.from_xml_string(BOXES)
    data, qpos = mujoco.MjData(mj_model), np.empty((count, 9))
    for row in range(count):
        data.qpos[:2] = rng.uniform([-0.3, -0.012], [0.3, 0.022])
        mujoco.mj_kinematics(mj_model, data)
        table = data.geom("table").xmat.reshape(3, 3)
        place = data.geom("finger").xpos + [0.0, 0.0, -0.035] if row % 2 else np.array([rng.uniform(-0.1, 0.2), 0.0, 0.0])
        place = place - data.geom("table").xpos
        normal = table[:, 2]
        place = place + (0.075 + rng.uniform(-0.001, 0.001) - place @ normal) * normal + data.geom("table").xpos
        turn = np.empty(4)
        mujoco.mju_axisAngle2Quat(turn, np.array([0.0, 1.0, 0.0]), 0.1)
        qpos[row] = [*data.qpos[:2], *place, *turn]
    return {
        "qpos": qpos,
        "qvel": rng.normal(0, 0.3, (count, 8)),
        "qacc_warmstart": rng.normal(0, 10, (count, 8)),
        "ctrl": rng.uniform(-1, 1, (count, 1)),
        "mocap": np.empty((count, 0)),
    }


def test_a_step_is_that_of_mujoco():
    mj_model = mujoco.MjModel.from_xml_string(BOXES)
    mj_model.opt.iterations, mj_model.opt.ls_iterations, mj_model.opt.tolerance = 100, 100, 0
    drawn = drawn_states(40)
    after, theirs, touched = step_of(mj_model, drawn), mujoco.MjData(mj_model), []
    for index in range(len(drawn["qpos"])):
        for field in ("qpos", "qvel", "qacc_warmstart", "ctrl"):
            getattr(theirs, field)[:] = drawn[field][index]
        mujoco.mj_step(mj_model, theirs)
        touched.append((any(theirs.contact.dim == 3), any(theirs.contact.dim == 4), theirs.nefc > 10 * theirs.ncon))
        for ours, part in ((after.position, theirs.qpos), (after.velocity, theirs.qvel)):
            np.testing.assert_allclose(ours[index], part, rtol=0, atol=1e-10)
        np.testing.assert_allclose(after.force[index], theirs.qfrc_constraint, rtol=0, atol=1e-6)
    on_table, under_finger = np.array(touched)[:, :2].sum(axis=0)
    assert on_table > 10 and under_finger > 10


def test_a_step_of_the_push():
    """Steps are compared with C MuJoCo's less the weld's term; some differ, because boxes also touch with edges there."""
    env = environments.make("FetchPush")
    visited = one_step.push_states(env)
    place = env.mj_model.joint("box").qposadr[0]
    visited.qpos[:20, place:] = [1.8, 0.75, 0.0245, 1.0, 0.0, 0.0, 0.0]  # on the floor
    theirs = one_step.mujoco_step(env.mj_model, visited, weld_term=False)
    drawn = visited._asdict()
    drawn["mocap"] = np.concatenate([visited.mocap_pos[:, 0], visited.mocap_quat[:, 0]], axis=1)
    error = np.abs(step_of(env.mj_model, drawn).velocity - theirs.qvel).max(axis=1)
    assert (theirs.contacts >= 8).sum() > 30
    assert (error < 1e-9).mean() > 0.85 and error[:20].max() < 1e-9 and theirs.contacts[:20].min() >= 4


def lowered_push(exact: bool | None) -> str:
    """Return the program of a control step of the push, lowered for NVIDIA GPUs."""
    env = environments.make("FetchPush")
    data = jax.eval_shape(lambda: jax.vmap(lambda _: mjx.make_data(env.mj_model))(jnp.zeros(8)))

    def control_step(data):
        with tracing_for("cuda"), kernels(True):
            return mjx_model.take_steps(env._model, data, 5, exact)

    return lowered_for_nvidia(lambda: jax.jit(jax.vmap(control_step)).trace(data))


def test_all_steps_of_the_push_are_one_kernel_for_nvidia(monkeypatch):
    monkeypatch.delenv(KERNELS_VARIABLE, raising=False)
    program = lowered_push(exact=None)
    assert program.count("take_box_steps") >= 1 and program.count("stablehlo.") < 150


def test_where_the_kernel_does_not_compile_mjx_takes_the_steps(monkeypatch):
    model, failing = environments.make("FetchPush")._model, []
    monkeypatch.setattr(mjx_model, "use_gpu_kernels", lambda probe: probe not in failing)
    with tracing_for("cuda"):
        assert mjx_model.prefers_scalar_engine(model)
        failing.append(box_kernel.probe)
        assert not mjx_model.prefers_scalar_engine(model)


def test_the_probe_is_a_kernel_for_nvidia():
    assert "take_box_steps" in lowered_for_nvidia(box_kernel.probe)


def test_inputs_table_and_outputs_of_a_warp():
    """The kernel runs in the interpreter, over two axes of episodes."""
    table = np.arange(2.0 * LANES).reshape(2, LANES)

    def compute(factor, inputs, rows):
        assert factor == 3 and all(number.shape == (LANES,) for number in [*inputs, *rows])
        return [inputs[0] + inputs[1], lane_newton.sum_lanes(inputs[1] * rows[1]), factor * inputs[2]]

    kernel = triton_scalars.warp_kernel("test", compute, 3, table, 3, True)
    inputs = np.random.default_rng(0).normal(size=(2, 5, 3)).astype(np.float32)
    found = jax.vmap(jax.vmap(lambda row: kernel(row[None])[0]))(jnp.asarray(inputs))
    one, other, last = np.moveaxis(inputs, -1, 0)
    np.testing.assert_allclose(found, np.stack([one + other, other * table[1].sum(), 3 * last], axis=-1), rtol=1e-5)


REFUSED = {
    "elliptic": ('iterations="20"', 'iterations="20" cone="elliptic"'),
    "without friction": ('condim="3"', 'condim="1"'),
    "other exponent": ('solref=".03 .8"', 'solimp=".9 .95 .001 .5 3"'),
    "sphere": ('<geom name="finger" size=".012 .01 .008"/>', '<geom name="finger" type="sphere" size=".01"/>'),
    "centre of mass": ('<geom name="box" size=".03 .02 .025"/>', '<geom name="box" pos=".01 0 0" size=".03 .02 .025"/>'),
    "child": (
        '<geom name="box" size=".03 .02 .025"/>',
        '<geom name="box" size=".03 .02 .025"/><body><geom size=".1 .1 .1"/></body>',
    ),
    "joint after it": ("</worldbody>", '<body><joint axis="0 1 0"/><geom size=".1 .1 .1"/></body></worldbody>'),
    "sensor": ("</mujoco>", '<sensor><jointpos joint="swing"/></sensor></mujoco>'),
    "pair of a mocap body": (
        '<geom name="table" size=".3 .2 .05" pos=".1 0 0" euler="0 .1 0"/>',
        '<body mocap="true"><geom name="table" size=".3 .2 .05"/></body>',
    ),
    "weld of the free body": ("</mujoco>", '<equality><weld body1="box" body2="arm"/></equality></mujoco>'),
    "motor of the free body": ("</actuator>", '<motor joint="free"/></actuator>'),
    "contacts disabled": ("<default>", '<option><flag contact="disable"/></option><default>'),
    "dry friction": ('armature=".01"', 'armature=".01" frictionloss=".1"'),
}


@pytest.mark.parametrize("what", REFUSED)
def test_which_models_with_boxes_are_refused(what):
    old, new = REFUSED[what]
    assert BOXES.count(old) == 1
    assert not scalar.supports(mjx.put_model(mujoco.MjModel.from_xml_string(BOXES.replace(old, new))))


def test_exact_steps_with_boxes_are_left_to_mjx():
    model = mjx.put_model(mujoco.MjModel.from_xml_string(BOXES))
    assert scalar.supports(model) and scalar.supports(model, exact=False) and not scalar.supports(model, exact=True)
