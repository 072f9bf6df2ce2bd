"""SawyerReach against what the thesis says of it, and MJX against C MuJoCo on its model."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import one_step

from benchmarks import worlds

COUNT = 512


def make():
    return worlds.make("SawyerReach")


@functools.cache
def starts():
    """State of COUNT episodes at their start."""
    return worlds.reset(make(), jax.random.split(jax.random.key(3), COUNT))[0]


def test_the_numbers_of_the_thesis():
    env = make()
    assert (env.horizon, env.threshold, env.action_size) == (25, 0.1, 3)
    assert abs(np.linalg.norm(env.config.goal_size) - 1.30) < 0.005
    assert abs(env.config.goal_centre[2] - env.config.goal_size[2] / 2 - 0.75) < 1e-6


def test_starts_at_the_centre_of_uniform_goals():
    env = make()
    np.testing.assert_allclose(starts().achieved_state, np.tile(env.config.goal_centre, (COUNT, 1)), atol=1e-3)
    offset = np.asarray(starts().goal_state) - np.array(env.config.goal_centre)
    half = 0.5 * np.array(env.config.goal_size)
    assert (np.abs(offset) < half + 0.06).all()
    np.testing.assert_allclose(offset.std(axis=0), half / np.sqrt(3), rtol=0.1)
    np.testing.assert_allclose(offset.mean(axis=0), 0.0, atol=0.06)


def test_chance_is_the_share_of_the_box_within_the_threshold():
    # A ball of 10 cm in the box: 1.3 %.
    assert float(starts().metrics["success"].mean()) < 0.04


def test_a_unit_of_action_is_five_centimetres():
    state = jax.tree.map(lambda leaf: leaf[:2], starts())
    action = jnp.array([[1.0, -1.0, 0.5], [0.0, 0.0, 0.0]])
    moved = worlds.advance(make(), state, action)
    for _ in range(3):
        moved = worlds.advance(make(), moved, jnp.zeros((2, 3)))
    np.testing.assert_allclose(moved.achieved_state - state.achieved_state, 0.05 * action, atol=2e-3)


def test_the_gripper_stays_over_the_table():
    state = jax.tree.map(lambda leaf: leaf[:2], starts())
    for _ in range(12):
        state = worlds.advance(make(), state, jnp.tile(jnp.array([0.0, 0.0, -1.0]), (2, 1)))
    assert np.asarray(state.achieved_state)[:, 2].min() > 0.69


def test_mjx_steps_as_mujoco_does():
    env = make()
    rng = np.random.default_rng(0)
    targets = np.array(env.config.goal_centre) + np.array(env.config.goal_size) * rng.uniform(-0.5, 0.5, (12, 10, 3))
    starts_qpos = np.tile(np.asarray(starts().data.qpos[0], np.float64), (12, 1))
    states = one_step.visited_states(env.mj_model, starts_qpos, np.zeros((12, 10, 0)), every=13, mocap=targets)
    excess, _ = one_step.velocity_difference(env.mj_model, states)
    assert excess.max() <= 1.0, f"{np.sort(excess)[-10:]}"
