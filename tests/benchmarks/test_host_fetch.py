"""FetchReach on the host: episodes, recordings and records, with stand-ins for the robot and for OpenGL."""

import json
import sys

import numpy as np
import pytest

from benchmarks.ledger.tables import host
from benchmarks.tasks import host_fetch, host_learning
from jaxrl_vis.errors import RequestError


class Point:
    """Stand-in for Gymnasium-Robotics' environment, with a grip that moves by at most 5 cm per step."""

    def reset(self, seed):
        self.grip, self.goal = np.zeros(3), np.random.default_rng(seed).uniform(-0.15, 0.15, 3)
        return self._observation(), {}

    def step(self, action):
        assert action.shape == (4,) and action.dtype == np.float32 and np.abs(action).max() <= 1.0
        self.grip = self.grip + 0.05 * action[:3]
        return self._observation(), 0.0, False, False, {}

    def _observation(self):
        return {"achieved_goal": self.grip, "desired_goal": self.goal}


class Picture:
    """Stand-in for the camera; the brightness of its image is the grip's first coordinate."""

    def __init__(self, env):
        self.env = env

    def render(self):
        return np.full(host_fetch.SHAPE, np.clip(100 + 400 * self.env.grip[0], 0, 255), np.uint8)

    def close(self):
        pass


@pytest.fixture
def hosted(monkeypatch):
    monkeypatch.setattr(host_fetch, "make_env", Point)
    monkeypatch.setattr(host_fetch, "Camera", Picture)


def towards(image, goal, displacement):
    return np.append(20.0 * displacement, 0.0)


@pytest.mark.usefixtures("hosted")
def test_an_episode_holds_what_was_seen_done_and_true():
    robot = host_fetch.HostFetch(noise=2.0, seed=0)
    played = robot.run_episode(towards)
    assert played.is_reached and played.observations.shape == (51, 32, 32, 1) and played.observations.dtype == np.uint8
    assert played.actions.shape == (50, 4) and np.abs(played.actions).max() == 1.0
    np.testing.assert_allclose(played.states[1:-1], np.cumsum(0.05 * played.actions[:, :3], axis=0), atol=1e-5)
    assert np.std(played.observations[0] - 100.0) == pytest.approx(2.0, abs=0.2)
    # The goal image shows the goal, where the last state is.
    assert played.goal.mean() == pytest.approx(100 + 400 * played.states[-1, 0], abs=1.0)
    assert not robot.run_episode(lambda image, goal, displacement: -towards(image, goal, displacement)).is_reached


@pytest.mark.usefixtures("hosted")
def test_a_seed_repeats_goals_and_noise():
    robot = host_fetch.HostFetch(noise=5.0, seed=3)
    first, second = robot.run_episode(towards), robot.run_episode(towards)
    robot.reseed(3)
    np.testing.assert_array_equal(robot.run_episode(towards).observations, first.observations)
    assert (first.states[-1] != second.states[-1]).all()


def test_what_is_missing_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium_robotics", None)
    with pytest.raises(RequestError, match="pip install gymnasium-robotics"):
        host_fetch.make_env()


@pytest.mark.usefixtures("hosted")
def test_cells_leave_records_that_a_table_is_written_from(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(host_learning, "_SMALL", {"preset": "debug"})
    small = [
        "--steps",
        "200",
        "--interval",
        "100",
        "--eval-episodes",
        "2",
        "--final-episodes",
        "2",
        "--updates-per-episode",
        "2",
    ]
    small += ["--episodes", "4", "--updates", "500", "--results", str(tmp_path), "--recordings", str(tmp_path)]
    names = ["live_exact_noise0_seed100", "recorded_tolerance_noise2_seed100"]
    assert host_learning.main(["--cells", *names, *small]) == 0
    live, recorded = (json.loads((tmp_path / f"{name}.json").read_text()) for name in names)
    assert [row["env_steps"] for row in live["rows"]] == [100, 200] and live["size"]["steps"] == 200
    assert 0.0 <= live["shares"]["false_positive_share"] <= 1.0 and live["versions"]["mujoco"]
    assert 0.0 <= recorded["shares"]["false_negative_share"] <= 1.0
    assert recorded["behaviour_success"] in (0.0, 0.25, 0.5, 0.75, 1.0) and len(recorded["rows"]) == 5
    table = host.rows(tmp_path)
    assert "| live | `indicator_balance_filter` | 0 | 100 | never |" in table
    assert "| recorded | `indicator_tolerance` | 2 | 100 |" in table
    capsys.readouterr()
    assert host_learning.main(["--cells", names[0], *small]) == 0 and not capsys.readouterr().out  # it has its record
    assert host_learning.main(["--cells", "live_magic"]) == 2
    assert "there is no cell live_magic" in capsys.readouterr().err
