"""`jaxrl_vis.indicator`: the method on plain arrays, fed by an environment that is stepped on the host, and by recordings."""

import numpy as np
import pytest

from jaxrl_vis import indicator
from jaxrl_vis.errors import RequestError

HORIZON, SIZE = 4, 8
OPTIONS = {"preset": "debug", "batch_size": 64, "hidden_sizes": (64, 64), "target_decay": 0.95, "action_penalty": 0.0}
OPTIONS |= {"normalizer_floor": 1.0}


def see(position, noise=0.0, draw=None):
    """Return a camera image [8, 8, 1] uint8 of the point at ``position``, in [-1, 1]: a bright column."""
    column = np.arange(SIZE) - 3.5
    brightness = np.clip(255.0 * (1.0 - np.abs(column - 3.5 * position) / 2.0), 0.0, 255.0)
    image = np.broadcast_to(brightness, (SIZE, SIZE))
    if noise:
        image = image + noise * draw.standard_normal(image.shape)
    return np.clip(np.round(image), 0, 255).astype(np.uint8)[..., None]


def record(count, seed=0, noise=0.0, act=None):
    """Return episodes in which the point moves to the action: observations, actions, goals, and final distances."""
    draw = np.random.default_rng(seed)
    observations = np.zeros((count, HORIZON + 1, SIZE, SIZE, 1), np.uint8)
    actions, goals = np.zeros((count, HORIZON, 1), np.float32), np.zeros((count, SIZE, SIZE, 1), np.uint8)
    away = np.zeros(count)
    for episode in range(count):
        position, goal = 0.0, draw.uniform(-0.8, 0.8)
        goals[episode] = see(goal, noise, draw)
        observations[episode, 0] = see(position, noise, draw)
        for time in range(HORIZON):
            chosen = draw.uniform(-1, 1) if act is None else act(observations[episode, time], goals[episode])[0]
            position = actions[episode, time, 0] = chosen
            observations[episode, time + 1] = see(position, noise, draw)
        away[episode] = abs(position - goal)
    return observations, actions, goals, away


def success(learner, noise=0.0):
    return np.mean(record(40, 9, noise, learner.act)[3] < 0.15)


def test_it_learns_from_recordings_what_their_behaviour_cannot(tmp_path):
    observations, actions, goals, away = record(200)
    assert np.mean(away < 0.15) < 0.3
    np.savez(tmp_path / "recorded.npz", observations=observations, actions=actions, goals=goals)
    learner = indicator.learn(tmp_path / "recorded.npz", updates=800, **OPTIONS)
    assert learner.episodes == 200 and success(learner) >= 0.9


def test_it_learns_while_it_is_stepped_and_forgives_noise():
    noise = 3.0
    learner = indicator.Learner((SIZE, SIZE, 1), 1, HORIZON, capacity=150, tolerance=12.0, tolerance_share=0.95, **OPTIONS)
    draw = np.random.default_rng(1)

    def explore(observation, goal):
        return np.clip(learner.act(observation, goal) + 0.3 * draw.standard_normal(1), -1, 1)

    for turn in range(16):
        for episode in zip(*record(10, turn, noise, explore if turn else None)[:3], strict=True):
            learner.add(*episode)
        metrics = learner.update(50)
    assert learner.config.reward.method == "indicator_tolerance" and learner.episodes == 160
    assert 0.3 < metrics["train/positive_share"] < 0.9 and not any("false" in name for name in metrics)
    assert success(learner, noise) >= 0.9


def test_its_parts_are_functions_of_arrays():
    images = np.stack([see(0.0), see(0.5)])
    np.testing.assert_array_equal(indicator.rewards(images, images[:1]), [1.0, -1.0])
    np.testing.assert_array_equal(indicator.rewards(images + 2, images, tolerance=2.0), [1.0, 1.0])
    keep = indicator.keep_mask(np.float32([1.0, -1.0, -1.0]), np.float32([9.0, 9.0, 0.0]), -1.0, 5.0)
    np.testing.assert_array_equal(keep, [1.0, 0.0, 1.0])


