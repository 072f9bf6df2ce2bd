"""Physics steps of the scalar engine, and their GPU kernel, which Pallas's interpreter runs here.

Whole steps of the hand are computed by NumPy, in float32, too, because compilation for a CPU takes minutes.
"""

import contextlib
import copy
import functools
import re
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from nvidia import lowered_for_nvidia

import jaxrl_vis_envs
from benchmarks.tasks import environments
from jaxrl_vis_envs.compiling.compilation import KERNELS_VARIABLE, kernels, tracing_for
from jaxrl_vis_envs.names import TASKS
from jaxrl_vis_envs.physics import mjx_model, scalar
from jaxrl_vis_envs.physics.mjx_model import mjx
from jaxrl_vis_envs.physics.scalar import (
    constraint_softness,
    contacts,
    dynamics,
    links,
    partial_arithmetic,
    quaternions,
    scalar_model,
    sparse_algebra,
    steps,
    steps_kernel,
    welds,
)
from jaxrl_vis_envs.physics.scalar.solver import friction_cones, line_search, scalar_newton
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
    """NumPy's functions, in which Python's numbers do not determine the dtype, as in JAX."""

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


@contextlib.contextmanager
def arithmetic_of(numpy: Any) -> Iterator[None]:
    """Let NumPy, or an object with its functions, compute the arithmetic of the scalar engine within the context."""
    arithmetic = (constraint_softness, contacts, friction_cones, line_search, partial_arithmetic, quaternions)
    arithmetic += (scalar_newton, sparse_algebra, steps, welds)
    with pytest.MonkeyPatch.context() as patch, np.errstate(over="ignore"):
        for module in arithmetic:
            patch.setattr(module, "jnp", numpy)
        lax = SimpleNamespace(fori_loop=loop_of_numpy, while_loop=open_loop_of_numpy, cond=branch_of_numpy)
        for module in (scalar_newton, line_search, steps):
            patch.setattr(module, "jax", SimpleNamespace(lax=lax))
        yield


def simulate_in_numpy(model: mjx.Model, data: mjx.Data, count: int, in_kernel: bool, exact: Any = True) -> steps.JointState:
    """Return the states [B, N] of a batch after `steps.simulate` in NumPy."""
    constants = scalar_model.build_scalar_model(model)
    used = list(constants.mocaps)
    mocap = np.concatenate([data.mocap_pos[:, used], data.mocap_quat[:, used]], axis=2).reshape(data.qpos.shape[0], -1)
    state = steps.JointState(*map(columns, (data.qpos, data.qvel, data.qacc_warmstart, data.qvel)))
    with arithmetic_of(Float32Numpy()):
        control, applied = columns(data.ctrl), columns(data.qfrc_applied)
        timestep = float(model.opt.timestep)
        state = steps.simulate(constants, state, control, applied, timestep, count, exact, in_kernel, columns(mocap))
    return steps.JointState(*(np.stack(part, axis=1) for part in state))


@functools.cache
def steps_by_matrices(name: str):
    """Return a function of a batch and a number of steps; the number is an argument, so that one program serves any number."""
    env = environments.make(name)

    def one_step(_: Any, data: mjx.Data) -> mjx.Data:
        return mjx_model._take_mjx_steps(env._model, data, 1, True)

    return jaxrl_vis_envs.jit(jax.vmap(lambda data, count: jax.lax.fori_loop(0, count, one_step, data), (0, None)))


def by_matrices(name: str, count: int):
    # From the host: a batch that a program returned is committed to its device, which would compile another one.
    return environments.make(name), lambda data: steps_by_matrices(name)(jax.device_get(data), count)


def repeated(data: mjx.Data, count: int) -> mjx.Data:
    """Return ``count`` copies, made on the host, because a device would need a program for each size of leaf."""
    return jax.tree.map(lambda leaf: np.tile(leaf, (count,) + (1,) * leaf.ndim), jax.device_get(data))


@functools.cache
def states(name: str) -> mjx.Data:
    """Return the states of 48 episodes in the middle of a control step, after three random ones."""
    env = environments.make(name)
    rng = np.random.default_rng(0)
    actions = jnp.asarray(rng.uniform(-1, 1, (4, 48, env.action_size)), jnp.float32)
    if name == "HandReach":
        data = repeated(env._start, 48)
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
    state = simulate_in_numpy(env._model, data, 1, in_kernel=True)
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
    after, state = control_step(data), simulate_in_numpy(env._model, data, env.config.substeps, in_kernel=False)
    error = np.abs(state.position - np.asarray(after.qpos)).max(axis=1)
    # A contact that begins one step later changes more than rounding errors do.
    assert np.median(error) < 2e-6 and error.max() < 1e-3, np.sort(error)[-5:]


