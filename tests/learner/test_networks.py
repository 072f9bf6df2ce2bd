"""The encoder is a plain stack of convolutions, and statistics are those of the whole data."""

import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrl_vis.config import preset
from jaxrl_vis.errors import RequestError
from jaxrl_vis.learner.ddpg import losses
from jaxrl_vis.learner.environment import make_env
from jaxrl_vis.learner.networks import forward_mode, normalizer
from jaxrl_vis.learner.networks.blocks import from_blocks, to_blocks
from jaxrl_vis.learner.networks.kernels import encoder as encoder_kernel
from jaxrl_vis.learner.networks.networks import Networks
from jaxrl_vis.learner.train_step import make_train_step


def make_networks(size, filters=(4, 8, 16), **overrides):
    config = preset("debug", encoder_filters=filters, latent_size=5, **overrides)
    return Networks(config, jax.ShapeDtypeStruct((3, size, size), jnp.uint8), 2, 0.0)


@pytest.mark.parametrize("size", [8, 16, 21, 30])
def test_the_encoder_is_a_stack_of_strided_convolutions(size):
    networks = make_networks(size)

    @jax.jit
    def latents_in_both_ways():
        params = networks.init_critic(jax.random.key(0))
        frames = jax.random.randint(jax.random.key(1), (2, 3, size, size), 0, 256).astype(jnp.uint8)
        statistics = normalizer.update(normalizer.init(networks.observation_spec), frames[:, None])
        scale = normalizer.scale(statistics, networks.config.network.normalizer_floor)
        values = jnp.clip((frames - statistics.mean) * scale, -5, 5).transpose(0, 2, 3, 1)
        for level, filters in enumerate((4, 8, 16)):
            kernel = params["encoder"][f"kernel_{level}"].reshape(2, 2, -1, filters)
            values = jax.lax.conv_general_dilated(values, kernel, (2, 2), "VALID", dimension_numbers=("NHWC", "HWIO", "NHWC"))
            values = nn.relu(values + params["encoder"][f"bias_{level}"])
        dense = params["encoder"]["latent"]
        expected = values.reshape(2, -1) @ dense["kernel"] + dense["bias"]
        return networks.encode(params, networks.prepare(networks.scaling(statistics), frames)), expected

    latent, expected = latents_in_both_ways()
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose(latent, expected, rtol=1e-4, atol=1e-4)


@functools.cache
def encoder_case(shape, batch: int, first: int, dtype):
    return EncoderCase(shape, batch, slice(first, batch), dtype)


class EncoderCase:
    """Latents of random images and gradients of a weighted sum of them, by each of the implementations."""

    def __init__(self, shape, batch, which, dtype):
        config = preset("fast", encoders="separate", latent_size=16, compute_dtype=dtype)
        self.networks = Networks(config, jax.ShapeDtypeStruct(shape, jnp.uint8), 2, 0.0)
        self.which, self._found = which, {}
        rng = np.random.default_rng(0)

        def drawn(path, leaf):
            """Return random kernels of the size of fresh ones, and biases that are not negligible."""
            window = 4 if "kernel_" in str(path) else 1
            most = np.sqrt(6 / (leaf.shape[0] + window * leaf.shape[1])) if len(leaf.shape) > 1 else 0.0
            return jnp.asarray(rng.uniform(-most, most, leaf.shape) + rng.normal(0, 0.05, leaf.shape), jnp.float32)

        shapes = jax.eval_shape(self.networks.init_actor, jax.random.key(0))["encoder"]
        self.params = jax.tree_util.tree_map_with_path(drawn, shapes)
        self.images = jnp.asarray(rng.integers(0, 256, (batch, *shape)), jnp.uint8)
        blank = normalizer.init(self.networks.observation_spec)
        self.statistics = jax.jit(normalizer.update)(blank, self.images[:, None])
        self.probe = jnp.asarray(rng.normal(size=(batch - which.start, 16)), jnp.float32)

    def latents_and_gradient(self, implementation):
        """Return both. ``implementation``: products (`networks`), kernel (in Pallas's interpreter) or plain (without a GPU)."""
        if implementation not in self._found:
            self._found[implementation] = self._latents_and_gradient(implementation)
        return self._found[implementation]

    def _latents_and_gradient(self, implementation):
        with pytest.MonkeyPatch.context() as patch:
            if implementation != "products":
                patch.setattr(Networks, "uses_kernel", True)
            for name in ("prepare", "encode") if implementation == "kernel" else ():
                patch.setattr(encoder_kernel, name, functools.partial(getattr(encoder_kernel, name), interpret=True))

            def loss(params, probe):
                inputs = self.networks.prepare(self.networks.scaling(self.statistics), self.images)
                latent = self.networks.encode({"encoder": params}, inputs, self.which)
                return jnp.sum(latent.astype(jnp.float32) * probe), latent.astype(jnp.float32)

            (_, latent), gradient = jax.jit(jax.value_and_grad(loss, has_aux=True))(self.params, self.probe)
            return latent, gradient


