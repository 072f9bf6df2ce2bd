"""Weightings of auxiliary losses: their rules, and their states in vmap, checkpoints and batches on several devices."""

import functools
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
import pytest
from weighting_problem import (
    MODES,
    NAMES,
    OPTIONS,
    assert_close,
    begin,
    encode,
    encoder_of,
    gradient_by,
    in_float32,
    losses_of,
    losses_of_latents,
    problem,
    weighting_of,
)

from jaxrl_vis.errors import RequestError
from jaxrl_vis.weighting import MAIN, WEIGHTINGS, Weighting, loss_gradients, make_weighting, measure, weighted_grad
from jaxrl_vis.weighting.base import log_loss, log_slope

# -- OL-AUX


@functools.cache
def raw_gradients(seed: int) -> tuple[Any, dict[str, Any]]:
    """Return the losses and their gradients with respect to the encoder."""
    losses, gradients, _ = jax.jit(functools.partial(loss_gradients, losses_of))(*in_float32(problem(seed)))
    return losses, {name: encoder_of(tree) for name, tree in gradients.items()}


def feed(weighting: Weighting, dots: list[dict[str, float]], losses: dict[str, float] | None = None) -> list[dict[str, float]]:
    """Return the weights after each update with these dots, for losses that are 1 if not given."""
    losses = losses or dict.fromkeys(NAMES, 1.0)
    update = jax.jit(weighting.update)
    state = weighting.init(NAMES)
    after = []
    for each in dots:
        _, state, _ = update(*in_float32((losses, each)), state)
        after.append({name: float(weight) for name, weight in state.weights.items()})
    return after


def test_weights_move_every_n_updates_by_the_mean() -> None:
    """Ten updates with N = 5 change the weights twice, each time by the mean over the last five."""
    dots = [{"near": 0.1 * step, "far": -0.3 * step} for step in range(1, 11)]
    losses = {MAIN: 2.0, "near": 0.5, "far": 3.0}
    slopes = {"near": 1 / (2.0 + 1e-8) / 0.52, "far": 1 / (2.0 + 1e-8) / 3.02}
    after = feed(make_weighting("ol_aux", interval=5, learning_rate=0.1), dots, losses)
    for name, slope in slopes.items():
        weights = [each[name] for each in after]
        assert weights[:4] == [1] * 4 and weights[4:9] == [weights[4]] * 5
        first = max(0.0, 1 + 25 * 0.1 * slope * np.mean([each[name] for each in dots[:5]]))
        second = max(0.0, first + 25 * 0.1 * slope * np.mean([each[name] for each in dots[5:]]))
        np.testing.assert_allclose((weights[4], weights[9]), (first, second), rtol=1e-5)
    assert after[-1]["far"] == 0.0


def test_the_step_uses_the_weights_from_before() -> None:
    weighting = make_weighting("ol_aux", interval=1, learning_rate=0.1)
    assert weighting.needs == "dots"
    losses = in_float32(dict.fromkeys(NAMES, 1.0))
    weights, state, _ = weighting.update(losses, in_float32({"near": 1.0, "far": -1.0}), weighting.init(NAMES))
    assert weights["near"] == 1 and state.weights["near"] > 1 > state.weights["far"]


def test_beta_is_five_n_unless_given() -> None:
    dots = [{"near": 0.01, "far": 0.0}] * 5
    slope = 1 / 1.02
    for options, expected in (
        ({}, 25.0),
        ({"interval": 1}, 5 * 5.0),
        ({"beta": 3.0}, 3.0),
        ({"interval": 1, "beta": 3.0}, 15.0),
    ):
        weight = feed(make_weighting("ol_aux", learning_rate=0.1, **options), dots)[-1]["near"]
        np.testing.assert_allclose(weight, 1 + expected * 0.1 * slope * 0.01, rtol=1e-5)


