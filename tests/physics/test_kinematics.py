"""Poses by pointer doubling against C MuJoCo's."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import jaxrl_vis_envs
from jaxrl_vis_envs.physics import mjx_model
from jaxrl_vis_envs.physics.mjx_model import mjx

# Two joints on one body, slides and hinges off the origin, a branch, a free body with another on it, a body without joints, a
# carried body with another on it, a camera that rides on a body and one that looks at it, a reference position other than 0.
TREE = """
<mujoco>
  <worldbody>
    <camera name="still" pos="0 -2 1"/>
    <camera name="follower" pos="0 -2 1" mode="targetbody" target="leaf"/>
    <body name="carried" mocap="true" pos="1 0 0" quat=".6 .8 0 0">
      <geom size=".1" pos=".1 0 0"/>
      <body pos="0 .3 0"><geom size=".1"/></body>
    </body>
    <body pos="0 0 .5" euler="10 20 30">
      <joint type="slide" axis="1 2 .5" ref=".1"/>
      <joint type="hinge" axis="0 1 1" pos=".1 .2 -.3" ref=".4"/>
      <joint type="slide" axis="0 0 1" pos=".05 0 0"/>
      <geom type="capsule" size=".05" fromto="0 0 0 .2 0 .1"/>
      <site name="one" pos=".1 .1 0" euler="0 40 0"/>
      <body pos=".3 0 0" euler="0 0 70">
        <geom size=".1" pos="0 .1 0" quat=".5 .5 .5 .5"/>
        <body name="leaf" pos="0 .2 .1">
          <joint axis="1 0 0" pos="0 0 .1"/>
          <joint axis="0 1 0"/>
          <geom type="box" size=".1 .2 .05"/>
          <camera name="rider" pos="0 0 .2" euler="30 0 0"/>
        </body>
      </body>
      <body pos="0 .3 0"><joint axis="0 0 1"/><geom size=".1"/></body>
    </body>
    <body pos="0 0 2" euler="10 0 0">
      <freejoint/>
      <geom type="box" size=".1 .2 .05" pos=".1 0 0"/>
      <body pos="0 .3 0"><joint axis="0 0 1"/><geom size=".1"/></body>
    </body>
  </worldbody>
</mujoco>
"""
POSES = ("xpos", "xquat", "xmat", "xipos", "ximat", "xanchor", "xaxis", "geom_xpos", "geom_xmat", "site_xpos", "site_xmat")


def assert_poses_agree(mj_model: mujoco.MjModel, names: tuple[str, ...]) -> None:
    rng = np.random.default_rng(0)
    qpos = rng.uniform(-2, 2, (8, mj_model.nq)).astype(np.float32)
    mocap_pos = rng.uniform(-1, 1, (8, mj_model.nmocap, 3)).astype(np.float32)
    mocap_quat = rng.normal(size=(8, mj_model.nmocap, 4)).astype(np.float32)
    model, still = mjx.put_model(mj_model), mjx_model.rest_data(mj_model)

    @jaxrl_vis_envs.jit
    @jax.vmap
    def ours(qpos: jax.Array, mocap_pos: jax.Array, mocap_quat: jax.Array) -> mjx.Data:
        with jax.default_matmul_precision("highest"):
            return mjx_model.kinematics(model, still.replace(qpos=qpos, mocap_pos=mocap_pos, mocap_quat=mocap_quat))

    poses = ours(jnp.asarray(qpos), jnp.asarray(mocap_pos), jnp.asarray(mocap_quat))
    data = mujoco.MjData(mj_model)
    for row in range(len(qpos)):
        data.qpos[:], data.mocap_pos[:], data.mocap_quat[:] = qpos[row], mocap_pos[row], mocap_quat[row]
        mujoco.mj_kinematics(mj_model, data)
        mujoco.mj_comPos(mj_model, data)
        mujoco.mj_camlight(mj_model, data)
        for name in names:
            true = getattr(data, name)
            found = np.asarray(getattr(poses, name)[row]).reshape(true.shape)
            np.testing.assert_allclose(found, true, atol=5e-6, err_msg=f"{name} of configuration {row}")


def test_every_kind_of_node():
    assert_poses_agree(mujoco.MjModel.from_xml_string(TREE), (*POSES, "cam_xpos", "cam_xmat"))


@pytest.mark.parametrize("asset", ["fetch_reach", "hand_reach"])
def test_robots(asset):
    assert_poses_agree(mjx_model.load_model(f"{asset}.xml"), POSES)


def test_balls_and_free_bodies_are_left_to_mjx():
    scene = "<body><{0}/><geom size='.1' pos='.1 .2 .3'/></body>"
    for joint in ("freejoint", "joint type='ball'"):
        mj_model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{scene.format(joint)}</worldbody></mujoco>")
        assert_poses_agree(mj_model, ("xpos", "geom_xpos", "geom_xmat"))


def test_a_model_without_joints():
    assert_poses_agree(
        mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='.1'/></worldbody></mujoco>"), ("geom_xpos",)
    )
