"""Physics steps of the scalar engine (`test_steps`) with welds, mocap bodies, spheres on planes and pyramidal cones."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from test_steps import columns, lowered_for_cuda, simulate_in_numpy

import jaxrl_vis_envs
from benchmarks.tasks import environments
from jaxrl_vis_envs.compiling.compilation import KERNELS_VARIABLE
from jaxrl_vis_envs.physics import mjx_model, scalar
from jaxrl_vis_envs.physics.mjx_model import mjx
from jaxrl_vis_envs.physics.scalar import dynamics, link_frames, links, quaternions, scalar_model, steps_kernel
from jaxrl_vis_envs.tasks.fetch_reach import FetchReach, VisualFetchReachConfig

# Welds of two bodies that hang on one joint, on a mocap body and on the world; joints and geoms that mocap bodies carry; planes
# that lean and that mocap bodies carry; at places and along axes that nothing folds away.
ODD = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.004" cone="pyramidal" iterations="6" impratio="1.5" gravity="1 -2 -9"/>
  <default><geom type="capsule" size=".05" density="800" contype="0" conaffinity="0"/></default>
  <worldbody>
    <geom name="slope" type="plane" size="1 1 .1" pos="0 0 -.1" euler=".3 -.2 .4"/>
    <body pos=".2 .1 -.2" euler="1 0 -.3"><geom name="board" type="plane" size="1 1 .1" euler=".2 1 0"/></body>
    <geom name="post" fromto="2 2 0 2 2 1"/>
    <body name="pull" mocap="true" pos=".5 .1 .4" quat=".8 .1 -.5 .2"><geom name="hook" fromto="0 0 0 .1 .2 0"/></body>
    <body name="pot" mocap="true" pos="-.3 .2 .1" quat=".9 .3 .2 -.1">
      <geom name="tray" type="plane" size="1 1 .1" euler=".5 0 0"/>
      <body name="stem" pos=".1 0 .1" euler="0 .2 .3">
        <joint name="sway" axis="1 2 0" stiffness="3" damping=".2"/>
        <geom name="stem" fromto="0 0 0 .1 0 .4" size=".15"/>
        <body name="leaf" pos=".1 0 .4">
          <joint name="flap" axis="0 1 .3"/>
          <geom name="leaf" type="sphere" size=".3" pos=".1 0 .05"/>
        </body>
      </body>
    </body>
    <body name="base" pos=".1 .2 .3" euler=".3 -.2 .5">
      <joint name="turn" axis="1 2 -3" pos=".05 .02 -.03" damping=".3" armature=".02" ref=".2"/>
      <geom fromto="0 0 0 .3 .05 .1"/>
      <body name="arm" pos=".3 .05 .1" euler="3 .5 2">
        <joint name="tilt" axis="0 -1 0" range="-.4 .5"/>
        <joint name="slide" type="slide" axis=".2 0 1"/>
        <geom name="arm" fromto="0 0 0 .25 0 .05" size=".1"/>
        <body name="hand" pos=".2 .1 .05" euler="0 .4 1">
          <joint name="roll" axis="1 0 .2" pos="0 .03 0"/>
          <geom name="hand" type="sphere" size=".12" pos=".1 0 .03"/>
        </body>
      </body>
      <body name="other" pos=".1 -.1 .2" euler="-1 2 .3">
        <joint name="swing" axis="0 0 1"/>
        <joint name="lift" type="slide" axis="0 1 0"/>
        <geom name="other" fromto="0 0 0 .3 .1 0" size=".08"/>
      </body>
    </body>
  </worldbody>
  <contact>
    <pair geom1="slope" geom2="hand" condim="4" friction=".7 .4 .03 .01 .01" margin=".02" solref=".03 .9"/>
    <pair geom1="leaf" geom2="tray" condim="3" friction=".9 .5 .03 .01 .01" solimp=".6 .9 .01"/>
    <pair geom1="board" geom2="leaf" condim="4" friction=".8 .6 .1 .01 .01"/>
    <pair geom1="slope" geom2="leaf" condim="1"/>
    <pair geom1="arm" geom2="stem" condim="3" friction=".9 .9 .01 .01 .01"/>
    <pair geom1="other" geom2="hook" condim="4" friction=".9 .9 .2 .01 .01"/>
    <pair geom1="other" geom2="stem" condim="1"/>
  </contact>
  <equality>
    <weld body1="pull" body2="hand" relpose=".1 .02 -.03 .7 .2 -.5 .1" torquescale=".4" solimp=".6 .9 .3 .4 3"/>
    <weld body1="arm" body2="other" anchor=".1 .02 .05" relpose=".1 .3 .05 -.5 .4 .3 .2" solref=".05 .7"/>
    <weld body1="stem" body2="base" anchor=".01 .02 .05" torquescale="2" solref="-200 -20"/>
    <weld body1="leaf" body2="world" solref=".1 1" solimp=".3 .8 1"/>
  </equality>
</mujoco>
"""


