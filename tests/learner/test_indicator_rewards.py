"""Learning without ground truth: rewards computed from observations, their diagnostics, and what disturbs them."""

import jax
import jax.numpy as jnp
import numpy as np
import probe_environments as probes
import pytest
from learners import begin, rollout, train_iteration
from test_ddpg import DISCOUNT, trained

from jaxrl_vis.config import preset, validate
from jaxrl_vis.errors import RequestError
from jaxrl_vis.learner.acting.rollout import add_noise
from jaxrl_vis.learner.ddpg import diagnostics
from jaxrl_vis.learner.ddpg.learned_reward import make_learned_reward
from jaxrl_vis.learner.memory import reward_errors
from jaxrl_vis.learner.memory.replay import Replay
from jaxrl_vis.learner.memory.rewards import cosine_reward
from jaxrl_vis.learner.memory.sampling import Choice, Sampler
from jaxrl_vis.learner.networks import normalizer
from jaxrl_vis.learner.resolved import resolve
from jaxrl_vis.learner.train_step import make_train_step
from jaxrl_vis.run.storage.metrics import with_precision
from jaxrl_vis.types import Batch, Episodes
from jaxrl_vis_envs import goals

BEST = 1.0 / (1.0 - DISCOUNT)


class StaysPut(probes.SeenGoWhereTold):
    """Probe that stays at its start, on either side; the goal is the start or the point opposite."""

    def start(self, key):
        place_key, side_key, goal_key = jax.random.split(key, 3)
        place = jax.random.uniform(place_key, (1,), minval=0.4, maxval=0.9)
        position = jnp.where(jax.random.bernoulli(side_key), place, -place)
        return position, jnp.where(jax.random.bernoulli(goal_key), position, -position)

    def move(self, position, action):
        return position


# -- The autoencoder


@pytest.fixture(scope="module")
def with_autoencoder():
    return trained(StaysPut(), method="autoencoder", iterations=14, batch_size=32)


def test_the_return_of_an_autoencoder_is_in_q(with_autoencoder):
    """Nothing moves, so Q is the similarity of point and goal, received for ever: 1 for equal ones, less across the image."""
    program, train, metrics = with_autoencoder
    networks = program.networks
    points = np.linspace(0.45, 0.85, 8, dtype=np.float32)[:, None]

    @jax.jit
    def values_and_rewards(train, goals):
        images = [jax.vmap(probes.SeenGoWhereTold().see)(each) for each in (points, goals)]
        inputs = [networks.prepare(networks.scaling(train.normalizer), each) for each in images]
        latents = jnp.stack([networks.encode(train.agent.critic, each) for each in inputs])
        rewards = cosine_reward(*(networks.encode(train.agent.reward_model.params, each) for each in inputs))
        return networks.value(train.agent.critic, latents, jnp.zeros((8, 1))), rewards

    values, rewards = values_and_rewards(train, points)
    np.testing.assert_allclose(rewards, 1.0, atol=1e-5)
    np.testing.assert_allclose(values, BEST, atol=0.15)
    values, rewards = values_and_rewards(train, -points)
    assert rewards.min() < 0.5  # there are unlike ones among them
    np.testing.assert_allclose(values, BEST * rewards, atol=0.5)
    assert abs(metrics["train/value_at_goals"][0] - BEST) < 0.1
    assert (program.resolved.target_minimum, program.resolved.target_maximum) == (0.0, BEST)


def test_an_autoencoder_learns_to_reconstruct(with_autoencoder):
    program, train, late = with_autoencoder
    _, early = train_iteration(program, begin(program, jax.random.key(7)[None]))
    assert late["train/autoencoder_loss"][0] < 0.5 * early["train/autoencoder_loss"][0]
    assert set(train.agent.reward_model.params) == {"encoder", "decoder"}