def test_a_reversed_gradient_drives_its_weight_to_zero_and_back() -> None:
    """Task `near` helps; once its gradient is reversed, its weight falls to 0, stays there, and can recover."""
    weighting = make_weighting("ol_aux", interval=2, learning_rate=0.1)
    losses, gradients = raw_gradients(0)
    compared = gradients | {"near": gradients[MAIN]}
    turned = compared | {"near": jax.tree.map(jnp.negative, compared["near"])}
    state = weighting.init(NAMES)
    update = jax.jit(lambda gradients, state: weighting.update(losses, measure(weighting, losses, gradients), state)[1])
    history = []
    for gradients_now in (compared, turned, compared):
        for _ in range(30 if gradients_now is turned else 4):
            state = update(gradients_now, state)
            history.append(float(state.weights["near"]))
    assert history[3] > 1 and history[33] == 0.0 and history[-1] > 0
    assert min(history) == 0.0


def test_total_compares_with_everything_that_is_learned() -> None:
    weighting = make_weighting("ol_aux", main_grad="total", learning_rate=0.1)
    losses, gradients = raw_gradients(2)
    state = weighting.init(NAMES, gradients[MAIN]).replace(weights=in_float32({MAIN: 1.0, "near": 0.5, "far": 2.0}))
    metrics = jax.jit(lambda: weighting.update(losses, measure(weighting, losses, gradients), state)[2])()
    flat = {name: np.concatenate([leaf.ravel() for leaf in jax.tree.leaves(tree)]) for name, tree in gradients.items()}
    learned = {name: flat[name] / (losses[name] + (1e-8 if name == MAIN else 0.02)) for name in NAMES}
    total = learned[MAIN] + 0.5 * learned["near"] + 2.0 * learned["far"]
    for name in NAMES[1:]:
        np.testing.assert_allclose(metrics[f"dot/{name}"], learned[name] @ total, rtol=1e-4)


def test_window_averages_the_latest_gradients() -> None:
    weighting = make_weighting("ol_aux", interval=1, window=3, log=False, learning_rate=0.1, minimum=None)
    random = np.random.default_rng(0)
    series = [{name: random.normal(size=6).astype(np.float32) for name in NAMES} for _ in range(5)]
    state = weighting.init(NAMES, jnp.zeros(6))
    expected = 1.0
    update = jax.jit(lambda gradients, state: weighting.update(dict.fromkeys(NAMES, jnp.ones(())), gradients, state))
    for step, gradients in enumerate(series):
        _, state, metrics = update(gradients, state)
        latest = series[max(0, step - 2) : step + 1]
        mean = {name: np.mean([each[name] for each in latest], axis=0) for name in NAMES}
        expected += 5 * 0.1 * mean["near"] @ mean[MAIN]
        np.testing.assert_allclose(metrics["dot/near"], mean["near"] @ mean[MAIN], rtol=1e-4)
        np.testing.assert_allclose(state.weights["near"], expected, rtol=1e-4)
    with pytest.raises(RequestError, match="give init the shared parameters"):
        weighting.init(NAMES)


def test_the_ablation_is_the_one_step_rule_on_n_times_the_data() -> None:
    params, batch = in_float32(problem(4, size=36))
    minibatches = [jax.tree.map(lambda leaf, k=k: leaf[12 * k : 12 * (k + 1)], batch) for k in range(3)]
    ablation = make_weighting("ol_aux_ablation", interval=3, learning_rate=0.01)
    assert ablation.interval == 3
    gradient = jax.jit(weighted_grad(losses_of, ablation, encoder_of))
    state, now = ablation.init(NAMES, encoder_of(params), params), params
    for minibatch in minibatches:  # parameters move on, what is compared does not
        found = gradient(now, state, minibatch)
        now = jax.tree.map(lambda leaf, change: leaf - np.float32(0.1) * change, now, found.gradient)
        state = found.state
    whole = make_weighting("ol_aux", interval=1, beta=15.0, learning_rate=0.01)
    expected = jax.jit(weighted_grad(losses_of, whole, encoder_of))(params, whole.init(NAMES), batch).state.weights
    assert_close(state.weights, expected)
    assert abs(expected["near"] - 1) > 0.001
    with pytest.raises(RequestError, match="give init all of them"):
        ablation.init(NAMES, encoder_of(params))


# -- Other weightings


