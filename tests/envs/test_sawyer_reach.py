"""SawyerReach against the thesis, and MJX against C MuJoCo on its model."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.tasks import environments, one_step

COUNT = 512


def make():
    return environments.make("SawyerReach")


@functools.cache
def starts():
    """Return the states of COUNT episodes at their start."""
    return environments.reset(make(), jax.random.split(jax.random.key(3), COUNT))[0]


def test_task_matches_the_thesis():
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
    moved = environments.advance(make(), state, action)
    for _ in range(3):
        moved = environments.advance(make(), moved, jnp.zeros((2, 3)))
    np.testing.assert_allclose(moved.achieved_state - state.achieved_state, 0.05 * action, atol=2e-3)


def test_the_gripper_stays_over_the_table():
    state = jax.tree.map(lambda leaf: leaf[:2], starts())
    for _ in range(12):
        state = environments.advance(make(), state, jnp.tile(jnp.array([0.0, 0.0, -1.0]), (2, 1)))
    assert np.asarray(state.achieved_state)[:, 2].min() > 0.69


def test_a_step_matches_mujoco_without_a_weld_term():
    env = make()
    states = one_step.sawyer_states(env)
    less = one_step.mujoco_step(env.mj_model, states, weld_term=False)
    multiples = one_step.relative_to_bound(one_step.our_step(env, states, "more"), less.qvel)
    assert multiples.max() <= 1.0, f"{np.sort(multiples)[-10:]}"
    # With the task's own iteration, all but a few states with a joint at its limit.
    assert (one_step.relative_to_bound(one_step.our_step(env, states, "task"), less.qvel) <= 1.0).mean() > 0.95