SHAPES = [
    ((4, 64, 64), 3, 1),
    ((1, 16, 16), 3, 1),  # too few patches for a tile
    ((3, 40, 35), 6, 2),  # borders to crop, a channel to pad
    ((12, 32, 32), 2, 0),  # three images
]


@pytest.mark.parametrize(("shape", "batch", "first"), SHAPES)
def test_the_gpu_kernel_computes_and_differentiates_the_same_function(shape, batch, first):
    case = encoder_case(shape, batch, first, "float32")
    assert not case.networks.uses_kernel
    expected, expected_gradient = case.latents_and_gradient("products")
    for implementation in ("kernel", "plain"):
        latent, gradient = case.latents_and_gradient(implementation)
        np.testing.assert_allclose(latent, expected, rtol=1e-4, atol=1e-4)
        for (path, ours), theirs in zip(jax.tree.leaves_with_path(gradient), jax.tree.leaves(expected_gradient), strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=1e-3, atol=1e-4 * np.abs(theirs).max(), err_msg=str(path))


@pytest.mark.parametrize("implementation", ["products", "kernel", "plain"])
def test_encoders_are_differentiated_forwards_where_tangents_are_wanted(implementation, monkeypatch):
    """A tangent is the inner product of the gradient and its direction, whichever implementation computes the gradient."""
    case = encoder_case(*SHAPES[2], "float32")
    _, gradient = case.latents_and_gradient(implementation)
    if implementation != "products":
        monkeypatch.setattr(Networks, "uses_kernel", True)
    if implementation == "kernel":
        monkeypatch.setattr(encoder_kernel, "encode", functools.partial(encoder_kernel.encode, interpret=True))
    inputs = jax.jit(case.networks.prepare)(case.networks.scaling(case.statistics), case.images)
    rng = np.random.default_rng(1)
    along = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape), jnp.float32), case.params)

    def loss(params):
        latent = case.networks.encode({"encoder": params}, inputs, case.which)
        return jnp.sum(latent.astype(jnp.float32) * case.probe)

    def with_rules(params):
        with forward_mode.with_tangents():
            return loss(params)

    tangent = jax.jit(lambda params: jax.jvp(with_rules, (params,), (along,))[1])(case.params)
    expected = sum(np.vdot(left, right) for left, right in zip(jax.tree.leaves(gradient), jax.tree.leaves(along), strict=True))
    np.testing.assert_allclose(tangent, expected, rtol=1e-3)
    with pytest.raises(TypeError, match="custom_vjp"):
        jax.jvp(loss, (case.params,), (along,))


@pytest.mark.parametrize("implementation", ["kernel", "plain"])
def test_images_move_alike_whoever_prepares_them(implementation, monkeypatch):
    case = encoder_case(*SHAPES[2], "float32")
    shift = jnp.array([[0, 0], [2, -3], [-1, 4], [5, 5], [-40, 0], [1, -40]], jnp.int32)

    @jax.jit
    def latents():
        inputs = case.networks.prepare(case.networks.scaling(case.statistics), case.images, shift)
        return case.networks.encode({"encoder": case.params}, inputs)

    expected = latents()
    monkeypatch.setattr(Networks, "uses_kernel", True)
    for name in ("prepare", "encode") if implementation == "kernel" else ():
        monkeypatch.setattr(encoder_kernel, name, functools.partial(getattr(encoder_kernel, name), interpret=True))
    jax.clear_caches()
    np.testing.assert_allclose(latents(), expected, rtol=1e-4, atol=1e-4)
    still = case.networks.encode(
        {"encoder": case.params}, case.networks.prepare(case.networks.scaling(case.statistics), case.images)
    )
    assert not np.allclose(still[1:], expected[1:], atol=0.1)
    np.testing.assert_allclose(still[0], expected[0], rtol=1e-4, atol=1e-4)


def test_in_bfloat16_the_gpu_kernel_is_as_near_to_float32_as_plain_products_are():
    """Both round, so float32 is the reference. Errors are those of whole leaves, relative to their float32 values."""
    shape, batch, first = (4, 32, 32), 16, 0
    truth = encoder_case(shape, batch, first, "float32").latents_and_gradient("products")
    case = encoder_case(shape, batch, first, "bfloat16")

    def errors(implementation):
        found = case.latents_and_gradient(implementation)
        pairs = zip(jax.tree.leaves(found), jax.tree.leaves(truth), strict=True)
        return np.array([np.linalg.norm(ours - theirs) / np.linalg.norm(theirs) for ours, theirs in pairs])

    products, kernel, plain = map(errors, ("products", "kernel", "plain"))
    assert products.max() > 1e-3  # bfloat16 it is
    assert kernel.mean() < 1.1 * products.mean() and plain.mean() < 1.1 * products.mean()
    assert kernel[0] < 0.02 and kernel.max() < 0.15


@pytest.mark.parametrize(
    ("filters", "shape"),
    [((16, 32), (4, 64, 64)), ((16, 24, 64, 64), (4, 64, 64)), ((16, 32, 64, 64), (20, 64, 64))],
)
def test_what_the_gpu_kernel_cannot_take_goes_the_other_way(filters, shape):
    assert not encoder_kernel.supports(filters, shape)


