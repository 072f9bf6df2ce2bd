"""Physics steps that are written out number by number, and their GPU kernel, which Pallas's interpreter runs here.

For a whole step of the hand NumPy does the arithmetic, in float32, too: to compile it for a CPU takes minutes.
"""

import copy
import functools
import re
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from nvidia import lowered_for_nvidia

from benchmarks.tasks import environments
from jaxrl_vis_envs.compilation import KERNELS_VARIABLE, env_jit, kernels, tracing_for
from jaxrl_vis_envs.physics import (
    algebra,
    capsules,
    cones,
    descent,
    dynamics,
    folding,
    line_search,
    links,
    mechanism,
    mjx_model,
    quaternions,
    reference,
    steps,
    steps_kernel,
    welds,
)
from jaxrl_vis_envs.physics.mjx_model import mjx
from jaxrl_vis_envs.tasks.hand_reach import HandReach, HandReachConfig

# Every kind of joint, body, actuator, limit and contact that steps take, at places and along axes that nothing folds away.
ODD = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.004" cone="elliptic" iterations="6" impratio="2" gravity="1 -2 -9">
    <flag warmstart="{warmstart}"/>
  </option>
  <default><geom type="capsule" size=".05" density="800" contype="0" conaffinity="0"/></default>
  <worldbody>
    <geom name="post" fromto=".6 .6 0 .5 .4 .9" size=".15"/>
    <body name="base" pos=".1 .2 .3" euler=".3 -.2 .5">
      <joint name="turn" axis="1 2 -3" pos=".05 .02 -.03" damping=".3" armature=".02" stiffness="2" springref=".3"/>
      <geom name="trunk" fromto="0 0 0 .3 .05 .1"/>
      <body name="fixed" pos=".1 .1 .1" euler="1 .5 .2"><geom fromto="0 0 0 .1 0 .1" size=".03"/></body>
      <body name="arm" pos=".3 .05 .1">
        <joint name="tilt" axis="0 -1 0" range="-.4 .5" margin=".05" frictionloss=".2" ref=".1"/>
        <joint name="roll" axis="1 0 0" range="-1 1" solreflimit="-300 -8" pos="0 .03 0"/>
        <geom name="arm" fromto="0 0 0 .25 0 .05"/>
        <body name="rod" pos=".2 0 .05" euler="0 .4 0">
          <joint name="slide" type="slide" axis=".2 0 1" range="-.05 .05" damping="1" solimplimit=".5 .8 .02 .3 3"/>
          <geom name="rod" fromto="0 0 0 0 .2 .2" size=".1"/>
        </body>
      </body>
      <body name="other" pos=".1 -.1 .2">
        <joint name="swing" axis="0 0 1" armature=".01" damping=".1"/>
        <geom name="other" fromto="0 0 0 .3 .1 0" size=".08"/>
      </body>
    </body>
  </worldbody>
  <contact>
    <pair geom1="rod" geom2="post" condim="3" friction=".7 .4 .01 .01 .01" margin=".02" solreffriction=".03 1"/>
    <pair geom1="arm" geom2="other" condim="3" friction=".9 .9 .01 .01 .01"/>
    <pair geom1="rod" geom2="other" condim="1" solref=".03 .8" solimp=".6 .9 .01"/>
  </contact>
  <tendon>
    <fixed name="tie" range="-.2 .2" margin=".01" armature=".03">
      <joint joint="roll" coef=".5"/><joint joint="swing" coef="-.8"/>
    </fixed>
  </tendon>
  <actuator>
    <position joint="turn" kp="20" kv="1" ctrlrange="-1 1" forcerange="-5 5"/>
    <motor joint="slide" gear="3"/>
    <general joint="swing" gear="-2" gaintype="affine" gainprm="1 .5 .2" biastype="affine" biasprm=".1 -1 -.2"/>
  </actuator>
</mujoco>
"""


def odd_model(warmstart: str = "enable") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(ODD.format(warmstart=warmstart))


class Float32Numpy:
    """NumPy's functions, for which plain numbers have no type of their own, as in JAX."""

    inf = np.inf

    def __getattr__(self, name):
        def call(*numbers):
            return getattr(np, name)(*(np.float32(number) if isinstance(number, float) else number for number in numbers))

        return call


