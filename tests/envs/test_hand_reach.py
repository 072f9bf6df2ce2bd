"""HandReach against measured properties of its original, and MJX against C MuJoCo on its model."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

import jaxrl_vis_envs
from benchmarks.tasks import environments, one_step

COUNT = 128
START_TIPS = [
    (0.9917, 0.7975, 0.1522),
    (1.0209, 0.8017, 0.1519),
    (1.0422, 0.8075, 0.1552),
    (1.0662, 0.8231, 0.1643),
    (0.9505, 0.8403, 0.1617),
]


def make(**overrides):
    return environments.make("HandReach", **overrides)


@functools.cache
def goals():
    """Return the configurations of COUNT goals."""
    return environments.reset(make(), jax.random.split(jax.random.key(3), COUNT))[1]


def tips(data):
    return np.asarray(data.site_xpos)[..., make()._tips, :]


def test_hand_matches_the_original():
    env = make()
    start = env.sample_start(jax.random.key(0))
    assert (env.mj_model.njnt, env.mj_model.nu, env.threshold, env.action_size) == (24, 20, 0.03, 20)
    np.testing.assert_allclose(tips(start), START_TIPS, atol=1e-4)
    # Explicit pairs are the only contacts: nothing else may collide.
    assert not env.mj_model.geom_contype.any() and 18 <= env.mj_model.npair <= 22


def test_goals_result_from_random_actions():
    start = np.array(START_TIPS).reshape(-1)
    goal = tips(goals()).reshape(COUNT, -1)
    distance = np.linalg.norm(goal - start, axis=-1)
    assert abs(distance.mean() - 0.133) < 0.012 and abs(distance.std() - 0.042) < 0.012
    assert distance.min() > 0.03  # never solved at the start
    assert abs(np.sqrt(np.square(goal - goal.mean(axis=0)).sum(axis=-1).mean()) - 0.106) < 0.012
    assert not np.asarray(goals().qvel).any()  # a goal stands still


def test_coupled_joints_move_together():
    qpos = np.asarray(goals().qpos)
    names = [make().mj_model.joint(index).name for index in range(24)]
    for finger in ("FF", "MF", "RF", "LF"):
        distal, middle = qpos[:, names.index(f"{finger}J0")], qpos[:, names.index(f"{finger}J1")]
        slack = 0.00705 * distal - 0.00805 * middle
        assert np.median(np.abs(slack)) < 0.0015


def test_actions_are_target_angles():
    env = make()
    low, high = env.mj_model.actuator_ctrlrange.T
    np.testing.assert_allclose(env._targets(jnp.ones(20)), high, atol=1e-6)
    np.testing.assert_allclose(env._targets(-jnp.ones(20)), low, atol=1e-6)


def test_gym_rule():
    """Thumb and one finger meet near the palm's front, the others stay; one goal in ten is the start itself."""
    env = make(goal_rule="meet")
    keys = jax.random.split(jax.random.key(4), COUNT)
    asked, got = jaxrl_vis_envs.jit(jax.vmap(lambda key: (env._meeting_tips(key), env.sample_goal(key))))(keys)
    moved = np.linalg.norm(np.asarray(asked) - np.array(START_TIPS), axis=-1) > 0.005
    returned = ~moved.any(axis=-1)
    assert 0.02 < returned.mean() < 0.2
    assert (moved[~returned].sum(axis=-1) == 2).all() and moved[~returned][:, 4].all()
    assert set(np.argmax(moved[~returned], axis=-1)) == {0, 1, 2, 3}
    # The joints lead there, or nearly: the little finger is short of some meeting points.
    error = np.linalg.norm(tips(got) - np.asarray(asked), axis=-1)
    assert np.median(error.max(axis=-1)) < 0.003


def test_a_step_matches_mujoco():
    """The task's own single solver iteration suffices."""
    env = make()
    states = one_step.hand_states(env)
    theirs = one_step.mujoco_step(env.mj_model, states, weld_term=True)
    assert (theirs.contacts > 0).sum() > 30
    multiples = one_step.relative_to_bound(one_step.our_step(env, states, "task"), theirs.qvel)
    assert multiples.max() <= 1.0, f"{np.sort(multiples)[-10:]}"