def test_blocks_hold_every_pixel_once():
    frames = jnp.arange(2 * 3 * 8 * 8).reshape(2, 3, 8, 8)
    blocks = to_blocks(frames, 2)
    assert blocks.shape == (2, 4, 48)
    np.testing.assert_array_equal(np.sort(np.asarray(blocks).ravel()), np.arange(blocks.size))
    np.testing.assert_array_equal(np.sort(np.asarray(blocks[0, 0])), np.sort(np.asarray(frames[0, :, :4, :4]).ravel()))


@pytest.mark.parametrize(("height", "width", "levels"), [(8, 8, 2), (10, 21, 2), (9, 17, 3)])
def test_blocks_become_images_again(height, width, levels):
    frames = np.arange(2 * 3 * height * width).reshape(2, 3, height, width)
    rows, columns = height >> levels << levels, width >> levels << levels  # the rest of the border fills no block
    np.testing.assert_array_equal(from_blocks(to_blocks(frames, levels), rows, columns), frames[..., :rows, :columns])


def test_an_image_smaller_than_a_block_is_refused():
    with pytest.raises(RequestError, match="image_size 7 is too small for 3 encoder layers, which need at least 8"):
        make_networks(7)


def test_shifts_move_images_and_not_out_of_sight():
    with pytest.raises(RequestError, match="random_shift 16 could move images of 16 pixels out of sight"):
        make_train_step(make_env(preset("debug", random_shift=16)), preset("debug", random_shift=16))
    states = preset("debug", env="FetchReach", random_shift=1)
    with pytest.raises(RequestError, match="random_shift 1 moves images, and FetchReach observes states: leave it out"):
        make_train_step(make_env(states), states)


def test_statistics_are_those_of_all_frames():
    batches = 255 * np.random.default_rng(0).beta(2.0, 5.0, (4, 6, 5, 3, 2, 2)).astype(np.float32)
    state = normalizer.init(jax.ShapeDtypeStruct((3, 2, 2), jnp.float32))
    update = jax.jit(normalizer.update)
    for batch in batches:
        state = update(state, batch)
    frames = np.asarray(batches, np.float64).reshape(-1, 3, 2, 2)
    np.testing.assert_allclose(state.mean, frames.mean(0), rtol=1e-5)
    np.testing.assert_allclose(normalizer.scale(state, 1e-6), 1 / frames.std(0), rtol=1e-4)


def test_a_pixel_that_never_changes_is_divided_by_the_floor():
    state = normalizer.update(normalizer.init(jax.ShapeDtypeStruct((1,), jnp.uint8)), jnp.full((3, 4, 1), 200, jnp.uint8))
    np.testing.assert_allclose(normalizer.scale(state, 0.01), [100.0])


def test_losses_by_hand():
    target = losses.td_target(jnp.array([0.0, -1.0, -1.0]), jnp.array([-2.0, -1.0, -99.0]), 0.5, minimum=-2.0)
    np.testing.assert_allclose(target, [-1.0, -1.5, -2.0])
    keep = losses.keep_mask(jnp.array([1.0, -1.0, -1.0]), jnp.array([50.0, 49.5, 48.0]), -1.0, 49.0)
    np.testing.assert_allclose(keep, [1.0, 0.0, 1.0])
    np.testing.assert_allclose(losses.critic_loss(jnp.array([1.0, 5.0, 3.0]), jnp.array([0.0, 0.0, 0.0]), keep), 5.0)
    assert losses.critic_loss(jnp.ones(3), jnp.zeros(3), jnp.zeros(3)) == 0.0
    np.testing.assert_allclose(losses.actor_loss(jnp.array([2.0, 4.0]), jnp.array([[1.0], [0.0]]), 0.5), -3.0 + 0.25)


@pytest.mark.parametrize(("log_of", "expected"), [("value", np.log(7.0) + 0.25), ("loss", np.log(7.25))])
def test_the_logarithm_of_an_actors_loss_by_hand(log_of, expected):
    """The value's distance from the best is 7, and the mean squared action is 0.5, with a weight of 0.5."""
    value, action = jnp.array([2.0, 4.0]), jnp.array([[1.0], [0.0]])
    np.testing.assert_allclose(losses.actor_loss(value, action, 0.5, 10.0, log_of=log_of), expected, rtol=1e-6)


@pytest.mark.parametrize("log_of", ["value", "loss"])
def test_which_logarithm_keeps_the_proportion_of_value_and_action_penalty(log_of):
    def proportion(**options):
        def loss(value, action):
            return losses.actor_loss(value, action, 0.5, **options)

        of_value, of_action = jax.grad(loss, argnums=(0, 1))(jnp.array([-20.0, -30.0]), jnp.array([[0.6], [0.2]]))
        return float(of_action[0, 0] / of_value[0])

    kept = np.isclose(proportion(log_below=0.0, log_of=log_of), proportion(), rtol=1e-4)
    assert kept == (log_of == "loss")