def loop_of_numpy(first, last, body, state):
    for number in range(first, last):
        state = body(number, state)
    return state


def columns(array) -> list[np.ndarray]:
    return list(np.asarray(array, np.float32).T)


def open_loop_of_numpy(condition, body, state):
    while condition(state):
        state = body(state)
    return state


def branch_of_numpy(condition, one, other):
    return one() if condition else other()


def taken(model: mjx.Model, data: mjx.Data, count: int, in_kernel: bool, exact: Any = True) -> steps.State:
    """`steps.take` of a batch, [B, N] each, in NumPy."""
    constants = mechanism.mechanism_of(model)
    used = list(constants.mocaps)
    mocap = np.concatenate([data.mocap_pos[:, used], data.mocap_quat[:, used]], axis=2).reshape(data.qpos.shape[0], -1)
    state = steps.State(*map(columns, (data.qpos, data.qvel, data.qacc_warmstart, data.qvel)))
    with pytest.MonkeyPatch.context() as patch, np.errstate(over="ignore"):
        for module in (algebra, capsules, cones, descent, folding, line_search, quaternions, reference, steps, welds):
            patch.setattr(module, "jnp", Float32Numpy())
        lax = SimpleNamespace(fori_loop=loop_of_numpy, while_loop=open_loop_of_numpy, cond=branch_of_numpy)
        for module in (descent, line_search, steps):
            patch.setattr(module, "jax", SimpleNamespace(lax=lax))
        control, applied = columns(data.ctrl), columns(data.qfrc_applied)
        timestep = float(model.opt.timestep)
        state = steps.take(constants, state, control, applied, timestep, count, exact, in_kernel, columns(mocap))
    return steps.State(*(np.stack(part, axis=1) for part in state))


@functools.cache
def by_matrices(name: str, count: int):
    env = environments.make(name)
    return env, env_jit(jax.vmap(lambda data: mjx_model._one_by_one(env._model, data, count, True)))


@functools.cache
def states(name: str) -> mjx.Data:
    """48 episodes in the middle of a control step, after three random ones."""
    env = environments.make(name)
    rng = np.random.default_rng(0)
    actions = jnp.asarray(rng.uniform(-1, 1, (4, 48, env.action_size)), jnp.float32)
    if name == "HandReach":
        data = jax.tree.map(lambda leaf: jnp.tile(leaf, (48,) + (1,) * leaf.ndim), env._start)
        actions = jax.vmap(jax.vmap(env._targets))(actions)
    else:
        data = jax.jit(jax.vmap(env.sample_start))(jax.random.split(jax.random.key(3), 48))
    _, control_step = by_matrices(name, env.config.substeps)
    for control in actions[:3]:
        data = control_step(data.replace(ctrl=control))
    _, one_step = by_matrices(name, 1)
    data = data.replace(ctrl=actions[3])
    for _ in range(4):
        data = one_step(data)
    return data


@pytest.mark.parametrize("name", ["HandReach", "FingerTurn"])
def test_a_step_of_each_task_is_that_of_matrices(name):
    data = states(name)
    env, one_step = by_matrices(name, 1)
    after = one_step(data)
    touching = (np.asarray(after._impl.contact.dist) < 0).sum(axis=1)
    assert (touching == 0).sum() > 5 and (touching > 0).sum() > 2
    state = taken(env._model, data, 1, in_kernel=True)
    assert state.acceleration.dtype == np.float32
    # Rounding errors of float32, 1e-7 of what cancels, times the condition of the mass matrix and of stiff contacts.
    scale = np.abs(np.asarray(after.qacc)).max(axis=1)
    error = np.abs(state.acceleration - np.asarray(after.qacc)).max(axis=1) / scale
    assert np.median(error) < 3e-6 and error.max() < 3e-4, np.sort(error)[-5:]
    np.testing.assert_allclose(state.velocity, after.qvel, atol=1e-4)
    np.testing.assert_allclose(state.force, after.qfrc_constraint, atol=1e-3 * np.abs(after.qfrc_constraint).max())