def test_cosine_opens_and_closes() -> None:
    weighting = make_weighting("cosine")
    losses = in_float32(dict.fromkeys(NAMES, 1.0))
    for dots, expected in (((2.0, -1e-30), (1, 0)), ((0.0, 1e-30), (1, 1)), ((-5.0, 3.0), (0, 1))):
        weights, state, _ = weighting.update(losses, in_float32(dict(zip(NAMES[1:], dots))), weighting.init(NAMES))
        assert (weights["near"], weights["far"]) == expected
        assert state.weights == weights


def test_sums_and_fixed_weights() -> None:
    losses = in_float32({MAIN: 2.0, "near": 3.0, "far": 0.5})
    expected = {
        "sum": 5.5,
        "none": 2.0,
        "none_log": np.log(2.0),
        "balance": np.log(2.0) + np.log(3.02) + np.log(0.52),
        "fixed": np.log(2.0) + 0.1 * np.log(3.02) + 10 * np.log(0.52),
    }
    for name, value in expected.items():
        weighting = make_weighting(name, **OPTIONS[name])
        weights, state, _ = weighting.update(losses, None, weighting.init(NAMES))
        np.testing.assert_allclose(weighting.objective(weights, losses), value, rtol=1e-6)
        assert weighting.needs == "losses" and state.updates == 1
    halves = make_weighting("fixed", weights=0.5, log=False)
    np.testing.assert_allclose(halves.objective(halves.init(NAMES).weights, losses), 3.75)


# -- Numbers at the edge


def test_logarithm_of_a_loss_is_finite_and_increasing() -> None:
    at = jnp.array([-1e6, -1.0, -1e-3, 0.0, 1e-12, 1e-3, 1.0, 1e6])
    for eps in (0.02, 1e-8):
        values = log_loss(at, eps)
        assert np.isfinite(values).all() and (np.diff(values) >= 0).all()
        slopes = jax.vmap(jax.grad(functools.partial(log_loss, eps=eps)))(at)
        np.testing.assert_allclose(slopes, log_slope(at, eps), rtol=1e-5)
    np.testing.assert_allclose(log_loss(jnp.float32(1.5), 0.02), np.log(1.52), rtol=1e-6)


@pytest.mark.parametrize("case", OPTIONS)
def test_finite_at_zero_and_negative_losses(case: str) -> None:
    weighting = weighting_of(case)
    gradients = {name: np.full(3, 0.5 - (name == "far"), np.float32) for name in NAMES}

    @jax.jit
    def update(losses: Any, state: Any) -> Any:
        weights, state, metrics = weighting.update(losses, measure(weighting, losses, gradients), state)
        return state, (weights, metrics, weighting.coefficients(weights, losses), weighting.objective(weights, losses))

    for value in (0.0, -0.5, -1e4):
        losses = in_float32({MAIN: max(value, 0.0), "near": value, "far": value})
        state = begin(weighting, gradients[MAIN])
        for _ in range(5):
            state, found = update(losses, state)
            for number in jax.tree.leaves((state, found)):
                assert np.isfinite(number).all()


# -- As part of a program


@pytest.mark.parametrize("case", ["cosine", "ol_aux", "ol_aux window", "ol_aux_ablation"])
def test_seeds_side_by_side_are_seeds_one_by_one(case: str) -> None:
    """Three states are updated in one vmap, within a scan whose number of updates is not a multiple of N."""
    weighting = weighting_of(case)
    losses, compared = raw_gradients(0)

    def run(scale: jax.Array) -> Any:
        turned = compared | {"near": jax.tree.map(lambda leaf: scale * leaf, compared["near"])}

        def step(state: Any, _: None) -> Any:
            weights, state, metrics = weighting.update(losses, measure(weighting, losses, turned), state)
            return state, (weights, metrics)

        return jax.lax.scan(step, begin(weighting, compared[MAIN]), length=7)

    scales = jnp.array([-1.0, 0.5, 2.0])
    together = jax.jit(jax.vmap(run))(scales)
    alone = jax.jit(run)
    for place, scale in enumerate(scales):
        assert_close(jax.tree.map(lambda leaf, place=place: leaf[place], together), alone(scale))


