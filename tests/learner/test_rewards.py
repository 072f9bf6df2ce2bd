"""Rewards other than the oracle's and the autoencoder's: with tolerance, of a frozen encoder, of a classifier in training."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from learners import update_arguments
from test_ddpg import trained
from test_indicator_rewards import StaysPut

from jaxrl_vis.config import preset, validate
from jaxrl_vis.config.methods import METHODS
from jaxrl_vis.errors import RequestError
from jaxrl_vis.learner.memory.rewards import features_method, make_reward
from jaxrl_vis.learner.networks import frozen_encoder
from jaxrl_vis.learner.networks.networks import Networks
from jaxrl_vis.learner.networks.normalizer import Scaling
from jaxrl_vis.learner.train_step import make_train_step
from jaxrl_vis.types import Batch
from jaxrl_vis_envs import goals


def pair(reached, goal):
    """Return a batch in which only the reached observations and the goals matter."""
    nothing = jnp.zeros((len(goal), 1))
    return Batch(jnp.stack([goal, goal, reached]), nothing, nothing, nothing)


def test_a_tolerance_forgives_noise_and_small_things():
    goal = np.full((4, 1, 10, 10), 100, np.uint8)
    reached = goal.copy()
    reached[1] += 8  # noise of the tolerated size, everywhere
    reached[2, 0, 0, 0] = 0  # one element in a hundred is another
    reached[3, 0, 0, :2] = 0  # two are
    method, config = METHODS["indicator_tolerance"], preset("debug", method="indicator_tolerance")
    assert method.filter and method.balance_probability > 0
    reward = make_reward(config, method)(pair(reached, goal), reached, 1.0, -1.0)
    np.testing.assert_array_equal(reward, [1.0, 1.0, 1.0, -1.0])
    exact = make_reward(config, METHODS["indicator"])(pair(reached, goal), reached, 1.0, -1.0)
    np.testing.assert_array_equal(exact, [1.0, -1.0, -1.0, -1.0])
    stricter = make_reward(config.replace(tolerance=7.0, tolerance_share=1.0), method)(pair(reached, goal), reached, 1.0, -1.0)
    np.testing.assert_array_equal(stricter, [1.0, -1.0, -1.0, -1.0])
    # Bytes are compared as numbers: 3 and 250 are not nine levels apart.
    assert goals.indicator_reward(np.uint8([[[3]]]), np.uint8([[[250]]]), tolerance=8.0) == -1.0


@functools.cache
def with_classifier():
    return trained(StaysPut(), method="classifier", iterations=8)


def test_a_classifier_tells_goals_from_what_is_not_there():
    """Half of the goals are where the point is and stays, so pairs of equal images get about 1, and others about 0."""
    program, train, metrics = with_classifier()
    networks = program.networks
    points = np.linspace(0.45, 0.85, 8, dtype=np.float32)[:, None]
    head = networks.head(1)

    @jax.jit
    def probabilities(train, goals):
        images = [jax.vmap(StaysPut().see)(each) for each in (points, goals)]
        model = train.agent.reward_model.params
        inputs = [networks.encode(model, networks.prepare(networks.scaling(train.normalizer), each)) for each in images]
        return jax.nn.sigmoid(head.apply({"params": model["head"]}, jnp.stack(inputs))[:, 0])

    assert probabilities(train, points).min() > 0.4 and probabilities(train, -points).max() < 0.2
    assert np.isfinite(metrics["train/classifier_loss"][0])
    assert 0.3 < metrics["train/positive_share"][0] < 0.7


def test_a_classifier_needs_images_and_true_states_are_refused():
    with pytest.raises(RequestError, match="method classifier encodes images, and Reacher shows states"):
        make_train_step(StatesOnly(), preset("debug", env="Reacher", method="classifier"))
    with pytest.raises(RequestError, match="random_shift and method classifier exclude each other"):
        validate(preset("debug", method="classifier", random_shift=2))
    with pytest.raises(RequestError, match="tolerance is an option of --method indicator_tolerance, and this is indicator"):
        validate(preset("debug", method="indicator", tolerance=3.0))


class StatesOnly(StaysPut):
    def see(self, position):
        return position


def small_encoder(path, size=8):
    config = preset("debug", encoder_filters=(4, 4), latent_size=6)
    networks = Networks(config, jax.ShapeDtypeStruct((1, size, size), jnp.uint8), 1, 0.0)
    encoder = networks.init_encoder(jax.random.key(2))
    scaling = Scaling(jnp.full((1, size, size), 120.0), jnp.full((1, size, size), 0.02))
    frozen_encoder.save(path, encoder, scaling)
    return lambda images: networks.encode({"encoder": encoder}, networks.prepare(scaling, images))


def test_a_frozen_encoder_is_the_same_from_its_file(tmp_path):
    original = small_encoder(tmp_path / "encoder.npz")
    images = jax.random.bits(jax.random.key(0), (5, 1, 8, 8), jnp.uint8)
    np.testing.assert_allclose(frozen_encoder.load(tmp_path / "encoder.npz")(images), original(images), atol=1e-5)


def test_features_are_rewarded_by_their_cosine(tmp_path):
    encode = small_encoder(tmp_path / "encoder.npz")
    reached, goal = jax.random.bits(jax.random.key(0), (2, 5, 1, 8, 8), jnp.uint8)
    config = preset("debug", method="features", reward_encoder=str(tmp_path / "encoder.npz"))
    first, second = (np.asarray(encode(images), np.float64) for images in (reached, goal))
    cosine = (first * second).sum(axis=1) / np.linalg.norm(first, axis=1) / np.linalg.norm(second, axis=1)
    found = make_reward(config, METHODS["features"])(pair(reached, goal), reached, 1.0, 0.0)
    np.testing.assert_allclose(found, np.clip(cosine, 0.0, 1.0), atol=1e-4)
    own = features_method(encode)
    np.testing.assert_allclose(make_reward(config, own)(pair(reached, goal), reached, 1.0, 0.0), found, atol=1e-4)
    program = make_train_step(StaysPut(), config)
    _, metrics = program.update_many(*update_arguments(program, jax.random.key(0)))
    assert 0.0 < metrics["train/positive_share"][0] < 1.0


def test_a_missing_or_wrong_encoder_gets_one_line(tmp_path):
    config = preset("debug", method="features")
    with pytest.raises(RequestError, match="needs an encoder: --reward-encoder FILE.npz"):
        make_reward(config, METHODS["features"])
    np.savez(tmp_path / "other.npz", weights=np.zeros(3))
    (tmp_path / "text.npz").write_text("no archive")
    small_encoder(tmp_path / "encoder.npz")
    with np.load(tmp_path / "encoder.npz") as file:
        arrays = dict(file)
    np.savez(tmp_path / "cut.npz", **{**arrays, "kernel_1": arrays["kernel_1"][:3]})
    for name in ("other", "text", "missing", "cut"):
        with pytest.raises(RequestError, match=f"{name}.npz is not an encoder") as refused:
            make_reward(config.replace(reward_encoder=str(tmp_path / f"{name}.npz")), METHODS["features"])
        assert "\n" not in str(refused.value)
    encode = frozen_encoder.load(tmp_path / "encoder.npz")
    with pytest.raises(RequestError, match=r"encodes images of \(1, 8, 8\), and these are of \(3, 8, 8\)"):
        encode(jnp.zeros((2, 3, 8, 8), jnp.uint8))