@pytest.mark.parametrize("name", ["HandReach", "FingerTurn"])
def test_a_control_step_of_each_task_is_that_of_matrices(name):
    data = states(name)
    env, _ = by_matrices(name, 1)
    _, control_step = by_matrices(name, env.config.substeps)
    after, state = control_step(data), taken(env._model, data, env.config.substeps, in_kernel=False)
    error = np.abs(state.position - np.asarray(after.qpos)).max(axis=1)
    # A contact that begins one step later changes more than rounding errors do.
    assert np.median(error) < 2e-6 and error.max() < 1e-3, np.sort(error)[-5:]


def test_on_a_cpu_the_finger_goes_number_by_number():
    data = states("FingerTurn")
    env, _ = by_matrices("FingerTurn", 1)
    _, control_step = by_matrices("FingerTurn", env.config.substeps)
    after = control_step(data)
    found = env_jit(jax.vmap(lambda data: mjx_model.take_steps(env._model, data, env.config.substeps, True, True)))(data)
    assert not np.array_equal(found.qpos, after.qpos)  # or they would be matrices, too
    for name in ("qpos", "time"):
        np.testing.assert_allclose(getattr(found, name), getattr(after, name), atol=1e-3)
    assert np.median(np.abs(found.qpos - after.qpos).max(axis=1)) < 2e-6
    np.testing.assert_allclose(found.qacc_warmstart, found.qacc)
    pushed = data.replace(xfrc_applied=data.xfrc_applied.at[0, 1, 0].set(1.0))
    found = env_jit(jax.vmap(lambda data: mjx_model.take_steps(env._model, data, 1, True, True)))(pushed)
    assert np.isnan(found.qpos[0]).all() and np.isfinite(found.qpos[1:]).all()
    # Whoever does not say that nothing is pushed gets what MJX does.
    found = env_jit(jax.vmap(lambda data: mjx_model.take_steps(env._model, data, 1, True)))(pushed)
    _, one_step = by_matrices("FingerTurn", 1)
    np.testing.assert_array_equal(found.qpos, one_step(pushed).qpos)
    assert not np.array_equal(found.qvel[0], one_step(data).qvel[0])


def odd_states(mj_model: mujoco.MjModel, count: int) -> mjx.Data:
    rng = np.random.default_rng(4)
    data = jax.tree.map(lambda leaf: jnp.tile(leaf, (count,) + (1,) * leaf.ndim), mjx_model.still_data(mj_model))
    draw = {"qpos": 0.5, "qvel": 2.0, "qacc_warmstart": 10.0, "qfrc_applied": 1.0, "ctrl": 1.5}
    sizes = {name: getattr(data, name).shape for name in draw}
    return data.replace(**{name: jnp.asarray(rng.normal(0, draw[name], sizes[name]), jnp.float32) for name in draw})


@pytest.mark.parametrize("warmstart", ["enable", "disable"])
def test_a_step_of_a_model_with_everything(warmstart):
    """Limits, dry friction, springs, tendons, servos, contacts with friction and without, and joints along any axis."""
    mj_model = odd_model(warmstart)
    model = mjx.put_model(mj_model)
    assert mechanism.takes(model)
    data = odd_states(mj_model, 200)
    after = env_jit(jax.vmap(lambda data: mjx_model.step(model, data, True)))(data)
    contact = np.asarray(after._impl.contact.dist) - np.asarray(after._impl.contact.includemargin)
    assert ((contact < 0).sum(axis=0) > 10).all() and ((contact < 0).sum(axis=1) > 1).sum() > 10
    state = taken(model, data, 1, in_kernel=warmstart == "disable")
    scale = np.abs(np.asarray(after.qacc)).max(axis=1)
    error = np.abs(state.acceleration - np.asarray(after.qacc)).max(axis=1) / scale
    assert np.median(error) < 2e-6 and error.max() < 1e-3, np.sort(error)[-10:]


@pytest.mark.parametrize("is_exact", [False, True])
def test_whether_steps_are_exact_may_be_a_number(is_exact):
    mj_model = odd_model()
    model, data = mjx.put_model(mj_model), odd_states(mj_model, 50)
    known, read = (taken(model, data, 2, in_kernel=True, exact=exact) for exact in (is_exact, np.int32(is_exact)))
    for one, other in zip(known, read, strict=True):
        np.testing.assert_array_equal(one, other)