def test_on_a_cpu_the_finger_has_the_scalar_engine():
    data = states("FingerTurn")
    env, _ = by_matrices("FingerTurn", 1)
    _, control_step = by_matrices("FingerTurn", env.config.substeps)
    after = control_step(data)
    take = jaxrl_vis_envs.jit(jax.vmap(lambda data: mjx_model.take_steps(env._model, data, env.config.substeps, True)))
    found = take(data)
    assert not np.array_equal(found.qpos, after.qpos)  # or they would be matrices, too
    for name in ("qpos", "time"):
        np.testing.assert_allclose(getattr(found, name), getattr(after, name), atol=1e-3)
    assert np.median(np.abs(found.qpos - after.qpos).max(axis=1)) < 2e-6
    np.testing.assert_allclose(found.qacc_warmstart, found.qacc)
    pushed = data.replace(xfrc_applied=jnp.asarray(data.xfrc_applied).at[0, 1, 0].set(1.0))
    found = take(pushed)
    assert np.isnan(found.qpos[0]).all() and np.isfinite(found.qpos[1:]).all()
    # Whoever says that bodies are pushed gets what MJX does.
    single = jax.tree.map(lambda leaf: leaf[0], jax.device_get(pushed))
    disturbed = functools.partial(mjx_model.take_steps, env._model, count=1, exact=True, disturbed=True)
    matrices = functools.partial(mjx_model._take_mjx_steps, env._model, count=1, exact=True)
    assert str(jax.make_jaxpr(disturbed)(single)) == str(jax.make_jaxpr(matrices)(single))
    assert not np.array_equal(control_step(pushed).qvel[0], after.qvel[0])


def odd_states(mj_model: mujoco.MjModel, count: int) -> mjx.Data:
    rng = np.random.default_rng(4)
    data = repeated(mjx_model.rest_data(mj_model), count)
    draw = {"qpos": 0.5, "qvel": 2.0, "qacc_warmstart": 10.0, "qfrc_applied": 1.0, "ctrl": 1.5}
    sizes = {name: getattr(data, name).shape for name in draw}
    return data.replace(**{name: jnp.asarray(rng.normal(0, draw[name], sizes[name]), jnp.float32) for name in draw})


@pytest.mark.parametrize("warmstart", ["enable", "disable"])
def test_a_step_of_a_model_with_everything(warmstart):
    """The model has limits, dry friction, springs, tendons, servos, contacts of both kinds, and joints along any axis."""
    mj_model = odd_model(warmstart)
    model = mjx.put_model(mj_model)
    assert scalar.supports(model)
    data = odd_states(mj_model, 200)
    after = jaxrl_vis_envs.jit(jax.vmap(lambda data: mjx_model.step(model, data, True)))(data)
    contact = np.asarray(after._impl.contact.dist) - np.asarray(after._impl.contact.includemargin)
    assert ((contact < 0).sum(axis=0) > 10).all() and ((contact < 0).sum(axis=1) > 1).sum() > 10
    state = simulate_in_numpy(model, data, 1, in_kernel=warmstart == "disable")
    scale = np.abs(np.asarray(after.qacc)).max(axis=1)
    error = np.abs(state.acceleration - np.asarray(after.qacc)).max(axis=1) / scale
    assert np.median(error) < 2e-6 and error.max() < 1e-3, np.sort(error)[-10:]


REACHER_SUBSTEPS = 10


