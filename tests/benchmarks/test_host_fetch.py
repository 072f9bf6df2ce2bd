"""FetchReach on the host: its physics are those of the task, whatever draws it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrl_vis_envs
from benchmarks.tasks import host_fetch


class NoImages:
    """In the place of OpenGL, which tests do without."""

    def __init__(self, *_):
        self.scene = self
        self.flags = {}

    def update_scene(self, data, camera):
        assert camera == "front"

    def render(self):
        return np.full((host_fetch.SIZE, host_fetch.SIZE, 3), 100, np.uint8)

    def close(self):
        pass


@pytest.fixture
def robot(monkeypatch):
    monkeypatch.setattr(host_fetch.mujoco, "Renderer", NoImages)
    return host_fetch.HostFetch(noise=2.0, seed=0)


def test_it_moves_as_the_task_does(robot):
    task = jaxrl_vis_envs.make("FetchReach")
    state = jaxrl_vis_envs.jit(task.reset)(jax.random.key(0))
    robot._begin()
    np.testing.assert_allclose(robot.grip, state.achieved_state, atol=1e-4)
    actions = np.random.default_rng(0).uniform(-1, 1, (5, 4))

    @jaxrl_vis_envs.jit
    def play(state):
        return jax.lax.scan(lambda state, action: (task.advance(state, action),) * 2, state, jnp.asarray(actions))[
            1
        ].achieved_state

    for action, expected in zip(actions, np.asarray(play(state)), strict=True):
        robot.step(action)
        np.testing.assert_allclose(robot.grip, expected, atol=2e-3)


def test_proportional_actions_reach_and_the_camera_has_its_noise(robot):
    images, actions, goal, is_reached = robot.episode(lambda image, goal, towards: np.append(5.0 * towards, 1.0))
    assert is_reached and images.shape == (51, 64, 64, 3) and images.dtype == np.uint8 and goal.shape == (64, 64, 3)
    assert actions.shape == (50, 4) and (actions[:, 3] == 0.0).all()
    assert images.std() == pytest.approx(2.0, abs=0.1) and (images[0] != images[1]).any()
    assert not robot.episode(lambda image, goal, towards: np.append(-towards, 0.0))[3]
