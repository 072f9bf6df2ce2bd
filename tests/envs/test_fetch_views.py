"""VisualFetchReach as in contrastive RL: its camera, compared with MuJoCo's own, and its goal images."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import jaxrl_vis_envs
from jaxrl_vis.config import preset
from jaxrl_vis.errors import RequestError
from jaxrl_vis.learner.environment import make_env
from jaxrl_vis_envs.render.viewpoint import camera_pose, intrinsic_matrix

SIZE = 32


@functools.cache
def env():
    return jaxrl_vis_envs.make("VisualFetchReach", view="contrastive_rl", pixels="rgb", image_size=SIZE)


@functools.cache
def states():
    """States of eight episodes at their start."""
    return jax.device_get(jaxrl_vis_envs.jit(jax.vmap(env().reset))(jax.random.split(jax.random.key(0), 8)))


def test_the_camera_is_mujocos_free_camera_at_their_settings():
    model = env().mj_model
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    free = mujoco.MjvCamera()
    free.type = mujoco.mjtCamera.mjCAMERA_FREE
    free.lookat[:] = (1.2, 0.8, 0.5)
    free.distance, free.azimuth, free.elevation = 0.8, 180.0, -30.0
    drawn = mujoco.MjvScene(model, 100)
    mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), mujoco.MjvPerturb(), free, mujoco.mjtCatBit.mjCAT_ALL, drawn)
    theirs = drawn.camera[0]
    position, forward, up = (np.array(array) for array in (theirs.pos, theirs.forward, theirs.up))
    position = (position + np.array(drawn.camera[1].pos)) / 2.0  # both eyes
    our_position, rotation, _ = camera_pose(env()._observer.scene, data)
    np.testing.assert_allclose(our_position, position, atol=1e-6)
    np.testing.assert_allclose(np.asarray(rotation)[:, 2], -forward, atol=1e-6)
    np.testing.assert_allclose(np.asarray(rotation)[:, 1], up, atol=1e-6)
    focal = theirs.frustum_near / theirs.frustum_top * SIZE / 2.0  # in pixels
    np.testing.assert_allclose(intrinsic_matrix(env()._observer.scene)[1, 1], focal, rtol=1e-6)


@pytest.mark.slow
def test_goal_images_show_where_ten_proportional_steps_lead():
    state, task = states(), jaxrl_vis_envs.make("FetchReach")
    assert state.obs["desired_goal"].shape == (8, 3, SIZE, SIZE)
    start = jaxrl_vis_envs.jit(task.reset)(jax.random.key(0))

    @jaxrl_vis_envs.jit
    def drive(goal):
        def step(driven, _):
            delta = jnp.clip(10.0 * (goal - driven.achieved_state), -1.0, 1.0)
            return task.advance(driven, jnp.concatenate([delta, jnp.zeros(1)])), None

        driven = jax.lax.scan(step, start, length=10)[0]
        return driven.data, driven.achieved_state

    data, reached = drive(state.goal_state[0])
    assert 0.0 < np.linalg.norm(reached - state.goal_state[0]) < 0.02
    image = jaxrl_vis_envs.jit(lambda data: env().observe(env().state_at(data, jnp.zeros(3))))(data)
    assert np.mean(np.asarray(image) != state.obs["desired_goal"][0]) < 0.01
    assert (np.mean(state.obs["desired_goal"] != state.obs["observation"], axis=(1, 2, 3)) > 0.03).all()
    # Success is about the goal that was asked for, within 5 cm, not about what its image shows.
    away = np.abs(state.goal_state - state.achieved_state)
    assert env().threshold == 0.05 and (away <= 0.15 + 1e-5).all() and away.max() > 0.1


def test_it_is_an_option_of_training_and_excludes_the_other_release():
    config = preset("debug", env_options=("view=contrastive_rl",), pixels="rgb")
    assert make_env(config).camera == "contrastive_rl"
    with pytest.raises(RequestError, match="leave out cross_hair and goal_at"):
        make_env(config.replace(env_options=("view=contrastive_rl", "cross_hair=true")))
    with pytest.raises(RequestError, match="view"):
        make_env(config.replace(env_options=("view=theirs",)))
