"""OL-AUX-5 along Adam's direction, against a transcription in NumPy."""

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.tasks import adam_direction
from jaxrl_vis.weighting import MAIN

NAMES = (MAIN, "near", "far")


def test_a_gradient_is_unchanged_if_all_are_equally_large() -> None:
    gradient = {"a": jnp.array([3.0, -4.0]), "b": jnp.array([[2.0]])}
    squares = {"a": jnp.array([0.5, 0.5]), "b": jnp.array([[0.5]])}
    same = adam_direction.adam_direction(gradient, squares, jnp.array(7))
    for name, leaf in gradient.items():
        np.testing.assert_allclose(same[name], leaf, rtol=1e-5)


def test_weights_follow_the_products_with_adams_direction() -> None:
    rng, size, updates = np.random.default_rng(0), 6, 12
    scales = 10.0 ** np.arange(size)  # raw gradients would be compared by the last coordinates alone
    gradients = rng.normal(size=(updates, len(NAMES), size)) / scales
    losses = rng.uniform(0.5, 2.0, size=(updates, len(NAMES)))
    weighting = adam_direction.ol_aux_5_adam()
    state = weighting.init(NAMES, {"w": jnp.zeros(size)})
    weights, squares, sums = np.ones(len(NAMES)), np.zeros(size), np.zeros(len(NAMES))
    for step, (rows, values) in enumerate(zip(gradients, losses), start=1):
        statistics = {name: {"w": jnp.asarray(row, jnp.float32)} for name, row in zip(NAMES, rows)}
        _, state, _ = weighting.update(dict(zip(NAMES, map(jnp.float32, values))), statistics, state)
        logs = rows / (values + [1e-8, 0.02, 0.02])[:, None]
        squares = 0.999 * squares + 0.001 * (weights @ logs) ** 2
        direction = logs[0] / (np.sqrt(squares / (1.0 - 0.999**step)) + 1e-8)
        sums += logs @ direction * np.linalg.norm(logs[0]) / np.linalg.norm(direction)
        if step % 5 == 0:
            weights[1:] = np.maximum(weights[1:] + 25.0 * 1e-3 * sums[1:] / 5.0, 0.0)
            sums[:] = 0.0
    assert weights[1] != pytest.approx(1.0, abs=1e-3)
    np.testing.assert_allclose([float(state.weights[name]) for name in NAMES], weights, rtol=1e-4)