def odd_model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(ODD)


def odd_states(mj_model: mujoco.MjModel, count: int) -> mjx.Data:
    rng = np.random.default_rng(4)
    still = jax.device_get(mjx_model.rest_data(mj_model))  # on a device each size of leaf would be a program to compile
    data = jax.tree.map(lambda leaf: np.tile(leaf, (count,) + (1,) * leaf.ndim), still)
    draw = {"qpos": 0.5, "qvel": 2.0, "qacc_warmstart": 10.0, "qfrc_applied": 1.0, "mocap_pos": 0.2, "mocap_quat": 1.0}
    drawn = {name: rng.normal(0, draw[name], getattr(data, name).shape) for name in draw}
    drawn["mocap_pos"] += np.asarray(data.mocap_pos)
    return data.replace(**{name: jnp.asarray(values, jnp.float32) for name, values in drawn.items()})


@functools.cache
def by_matrices(name: str):
    """Return the task, and its physics steps without kernels: one program for any number of them."""
    env = environments.make(name)

    def steps_of(data, count):
        return jax.lax.fori_loop(0, count, lambda _, data: mjx_model.step(env._model, data, False), data)

    return env, jaxrl_vis_envs.jit(jax.vmap(steps_of, in_axes=(0, None)))


@functools.cache
def states(name: str) -> mjx.Data:
    """48 episodes in the middle of a control step, after some random ones; half press on the table or into the stalks."""
    env, step = by_matrices(name)
    actions = np.random.default_rng(0).uniform(-1, 1, (9 if name == "StalkReach" else 5, 48, env.action_size))
    if name != "SawyerReach":
        axis, sign = {"FetchReach": (2, -1.0), "StalkReach": (1, 1.0)}[name]
        actions[:, ::2, axis] = sign
    with pytest.MonkeyPatch.context() as patch:
        # What `act` does before its steps.
        patch.setattr(mjx_model, "take_steps", lambda model, data, count, **rest: data)
        patch.setattr(mjx_model, "simulate", lambda model, data, count, **rest: data)
        begin = jax.jit(jax.vmap(lambda data, action: env.act(mjx_model.kinematics(env._model, data), action)))
        data = jax.jit(jax.vmap(env.sample_start))(jax.random.split(jax.random.key(3), 48))
        for action in jnp.asarray(actions, jnp.float32):
            data = step(begin(data, action), env.config.substeps)
        return step(begin(data, action), 3)


@pytest.mark.parametrize("in_kernel", [True, False])
def test_a_step_of_a_model_with_everything(in_kernel):
    mj_model = odd_model()
    model = mjx.put_model(mj_model)
    assert scalar.supports(model)
    data = odd_states(mj_model, 200)
    # Contacts of capsules are where the scalar engine has them only if exact.
    after = jaxrl_vis_envs.jit(jax.vmap(lambda data: mjx_model.step(model, data, True)))(data)
    contact = np.asarray(after._impl.contact.dist) - np.asarray(after._impl.contact.includemargin)
    assert ((contact < 0).sum(axis=0) >= 10).all(), (contact < 0).sum(axis=0)
    state = simulate_in_numpy(model, data, 1, in_kernel, exact=True)
    scale = np.abs(np.asarray(after.qacc)).max(axis=1)
    error = np.abs(state.acceleration - np.asarray(after.qacc)).max(axis=1) / scale
    assert np.median(error) < 2e-6 and error.max() < 1e-3, np.sort(error)[-10:]


