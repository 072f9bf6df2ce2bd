"""Poses of cameras and lights follow the bodies in all modes, from `mjx.kinematics` alone, whatever the data contains."""

import itertools
import json
import re
import sys
import types
import typing
from types import SimpleNamespace

import doc_blocks
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

import jaxrl_vis_envs
from jaxrl_vis_envs import registry
from jaxrl_vis_envs.render import Scene, camera, mounts, render
from jaxrl_vis_envs.render.pixel import lights
from jaxrl_vis_envs.tasks.mjx_env import MjxGoalEnv

MODES = ("fixed", "track", "trackcom", "targetbody", "targetbodycom")
AIMED = ' target="far"'
# A lamp and an eye of every mode on a body that moves, on one that hangs on it, and on the world.
RIDERS = "\n".join(
    f'<{kind} name="{{name}} {mode}" mode="{mode}"{AIMED if mode.startswith("target") else ""} pos=".1 -.3 .4" {way}/>'
    for kind, way in (("camera", 'xyaxes="1 .2 0 0 .5 .9"'), ("light", 'dir=".2 .3 -1"'))
    for mode in MODES
)
MODEL = f"""
<mujoco>
  <worldbody>
    {RIDERS.format(name="world")}
    <body name="cart" pos=".1 .2 .3" euler="10 20 30">
      <joint type="slide" axis="1 0 0"/><joint type="hinge" axis="0 0 1" pos=".1 0 0"/>
      <geom name="box" type="box" size=".15 .1 .08"/>
      {RIDERS.format(name="cart")}
      <body name="arm" pos=".3 0 .1" euler="0 40 0">
        <joint type="ball"/><geom type="capsule" fromto="0 0 0 .3 0 .1" size=".03"/>
        {RIDERS.format(name="arm")}
        <body pos=".3 0 .1"><geom type="sphere" size=".05" mass="3"/></body>
      </body>
    </body>
    <body name="far" pos="-.5 .4 .2"><freejoint/><geom type="box" size=".1 .1 .1"/>
      <body name="massless" pos="0 0 .3"><site name="mark"/></body>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def moved():
    """Model, MjData of two poses, and mjx.Data of both, [2, ...], with `mjx.kinematics` only."""
    mj_model = mujoco.MjModel.from_xml_string(MODEL)
    rng = np.random.default_rng(0)
    data, positions = [], []
    for _ in range(2):
        data.append(mujoco.MjData(mj_model))
        mujoco.mj_integratePos(mj_model, data[-1].qpos, rng.uniform(-0.6, 0.6, mj_model.nv), 1.0)
        positions.append(data[-1].qpos.copy())
        mujoco.mj_forward(mj_model, data[-1])
    model, empty = mjx.put_model(mj_model), mjx.make_data(mj_model)
    move = jax.vmap(lambda qpos: mjx.kinematics(model, empty.replace(qpos=qpos)))
    return mj_model, data, jaxrl_vis_envs.jit(move)(jnp.asarray(np.stack(positions), jnp.float32))


def test_camera_poses_match_mujoco_in_all_modes(moved):
    mj_model, data, batch = moved
    assert mj_model.ncam == 3 * len(MODES) and not np.any(batch.cam_xpos)
    scenes = [Scene.from_mjmodel(mj_model, index, 4, 4) for index in range(mj_model.ncam)]
    poses = jaxrl_vis_envs.jit(jax.vmap(lambda one: [camera.camera_pose(scene, one)[:2] for scene in scenes]))(batch)
    for index, (position, rotation) in enumerate(poses):
        for row, truth in enumerate(data):
            name = mj_model.camera(index).name
            np.testing.assert_allclose(position[row], truth.cam_xpos[index], atol=2e-6, err_msg=name)
            np.testing.assert_allclose(rotation[row].reshape(9), truth.cam_xmat[index], atol=5e-6, err_msg=name)


def test_light_poses_match_mujoco_in_all_modes(moved, monkeypatch):
    mj_model, data, batch = moved
    monkeypatch.setattr("jaxrl_vis_envs.render.model.reading.MAX_LIGHTS", mj_model.nlight + 1)
    scene = Scene.from_mjmodel(mj_model, 0, 4, 4)
    positions, directions = jaxrl_vis_envs.jit(jax.vmap(lambda one: lights.light_poses(scene, one)))(batch)
    for row, truth in enumerate(data):
        np.testing.assert_allclose(positions[row], truth.light_xpos, atol=2e-6)
        np.testing.assert_allclose(directions[row], truth.light_xdir, atol=5e-6)


def test_centre_of_mass_of_a_massless_subtree_is_the_body():
    bodies = mounts.Bodies(jnp.array([0.0, 2.0, 1.0, 0.0]), (0, 0, 1, 2))
    data = SimpleNamespace(xipos=np.array([[0, 0, 0], [1, 0, 0], [4, 0, 3], [0, 7, 0]], np.float32))
    np.testing.assert_allclose(mounts.centre_of_mass(bodies, data, 1), [2.0, 0.0, 1.0], atol=1e-6)
    np.testing.assert_allclose(mounts.centre_of_mass(bodies, data, 3), [0.0, 7.0, 0.0])


@pytest.mark.parametrize(("place", "up"), [((0.1, 0.2, 3.0), 1.0), ((0.1, 0.2, -3.0), -1.0)])
def test_vertical_camera_has_right_along_x(place, up):
    rotation = mounts.look_at(jnp.array(place), jnp.array([0.1, 0.2, 0.0]))
    np.testing.assert_allclose(rotation, [[1, 0, 0], [0, up, 0], [0, 0, up]], atol=1e-6)


@pytest.mark.parametrize("kind", ["mjx", "mujoco"])
def test_uncomputed_poses_raise_one_line(moved, kind):
    mj_model = moved[0]
    data = mjx.make_data(mj_model) if kind == "mjx" else mujoco.MjData(mj_model)
    with pytest.raises(ValueError, match="all poses are zero: run mjx.kinematics") as refusal:
        render(Scene.from_mjmodel(mj_model, 0, 4, 4), data)
    assert "\n" not in str(refusal.value)


def documented_task(page: str) -> type:
    """Task from a documentation page, with a camera that is fixed to the puck and looks ahead over the table."""
    path = doc_blocks.ROOT / page
    cells = json.loads(path.read_text())["cells"] if path.suffix == ".ipynb" else []
    sources = [block.text for block in doc_blocks.blocks(path)] if not cells else ["".join(cell["source"]) for cell in cells]
    (source,) = [source for source in sources if "(MjxGoalEnv)" in source]
    eye = '<camera name="above" pos="0 -.5 .3" xyaxes="1 0 0 0 .5 .85"/>'
    source, changes = re.subn(r"%%.*|<camera name=.above.*?/>", "", source)
    source, more = re.subn(r'(<body name="puck".*?>)', rf"\1{eye}", source)
    assert changes == 1 + bool(cells) and more == 1, "the page's model is another: put the camera on its puck here too"
    module = types.ModuleType("documented_task")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, module.__name__, module)  # dataclasses look for their module
        patch.setattr(registry, "_ENTRIES", dict(registry._ENTRIES))
        exec(compile(source, page, "exec"), module.__dict__)
    (task,) = [value for value in vars(module).values() if isinstance(value, type) and value.__module__ == module.__name__
               and issubclass(value, MjxGoalEnv)]  # fmt: skip
    return task


@pytest.mark.parametrize("page", ["docs/extending.md", "notebooks/02_new_environment.ipynb"])
def test_documented_task_renders_goals_from_the_hand_camera(page):
    task = documented_task(page)
    env = task(typing.get_type_hints(task.__init__)["config"](image_size=24, pixels="depth", depth_range=(0.1, 2.0)))
    goals = jaxrl_vis_envs.jit(jax.vmap(env.sample_goal))(jax.random.split(jax.random.key(0), 3))
    images = jaxrl_vis_envs.jit(jax.vmap(env._observer))(goals)
    data = mujoco.MjData(env.mj_model)
    for image, qpos in zip(np.asarray(images), np.asarray(goals.qpos), strict=True):
        data.qpos[:] = qpos
        mujoco.mj_forward(env.mj_model, data)
        truth = np.asarray(env._observer(data))
        assert np.mean(np.abs(image.astype(int) - truth) <= 1) > 0.995
    assert all(np.any(a != b) for a, b in itertools.combinations(np.asarray(images), 2))