def test_mechanisms_are_the_same_where_their_content_is():
    def content(**changes):
        mj_model = odd_model()
        for name, value in changes.items():
            getattr(mj_model, name)[:] = value
        return mechanism.content(mechanism.mechanism_of(mjx.put_model(mj_model)))

    assert hash(content()) == hash(content()) and content() == content()
    for name in ("dof_damping", "body_mass", "jnt_range", "pair_margin", "geom_pos", "tendon_armature"):
        assert content(**{name: 0.123}) != content(), name


@pytest.mark.parametrize("name", ["HandReach", "FingerTurn", "Reacher", "odd"])
def test_masses_and_bias_forces_are_those_of_mujoco(name, monkeypatch):
    """In double precision, but for what MJX has rounded of the model."""
    monkeypatch.setattr(folding, "jnp", np)
    mj_model = copy.copy(odd_model() if name == "odd" else environments.make(name).mj_model)
    mj_model.tendon_armature[:] = 0
    model = mjx.put_model(mj_model)
    tree, _ = links.links_of(model)
    rng = np.random.default_rng(5)
    positions, velocities = rng.uniform(-2, 2, (8, mj_model.nq)), rng.normal(0, 3, (8, mj_model.nv))
    joints = dynamics.joints_at(tree, list((positions - mj_model.qpos0).T))
    has_gravity = not mj_model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY
    mass = dynamics.mass_matrix(tree, joints)
    bias = dynamics.bias(tree, joints, list(velocities.T), mj_model.opt.gravity * has_gravity)
    data = mujoco.MjData(mj_model)
    for index, (position, velocity) in enumerate(zip(positions, velocities, strict=True)):
        data.qpos[:], data.qvel[:] = position, velocity
        mujoco.mj_forward(mj_model, data)
        theirs = np.zeros((mj_model.nv, mj_model.nv))
        mujoco.mj_fullM(mj_model, data, theirs)
        ours = np.diag(mj_model.dof_armature)
        for (one, other), number in mass.items():
            number = np.broadcast_to(number, 8)[index]
            ours[one, other] = number + (ours[one, other] if one == other else 0)
            ours[other, one] = ours[one, other]
        np.testing.assert_allclose(ours, theirs, atol=1e-6 * np.abs(theirs).max())
        np.testing.assert_allclose(
            [np.broadcast_to(number, 8)[index] for number in bias], data.qfrc_bias, atol=1e-6 * np.abs(data.qfrc_bias).max()
        )


def test_sine_and_cosine():
    angles = np.linspace(-40, 40, 200_001).astype(np.float32)
    sine, cosine = folding.sine_and_cosine(jnp.asarray(angles))
    np.testing.assert_allclose(sine, np.sin(angles.astype(np.float64)), atol=3e-7)
    np.testing.assert_allclose(cosine, np.cos(angles.astype(np.float64)), atol=3e-7)


def test_the_kernel_takes_the_same_steps():
    """Two axes of episodes, as in training: seeds and environments."""
    env, many_steps = by_matrices("FingerTurn", 3)
    data = jax.tree.map(lambda leaf: leaf[:6], states("FingerTurn"))
    after = many_steps(data)
    in_two_axes = jax.tree.map(lambda leaf: leaf.reshape(2, 3, *leaf.shape[1:]), data)
    kernel = functools.partial(mjx_model._in_one_kernel, env._model, count=3, exact=True, interpret=True)
    run = jax.jit(jax.vmap(jax.vmap(kernel)))
    ours = run(in_two_axes)
    for name in ("qpos", "qvel", "qacc", "qacc_warmstart", "qfrc_constraint", "time"):
        mine, theirs = np.asarray(getattr(ours, name)), np.asarray(getattr(after, name))
        np.testing.assert_allclose(mine.reshape(theirs.shape), theirs, rtol=1e-3, atol=1e-3 if "acc" in name else 1e-4)
        assert mine.dtype == theirs.dtype and getattr(ours, name).weak_type == getattr(after, name).weak_type

    pushed = in_two_axes.replace(xfrc_applied=in_two_axes.xfrc_applied.at[1, 2, 1, 0].set(1.0))
    is_number = np.isfinite(run(pushed).qpos).all(axis=-1)
    np.testing.assert_array_equal(is_number, [[True, True, True], [True, True, False]])


