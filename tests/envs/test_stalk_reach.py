"""StalkReach: an arm among stalks that sway."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrl_vis_envs
from benchmarks.tasks import environments
from jaxrl_vis_envs.plants import bending
from jaxrl_vis_envs.tasks import stalk_arm

COUNT = 64


def make():
    return environments.make("StalkReach")


@functools.cache
def starts():
    """Return the states of COUNT episodes at their start, and the configurations of their goals."""
    return environments.reset(make(), jax.random.split(jax.random.key(3), COUNT))


def target_stalks() -> np.ndarray:
    env, (_, goal) = make(), starts()
    return np.asarray(goal.mocap_pos)[:, env.mj_model.body_mocapid[env.mj_model.body("wind").id], 2].astype(int)


def test_the_goal_is_a_stalk_between_the_jaws():
    env, (state, goal) = make(), starts()
    layout = bending.read_layout(env.mj_model)
    heights = np.asarray(goal.qpos)[:, 0]
    places = np.asarray(jax.vmap(lambda data: bending.at_height(data, layout, data.qpos[0]))(goal))
    np.testing.assert_allclose(places[np.arange(COUNT), target_stalks()], state.goal_state, atol=1e-4)
    assert heights.min() >= env.config.goal_heights[0] and heights.max() <= env.config.goal_heights[1]
    assert set(target_stalks()) == set(range(env.config.stalks))
    assert stalk_arm.is_reachable(np.asarray(state.goal_state, float))[:, 0].all()
    # The stalks of the goal stand still, those of the episode are in the wind; their feet are the same.
    np.testing.assert_array_equal(goal.mocap_pos, state.data.mocap_pos)
    assert np.abs(np.asarray(goal.qpos)[:, 3:]).max() == 0
    swayed = np.abs(np.asarray(state.data.qpos)[:, 3:]).max(axis=1)
    assert (swayed > 1e-4).mean() > 0.9


def test_distance_is_to_the_current_position_of_the_stalk():
    env, (state, _) = make(), starts()
    for _ in range(3):
        state = environments.advance(env, state, np.zeros((COUNT, 3)))
    layout = bending.read_layout(env.mj_model)
    now = np.asarray(jax.vmap(lambda data: bending.at_height(data, layout, data.qpos[0]))(state.data))
    now = now[np.arange(COUNT), target_stalks()]
    grip = np.asarray(stalk_arm.grip_at(state.data.qpos[:, :3]))
    # In the plane: the goal has a height of its own, at which a leaning stalk is elsewhere.
    rest = np.asarray(state.achieved_state) - grip + now
    np.testing.assert_allclose((grip - now)[:, :2], (np.asarray(state.achieved_state) - rest)[:, :2], atol=1e-5)
    assert np.abs(np.asarray(state.achieved_state) - grip)[:, :2].max() > 1e-3
    np.testing.assert_allclose((np.asarray(state.achieved_state) - grip)[:, 2], 0.0, atol=1e-6)


def test_a_unit_of_action_is_three_centimetres():
    env, (state, _) = make(), starts()
    action = jnp.tile(jnp.array([[0.5, 0.0, -1.0]]), (COUNT, 1))
    before = np.asarray(stalk_arm.grip_at(state.data.qpos[:, :3]))
    state = environments.advance(env, state, action)
    for _ in range(8):
        state = environments.advance(env, state, jnp.zeros((COUNT, 3)))
    moved = np.asarray(stalk_arm.grip_at(state.data.qpos[:, :3])) - before
    np.testing.assert_allclose(moved, 0.03 * np.asarray(action), atol=2e-3)


def test_the_arm_pushes_stalks():
    env, (state, _) = make(), starts()
    still = np.abs(np.asarray(state.data.qpos)[:, 3:]).max()
    for _ in range(20):
        state = environments.advance(env, state, np.tile([0.3, 1.0, 0.0], (COUNT, 1)))
    pushed = np.abs(np.asarray(state.data.qpos)[:, 3:]).max(axis=1)
    assert (pushed > 2 * still).mean() > 0.5


def test_stalks_spring_back():
    env, (state, _) = make(), starts()
    bent = np.array(state.data.qpos)
    bent[:, 3:] += 0.1
    state = state.replace(data=state.data.replace(qpos=bent))
    for _ in range(50):
        state = environments.advance(env, state, np.zeros((COUNT, 3)))
    assert np.median(np.abs(np.asarray(state.data.qpos)[:, 3:]).max(axis=1)) < 0.04


@pytest.mark.parametrize(
    ("override", "value", "message"),
    [
        ("stalks", 5, "stalks must be from 1 to 4"),
        ("spacing", (0.1, 0.05), "spacing must be within"),
        ("goal_heights", (0.2, 0.9), "goal_heights must be within"),
        ("lean", 30.0, "lean must be from 0 to 20"),
        ("wind", -0.01, "wind"),
        ("substeps", 4, "substeps"),
    ],
)
def test_bad_settings_are_refused(override: str, value: object, message: str):
    with pytest.raises(ValueError, match=message):
        jaxrl_vis_envs.make("StalkReach", **{override: value})