def test_likeness_is_a_cosine_that_is_cut_off_at_a_right_angle():
    latents = jnp.array([[3.0, 0.0], [1.0, 1.0], [0.0, 2.0], [-1.0, 0.0], [0.0, 0.0]])
    goal = jnp.array([[0.5, 0.0]])
    np.testing.assert_allclose(cosine_reward(latents, goal), [1.0, np.sqrt(0.5), 0.0, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(cosine_reward(latents[:1], goal, 1.0, -1.0), [1.0])
    gradient = jax.grad(lambda latents: jnp.sum(cosine_reward(latents, goal)))(latents)
    assert not np.any(gradient)


def test_stacked_images_are_compared_as_goals():
    """The point has moved and the goal is static: they are equal if their newest images are."""

    class Stacked(StaysPut):
        frame_stack = 2

        def see(self, position):
            return self.as_goal(jnp.tile(super().see(position), (2, 1, 1)))

    env, size = Stacked(), 3
    program = make_train_step(env, preset("debug", method="autoencoder"))
    networks, resolved = program.networks, program.resolved
    learned_reward = make_learned_reward(networks, program.config, resolved)
    assert learned_reward is not None
    train = jax.tree.map(lambda leaf: leaf[0], begin(program, jax.random.key(0)[None]).train)
    moving = jax.random.bits(jax.random.key(1), (size, 2, 8, 8), jnp.uint8)
    reached = jax.vmap(env.as_goal)(moving)
    batch = Batch(jnp.stack([moving, reached, moving]), jnp.zeros((size, 1)), jnp.zeros((size, 1)), jnp.zeros((size, 1)))

    @jax.jit
    def rewards(train, batch):
        train = train.replace(normalizer=normalizer.update(train.normalizer, batch.observations))
        scaling = networks.batch_scaling(train.statistics)
        inputs = networks.prepare_batch(scaling, batch)
        both = batch.replace(achieved_goal=reached), batch
        return [
            learned_reward.compute_batch_rewards(train.agent.reward_model, scaling.observations, inputs, each).reward
            for each in both
        ]

    of_reached, of_moving = rewards(train, batch)
    np.testing.assert_allclose(of_reached, 1.0, atol=1e-5)
    assert np.all(of_moving < 0.999)


def test_other_methods_carry_no_autoencoder():
    loop = jax.eval_shape(make_train_step(StaysPut(), preset("debug")).init, jax.random.key(0)[None])
    assert loop.train.agent.reward_model is None


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"method": "autoencoder", "random_shift": 2}, "random_shift and method autoencoder exclude each other"),
        ({"method": "autoencoder", "normalizers": "separate"}, "normalizers separate and method autoencoder"),
        ({"method": "autoencoder", "n_step": 2}, "n_step needs true states, which method autoencoder does not use"),
        ({"method": "indicator", "reward_noise": 0.1}, "reward_noise needs true states, which method indicator does not use"),
        ({"reward_noise": 0.1, "n_step": 2}, "n_step 2 and reward_noise exclude each other"),
        ({"reward_false_positives": 1.5}, "reward_false_positives is a share"),
        ({"reward_noise": -1.0}, "reward_noise must be at least 0"),
        ({"observation_noise": -1.0}, "observation_noise must be at least 0"),
        ({"reward_clutter": 0.5}, "there are none: set reward_false_positives or reward_false_negatives"),
        ({"reward_clutter": 0.2, "reward_false_positives": 0.3}, r"cannot exceed reward_clutter \(0.2\)"),
    ],
)
def test_what_makes_no_sense_is_refused_in_one_line(options, said):
    with pytest.raises(RequestError, match=said) as caught:
        validate(preset("debug", **options))
    assert "\n" not in str(caught.value)


def test_an_autoencoder_needs_images():
    with pytest.raises(RequestError, match="method autoencoder encodes images.*use --method indicator"):
        make_train_step(probes.GoWhereTold(), preset("debug", env="Reacher", method="autoencoder"))


# -- State vectors


def test_equality_of_state_vectors():
    states = jnp.array([[0.0, 1.0], [0.0, 1.0], [2.0, 3.0]])
    goal_states = jnp.array([[0.0, 1.0], [0.0, 1.5], [2.0, 3.0]])
    np.testing.assert_array_equal(goals.indicator_reward(states, goal_states, num_axes=1), [1.0, -1.0, 1.0])


