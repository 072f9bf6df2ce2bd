"""Contract of every weighting, whatever its method: its state, its numbers at extremes, and what its paper promises."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrl_vis.weighting as jw
from jaxrl_vis.errors import RequestError

NAMES = ("edge", "main", "near")
SHARED = {"bias": jnp.zeros(2), "kernel": jnp.zeros((2, 3))}
ALL = tuple(jw.WEIGHTINGS)
# Those to which one of the losses is the main one, or which draw.
WITH_MAIN = ("none", "none_log", "fixed", "balance", "cosine", "ol_aux", "ol_aux_ablation", "auxinash")
DRAWN = ("random", "pcgrad", "gradvac", "graddrop")
ALIKE = tuple(name for name in ALL if name not in WITH_MAIN + DRAWN)


def begin(name: str, names: tuple[str, ...] = NAMES) -> Any:
    weighting = jw.make_weighting(name)
    return weighting.init(names, SHARED, *((SHARED,) if weighting.hold is not None else ()))


def as_tree(row: np.ndarray) -> dict[str, Any]:
    return {"bias": jnp.asarray(row[:2], jnp.float32), "kernel": jnp.asarray(row[2:].reshape(2, 3), jnp.float32)}


def flat(tree: Any) -> np.ndarray:
    return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(tree)])


@functools.cache
def stepper(name: str) -> Any:
    """Return a compiled function (losses, gradients by name, state) -> (shared gradient, weights, state, metrics)."""
    weighting = jw.make_weighting(name)

    def step(losses: Any, gradients: Any, state: Any) -> Any:
        found, state, metrics = weighting.update(losses, jw.measure(weighting, losses, gradients), state)
        if isinstance(found, jw.Direction):
            return found.shared, found.weights, state, metrics
        return jw.weighted_sum(gradients, weighting.coefficients(found, losses)), found, state, metrics

    return jax.jit(step)


def take(name: str, rows: np.ndarray, losses: Any = (1.0, 1.0, 1.0), names: tuple[str, ...] = NAMES) -> tuple[np.ndarray, Any]:
    """Return the gradient [8] and the weights of the first step from gradients [K, 8] and losses [K]."""
    by_name = {each: jnp.float32(loss) for each, loss in zip(names, losses, strict=True)}
    gradients = {each: as_tree(row) for each, row in zip(names, rows, strict=True)}
    gradient, weights, _, _ = stepper(name)(by_name, gradients, begin(name, names))
    return flat(gradient), weights


def rows(seed: int = 0, count: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, 8))


@pytest.mark.parametrize("name", ALL)
def test_states_and_metrics_keep_their_structure(name: str) -> None:
    """A state may be the carry of a scan; one that was saved as NumPy arrays continues in the same way."""
    losses = {each: jnp.float32(1.0 + place) for place, each in enumerate(NAMES)}
    gradients = {each: as_tree(row) for each, row in zip(NAMES, rows(), strict=True)}
    first, second = begin(name), None
    _, weights, second, metrics = stepper(name)(losses, gradients, first)
    assert jax.tree.structure(first) == jax.tree.structure(second)
    jax.tree.map(lambda old, new: (old.shape, old.dtype) == (new.shape, new.dtype) or pytest.fail(str(old)), first, second)
    assert set(weights) == set(second.weights) == set(NAMES) and int(second.updates) == 1
    assert all(weight.shape == () and weight.dtype == jnp.float32 for weight in weights.values())
    assert {value.shape for value in metrics.values()} <= {()}

    def save(leaf: Any) -> Any:
        is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        return jax.random.wrap_key_data(np.array(jax.random.key_data(leaf))) if is_key else jnp.asarray(np.array(leaf))

    one, other = (stepper(name)(losses, gradients, state)[:2] for state in (second, jax.tree.map(save, second)))
    jax.tree.map(np.testing.assert_array_equal, one, other)


CASES = {
    "no gradients": (np.zeros((3, 8)), (1.0, 1.0, 1.0)),
    "one gradient is 0": (rows() * [[1], [0], [1]], (1.0, 0.0, 1.0)),
    "equal gradients": (np.repeat(rows()[:1], 3, axis=0), (1.0, 1.0, 1.0)),
    "opposed gradients": (rows()[:1] * [[1], [-1], [1]], (1.0, 2.0, 3.0)),
    "gradients of many lengths": (rows() * [[1e-8], [1.0], [1e8]], (1e-8, 1.0, 1e8)),
    "losses of 0": (rows(), (0.0, 0.0, 0.0)),
    "negative losses": (rows(), (-1.0, -1e3, 2.0)),
    "huge losses": (rows(), (1e15, 1e-15, 1.0)),
}


@pytest.mark.parametrize("name", ALL)
def test_every_number_is_finite(name: str) -> None:
    """Three steps are taken from the initial state in each of the cases."""
    for case, (gradients, losses) in CASES.items():
        state = begin(name)
        by_name = {each: jnp.float32(loss) for each, loss in zip(NAMES, losses, strict=True)}
        trees = {each: as_tree(row) for each, row in zip(NAMES, gradients, strict=True)}
        for _ in range(3):
            gradient, weights, state, metrics = stepper(name)(by_name, trees, state)
            leaves = [
                leaf
                for leaf in jax.tree.leaves((gradient, weights, metrics, state))
                if jnp.issubdtype(leaf.dtype, jnp.floating)
            ]
            assert all(np.isfinite(leaf).all() for leaf in leaves), case


@pytest.mark.parametrize("name", ALIKE)
def test_losses_may_change_places(name: str) -> None:
    gradients, losses = rows(3), (0.5, 1.0, 2.0)
    before, weights = take(name, gradients, losses)
    order = [2, 0, 1]
    after, moved = take(name, gradients[order], tuple(losses[place] for place in order))
    np.testing.assert_allclose(after, before, rtol=2e-4, atol=2e-4)
    for place, source in enumerate(order):
        np.testing.assert_allclose(moved[NAMES[place]], weights[NAMES[source]], rtol=2e-4, atol=2e-5)


@pytest.mark.parametrize("name", ALL)
def test_one_direction_that_all_gradients_share_is_kept(name: str) -> None:
    """If all gradients are equal, the step is a positive multiple of them."""
    row = rows(1)[0]
    step, _ = take(name, np.repeat(row[None], 3, axis=0))
    cosine = step @ row / (np.linalg.norm(step) * np.linalg.norm(row))
    np.testing.assert_allclose(cosine, 1.0, atol=1e-5)


@pytest.mark.parametrize("name", [name for name in ALL if name not in WITH_MAIN])
def test_a_single_loss_is_followed(name: str) -> None:
    row = rows(2)[:1]
    step, _ = take(name, row, (1.0,), ("alone",))
    np.testing.assert_allclose(step / np.linalg.norm(step), row[0] / np.linalg.norm(row[0]), atol=1e-5)


@pytest.mark.parametrize("name", ("mgda", "upgrad", "dualproj", "imtl_g", "aligned_mtl", "uniform", "nash_mtl", "pcgrad"))
def test_two_opposed_losses_of_one_length_cancel_out(name: str) -> None:
    row = rows(4)[0]
    step, _ = take(name, np.stack([row, -row]), (1.0, 1.0), NAMES[:2])
    assert np.linalg.norm(step) < 1e-3 * np.linalg.norm(row)


# Power of c that the step is multiplied by, where all gradients are multiplied by c: of G w = w^(-1/2) it is -1/3.
DEGREES = dict.fromkeys(("uniform", "sum", "mgda", "upgrad", "dualproj", "cagrad", "imtl_g", "aligned_mtl", "config"), 1.0)
DEGREES |= {"pcgrad": 1.0, "gradvac": 1.0, "graddrop": 1.0, "nash_mtl": 0.0, "auxinash": 0.0, "fairgrad": -1 / 3}


@pytest.mark.parametrize("name", DEGREES)
def test_steps_scale_with_the_gradients_as_papers_say(name: str) -> None:
    step, _ = take(name, rows(5))
    scaled, _ = take(name, 7.0 * rows(5))
    np.testing.assert_allclose(scaled, 7.0 ** DEGREES[name] * step, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("name", ("nash_mtl", "auxinash", "imtl_g", "db_mtl", "geometric_mean", "balance"))
def test_units_of_the_losses_do_not_matter(name: str) -> None:
    """If each loss and its gradient are in another unit, the step keeps its direction."""
    units = np.array([0.05, 1.0, 30.0]) if name != "balance" else np.array([50.0, 100.0, 3e3])  # far above eps
    base = np.array([1.0, 1.0, 1.0]) if name != "balance" else np.array([1e4, 1e4, 1e4])
    one, _ = take(name, rows(6) * base[:, None], tuple(base))
    other, _ = take(name, rows(6) * (base * units)[:, None], tuple(base * units))
    if name == "imtl_g":  # its projections on all unit gradients are equal, which leaves the length free
        one, other = (np.abs(step / np.linalg.norm(step)) for step in (one, other))
    else:
        one, other = (step / np.linalg.norm(step) for step in (one, other))
    np.testing.assert_allclose(other, one, atol=2e-3)


@pytest.mark.parametrize("name", ("mgda", "upgrad", "dualproj", "nash_mtl", "fairgrad", "config", "auxinash"))
def test_steps_oppose_no_gradient(name: str) -> None:
    for seed in range(20):
        gradients = rows(seed)
        gradients[1] -= 1.5 * gradients[0]  # a conflict
        gradients = gradients.astype(np.float32)
        step, _ = take(name, gradients)
        slopes = gradients @ step / (np.linalg.norm(gradients, axis=1) * np.linalg.norm(step))
        assert slopes.min() > -1e-4, slopes


@pytest.mark.parametrize("name", ALL)
def test_wrong_names_are_refused(name: str) -> None:
    with pytest.raises(RequestError, match="two losses are called 'main'"):
        begin(name, ("main", "main"))
    with pytest.raises(RequestError):
        begin(name, ())


def test_drawn_numbers_differ_from_step_to_step_and_from_key_to_key() -> None:
    weighting = jw.random()
    losses = dict.fromkeys(NAMES, jnp.float32(1.0))
    state = weighting.init(NAMES)
    first, after, _ = weighting.update(losses, None, state)
    second, _, _ = weighting.update(losses, None, after)
    other, _, _ = weighting.update(losses, None, state.replace(key=jax.random.key(1)))
    again, _, _ = weighting.update(losses, None, state)
    values = [float(weights["main"]) for weights in (first, second, other, again)]
    assert len({*values[:3]}) == 3 and values[0] == values[3]
    np.testing.assert_allclose(sum(map(float, first.values())), 1.0, rtol=1e-6)


def test_limits_bound_the_weights_and_their_sum() -> None:
    gradients = {each: as_tree(row) for each, row in zip(NAMES, rows() * [[1], [10], [0.1]], strict=True)}
    losses = dict.fromkeys(NAMES, jnp.float32(1.0))
    free = jw.nash_mtl()
    bounded = jw.limited(free, minimum=0.5, maximum=2.0, total=3.0)
    state = free.init(NAMES)
    raw, _, _ = free.update(losses, jw.measure(free, losses, gradients), state)
    weights, _, metrics = bounded.update(losses, jw.measure(bounded, losses, gradients), state)
    assert isinstance(raw, dict) and isinstance(weights, dict)
    clipped = {name: np.clip(float(weight), 0.5, 2.0) for name, weight in raw.items()}
    for name in NAMES:
        np.testing.assert_allclose(weights[name], 3.0 * clipped[name] / sum(clipped.values()), rtol=1e-5)
        assert metrics[f"weight/{name}"] == weights[name]
    main_stays = jw.limited(jw.balance(), maximum=0.25)
    weights, _, _ = main_stays.update(losses, None, main_stays.init(NAMES))
    assert isinstance(weights, dict)
    assert (float(weights["main"]), float(weights["near"])) == (1.0, 0.25)
    direction = jw.limited(jw.graddrop(), maximum=1.0)
    with pytest.raises(RequestError, match="graddrop gives a direction"):
        direction.update(losses, gradients, direction.init(NAMES, SHARED))
    with pytest.raises(RequestError, match="maximum of weighting mgda must be at least its minimum"):
        jw.limited(jw.mgda(), minimum=1.0, maximum=0.5)


@pytest.mark.parametrize("name", ("sum", "cosine", "mgda"))
def test_cosines_are_logged_beside_any_weights(name: str) -> None:
    gradients = {each: as_tree(row) for each, row in zip(NAMES, rows(7), strict=True)}
    losses = dict.fromkeys(NAMES, jnp.float32(1.0))
    plain, logged = jw.make_weighting(name), jw.with_cosines(jw.make_weighting(name))
    state = plain.init(NAMES)
    weights, _, _ = plain.update(losses, jw.measure(plain, losses, gradients), state)
    same, _, metrics = logged.update(losses, jw.measure(logged, losses, gradients), state)
    jax.tree.map(lambda one, other: np.testing.assert_allclose(one, other, rtol=1e-5), weights, same)
    unit = rows(7) / np.linalg.norm(rows(7), axis=1, keepdims=True)
    np.testing.assert_allclose(metrics["cosine/near"], unit[1] @ unit[2], atol=1e-5)
    np.testing.assert_allclose(metrics["cosine/least"], (unit @ unit.T).min(), atol=1e-5)
    with pytest.raises(RequestError, match="moco needs whole gradients"):
        jw.with_cosines(jw.moco())
