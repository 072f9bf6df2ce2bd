"""The ball of PointMass moves as in MuJoCo, and stops at the rails."""

import mujoco
import numpy as np

from benchmarks.tasks import environments


def test_episodes_match_mujoco_up_to_the_rails() -> None:
    env, random = environments.make("PointMass"), np.random.default_rng(0)
    positions, velocities = random.uniform(-0.3, 0.3, (16, 2)), random.uniform(-0.6, 0.6, (16, 2))
    state = environments.start_at(env, positions, velocities)
    theirs = [mujoco.MjData(env.mj_model) for _ in positions]
    for data, position, velocity in zip(theirs, positions, velocities, strict=True):
        data.qpos[:], data.qvel[:] = position, velocity
    for _ in range(5):
        actions = random.uniform(-1.0, 1.0, (16, 2)).round()
        for _ in range(20):
            state = environments.advance(env, state, actions)
            for data, action in zip(theirs, actions, strict=True):
                data.ctrl[:] = action
                mujoco.mj_step(env.mj_model, data, env.config.substeps)
            wanted = np.array([data.qpos for data in theirs])
            np.testing.assert_allclose(np.asarray(state.data.qpos), wanted, atol=2e-5)
    assert (np.abs(wanted) > 0.34).any() and np.abs(wanted).max() < 0.36