def reacher_states(count: int) -> mjx.Data:
    """Return states at random velocities and torques, half of the elbows within a step of the limit, on either side of it."""
    rng = np.random.default_rng(6)
    elbow = np.concatenate(
        [rng.uniform(-2.5, 2.5, count // 2), rng.choice([-1, 1], count // 2) * rng.uniform(2.9, 3.05, count // 2)]
    )
    numbers = {
        "qpos": np.stack([rng.uniform(-6, 6, count), elbow], axis=1),
        "qvel": rng.normal(0, 5, (count, 2)),
        "qacc_warmstart": rng.normal(0, 100, (count, 2)),
        "ctrl": rng.uniform(-1, 1, (count, 2)),
        "qfrc_applied": rng.normal(0, 5, (count, 2)),
    }
    still = mjx_model.rest_data(environments.make("Reacher").mj_model)
    return jax.vmap(lambda varied: still.replace(**varied))({name: jnp.float32(value) for name, value in numbers.items()})


@pytest.mark.parametrize("integrator", ["mjINT_EULER", "mjINT_RK4"])
@pytest.mark.parametrize("name", ["Reacher", "FingerTurn", "HandReach"])
def test_a_step_is_that_of_mujoco(name, integrator, monkeypatch):
    """Both compute in double precision. A step of the Runge-Kutta method solves the constraints four times."""
    mj_model = copy.copy(environments.make(name).mj_model)
    mj_model.opt.integrator = getattr(mujoco.mjtIntegrator, integrator)
    mj_model.opt.iterations, mj_model.opt.ls_iterations, mj_model.opt.tolerance = 100, 100, 0
    rng, count = np.random.default_rng(0), 40
    low, high = np.where(mj_model.jnt_limited[:, None], mj_model.jnt_range, [-3.0, 3.0]).T
    drawn = {
        "qpos": rng.uniform(low - 0.2, high + 0.2, (count, mj_model.nq)),
        "qvel": rng.normal(0, 2, (count, mj_model.nv)),
        "qacc_warmstart": rng.normal(0, 10, (count, mj_model.nv)),
        "ctrl": rng.uniform(-1, 1, (count, mj_model.nu)),
    }
    with jax.enable_x64(True):  # or MJX rounds the model
        constants = scalar_model.build_scalar_model(mjx.put_model(mj_model))
    monkeypatch.setattr(dynamics, "sine_and_cosine", lambda angle: (np.sin(angle), np.cos(angle)))
    state = steps.JointState(*(list(drawn[name].T) for name in ("qpos", "qvel", "qacc_warmstart", "qvel")))
    with arithmetic_of(np):
        nothing = list(np.zeros((mj_model.nv, count)))
        control, timestep = list(drawn["ctrl"].T), mj_model.opt.timestep
        after = steps.simulate(constants, state, control, nothing, timestep, 1, exact=True)
    theirs, constrained = mujoco.MjData(mj_model), 0
    for index in range(count):
        for field, values in drawn.items():
            getattr(theirs, field)[:] = values[index]
        mujoco.mj_step(mj_model, theirs)
        constrained += theirs.nefc - mj_model.dof_frictionloss.astype(bool).sum() > 0
        for ours, part in ((after.position, theirs.qpos), (after.velocity, theirs.qvel)):
            np.testing.assert_allclose([number[index] for number in ours], part, rtol=0, atol=1e-11 * np.abs(part).max())
    assert constrained >= 2


def test_the_kernel_of_runge_kutta_takes_the_steps_of_mjx():
    """The interpreted kernel takes the reacher's steps as MJX does, with the task's own number of iterations."""
    env, data = environments.make("Reacher"), reacher_states(48)
    assert env.mj_model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
    matrices = functools.partial(mjx_model.take_steps, env._model, count=REACHER_SUBSTEPS)
    take = functools.partial(steps_kernel.simulate, interpret=True)
    kernel = functools.partial(scalar._simulate_with, take, env._model, count=REACHER_SUBSTEPS, exact=None)
    after, ours = (jaxrl_vis_envs.jit(jax.vmap(steps))(data) for steps in (matrices, kernel))
    assert 0.1 < (np.abs(after.qfrc_constraint[:, 1]) > 0).mean() < 0.9
    for name in ("qpos", "qvel", "time"):
        np.testing.assert_allclose(getattr(ours, name), getattr(after, name), rtol=1e-5, atol=1e-5)
    for name in ("qacc", "qacc_warmstart", "qfrc_constraint"):
        np.testing.assert_allclose(getattr(ours, name), getattr(after, name), rtol=1e-3, atol=1e-2)
    # One step, also beside MJX's own.
    theirs = jaxrl_vis_envs.jit(jax.vmap(lambda data: mjx.step(env._model, data)))(data)
    ours = simulate_in_numpy(env._model, data, 1, in_kernel=True, exact=False)
    np.testing.assert_allclose(ours.position, theirs.qpos, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(ours.velocity, theirs.qvel, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("integrator", ["Euler", "RK4"])
def test_joints_without_constraints_beside_others(integrator):
    xml = f"""
    <mujoco><option integrator="{integrator}"/><default><geom contype="0" conaffinity="0"/></default><worldbody>
      <body><joint limited="true" range="-.1 .1" axis="0 1 0"/><geom type="capsule" size=".02 .1"/></body>
      <body pos="1 0 0"><joint axis="0 1 0"/><geom type="capsule" size=".02 .1" pos=".1 0 0"/></body>
    </worldbody></mujoco>
    """
    mj_model = mujoco.MjModel.from_xml_string(xml)
    model, still = mjx.put_model(mj_model), mjx_model.rest_data(mj_model)
    assert scalar.supports(model)
    data = jax.vmap(lambda qpos: still.replace(qpos=qpos))(jnp.array([[0.0, 0.3], [0.2, -0.2]]))
    after = jaxrl_vis_envs.jit(jax.vmap(functools.partial(mjx_model.take_steps, model, count=3)))(data)
    for take in (steps.simulate_arrays, functools.partial(steps_kernel.simulate, interpret=True)):
        ours = jax.jit(jax.vmap(functools.partial(scalar._simulate_with, take, model, count=3, exact=None)))(data)
        np.testing.assert_allclose(ours.qpos, after.qpos, atol=1e-6)
        np.testing.assert_allclose(ours.qfrc_constraint, after.qfrc_constraint, atol=1e-3)


@pytest.mark.parametrize("is_exact", [False, True])
def test_whether_steps_are_exact_may_be_a_number(is_exact):
    mj_model = odd_model()
    model, data = mjx.put_model(mj_model), odd_states(mj_model, 50)
    known, read = (simulate_in_numpy(model, data, 2, in_kernel=True, exact=exact) for exact in (is_exact, np.int32(is_exact)))
    for one, other in zip(known, read, strict=True):
        np.testing.assert_array_equal(one, other)


def test_scalar_models_are_the_same_where_their_fingerprints_are():
    def fingerprint(**changes):
        mj_model = odd_model()
        for name, value in changes.items():
            getattr(mj_model, name)[:] = value
        return scalar_model.fingerprint(scalar_model.build_scalar_model(mjx.put_model(mj_model)))

    assert hash(fingerprint()) == hash(fingerprint()) and fingerprint() == fingerprint()
    for name in ("dof_damping", "body_mass", "jnt_range", "pair_margin", "geom_pos", "tendon_armature"):
        assert fingerprint(**{name: 0.123}) != fingerprint(), name


@pytest.mark.parametrize("name", ["HandReach", "FingerTurn", "Reacher", "odd"])
def test_masses_and_bias_forces_are_those_of_mujoco(name, monkeypatch):
    """Both compute in double precision, except for the model, which MJX rounds."""
    monkeypatch.setattr(partial_arithmetic, "jnp", np)
    mj_model = copy.copy(odd_model() if name == "odd" else environments.make(name).mj_model)
    mj_model.tendon_armature[:] = 0
    model = mjx.put_model(mj_model)
    tree, _ = links.build_links(model)
    rng = np.random.default_rng(5)
    positions, velocities = rng.uniform(-2, 2, (8, mj_model.nq)), rng.normal(0, 3, (8, mj_model.nv))
    joints = dynamics.joint_transforms(tree, list((positions - mj_model.qpos0).T))
    has_gravity = not mj_model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY
    mass = dynamics.mass_matrix(tree, joints)
    bias = dynamics.bias_forces(tree, joints, list(velocities.T), mj_model.opt.gravity * has_gravity)
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
    angles = np.linspace(-6300, 6300, 400_001).astype(np.float32)  # a thousand turns
    sine, cosine = partial_arithmetic.sine_and_cosine(jnp.asarray(angles))
    np.testing.assert_allclose(sine, np.sin(angles.astype(np.float64)), atol=3e-7)
    np.testing.assert_allclose(cosine, np.cos(angles.astype(np.float64)), atol=3e-7)


def test_the_kernel_takes_the_same_steps():
    """Episodes have two axes, as in training: seeds and environments."""
    env, many_steps = by_matrices("FingerTurn", 3)
    start, end = states("FingerTurn"), many_steps(states("FingerTurn"))
    data, after = (jax.tree.map(lambda leaf: leaf[:6], jax.device_get(each)) for each in (start, end))
    in_two_axes = jax.tree.map(lambda leaf: leaf.reshape(2, 3, *leaf.shape[1:]), data)
    take = functools.partial(steps_kernel.simulate, interpret=True)
    kernel = functools.partial(scalar._simulate_with, take, env._model, count=3, exact=True)
    run = jax.jit(jax.vmap(jax.vmap(kernel)))
    ours = run(in_two_axes)
    for name in ("qpos", "qvel", "qacc", "qacc_warmstart", "qfrc_constraint", "time"):
        mine, theirs = np.asarray(getattr(ours, name)), np.asarray(getattr(after, name))
        np.testing.assert_allclose(mine.reshape(theirs.shape), theirs, rtol=1e-3, atol=1e-3 if "acc" in name else 1e-4)
        assert mine.dtype == theirs.dtype and getattr(ours, name).weak_type == getattr(end, name).weak_type

    pushed = in_two_axes.replace(xfrc_applied=jnp.asarray(in_two_axes.xfrc_applied).at[1, 2, 1, 0].set(1.0))
    is_number = np.isfinite(run(pushed).qpos).all(axis=-1)
    np.testing.assert_array_equal(is_number, [[True, True, True], [True, True, False]])


def lowered_for_cuda(model: mjx.Model, data: mjx.Data) -> str:
    """Return the program of a control step, lowered for NVIDIA GPUs without one."""

    def control_step(data):
        with tracing_for("cuda"), kernels(True):
            return mjx_model.take_steps(model, data, 5, True)

    return lowered_for_nvidia(lambda: jax.jit(jax.vmap(control_step)).trace(data))


@pytest.mark.parametrize("name", ["FingerTurn", "HandReach", "Reacher"])
def test_all_steps_of_a_task_are_one_kernel_for_nvidia(name, monkeypatch):
    monkeypatch.delenv(KERNELS_VARIABLE, raising=False)
    env = environments.make(name)
    data = jax.eval_shape(lambda: jax.vmap(lambda _: mjx.make_data(env.mj_model))(jnp.zeros(8)))
    program = lowered_for_cuda(env._model, data)
    assert program.count("take_physics_steps") >= 1
    assert program.count("stablehlo.") < 100


def test_goals_and_steps_of_the_hand_are_one_kernel(monkeypatch):
    """XLA compiles equal code once: the number, length and exactness of steps are inputs of the kernel."""
    monkeypatch.delenv(KERNELS_VARIABLE, raising=False)
    env = environments.make("HandReach")

    def from_goal(key, action):
        with tracing_for("cuda"), kernels(True):
            return env.act(env.sample_goal(key), action)

    keys, actions = jax.eval_shape(lambda: (jax.random.split(jax.random.key(0), 8), jnp.zeros((8, env.action_size))))
    program = lowered_for_nvidia(lambda: jax.jit(jax.vmap(from_goal)).trace(keys, actions))
    assert program.count("take_physics_steps") >= 1 and len(set(re.findall('ir = "[^"]*"', program))) == 1


def test_steps_are_taken_one_by_one_where_their_kernel_does_not_compile(monkeypatch):
    monkeypatch.setattr(mjx_model, "use_gpu_kernels", lambda probe: probe is not steps_kernel.probe)
    env = environments.make("FingerTurn")
    data = jax.eval_shape(lambda: jax.vmap(lambda _: mjx.make_data(env.mj_model))(jnp.zeros(8)))
    program = lowered_for_cuda(env._model, data)
    assert "take_physics_steps" not in program and program.count("stablehlo.") > 1000


def test_the_probe_is_a_kernel_for_nvidia():
    program = lowered_for_nvidia(steps_kernel.probe)
    assert "take_physics_steps" in program


def test_which_models_the_scalar_engine_supports():
    for name in TASKS:
        assert scalar.supports(environments.make(name)._model), name
    hand = environments.make("HandReach")
    assert scalar.supports(hand._goal_model)
    without_contacts = HandReach(HandReachConfig(contacts=False))._model
    assert scalar.supports(without_contacts)
    assert scalar_model.build_scalar_model(without_contacts).contacts == ()


def test_a_model_whose_numbers_vary_has_none():
    model = mjx.put_model(odd_model())
    found = []

    @jax.jit
    def try_it(damping):
        found.append(scalar.supports(model.replace(dof_damping=damping)))

    try_it(model.dof_damping)
    assert found == [False] and scalar.supports(model)


def test_an_order_that_fills_in_little():
    """Leaves are eliminated first, in a chain that hangs on the first joint, and in two more that a constraint ties."""
    mass = [(0, 0), (1, 1), (1, 0), (2, 2), (2, 1), (2, 0), (3, 3), (3, 0), (4, 4), (4, 0)]
    order = steps.elimination_order(5, mass, [(3, 4), (1,)])
    assert sorted(order) == [0, 1, 2, 3, 4]
    assert order.index(2) > order.index(1) > order.index(0) == 0

    env = environments.make("HandReach")
    constants = scalar_model.build_scalar_model(env._model)
    tree = constants.links
    ancestors = [(joint, other) for joint in range(24) for other in links.ancestor_joints(tree, joint)]
    order = steps.elimination_order(24, ancestors, [contact.pair.joints for contact in constants.contacts])
    place = {joint: index for index, joint in enumerate(order)}
    assert all(place[other] <= place[joint] for joint, other in ancestors)