@pytest.mark.parametrize("name", ["FetchReach", "SawyerReach", "StalkReach"])
def test_a_step_of_each_task_is_that_of_matrices(name):
    env, step = by_matrices(name)
    data = states(name)
    after = step(data, 1)
    if name != "SawyerReach":
        touching = (np.asarray(after._impl.contact.dist - after._impl.contact.includemargin) < 0).sum(axis=1)
        assert (touching == 0).sum() > 5 and (touching > 0).sum() > 5
    state = simulate_in_numpy(env._model, data, 1, in_kernel=True, exact=False)
    assert state.acceleration.dtype == np.float32
    # Rounding errors of float32, 1e-7 of what cancels: stiff welds and contacts, whose forces nearly balance.
    scale = np.abs(np.asarray(after.qacc)).max(axis=1)
    error = np.abs(state.acceleration - np.asarray(after.qacc)).max(axis=1) / scale
    assert np.median(error) < 1e-4 and error.max() < 3e-3, np.sort(error)[-5:]
    np.testing.assert_allclose(state.velocity, after.qvel, atol=5e-5)
    np.testing.assert_allclose(state.force, after.qfrc_constraint, atol=3e-4 * np.abs(after.qfrc_constraint).max())


@pytest.mark.parametrize("name", ["FetchReach", "SawyerReach", "StalkReach"])
def test_a_control_step_of_each_task_is_that_of_matrices(name):
    env, step = by_matrices(name)
    after = step(states(name), env.config.substeps)
    state = simulate_in_numpy(env._model, states(name), env.config.substeps, in_kernel=True, exact=False)
    error = np.abs(state.position - np.asarray(after.qpos)).max(axis=1)
    # A contact that begins one step later changes more than rounding errors do.
    assert np.median(error) < 1e-6 and error.max() < 1e-4, np.sort(error)[-5:]


def test_the_kernel_takes_the_same_steps():
    """Episodes have two axes, as in training: seeds and environments."""
    env, step = by_matrices("SawyerReach")
    start = states("SawyerReach")
    end = step(start, 3)
    data, after = (jax.tree.map(lambda leaf: leaf[:6], jax.device_get(each)) for each in (start, end))
    in_two_axes = jax.tree.map(lambda leaf: leaf.reshape(2, 3, *leaf.shape[1:]), data)
    take = functools.partial(steps_kernel.simulate, interpret=True)
    kernel = functools.partial(scalar._simulate_with, take, env._model, count=3, exact=None)
    run = jax.jit(jax.vmap(jax.vmap(kernel)))
    ours = run(in_two_axes)
    for name in ("qpos", "qvel", "qacc", "qacc_warmstart", "qfrc_constraint", "time"):
        mine, theirs = np.asarray(getattr(ours, name)), np.asarray(getattr(after, name))
        atol = 3e-5 * np.abs(theirs).max()
        np.testing.assert_allclose(mine.reshape(theirs.shape), theirs, atol=atol, rtol=0)
        assert mine.dtype == theirs.dtype and getattr(ours, name).weak_type == getattr(end, name).weak_type

    let_go = in_two_axes.replace(eq_active=jnp.asarray(in_two_axes.eq_active).at[0, 1].set(False))
    is_number = np.isfinite(run(let_go).qpos).all(axis=-1)
    np.testing.assert_array_equal(is_number, [[True, False, True], [True, True, True]])


@pytest.mark.parametrize("name", ["FetchReach", "SawyerReach", "StalkReach"])
def test_all_steps_of_a_task_are_one_kernel_for_nvidia(name, monkeypatch):
    monkeypatch.delenv(KERNELS_VARIABLE, raising=False)
    env = environments.make(name)
    data = jax.eval_shape(lambda: jax.vmap(lambda _: mjx.make_data(env.mj_model))(jnp.zeros(8)))
    program = lowered_for_cuda(env._model, data)
    assert program.count("take_physics_steps") >= 1
    assert program.count("stablehlo.") < 150


