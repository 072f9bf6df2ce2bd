"""The kernels of heads compute and differentiate what `networks` does, whichever half of them runs."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrl_vis import preset
from jaxrl_vis.learner import head_kernel, tangents
from jaxrl_vis.learner.networks import Networks, _Head

WIDTH, ROWS = 64, 32


class HeadCase:
    """A head's value of some inputs and its gradients, by flax and by the kernels."""

    def __init__(self, outputs, layers, dtype=jnp.float32):
        keys = jax.random.split(jax.random.key(outputs), 4)
        self.head = _Head((WIDTH,) * (layers + 1), outputs, -3.0, dtype)
        self.values = jax.nn.relu(jax.random.normal(keys[0], (ROWS, WIDTH))).astype(dtype)
        self.probe = jax.random.normal(keys[1], (ROWS, outputs))
        shapes = jax.eval_shape(self.head.init, keys[2], self.values)["params"]
        self.params = jax.tree.map(lambda leaf: 0.2 * jax.random.normal(keys[3], leaf.shape), shapes)
        # So that what goes in is what its first layer makes.
        self.params["hidden_0"] = {"kernel": jnp.eye(WIDTH), "bias": jnp.zeros(WIDTH)}

    def by_flax(self, values, params):
        return self.head.apply({"params": params}, values)

    def by_kernel(self, values, params, interpret):
        return head_kernel.apply(values, head_kernel.make_weights(params), interpret)

    def value_and_gradients(self, function):
        def loss(values, params):
            out = function(values, params)
            return jnp.sum(self.probe * out), out

        (_, out), gradients = jax.jit(jax.value_and_grad(loss, (0, 1), has_aux=True))(self.values, self.params)
        del gradients[1]["hidden_0"]
        return out, gradients


@pytest.mark.parametrize("interpret", [True, False], ids=["kernel", "plain"])
@pytest.mark.parametrize(("outputs", "layers"), [(1, 2), (5, 1)])
def test_a_head_is_the_same_function_with_the_same_gradients(outputs, layers, interpret):
    case = HeadCase(outputs, layers)
    out, gradients = case.value_and_gradients(functools.partial(case.by_kernel, interpret=interpret))
    expected, expected_gradients = case.value_and_gradients(case.by_flax)
    assert out.dtype == jnp.float32 and np.abs(expected).max() > 1
    np.testing.assert_allclose(out, expected, rtol=1e-4, atol=1e-4)
    # A gradient of the values passes through the first layer's rectifier in flax's head: here, where they are 0.
    of_values = np.where(np.asarray(case.values) > 0, gradients[0], 0)
    np.testing.assert_allclose(of_values, expected_gradients[0], rtol=1e-3, atol=1e-4 * np.abs(of_values).max())
    for (path, ours), theirs in zip(
        jax.tree.leaves_with_path(gradients[1]), jax.tree.leaves(expected_gradients[1]), strict=True
    ):
        np.testing.assert_allclose(ours, theirs, rtol=1e-3, atol=1e-4 * np.abs(theirs).max(), err_msg=str(path))


def test_heads_are_differentiated_forwards_where_tangents_are_wanted():
    case = HeadCase(3, 2)
    along = jax.tree.map(lambda leaf: jnp.cos(jnp.arange(leaf.size, dtype=jnp.float32)).reshape(leaf.shape), case.params)
    call = functools.partial(case.by_kernel, case.values, interpret=False)
    with tangents.with_tangents():
        _, tangent = jax.jvp(call, (case.params,), (along,))
    _, gradients = case.value_and_gradients(functools.partial(case.by_kernel, interpret=False))
    del along["hidden_0"]
    pairs = zip(jax.tree.leaves(gradients[1]), jax.tree.leaves(along), strict=True)
    expected = sum(np.vdot(one, other) for one, other in pairs)
    np.testing.assert_allclose(np.vdot(case.probe, tangent), expected, rtol=1e-3)
    with pytest.raises(TypeError, match="custom_vjp"):
        jax.jvp(call, (case.params,), (case.params,))


def test_networks_value_and_act_alike_with_and_without_the_kernel(monkeypatch):
    config = preset("fast", hidden_sizes=(WIDTH, WIDTH, WIDTH), compute_dtype="bfloat16")
    networks = Networks(config, jax.ShapeDtypeStruct((10,), jnp.float32), 4, -3.0)
    actor, critic = networks.init_actor(jax.random.key(0)), networks.init_critic(jax.random.key(1))
    latents = jax.random.normal(jax.random.key(2), (2, ROWS, 10))

    def outcomes(latents):
        action = networks.act(actor, latents)
        return action, networks.value(critic, latents, action)

    expected = jax.jit(outcomes)(latents)
    calls = []

    def applied(values, weights):
        calls.append(values.shape)
        return head_kernel._apply(values, weights, True)

    monkeypatch.setattr(head_kernel, "is_available", lambda: True)
    monkeypatch.setattr(head_kernel, "apply", applied)
    found = jax.jit(lambda latents: outcomes(latents))(latents)
    assert calls == [(ROWS, WIDTH)] * 2
    for ours, theirs in zip(found, expected, strict=True):
        assert np.ptp(theirs) > 0.1
        np.testing.assert_allclose(ours, theirs, atol=0.03)
    outcomes(latents[:, :7])  # rows that no program takes go the other way
    assert len(calls) == 2


@pytest.mark.parametrize(("sizes", "rows"), [((64,), 32), ((64, 32), 32), ((96, 96), 32), ((32, 32), 32), ((64, 64), 24)])
def test_other_heads_and_batches_go_the_other_way(sizes, rows):
    assert not head_kernel.supports(sizes, rows)
    assert head_kernel.supports((64, 64, 64), 32)
