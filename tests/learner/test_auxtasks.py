"""Every auxiliary task can be learned from latents, and its loss reaches what it should and nothing else."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxrl_vis.errors import RequestError
from jaxrl_vis.learner import auxtasks
from jaxrl_vis.learner.auxtasks import autoencoder, heads, optical_flow
from jaxrl_vis.learner.auxtasks.auxiliary import Auxiliary
from jaxrl_vis.learner.networks.blocks import from_blocks
from jaxrl_vis.learner.networks.kernels import decoder as decoder_kernel
from jaxrl_vis.learner.networks.kernels.patches import to_patches
from jaxrl_vis.types import Batch
from jaxrl_vis.weighting import make_weighting

LATENTS = ("latent_t", "latent_tp1", "latent_view")
# The latents that each loss has a gradient to.
REACHES = {
    "forward_dynamics": {"latent_t"},
    "inverse_dynamics": {"latent_t", "latent_tp1"},
    "egomotion": {"latent_t", "latent_view"},
    "autoencoder": {"latent_t"},
    "optical_flow": {"latent_t", "latent_tp1"},
}


def make_spec(channels, size, latent_size=8, **sizes):
    return auxtasks.Spec(jax.ShapeDtypeStruct((channels, size, size), jnp.uint8), 3, latent_size, **sizes)


def make_views(spec, batch):
    """Return, by task, a view with random numbers in all fields that its loss may read."""
    keys = iter(jax.random.split(jax.random.key(0), 7))
    latents = {name: jax.random.normal(next(keys), (batch, spec.latent_size)).astype(spec.dtype) for name in LATENTS}
    action = jax.random.uniform(next(keys), (batch, spec.action_size), minval=-1.0)
    motion = jax.random.uniform(next(keys), (batch, 3 if spec.options.max_shift else 1), minval=-1.0)
    image = jax.random.normal(next(keys), (batch, *spec.observation.shape))
    flow = jax.random.exponential(next(keys), (batch, *spec.observation.shape[1:]))
    view, targets = auxtasks.View(**latents, action=action, image=image), {"egomotion": motion, "optical_flow": flow}
    return {name: view.replace(target=targets.get(name)) for name in auxtasks.NAMES}


def init_all(tasks):
    return {name: task.init(jax.random.fold_in(jax.random.key(1), number)) for number, (name, task) in enumerate(tasks.items())}


def test_each_task_learns_what_it_is_to_predict():
    spec = make_spec(4, 16, latent_size=24, levels=2)
    tasks, optimizer = auxtasks.make(auxtasks.NAMES, spec), optax.adam(1e-2)
    patches = jax.random.normal(jax.random.key(2), (16, 4, 4, 4))  # images have some structure, unlike noise
    image = jnp.repeat(jnp.repeat(patches, 4, axis=2), 4, axis=3)
    views = {name: view.replace(image=image) for name, view in make_views(spec, 16).items()}

    def total(params):
        found = {name: task.loss(params[name], views[name]) for name, task in tasks.items()}
        return sum(found.values()), found

    def step(carry, _):
        params, moments = carry
        gradient, found = jax.grad(total, has_aux=True)(params)
        change, moments = optimizer.update(gradient, moments)
        return (optax.apply_updates(params, change), moments), found

    @jax.jit
    def learn():
        params = init_all(tasks)
        return jax.lax.scan(step, (params, optimizer.init(params)), length=400)[1]

    for name, curve in learn().items():
        assert curve[-1] < 0.05 * curve[0], name


# Of 100 pixels, an encoder of four layers reads the first 96.
@pytest.mark.parametrize(
    ("channels", "size", "whole", "dtype", "options"),
    [(4, 64, 64, jnp.float32, auxtasks.Options()), (12, 100, 96, jnp.bfloat16, auxtasks.RELEASE)],
)
def test_losses_reach_what_they_should(channels, size, whole, dtype, options):
    spec = make_spec(channels, size, frame_stack=channels // 4, dtype=dtype, options=options)
    tasks, views = auxtasks.make(auxtasks.NAMES, spec), make_views(spec, 2)

    @jax.jit
    def run():
        params = init_all(tasks)
        gradients = {name: jax.value_and_grad(task.loss, argnums=(0, 1)) for name, task in tasks.items()}
        found = {name: gradient(params[name], views[name]) for name, gradient in gradients.items()}
        return found, {name: task.predict(params[name], views[name]) for name, task in tasks.items()}

    found, predictions = run()
    shapes = {"forward_dynamics": (2, 8), "inverse_dynamics": (2, 3), "egomotion": views["egomotion"].target.shape}
    shapes |= {"autoencoder": (2, 1 if options.in_grey else channels, whole, whole), "optical_flow": (2, whole, whole)}
    assert {name: prediction.shape for name, prediction in predictions.items()} == shapes
    for name, (loss, (params_gradient, view_gradient)) in found.items():
        assert loss.shape == () and loss.dtype == jnp.float32 and loss > 0.0
        assert predictions[name].dtype == jnp.float32
        assert all(leaf.dtype == jnp.float32 and np.any(leaf != 0.0) for leaf in jax.tree.leaves(params_gradient)), name
        reached = {latent for latent in LATENTS if np.any(np.asarray(getattr(view_gradient, latent), np.float32) != 0.0)}
        not_detached = {"latent_tp1"} if name == "forward_dynamics" and not options.detach else set()
        assert reached == REACHES[name] | not_detached, name
    flow_error = np.mean(np.square(predictions["optical_flow"] - views["optical_flow"].target[:, :whole, :whole]))
    np.testing.assert_allclose(found["optical_flow"][0], flow_error, rtol=1e-5)
    if not options.in_grey:
        error = np.mean(np.square(predictions["autoencoder"] - views["autoencoder"].image[..., :whole, :whole]))
        np.testing.assert_allclose(found["autoencoder"][0], error, rtol=1e-5)


def test_a_decoder_is_a_stack_of_transposed_convolutions():
    shape, levels = (3, 8, 12), 2

    @jax.jit
    def images_in_both_ways():
        params = heads.init_decoder(jax.random.key(0), 5, shape, levels)
        params = jax.tree.map(lambda leaf: leaf + 0.1 * jax.random.normal(jax.random.key(1), leaf.shape), params)
        values = jax.random.normal(jax.random.key(2), (2, 5))
        expected = (values @ params["dense"]["kernel"] + params["dense"]["bias"]).reshape(2, 2, 3, -1)
        for level in range(levels):
            layer = params[f"up_{level}"]
            # JAX's transposed convolution reads its kernel backwards.
            kernel = layer["kernel"].reshape(expected.shape[-1], 2, 2, -1).transpose(1, 2, 0, 3)[::-1, ::-1]
            expected = jax.lax.conv_transpose(
                jax.nn.relu(expected), kernel, (2, 2), "VALID", dimension_numbers=("NHWC", "HWIO", "NHWC")
            )
            expected = expected + layer["bias"]
        return from_blocks(heads.decode(params, values, jnp.float32), *shape[1:]), expected.transpose(0, 3, 1, 2)

    images, expected = images_in_both_ways()
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose(images, expected, rtol=1e-4, atol=1e-5)


def test_bfloat16_decodes_nearly_what_float32_does():
    specs = [make_spec(3, 8, levels=1, dtype=dtype) for dtype in (jnp.float32, jnp.bfloat16)]
    full, half = (autoencoder.make(spec) for spec in specs)

    @jax.jit
    def decode_in_both_ways():
        params, view = full.init(jax.random.key(0)), make_views(specs[0], 4)["autoencoder"]
        return full.predict(params, view), half.predict(params, view)

    expected, found = decode_in_both_ways()
    assert 1e-4 < np.linalg.norm(found - expected) / np.linalg.norm(expected) < 2e-2


def declared_fields(task):
    """Return the names of the optional fields of a view that a task declares."""
    own = {"latent_view": task.view, "target": task.view or task.target}
    return {*task.needs, *(field for field, maker in own.items() if maker is not None)}


def test_what_a_task_does_not_declare_may_be_left_out():
    spec = make_spec(4, 16, levels=2)
    everything = jax.eval_shape(lambda: make_views(spec, 2))
    for name, task in auxtasks.make(auxtasks.NAMES, spec).items():
        params = jax.eval_shape(task.init, jax.random.key(0))
        fields = {field: getattr(everything[name], field) for field in declared_fields(task)}
        bare = auxtasks.View(everything[name].latent_t, everything[name].action)
        assert jax.eval_shape(task.loss, params, bare.replace(**fields)).shape == ()
        for field in fields:
            with pytest.raises(ValueError, match=f"needs View.{field}"):
                jax.eval_shape(task.loss, params, bare.replace(**{**fields, field: None}))


def test_only_what_is_declared_is_made():
    spec = make_spec(4, 16, levels=2)
    images = jnp.zeros((3, 2, 4, 16, 16), jnp.uint8)
    batch = Batch(images, jnp.zeros((2, 3)), jnp.zeros((2, 1)), jnp.zeros((2, 1)))
    for names, views, targets, stored in (
        (("forward_dynamics", "autoencoder"), set(), set(), set()),
        (("egomotion",), {"egomotion"}, {"egomotion"}, set()),
        (("optical_flow", "inverse_dynamics"), set(), {"optical_flow"}, {"optical_flow"}),
    ):
        auxiliary = Auxiliary(auxtasks.make(names, spec), make_weighting("sum"))
        specs = auxiliary.stored_spec(spec.observation, 5)
        assert set(specs) == stored and all(kept.shape == (5, 16, 16) for kept in specs.values())
        of_steps = {name: jax.ShapeDtypeStruct((2, *kept.shape[1:]), kept.dtype) for name, kept in specs.items()}
        made = jax.eval_shape(auxiliary.with_targets, jax.random.key(0), batch, of_steps)
        assert (set(made.views), set(made.targets)) == (views, targets)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["optical_flaw"], "unknown auxiliary task 'optical_flaw'; did you mean optical_flow?"),
        (["egomotion", "egomotion"], "auxiliary task egomotion is given twice; give it once"),
        (["xyz"], "unknown auxiliary task 'xyz'; choose one of forward_dynamics, "),
    ],
)
def test_wrong_names_are_refused_in_one_line(names, message):
    with pytest.raises(RequestError) as refusal:
        auxtasks.make(names, make_spec(4, 16))
    assert str(refusal.value).startswith(message) and "\n" not in str(refusal.value)


def test_tasks_that_show_states_have_no_auxiliary_tasks():
    spec = auxtasks.Spec(jax.ShapeDtypeStruct((10,), jnp.float32), 4, 10)
    assert auxtasks.make([], spec) == {}
    with pytest.raises(RequestError, match=r"auxiliary tasks \(egomotion\) train an encoder of images.*states of 10 numbers"):
        auxtasks.make(["egomotion"], spec)


@functools.cache
def decoder_gradients(channels, dtype, implementation):
    """Return losses of both decoders and their gradients, flat. ``implementation``: products, kernel (interpreted) or plain."""
    spec = make_spec(channels, 32, latent_size=16, dtype=dtype, levels=3)
    tasks, views = auxtasks.make(("autoencoder", "optical_flow"), spec), make_views(spec, 4)
    view = views["autoencoder"]
    # What all of them can represent.
    latents = [latent.astype(jnp.bfloat16).astype(dtype) for latent in (view.latent_t, view.latent_tp1)]
    flow = optical_flow.from_bytes(optical_flow.to_bytes(views["optical_flow"].target))
    view = view.replace(image=view.image.astype(jnp.bfloat16).astype(dtype), target=flow)
    goals = jax.random.normal(jax.random.key(3), (5, channels, 32, 32)).astype(dtype)
    patches = to_patches(jnp.concatenate([view.image, goals]), spec.levels)  # the encoder reads more than one observation

    @jax.jit
    def found():
        params = init_all(tasks)
        params = jax.tree.map(lambda leaf: leaf + 0.1 * jax.random.normal(jax.random.key(leaf.size), leaf.shape), params)

        def losses(params, latents):
            seen = view.replace(latent_t=latents[0], latent_tp1=latents[1])
            seen = seen if implementation == "products" else seen.replace(patches=patches)
            return sum((3.0 + len(name)) * task.loss(params[name], seen) for name, task in tasks.items())

        return jax.value_and_grad(losses, argnums=(0, 1))(params, latents)

    with pytest.MonkeyPatch.context() as patch:
        if implementation == "kernel":
            patch.setattr(decoder_kernel, "squared_error", functools.partial(decoder_kernel.squared_error, interpret=True))
        return [np.asarray(leaf, np.float32) for leaf in jax.tree.leaves(found())]


@pytest.mark.parametrize("channels", [3, 4])
@pytest.mark.parametrize("implementation", ["kernel", "plain"])
def test_decoders_as_kernels_have_the_same_losses_and_gradients(channels, implementation):
    truth = decoder_gradients(channels, jnp.float32, "products")
    for ours, theirs in zip(decoder_gradients(channels, jnp.float32, implementation), truth, strict=True):
        assert np.linalg.norm(ours - theirs) <= 1e-4 * np.linalg.norm(theirs) and np.any(theirs != 0.0)


@pytest.mark.parametrize("implementation", ["kernel", "plain"])
def test_in_bfloat16_decoders_as_kernels_are_as_near_to_float32_as_products_are(implementation):
    truth = decoder_gradients(4, jnp.float32, "products")

    def errors(implementation):
        pairs = zip(decoder_gradients(4, jnp.bfloat16, implementation), truth, strict=True)
        return np.array([np.linalg.norm(ours - theirs) / np.linalg.norm(theirs) for ours, theirs in pairs])

    products, ours = errors("products"), errors(implementation)
    assert products.max() > 1e-3  # bfloat16 it is
    assert ours.mean() < 1.1 * products.mean() and ours.max() < 0.15