def test_states_are_observations_too():
    learner = indicator.Learner((2,), 1, 3, preset="debug", algorithm="td3")
    learner.add(np.random.default_rng(0).normal(size=(4, 2)), np.zeros((3, 1)))
    assert np.isfinite(learner.update(4)["train/critic_loss"])
    assert learner.act(np.zeros(2), np.ones(2)).shape == (1,)


def test_true_states_pay_the_oracle_and_measure_other_rewards():
    observations, actions, _, _ = record(120)
    positions = np.concatenate([np.zeros((120, 1)), actions[..., 0], actions[:, -1:, 0]], axis=1)[..., None]
    learners = [
        indicator.Learner((SIZE, SIZE, 1), 1, HORIZON, state_size=1, threshold=0.15, **options, **OPTIONS)
        for options in ({"method": "oracle"}, {"tolerance": 255.0})
    ]
    for learner in learners:
        for episode in range(120):
            learner.add(observations[episode], actions[episode], states=positions[episode])
    learners[0].update(400)
    assert success(learners[0]) >= 0.9
    metrics = learners[1].update(4)  # with this tolerance all images are equal
    assert metrics["train/false_positive_share"] == 1.0 and metrics["train/positive_share"] == 1.0
    with pytest.raises(RequestError, match="states are needed where a learner has a state_size"):
        learners[0].add(observations[0], actions[0])
    with pytest.raises(RequestError, match=r"states must be finite numbers of the shape \(6, 1\)"):
        learners[0].add(observations[0], actions[0], states=positions[0, :-1])


def test_mistakes_get_one_line(tmp_path):
    with pytest.raises(RequestError, match="oracle needs true states"):
        indicator.Learner((2,), 1, 3, method="oracle")
    with pytest.raises(RequestError, match=r"images \(H, W, C\) or vectors"):
        indicator.Learner((8, 8), 1, 3)
    learner = indicator.Learner((SIZE, SIZE, 1), 1, HORIZON, preset="debug")
    with pytest.raises(RequestError, match="add episodes first"):
        learner.update(4)
    observations, actions, goals, _ = record(1)
    with pytest.raises(RequestError, match=r"observations must be uint8 of the shape \(5, 8, 8, 1\), not float64"):
        learner.add(observations[0] / 255.0, actions[0])
    with pytest.raises(RequestError, match=r"actions must be finite numbers of the shape \(4, 1\)"):
        learner.add(observations[0], np.full((4, 1), np.nan))
    with pytest.raises(RequestError, match=r"goal must be uint8 of the shape \(8, 8, 1\)"):
        learner.act(observations[0, 0], goals)
    (tmp_path / "text.npz").write_text("no archive")
    np.savez(tmp_path / "short.npz", observations=observations, actions=actions[:, :2])
    np.savez(tmp_path / "other.npz", images=observations)
    for name, message in (("text", "no recorded"), ("missing", "no recorded"), ("other", "no recorded"), ("short", "shape")):
        with pytest.raises(RequestError, match=message):
            indicator.learn(tmp_path / f"{name}.npz")


def test_an_algorithm_of_ones_own_learns_from_recordings():
    """Behaviour cloning works, because each action leads to the position in the next image, whatever came before."""
    observations, actions, goals, _ = record(60)
    algorithm = "benchmarks.tasks.behaviour_cloning:make"
    learner = indicator.Learner((SIZE, SIZE, 1), 1, HORIZON, algorithm=algorithm, balance_probability=1.0, **OPTIONS)
    for episode in zip(observations, actions, goals, strict=True):
        learner.add(*episode)
    first, last = (learner.update(100)["train/imitation_loss"] for _ in range(2))
    assert last < 0.7 * first
    with pytest.raises(RequestError, match="algorithm cannot be"):
        indicator.Learner((2,), 1, 3, algorithm="cloning")