def test_what_is_drawn_at_a_mocap_body_changes_nothing():
    env = FetchReach(VisualFetchReachConfig(cross_hair=True))
    assert scalar.supports(env._model)
    plain, drawn = (scalar_model.build_scalar_model(model) for model in (environments.make("FetchReach")._model, env._model))
    assert len(drawn.welds) == len(plain.welds) == 1 and len(drawn.contacts) == len(plain.contacts) == 2
    assert drawn.mocaps == plain.mocaps == (0,)


REFUSED = {
    "joint": ('<weld body1="leaf" body2="world" solref=".1 1" solimp=".3 .8 1"/>', '<joint joint1="sway" joint2="flap"/>'),
    "connect": ('<weld body1="leaf" body2="world" solref=".1 1" solimp=".3 .8 1"/>', '<connect body1="leaf" anchor="0 0 0"/>'),
    "inactive weld": ('torquescale="2"', 'torquescale="2" active="false"'),
    "weld of what never moves": ('body1="leaf" body2="world"', 'body1="pull" body2="pot"'),
    "elliptic, about the normal": ('cone="pyramidal"', 'cone="elliptic"'),
    "rolling friction": ('geom2="hook" condim="4"', 'geom2="hook" condim="6"'),
    "capsule on plane": ('geom1="slope" geom2="leaf"', 'geom1="slope" geom2="arm"'),
    "two spheres": ('geom1="slope" geom2="leaf"', 'geom1="hand" geom2="leaf"'),
    "contact of what never moves": ('geom1="other" geom2="stem"', 'geom1="post" geom2="hook"'),
    "sensor": ("</mujoco>", '<sensor><jointpos joint="sway"/></sensor></mujoco>'),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_steps_do_not_take(what):
    old, new = REFUSED[what]
    assert ODD.count(old) == 1
    assert not scalar.supports(mjx.put_model(mujoco.MjModel.from_xml_string(ODD.replace(old, new))))


def test_steps_do_not_take_welds_of_sites():
    spec = mujoco.MjSpec.from_string(ODD)
    for body in ("leaf", "base"):
        spec.body(body).add_site(name=body)
    weld = spec.add_equality(type=mujoco.mjtEq.mjEQ_WELD, objtype=mujoco.mjtObj.mjOBJ_SITE, name1="leaf", name2="base")
    assert not scalar.supports(mjx.put_model(spec.compile()))
    spec.delete(weld)
    assert scalar.supports(mjx.put_model(spec.compile()))


def test_places_of_welded_bodies():
    """Poses are compared with MJX's kinematics, with joints that turn more than once."""
    mj_model = odd_model()
    model = mjx.put_model(mj_model)
    data = odd_states(mj_model, 20)
    data = data.replace(qpos=4.0 * data.qpos)
    constants = scalar_model.build_scalar_model(model)
    after = jax.jit(jax.vmap(lambda data: mjx_model.kinematics(model, data)))(data)
    numbers = np.concatenate([data.mocap_pos, data.mocap_quat], axis=2).reshape(20, -1)
    mocap = link_frames.mocap_poses(tuple(links.mocap_link(index) for index in constants.mocaps), columns(numbers))
    moved = columns(np.asarray(data.qpos) - np.asarray(model.qpos0))
    joints = dynamics.joint_transforms(constants.links, moved, range(len(moved)))
    where = link_frames.LinkFrames(constants.links, joints, links.WORLD, mocap)
    for constraint, (one, other) in zip(constants.welds, zip(model.eq_obj1id, model.eq_obj2id, strict=True), strict=True):
        (first, second), (_, rotation) = constraint.weld.frames, constraint.weld.quaternions
        ours = quaternions.multiply(where.quaternion(second.link), rotation)
        ours, theirs = np.stack([np.broadcast_to(part, 20) for part in ours], axis=1), np.asarray(after.xquat)[:, other]
        ours = ours * np.sign(np.sum(ours * theirs, axis=1, keepdims=True))
        np.testing.assert_allclose(ours, theirs, atol=3e-6)
        point = where.point(first.link, first.position)
        position = np.stack([np.broadcast_to(part, 20) for part in point], axis=1)
        np.testing.assert_allclose(position, np.asarray(after.xpos)[:, one], atol=3e-6)