@pytest.mark.parametrize("case", ["sum", "cosine", "ol_aux", "ol_aux window", "ol_aux_ablation"])
def test_states_survive_a_checkpoint(case: str, tmp_path: Path) -> None:
    weighting = weighting_of(case)
    shared = jnp.zeros(3)
    losses = dict.fromkeys(NAMES, jnp.ones(()))
    gradients = {name: jnp.full(3, 0.5 - (name == "far")) for name in NAMES}
    state = begin(weighting, shared)
    for _ in range(3):
        state = weighting.update(losses, measure(weighting, losses, gradients), state)[1]
    with ocp.StandardCheckpointer() as checkpointer:
        checkpointer.save(tmp_path / "state", state)
        checkpointer.wait_until_finished()
        restored = checkpointer.restore(tmp_path / "state", jax.eval_shape(lambda: begin(weighting, shared)))
    assert_close(restored, state, tolerance=0)


def test_parts_of_a_batch_on_several_devices_are_one_batch() -> None:
    """Losses and gradients are averaged before dots and logarithms are taken."""
    params, batch = in_float32(problem(5, size=24))
    weighting = make_weighting("ol_aux", interval=1, learning_rate=0.01)
    state = weighting.init(NAMES)
    parts = jax.tree.map(lambda leaf: leaf.reshape(2, 12, *leaf.shape[1:]), batch)

    @jax.jit
    def on_both() -> Any:
        found = []
        for mode in MODES:
            gradient = gradient_by(mode, weighting, reduce=lambda tree: jax.lax.pmean(tree, "devices"))
            found.append(jax.vmap(gradient, in_axes=(None, None, 0), axis_name="devices")(params, state, parts))
        return weighted_grad(losses_of, weighting, encoder_of)(params, state, batch), found

    whole, found = on_both()
    for each in found:
        for place in range(2):
            assert_close(jax.tree.map(lambda leaf, place=place: leaf[place], each), whole)


def test_a_batch_spread_over_devices_by_the_compiler_or_by_hand(clean_environment: dict[str, str]) -> None:
    code = """
import jax, numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from weighting_problem import *

params, batch = in_float32(problem(5, size=24))
mesh = Mesh(np.array(jax.devices()), ("data",))
spread = jax.device_put(batch, NamedSharding(mesh, PartitionSpec("data")))
weighting = make_weighting("ol_aux", interval=1, learning_rate=0.01, window=2)
state = weighting.init(NAMES, encoder_of(params))
gradient = jax.jit(weighted_grad(losses_of, weighting, encoder_of))
assert len(spread["x"].devices()) == 2
assert_close(gradient(params, state, spread), gradient(params, state, batch))

upgrad = make_weighting("upgrad")
options = {"shared": encoder_of, "encode": encode}
of_part = weighted_grad(
    losses_of_latents, upgrad, mode="latents", reduce=lambda tree: jax.lax.pmean(tree, "data"), **options
)
specs = (PartitionSpec(), PartitionSpec(), PartitionSpec("data"))
of_parts = jax.jit(jax.shard_map(of_part, mesh=mesh, in_specs=specs, out_specs=PartitionSpec(), check_vma=False))
whole = jax.jit(weighted_grad(losses_of_latents, upgrad, **options))
assert_close(of_parts(params, upgrad.init(NAMES), spread), whole(params, upgrad.init(NAMES), batch))
"""
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=2"
    path = os.pathsep.join((str(Path(__file__).parents[1]), clean_environment["PYTHONPATH"]))
    environment = {**clean_environment, "PYTHONPATH": path, "XLA_FLAGS": flags}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_what_comes_beside_the_losses() -> None:
    params, batch = in_float32(problem(0))
    weighting = make_weighting("ol_aux")
    state = weighting.init(NAMES)

    def with_more(params: Any, latent: Any, batch: Any) -> Any:
        return losses_of_latents(params, latent, batch), {"size": jnp.sum(batch["x"])}

    for mode in MODES:
        gradient = weighted_grad(with_more, weighting, encoder_of, mode, has_aux=True, encode=encode)
        found = jax.eval_shape(gradient, params, state, batch)
        assert jax.tree.map(lambda leaf: leaf.shape, found.extra) == {"size": ()}


# -- Bad input