def lowered_for_cuda(model: mjx.Model, data: mjx.Data) -> str:
    """The program of a control step for NVIDIA GPUs, without one."""

    def control_step(data):
        with tracing_for("cuda"), kernels(True):
            return mjx_model.take_steps(model, data, 5, True, True)

    return lowered_for_nvidia(lambda: jax.jit(jax.vmap(control_step)).trace(data))


@pytest.mark.parametrize("name", ["FingerTurn", "HandReach"])
def test_all_steps_of_a_task_are_one_kernel_for_nvidia(name, monkeypatch):
    monkeypatch.delenv(KERNELS_VARIABLE, raising=False)
    env = environments.make(name)
    data = jax.eval_shape(lambda: jax.vmap(lambda _: mjx.make_data(env.mj_model))(jnp.zeros(8)))
    program = lowered_for_cuda(env._model, data)
    assert program.count("take_physics_steps") >= 1 and "solve_constraints" not in program
    assert program.count("stablehlo.") < 100


def test_goals_and_steps_of_the_hand_are_one_kernel(monkeypatch):
    """Which XLA compiles once, as the code is the same to the last letter: number, length and exactness of steps are inputs."""
    monkeypatch.delenv(KERNELS_VARIABLE, raising=False)
    env = environments.make("HandReach")

    def from_goal(key, action):
        with tracing_for("cuda"), kernels(True):
            return env.act(env.sample_goal(key), action)

    keys, actions = jax.eval_shape(lambda: (jax.random.split(jax.random.key(0), 8), jnp.zeros((8, env.action_size))))
    program = lowered_for_nvidia(lambda: jax.jit(jax.vmap(from_goal)).trace(keys, actions))
    assert program.count("take_physics_steps") >= 1 and len(set(re.findall('ir = "[^"]*"', program))) == 1


def test_steps_are_taken_one_by_one_where_their_kernel_does_not_compile(monkeypatch):
    monkeypatch.setattr(mjx_model, "runs_gpu_kernels", lambda probe: probe is not steps_kernel.probe)
    env = environments.make("FingerTurn")
    data = jax.eval_shape(lambda: jax.vmap(lambda _: mjx.make_data(env.mj_model))(jnp.zeros(8)))
    program = lowered_for_cuda(env._model, data)
    assert "take_physics_steps" not in program and "solve_constraints" in program


def test_the_probe_is_a_kernel_for_nvidia():
    program = lowered_for_nvidia(steps_kernel.probe_program)
    assert "take_physics_steps" in program


def test_which_models_have_steps_by_numbers():
    takes = {
        name: mechanism.takes(environments.make(name)._model) for name in ("FingerTurn", "HandReach", "Reacher", "FetchReach")
    }
    assert takes == {"FingerTurn": True, "HandReach": True, "Reacher": False, "FetchReach": True}
    hand = environments.make("HandReach")
    assert mechanism.takes(hand._goal_model)
    without_contacts = HandReach(HandReachConfig(contacts=False))._model
    assert mechanism.takes(without_contacts)
    assert mechanism.mechanism_of(without_contacts).contacts == ()


def test_a_model_whose_numbers_vary_has_none():
    model = mjx.put_model(odd_model())
    found = []

    @jax.jit
    def try_it(damping):
        found.append(mechanism.takes(model.replace(dof_damping=damping)))

    try_it(model.dof_damping)
    assert found == [False] and mechanism.takes(model)


def test_an_order_that_fills_in_little():
    """A chain that hangs on the first joint, and two more that a constraint ties; leaves are eliminated first."""
    mass = [(0, 0), (1, 1), (1, 0), (2, 2), (2, 1), (2, 0), (3, 3), (3, 0), (4, 4), (4, 0)]
    order = steps.elimination_order(5, mass, [(3, 4), (1,)])
    assert sorted(order) == [0, 1, 2, 3, 4]
    assert order.index(2) > order.index(1) > order.index(0) == 0

    env = environments.make("HandReach")
    constants = mechanism.mechanism_of(env._model)
    tree = constants.links
    ancestors = [(joint, other) for joint in range(24) for other in links.carriers(tree, joint)]
    order = steps.elimination_order(24, ancestors, [contact.pair.joints for contact in constants.contacts])
    place = {joint: index for index, joint in enumerate(order)}
    assert all(place[other] <= place[joint] for joint, other in ancestors)
