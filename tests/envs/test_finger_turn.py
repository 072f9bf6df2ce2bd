"""FingerTurn against measured properties of its original, and MJX against C MuJoCo on its model."""

import functools

import jax
import mujoco
import numpy as np
import pytest

import jaxrl_vis_envs
from benchmarks.tasks import environments, one_step

COUNT = 512


def make():
    return environments.make("FingerTurn")


@functools.cache
def starts_and_goals():
    """Return the states of COUNT episodes at their start, and the configurations that their goals show."""
    return environments.reset(make(), jax.random.split(jax.random.key(3), COUNT))


def starts():
    return starts_and_goals()[0]


def test_starts_are_contact_free():
    env = make()
    data = mujoco.MjData(env.mj_model)
    for qpos in np.asarray(starts().data.qpos):
        data.qpos[:] = qpos
        mujoco.mj_forward(env.mj_model, data)
        assert data.ncon == 0
    assert not np.asarray(starts().data.qvel).any()


def test_starts_fill_the_ranges_of_the_joints():
    qpos = np.asarray(starts().data.qpos)
    limit = np.deg2rad(110)
    # Contact-free starts favour no side much; a uniform angle has a standard deviation of range / sqrt(12).
    for joint, half_range in ((0, limit), (1, limit), (2, np.pi)):
        assert (np.abs(qpos[:, joint]) <= half_range).all() and np.abs(qpos[:, joint]).max() > 0.97 * half_range
        assert abs(qpos[:, joint].std() / (2 * half_range / np.sqrt(12)) - 1) < 0.1


def test_goals_are_tips_at_uniform_angles():
    goal = np.asarray(starts().goal_state)
    np.testing.assert_allclose(np.linalg.norm(goal, axis=-1), 0.13, atol=1e-5)
    angle = np.sort(np.arctan2(goal[:, 0], goal[:, 1]))
    uniform = np.linspace(-np.pi, np.pi, COUNT)
    assert np.abs(angle - uniform).max() < 1.63 / np.sqrt(COUNT) * 2 * np.pi  # Kolmogorov-Smirnov at 1 %
    assert abs(float(starts().metrics["success"].mean()) - 0.174) < 3 * np.sqrt(0.174 * 0.826 / COUNT)


def test_the_finger_hangs_away_from_the_spinner_in_the_goal():
    qpos = np.asarray(starts_and_goals()[1].qpos)
    np.testing.assert_allclose(qpos[:, :2], np.tile([-np.pi / 2, 0.0], (COUNT, 1)), atol=1e-6)


def test_three_images_by_default_and_one_by_choice():
    assert jaxrl_vis_envs.make("VisualFingerTurn", image_size=8).observation_spec.shape == (12, 8, 8)
    assert jaxrl_vis_envs.make("VisualFingerTurn", image_size=8, frame_stack=1).observation_spec.shape == (4, 8, 8)


@pytest.mark.parametrize(("substeps", "period"), [(21, 0.21), (2, 0.02)])
def test_control_period(substeps, period):
    assert jaxrl_vis_envs.make("FingerTurn", substeps=substeps).control_period == pytest.approx(period)


def test_a_step_matches_mujoco():
    """The task's own number of solver iterations suffices."""
    env = make()
    states = one_step.finger_states(env)
    theirs = one_step.mujoco_step(env.mj_model, states, weld_term=True)
    assert (theirs.contacts > 0).sum() > 30
    multiples = one_step.relative_to_bound(one_step.our_step(env, states, "task"), theirs.qvel)
    assert multiples.max() <= 1.0, f"{np.sort(multiples)[-10:]}"