@pytest.mark.parametrize(
    ("make", "parts"),
    [
        (lambda: make_weighting("ol_uax"), ["unknown weighting 'ol_uax'", "did you mean ol_aux"]),
        (lambda: make_weighting("zzz"), ["unknown weighting 'zzz'", "none_log"]),
        (lambda: make_weighting("ol_aux", intervall=5), ["no option 'intervall'", "did you mean interval"]),
        (lambda: make_weighting("ol_aux_ablation", held=False), ["no option 'held'"]),
        (lambda: make_weighting("sum", log=True), ["no option 'log'", "it has none"]),
        (lambda: make_weighting("ol_aux", interval=0), ["interval", "at least 1, not 0"]),
        (lambda: make_weighting("ol_aux", window=0), ["window", "at least 1, not 0"]),
        (lambda: make_weighting("ol_aux").update({}, {}, make_weighting("sum").init(NAMES)), ["not one of weighting ol_aux"]),
        (lambda: make_weighting("ol_aux", interval=2.5), ["interval", "a whole number, not 2.5"]),
        (lambda: make_weighting("ol_aux", beta=float("nan")), ["finite"]),
        (lambda: make_weighting("ol_aux", main_grad="totl"), ["main_grad", "did you mean total"]),
        (lambda: make_weighting("ol_aux_ablation", window=4), ["no option 'window'"]),
        (lambda: make_weighting("balance", eps=0.0), ["eps of weighting balance", "greater than 0"]),
        (lambda: make_weighting("fixed", weights=float("inf")), ["finite"]),
        (lambda: make_weighting("fixed", weights={"nera": 1.0}).init(NAMES), ["'nera'", "did you mean near"]),
        (lambda: make_weighting("fixed", weights={"near": 1.0}).init(NAMES), ["no weight for loss 'far'"]),
        (lambda: make_weighting("ol_aux").init((MAIN,)), ["no auxiliary loss", "none_log"]),
        (lambda: make_weighting("balance").init(("near", "far")), ["no loss is called 'main'"]),
        (lambda: make_weighting("sum").init((MAIN, "near", "near")), ["two losses are called 'near'"]),
        (lambda: weighted_grad(losses_of, make_weighting("sum"), mode="per_los"), ["'per_los'", "did you mean per_loss"]),
        (lambda: weighted_grad(losses_of, make_weighting("sum"), mode="latents"), ["give encode"]),
        (
            lambda: jax.jit(weighted_grad(losses_of, make_weighting("sum")))(
                *in_float32(problem(0))[:1], WRONG, in_float32(problem(0)[1])
            ),
            ["losses are far, main, near", "began with main, other"],
        ),
    ],
)
def test_bad_requests_get_one_line(make: Any, parts: list[str]) -> None:
    with pytest.raises(RequestError) as caught:
        make()
    assert "\n" not in str(caught.value)
    for part in parts:
        assert part in str(caught.value)


WRONG = make_weighting("sum").init((MAIN, "other"))


@pytest.mark.parametrize("mode", [mode for mode in MODES if mode != "latents"])
def test_losses_of_another_form_get_one_line(mode: Any) -> None:
    weighting = make_weighting("sum")
    for losses_fn, has_aux, wrong in (
        (lambda point: {MAIN: point**2, "near": jnp.sum(point)}, False, "loss 'main' has shape (2,) and must be one number"),
        (lambda point: jnp.sum(point), False, "losses_fn must return a dictionary of losses by name, not a "),
        (lambda point: ({MAIN: jnp.sum(point), "near": jnp.sum(point)}, 1), False, "has_aux=True"),
        (lambda point: {MAIN: jnp.sum(point), "near": jnp.sum(point)}, True, "losses by name, and an auxiliary output"),
    ):
        with pytest.raises(RequestError) as caught:
            weighted_grad(losses_fn, weighting, mode=mode, has_aux=has_aux)(jnp.ones(2), weighting.init((MAIN, "near")))
        assert wrong in str(caught.value)


def test_every_weighting_with_a_main_loss_is_tried_here() -> None:
    """`test_weighting_contract` tests all of them."""
    assert {case.split()[0] for case in OPTIONS} == {name for name in WEIGHTINGS if make_weighting(name).main} | {"sum"}
    assert make_weighting("none").init((MAIN,)).weights == {MAIN: 1}