def test_indicator_rewards_teach_from_state_vectors():
    program, train, metrics = trained(
        probes.GoWhereTold(), method="indicator_balance_filter", relabel_probability=0.9, iterations=25
    )
    outcome, _ = program.evaluate(jax.tree.map(lambda leaf: leaf[None], train), jax.random.key(11))
    assert outcome["eval/success"][0] >= 0.95
    assert abs(metrics["train/positive_share"][0] - (0.45 + 0.45 * 25 / 48)) < 0.03
    assert metrics["train/false_positive_share"][0] == 0.0


# -- Diagnostics


def test_diagnostics_of_a_batch_that_can_be_counted():
    reward = jnp.array([1.0, 1.0, -1.0, -1.0, -1.0, -1.0, -1.0, -1.0])
    success = jnp.array([1.0, 0.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    keep = jnp.array([1.0, 1.0, 0.0, 0.0, 1.0, 0.0, 1.0, 1.0])
    found = diagnostics.fractions(diagnostics.count_rewards(reward, keep, 1.0, -1.0, success))
    assert {name: round(float(value), 6) for name, value in found.items()} == {
        "positive_share": 0.25,
        "filtered_share": 0.5,  # 3 of 6 negatives
        "false_positive_share": 0.25,  # 1 of 4 that are not there
        "false_negative_share": 0.5,  # 3 of 6 negatives
        "filtered_false_share": round(2 / 6, 6),
    }
    means = with_precision({f"train/{name}": [float(value), 0.0] for name, value in found.items()})
    precision = means["train/filter_precision"]
    assert precision[0] == pytest.approx(2 / 3) and np.isnan(precision[1])  # nothing was filtered


def test_diagnostics_of_graded_rewards_count_what_is_paid():
    paid, success = jnp.array([1.0, 0.5, 0.25, 0.0]), jnp.array([1.0, 0.0, 0.0, 1.0])
    found = diagnostics.fractions(diagnostics.count_rewards(paid, jnp.ones(4), 1.0, 0.0, success, graded=True))
    assert found["positive_share"] == 0.4375 and found["false_positive_share"] == 0.375
    assert found["false_negative_share"] == pytest.approx(1 / 2.25)


def test_diagnostics_without_the_truth_say_nothing_of_it():
    found = diagnostics.fractions(diagnostics.count_rewards(jnp.array([0.0, -1.0]), jnp.ones(2), 0.0, -1.0))
    assert set(found) == {"positive_share", "filtered_share"}


# -- Estimators that err


def spread(count=20_000):
    keys = jax.random.split(jax.random.key(2))
    return tuple(jax.random.uniform(key, (count, 3), minval=-1.0, maxval=1.0) for key in keys)


def test_noise_on_the_estimate_has_its_deviation_and_is_the_same_every_time():
    states, _ = spread()
    error = np.asarray(reward_errors.estimate(states, 0.05) - states)
    assert abs(error.std() - 0.05) < 0.001 and abs(error.mean()) < 0.001
    assert np.abs(np.corrcoef(error.T) - np.eye(3)).max() < 0.03
    again = reward_errors.estimate(states[::-1], 0.05)[::-1]
    np.testing.assert_array_equal(states + error, again)


@pytest.mark.parametrize("clutter", [1.0, 0.25])
def test_false_rewards_have_their_shares_where_they_belong(clutter):
    states, goal_states = spread()
    end = None if clutter == 1.0 else reward_errors.find_clutter_end(goal_states, jnp.ones(20_000, bool), clutter)
    for is_positive, share in ((jnp.zeros(20_000, bool), 0.1), (jnp.ones(20_000, bool), 0.2)):
        flipped = reward_errors.flip(is_positive, states, goal_states, 0.1, 0.2, clutter, end)
        is_false = np.asarray(flipped != is_positive)
        assert abs(is_false.mean() - share) < 0.01
        if clutter < 1.0:
            assert np.asarray(states)[is_false, 0].max() < -0.45  # the lowest quarter of -1 to 1
        np.testing.assert_array_equal(flipped, reward_errors.flip(is_positive, states, goal_states, 0.1, 0.2, clutter, end))


@pytest.mark.parametrize("first", [0, 1, 2])
def test_the_clutter_ends_where_the_share_of_stored_goals_does(first):
    """The first rollout may lie anywhere in the ring, as after a resumption without the replay."""
    config = validate(preset("debug", reward_clutter=0.5, reward_false_positives=0.1))
    replay = Replay(num_rollouts=3, num_envs=2, horizon=5)
    state = replay.init(jax.ShapeDtypeStruct((2,), jnp.float32), goal_state_size=1, action_size=1)
    sampler = Sampler(config, resolve(config, 5), replay, 0.1)
    for iteration, reached in ((first, (3.0, 1.0)), (first + 1, (2.0, 4.0))):
        goal_states = jnp.broadcast_to(jnp.array(reached)[:, None, None], (2, 7, 1))
        rollout = Episodes(observations=jnp.zeros((2, 7, 2)), states=goal_states, actions=jnp.zeros((2, 5, 1)))
        state = replay.insert(state, rollout, jnp.int32(iteration))
        end = sampler.choose(state, jax.random.key(0), jnp.int32(iteration)).clutter_end
        assert end == 3.0


def test_errors_of_the_estimator_show_in_the_diagnostics():
    options = {"reward_false_positives": 0.1, "reward_false_negatives": 0.2, "reward_clutter": 0.5, "relabel_probability": 0.9}
    config = preset("debug", num_envs=256, updates_per_iteration=20, batch_size=512, **options)
    program = make_train_step(probes.GoWhereTold(), config)
    _, metrics = train_iteration(program, begin(program, jax.random.key(3)[None]))
    assert abs(metrics["train/false_positive_share"][0] - 0.1) < 0.03
    true_share = metrics["train/positive_share"][0]  # of what is there, about a fifth is not paid
    assert 0.0 < metrics["train/false_negative_share"][0] < 0.25 * true_share / (1.0 - true_share)


# -- A noisy camera


class StillImage(probes.SeenGoWhereTold):
    """Probe that never moves, so that all frames are equal without noise."""

    def start(self, key):
        return jnp.zeros(1), jnp.zeros(1)

    def move(self, position, action):
        return position


@pytest.mark.parametrize("noise", [0.0, 8.0])
def test_noisy_frames_equal_themselves_and_no_others(noise):
    env = StillImage()
    config = preset("debug", method="indicator", num_envs=4, batch_size=4 * env.horizon, observation_noise=noise)
    program = make_train_step(env, config)
    loop = begin(program, jax.random.key(0)[None])
    episodes, _ = rollout(program, loop.train, jax.random.key(1)[None])
    assert episodes.observations.dtype == jnp.uint8
    frames = np.asarray(episodes.observations[0]).reshape(-1, 64)
    assert len(np.unique(frames, axis=0)) == (1 if noise == 0.0 else len(frames))
    state = program.replay.of_rollout(jax.tree.map(lambda leaf: leaf[0], episodes))
    sampler = Sampler(config, resolve(config, env.horizon), program.replay, env.threshold)

    @jax.jit
    def rewards(state, key):
        indices = sampler.choose(state, key, jnp.int32(0)).indices
        return [sampler.batch(state, Choice(indices, indices.time + further)).reward for further in (1, 2)]

    own, later = rewards(state, jax.random.key(2))
    np.testing.assert_array_equal(own, 1.0)
    np.testing.assert_array_equal(later, 1.0 if noise == 0.0 else -1.0)


def test_noise_has_its_deviation_and_stays_in_range():
    grey = jnp.full((4, 1, 64, 64), 100, jnp.uint8)
    noisy = add_noise(jax.random.key(0), grey, 5.0)
    assert noisy.dtype == jnp.uint8
    assert abs(np.asarray(noisy, np.float32).std() - 5.0) < 0.1 and abs(np.asarray(noisy, np.float32).mean() - 100.0) < 0.2
    dark = np.asarray(add_noise(jax.random.key(0), jnp.zeros_like(grey), 5.0))
    assert dark.max() < 40  # clipped at 0, not wrapped around
    states = add_noise(jax.random.key(0), jnp.zeros((1000, 3)), 0.1)
    assert states.dtype == jnp.float32 and abs(np.asarray(states).std() - 0.1) < 0.01
