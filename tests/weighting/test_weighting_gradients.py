"""Gradients of weighted losses and their dot products: all modes, compared with each other and with finite differences."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from weighting_problem import (
    MODES,
    NAMES,
    assert_close,
    encode,
    encoder_gradients,
    encoder_of,
    gradient_by,
    in_float32,
    losses_of,
    modes_of,
    problem,
    weighting_of,
)

from jaxrl_vis.errors import RequestError
from jaxrl_vis.weighting import MAIN, make_weighting, weighted_grad
from jaxrl_vis.weighting.base import dot


@pytest.mark.parametrize("case", ["sum", "fixed", "cosine of logarithms", "ol_aux", "ol_aux total", "ol_aux as released"])
def test_ways_agree_and_find_the_gradient_of_the_weighted_objective(case: str) -> None:
    weighting = weighting_of(case)
    params, batch = in_float32(problem(0))

    @jax.jit
    def all_ways(params: Any, state: Any) -> Any:
        found = [gradient_by(mode, weighting)(params, state, batch) for mode in modes_of(weighting)]
        in_encoder, in_heads = found[0].weights, weighting.head_weights(found[0].weights)
        expected = {
            part: jax.grad(lambda params, weights=weights: weighting.objective(weights, losses_of(params, batch)))(params)[part]
            for part, weights in (("encoder", in_encoder), ("heads", in_heads))
        }
        return found, expected

    state = weighting.init(NAMES, encoder_of(params))
    for _ in range(6):
        (reference, *others), expected = all_ways(params, state)
        for other in others:
            assert_close(other, reference)
        assert_close(reference.gradient, expected)
        assert reference.weights[MAIN] == 1 and set(reference.weights) == set(NAMES)
        params = jax.tree.map(lambda leaf, change: leaf - np.float32(0.02) * change, params, reference.gradient)
        state = reference.state
    if weighting.needs == "gradients":
        with pytest.raises(RequestError, match="use per_loss"):
            gradient_by("latents", weighting)
    if "ol_aux" in case:  # weights have moved, and differently
        moved = np.array([reference.weights[name] for name in NAMES[1:]])
        assert (moved >= 0).all() and (np.abs(moved - 1) > 0.001).all() and moved[0] != moved[1]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", ["cosine", "cosine of logarithms", "ol_aux"])
def test_heads_learn_while_their_loss_is_kept_out_of_the_encoder(case: str, mode: Any) -> None:
    params, batch = in_float32(problem(0))
    for name in NAMES[1:]:  # opposed to the main loss: the same head and targets with the other sign of the latents' error
        params["heads"][name], batch[name] = (
            params["heads"][MAIN],
            2.0 * (encode(params["encoder"], batch) @ params["heads"][MAIN]),
        )
        batch[name] = batch[name] - batch[MAIN]
    weighting = weighting_of(case)._replace(heads="always")
    state = weighting.init(NAMES)
    state = state.replace(weights={MAIN: jnp.ones(()), "near": jnp.zeros(()), "far": jnp.zeros(())})
    found = gradient_by(mode, weighting)(params, state, batch)
    gradients = jax.jacrev(losses_of)(params, batch)
    slopes = weighting.slopes(losses_of(params, batch))
    assert [float(found.weights[name]) for name in NAMES] == [1, 0, 0]
    assert_close(found.gradient["encoder"], jax.tree.map(lambda leaf: slopes[MAIN] * leaf, gradients[MAIN]["encoder"]))
    for name in NAMES:
        expected = slopes[name] * gradients[name]["heads"][name]
        assert_close(found.gradient["heads"][name], expected)
        assert np.abs(expected).max() > 0.01
    still = gradient_by(mode, weighting._replace(heads="weighted"))(params, state, batch)
    assert not np.any(still.gradient["heads"]["near"])


def passes_through_the_encoder(mode: Any, losses: int) -> int:
    """Count a step's products with the encoder's inputs: one for each forward pass, backward pass or tangent."""
    params, batch = in_float32(problem(0))
    names = [MAIN, *(f"other{number}" for number in range(losses - 1))]
    params["heads"] = {name: params["heads"][MAIN] for name in names}
    batch = {"x": batch["x"], **{name: batch[MAIN] for name in names}}
    weighting = make_weighting("ol_aux")
    gradient = gradient_by(mode, weighting)
    equations = jax.make_jaxpr(gradient)(params, weighting.init(names), batch).eqns
    products = [each for each in equations if each.primitive.name == "dot_general"]
    return sum(batch["x"].shape in [operand.aval.shape for operand in each.invars] for each in products)


def test_latents_pass_the_encoder_as_often_for_many_losses() -> None:
    assert passes_through_the_encoder("latents", 3) == passes_through_the_encoder("latents", 10) <= 5
    assert passes_through_the_encoder("per_loss", 10) >= 20


def halves(names: tuple[str, ...] = ("first", "second")) -> dict[str, Any]:
    """Return latents of the first and the second half of a minibatch, as two groups."""
    parts = dict(zip(("first", "second"), (slice(0, 6), slice(6, 12)), strict=True))
    return {name: functools.partial(encode_part, part=parts[name]) for name in names}


def encode_part(encoder: Any, batch: Any, part: slice) -> Any:
    return jnp.tanh(batch["x"][part] @ encoder["kernel"] + encoder["bias"])


def losses_of_halves(params: Any, latents: Any, batch: Any) -> dict[str, Any]:
    """Compute losses: main reads the first half, near the second, far both; main also reads the second without a gradient."""
    heads, first, second = params["heads"], latents["first"], latents["second"]
    still = jax.lax.stop_gradient(jnp.mean(second))
    return {
        MAIN: jnp.mean((first @ heads[MAIN] - batch[MAIN][:6] - 0.1 * still) ** 2),
        "near": jnp.mean((second @ heads["near"] - batch["near"][6:]) ** 2),
        "far": jnp.mean((jnp.concatenate([first, second]) @ heads["far"] - batch["far"]) ** 2),
    }


@pytest.mark.parametrize("case", ["none", "balance", "cosine", "ol_aux"])
def test_latents_in_groups(case: str) -> None:
    weighting = weighting_of(case)
    params, batch = in_float32(problem(0))
    ways = MODES

    @jax.jit
    def all_ways(params: Any, state: Any) -> Any:
        gradients = [weighted_grad(losses_of_halves, weighting, encoder_of, mode, encode=halves()) for mode in ways]
        return [gradient(params, state, batch) for gradient in gradients]

    state = weighting.init(NAMES)
    for _ in range(3):
        reference, *others = all_ways(params, state)
        for other in others:
            assert_close(other, reference)
        params = jax.tree.map(lambda leaf, change: leaf - np.float32(0.02) * change, params, reference.gradient)
        state = reference.state


@pytest.mark.parametrize(("others", "passes"), [(("near",), (2, 4)), (("near", "far"), (5, 4))])
def test_gradients_pass_only_through_latents_that_losses_read(others: tuple[str, ...], passes: tuple[int, int]) -> None:
    params, batch = in_float32(problem(0))
    names = (MAIN, *others)
    weighting = make_weighting("ol_aux")

    def chosen(params: Any, latents: Any, batch: Any) -> dict[str, Any]:
        found = losses_of_halves({"heads": {**problem(0)[0]["heads"], **params["heads"]}}, latents, batch)
        return {name: found[name] for name in names}

    params["heads"] = {name: params["heads"][name] for name in names}
    gradient = weighted_grad(chosen, weighting, encoder_of, "latents", encode=halves())
    found = jax.make_jaxpr(gradient)(params, weighting.init(names), batch)
    slices = {}  # variable -> the half of the inputs that it is
    counted = {0: 0, 6: 0}
    for equation in found.jaxpr.eqns:
        if equation.primitive.name == "slice" and equation.invars[0].aval.shape == batch["x"].shape:
            slices[equation.outvars[0]] = equation.params["start_indices"][0]
        if equation.primitive.name == "dot_general":
            for operand in equation.invars:
                counted[slices.get(operand, 0)] += operand in slices
    # Forward; backward for the main loss; forward with a tangent, and backward for the others: of those that are needed.
    assert (counted[0], counted[6]) == passes


def test_dots_are_those_of_finite_differences() -> None:
    weighting = make_weighting("ol_aux", log=False)

    @jax.jit
    def both_ways(params: Any, batch: Any) -> list[dict[str, jax.Array]]:
        found = [gradient_by(mode, weighting) for mode in MODES]
        return [gradient(params, weighting.init(NAMES), batch).metrics for gradient in found]

    for seed in range(3):
        params, batch = problem(seed)
        oracle = encoder_gradients(params, batch)
        for metrics in both_ways(*in_float32((params, batch))):
            for name in NAMES[1:]:
                value = metrics[f"dot/{name}"]
                assert value.dtype == jnp.float32
                sizes = np.linalg.norm(oracle[name]) * np.linalg.norm(oracle[MAIN])
                assert abs(float(value) - oracle[name] @ oracle[MAIN]) <= 1e-5 * sizes


def test_dots_of_large_trees_are_exact_enough() -> None:
    random = np.random.default_rng(0)
    one = {"a": random.normal(size=(700, 512)).astype(np.float32), "b": random.normal(size=3).astype(np.float32)}
    for other in (one, jax.tree.map(lambda leaf: np.roll(leaf, 1), one)):
        expected = sum(np.vdot(one[name].astype(np.float64), other[name].astype(np.float64)) for name in one)
        sizes = sum(np.sum(leaf.astype(np.float64) ** 2) for leaf in one.values())
        assert abs(float(jax.jit(dot)(one, other)) - expected) <= 1e-5 * sizes
        assert jax.jit(dot)(*jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.bfloat16), (one, other))).dtype == jnp.float32


def test_bfloat16() -> None:
    """Weights and gradients of bfloat16 parameters are float32, and have the direction of those of float32 parameters."""
    params, batch = in_float32(problem(1, size=64))
    weighting = make_weighting("ol_aux", interval=1, learning_rate=0.01)

    @jax.jit
    def all_ways(params: Any) -> Any:
        return [gradient_by(mode, weighting)(params, weighting.init(NAMES), batch) for mode in MODES]

    exact = all_ways(params)[0]
    for coarse in all_ways(jax.tree.map(lambda leaf: leaf.astype(jnp.bfloat16), params)):
        assert all(leaf.dtype in (jnp.float32, jnp.int32) for leaf in jax.tree.leaves(coarse))
        one, other = (np.concatenate([leaf.ravel() for leaf in jax.tree.leaves(each.gradient)]) for each in (exact, coarse))
        assert one @ other >= 0.99 * np.linalg.norm(one) * np.linalg.norm(other)
        for name in NAMES[1:]:
            assert np.sign(coarse.metrics[f"dot/{name}"]) == np.sign(exact.metrics[f"dot/{name}"])
