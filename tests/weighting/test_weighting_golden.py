"""Each method, compared with a float64 transcription of its paper in NumPy; and the Gramian, with the explicit one."""

import contextlib
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from weighting_problem import encode, encoder_of, losses_of_latents, problem

import jaxrl_vis.weighting as jw
from jaxrl_vis.weighting import directions, learned, loss_values, solvers, surgery

NAMES = ("a", "b", "c")


@pytest.fixture(autouse=True)
def in_float64() -> Iterator[None]:
    with jax.enable_x64(True):
        yield


def gradients(seed: int = 0, count: int = 3, size: int = 6) -> np.ndarray:
    """Return gradients [K, size] of which two are in conflict."""
    rows = np.random.default_rng(seed).normal(size=(count, size))
    rows[1] -= rows[0]
    return rows


def named(rows: Any) -> dict[str, jax.Array]:
    return {name: jnp.asarray(row) for name, row in zip(NAMES, rows, strict=False)}


def weights_of(weighting: jw.Weighting, rows: np.ndarray, losses: Any = (1.0, 1.0, 1.0)) -> np.ndarray:
    names = NAMES[: len(rows)]
    step, _, _ = jax.jit(weighting.update)(named(losses[: len(rows)]), jnp.asarray(rows @ rows.T), weighting.init(names))
    assert isinstance(step, dict)
    return np.array([step[name] for name in names])


# -- From the Gramian


def test_mgda_of_two_losses_is_the_closed_form() -> None:
    for seed in range(10):
        one, other = gradients(seed, 2)
        share = np.clip((other - one) @ other / ((one - other) @ (one - other)), 0.0, 1.0)
        np.testing.assert_allclose(weights_of(jw.mgda(), np.stack([one, other])), [share, 1 - share], atol=1e-9)


def test_projections_onto_the_cone_of_two_gradients_are_the_closed_form() -> None:
    one, other = gradients(1, 2)
    assert one @ other < 0

    def project(vector: np.ndarray) -> np.ndarray:
        """Project onto the directions that oppose neither; at most one of the two constraints is active here."""
        for normal in (one, other):
            moved = vector - min(0.0, vector @ normal) * normal / (normal @ normal)
            if min(moved @ one, moved @ other) > -1e-9:
                return moved
        raise AssertionError

    rows = np.stack([one, other])
    np.testing.assert_allclose(rows.T @ weights_of(jw.upgrad(), rows), (project(one) + project(other)) / 2, atol=1e-9)
    mean = (one + other) / 2
    np.testing.assert_allclose(rows.T @ weights_of(jw.dualproj(), rows), project(mean), atol=1e-9)


def test_cagrad_has_the_best_worst_loss_in_its_ball() -> None:
    """The dual objective at w bounds the worst loss's decrease from above, for any w: here both are equal."""
    for seed in range(3):
        rows = gradients(seed)
        weights = weights_of(jw.cagrad(0.4), rows)
        mean, step = rows.mean(axis=0), rows.T @ weights
        radius = 0.4 * np.linalg.norm(mean)
        np.testing.assert_allclose(np.linalg.norm(step - mean), radius, rtol=1e-9)
        inside = (weights - 1 / 3) / (weights - 1 / 3).sum()
        hull = inside @ rows
        assert inside.min() > -1e-9
        np.testing.assert_allclose((rows @ step).min(), hull @ mean + radius * np.linalg.norm(hull), rtol=1e-8)
    np.testing.assert_allclose(weights_of(jw.cagrad(0.0), gradients()), 1 / 3)


def test_cagrad_of_gradients_on_a_line_stops_short_of_the_mean_or_goes_beyond_it() -> None:
    """With c = 1/2, the step is half the mean if signs are mixed (some loss must rise), and 1.5 times the mean if not."""
    signed = np.random.default_rng(3).normal(size=(200, 3))
    signed[0] = [1.0, -0.42374804, -0.60578518]  # one gradient is shifted to 0 on the way
    weighting = jw.cagrad(0.5)

    def step(values: jax.Array) -> jax.Array:
        found, _, _ = weighting.update(named([1.0, 1.0, 1.0]), values[:, None] * values[None, :], weighting.init(NAMES))
        assert isinstance(found, dict)
        return sum((found[name] * value for name, value in zip(NAMES, values, strict=True)), jnp.zeros(()))

    found = jax.jit(jax.vmap(step))(jnp.asarray(signed))
    is_mixed = (signed.min(axis=1) < 0) & (signed.max(axis=1) > 0)
    np.testing.assert_allclose(found, signed.mean(axis=1) * np.where(is_mixed, 0.5, 1.5), rtol=1e-6, atol=1e-9)


def test_bargains_are_solved() -> None:
    rows = gradients(2)
    shares = weights_of(jw.nash_mtl(), rows)
    np.testing.assert_allclose(rows @ rows.T @ shares * shares, 1.0, rtol=1e-9)
    clipped = weights_of(jw.nash_mtl(max_norm=0.5), rows)
    np.testing.assert_allclose(np.linalg.norm(rows.T @ clipped), 0.5, rtol=1e-9)
    for alpha in (0.5, 1.0, 2.0, 4.0):
        fair = weights_of(jw.fairgrad(alpha), rows)
        np.testing.assert_allclose(rows @ rows.T @ fair * fair ** (1 / alpha), 1.0, rtol=1e-8)


def test_closed_forms() -> None:
    rows = gradients(3)
    unit = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    impartial = weights_of(jw.imtl_g(), rows)
    projections = unit @ (rows.T @ impartial)
    np.testing.assert_allclose(projections, projections[0], rtol=1e-8)
    np.testing.assert_allclose(impartial.sum(), 1.0, rtol=1e-9)
    left, values, right = np.linalg.svd(rows, full_matrices=False)
    aligned = values.min() * (left @ right).T @ np.full(3, 1 / 3)
    np.testing.assert_allclose(rows.T @ weights_of(jw.aligned_mtl(), rows), aligned, atol=1e-9)
    best = np.linalg.pinv(unit) @ np.ones(3)
    best /= np.linalg.norm(best)
    np.testing.assert_allclose(rows.T @ weights_of(jw.config(), rows), (rows @ best).sum() * best, atol=1e-9)


def test_dependent_gradients_have_solutions() -> None:
    """Three gradients span one or two dimensions."""
    for rank in (1, 2):
        random = np.random.default_rng(rank)
        rows = random.normal(size=(3, rank)) @ random.normal(size=(rank, 6))
        hull = rows.T @ weights_of(jw.mgda(), rows)
        assert (rows @ hull).min() > hull @ hull - 1e-9
        for weighting in (jw.upgrad(), jw.dualproj()):
            step = rows.T @ weights_of(weighting, rows)
            assert (rows @ step).min() > -1e-9
        assert np.isfinite(weights_of(jw.nash_mtl(), rows)).all()


def test_nonnegative_least_squares_meet_their_optimality_conditions() -> None:
    random = np.random.default_rng(0)
    solve = jax.jit(lambda matrix, target: solvers.nonnegative(matrix, target)[0])
    for _ in range(30):
        factor = random.normal(size=(8, 10))
        matrix, target = factor @ factor.T, random.normal(size=8)
        x = np.asarray(solve(matrix, target))
        slack = matrix @ x - target
        assert x.min() >= 0 and slack.min() > -1e-8 and abs(x @ slack) < 1e-8


def test_projections_onto_the_simplex() -> None:
    for seed in range(5):
        vector = np.random.default_rng(seed).normal(size=5)
        found = np.asarray(solvers.to_simplex(jnp.asarray(vector)))
        assert found.min() >= 0
        np.testing.assert_allclose(found.sum(), 1.0)
        level = (vector - found)[found > 0]
        np.testing.assert_allclose(level, level[0])
        assert (vector[found == 0] <= level[0] + 1e-12).all()


# -- In a random order, which is given


def test_pcgrad_and_gradvac_change_vectors_as_in_the_papers() -> None:
    rows, random = gradients(4, 4), np.random.default_rng(0)
    orders = np.stack([random.permutation(4) for _ in range(4)])
    usual, beta = random.uniform(-0.2, 0.4, size=(4, 4)), 0.3
    surgical, vaccinated, means = np.zeros(6), np.zeros(6), usual.copy()
    for i in range(4):
        changed, turned = rows[i].copy(), rows[i].copy()
        for j in orders[i]:
            if j == i:
                continue
            changed -= min(0.0, changed @ rows[j]) / (rows[j] @ rows[j]) * rows[j]
            length, other = np.linalg.norm(turned), np.linalg.norm(rows[j])
            cosine = turned @ rows[j] / (length * other)
            wanted = means[i, j]
            if cosine < wanted:
                top = wanted * np.sqrt(1 - cosine**2) - cosine * np.sqrt(1 - wanted**2)
                turned = turned + length * top / (other * np.sqrt(1 - wanted**2)) * rows[j]
            means[i, j] = (1 - beta) * wanted + beta * cosine
        surgical, vaccinated = surgical + changed, vaccinated + turned
    gramian = jnp.asarray(rows @ rows.T)
    np.testing.assert_allclose(rows.T @ surgery.pcgrad_weights(gramian, jnp.asarray(orders)), surgical, atol=1e-9)
    found, after = surgery.gradvac_weights(gramian, jnp.asarray(usual), jnp.asarray(orders), beta)
    np.testing.assert_allclose(rows.T @ found, vaccinated, atol=1e-9)
    off = ~np.eye(4, dtype=bool)
    np.testing.assert_allclose(np.asarray(after)[off], means[off], atol=1e-9)


def test_graddrop_keeps_gradients_of_one_sign() -> None:
    rows, drawn = gradients(5), np.random.default_rng(1).uniform(size=6)
    purity = 0.5 * (1 + rows.sum(axis=0) / np.abs(rows).sum(axis=0))
    for leak in (0.0, 0.25):
        expected = np.zeros(6)
        for row in rows:
            mask = np.where(purity > drawn, row > 0, row < 0)
            expected += (leak + (1 - leak) * mask) * row
        found = directions.graddrop_direction(named(rows), jnp.asarray(drawn), leak)
        np.testing.assert_allclose(found, expected, rtol=1e-12)


# -- With a memory


def run(weighting: jw.Weighting, losses: np.ndarray, rows: np.ndarray | None = None) -> list[Any]:
    """Return the steps [T] of a weighting from losses [T, 3], and gradients [T, 3, size] where it needs them."""
    state = weighting.init(NAMES, jnp.zeros(rows.shape[-1]) if rows is not None else None)
    update, steps = jax.jit(weighting.update), []
    for place, values in enumerate(losses):
        by_name = named(values)
        statistics = None if rows is None else jw.measure(weighting, by_name, named(rows[place]))
        step, state, _ = update(by_name, statistics, state)
        steps.append(step)
    return steps


def vectors(steps: list[Any]) -> np.ndarray:
    return np.array([[step[name] for name in NAMES] for step in steps])


LOSSES = np.random.default_rng(9).uniform(0.2, 3.0, size=(6, 3))
GRADIENTS = np.random.default_rng(8).normal(size=(6, 3, 5))


class Adam:
    """Adam in NumPy, with decay rates 0.9 and 0.999 and epsilon 1e-8."""

    def __init__(self, size: int, rate: float) -> None:
        self.first, self.second, self.steps, self.rate = np.zeros(size), np.zeros(size), 0, rate

    def __call__(self, gradient: np.ndarray) -> np.ndarray:
        self.steps += 1
        self.first = 0.9 * self.first + 0.1 * gradient
        self.second = 0.999 * self.second + 0.001 * gradient**2
        mean, square = self.first / (1 - 0.9**self.steps), self.second / (1 - 0.999**self.steps)
        return -self.rate * mean / (np.sqrt(square) + 1e-8)


def softmax(vector: np.ndarray) -> np.ndarray:
    powers = np.exp(vector - vector.max())
    return powers / powers.sum()


def test_learned_scales_follow_their_objectives() -> None:
    scales, adam, expected = np.zeros(3), Adam(3, 0.05), []
    others, other_adam, doubled = np.zeros(3), Adam(3, 0.05), []
    for losses in LOSSES:
        expected.append(np.exp(-scales) / 2)
        scales = scales + adam(0.5 - 0.5 * np.exp(-scales) * losses)
        doubled.append(np.exp(others))
        others = others + other_adam(np.exp(others) * losses - 1)
    np.testing.assert_allclose(vectors(run(jw.uncertainty(0.05), LOSSES)), expected, rtol=1e-9)
    np.testing.assert_allclose(vectors(run(jw.imtl_l(0.05), LOSSES)), doubled, rtol=1e-9)


def test_weights_of_values_alone() -> None:
    mean = np.exp(np.log(LOSSES).mean(axis=1, keepdims=True))
    np.testing.assert_allclose(vectors(run(jw.geometric_mean(1e-12), LOSSES)), mean / (3 * LOSSES), rtol=1e-9)
    smooth = np.stack([softmax((losses - [0, 0.1, 0]) / 3 / 0.2) / 3 for losses in LOSSES])
    np.testing.assert_allclose(vectors(run(jw.stch(0.2, {"b": 0.1}), LOSSES)), smooth, rtol=1e-9)
    drawn = jnp.asarray([0.3, -1.0, 2.0])
    np.testing.assert_allclose(loss_values.random_weights(drawn), softmax(np.array(drawn)), rtol=1e-12)


def test_dwa_reads_the_means_of_two_epochs() -> None:
    found = vectors(run(jw.dwa(temperature=1.5, epoch=2), LOSSES))
    means = LOSSES.reshape(3, 2, 3).mean(axis=1)
    np.testing.assert_allclose(found[:4], 1.0)
    np.testing.assert_allclose(found[4:], np.tile(3 * softmax(means[1] / means[0] / 1.5), (2, 1)), rtol=1e-9)


def test_famo_raises_losses_that_fall_less() -> None:
    logits, adam, expected, before = np.zeros(3), Adam(3, 0.1), [], None
    for losses in LOSSES:
        if before is not None:
            shares = softmax(logits)
            change = np.log(before) - np.log(losses)
            logits = logits + adam(shares * (change - shares @ change) + 0.01 * logits)
        weights = softmax(logits) / losses
        expected.append(weights / weights.sum())
        before = losses
    np.testing.assert_allclose(vectors(run(jw.famo(0.1, 0.01, eps=1e-14), LOSSES)), expected, rtol=1e-8)


def test_gradnorm_follows_its_paper() -> None:
    weights, adam, expected = np.ones(3), Adam(3, 0.1), []
    for losses, rows in zip(LOSSES, GRADIENTS, strict=True):
        expected.append(weights)
        rates = losses / LOSSES[0]
        lengths = np.linalg.norm(rows, axis=1)
        target = (weights * lengths).mean() * (rates / rates.mean()) ** 0.7
        weights = weights + adam(np.sign(weights * lengths - target) * lengths)
        weights = 3 * weights / weights.sum()
    np.testing.assert_allclose(vectors(run(jw.gradnorm(0.7, 0.1), LOSSES, GRADIENTS)), expected, rtol=1e-8)


def test_auxinash_bargains_with_learned_preferences() -> None:
    rows = GRADIENTS[0]
    gramian, shares = rows @ rows.T, np.array([0.5, 1.0, 1.5])
    weights = np.asarray(solvers.bargain(jnp.asarray(gramian), jnp.asarray(shares)))
    np.testing.assert_allclose(gramian @ weights * weights, shares, rtol=1e-9)

    def decrease(shares: np.ndarray) -> float:
        """Return the decrease of loss b per unit of step size."""
        return float(gramian[1] @ np.asarray(solvers.bargain(jnp.asarray(gramian), jnp.asarray(shares))))

    slopes = np.array([(decrease(shares + 1e-5 * mode) - decrease(shares - 1e-5 * mode)) / 2e-5 for mode in np.eye(3)])
    found = learned.preference_slope(jnp.asarray(gramian), jnp.asarray(shares), jnp.asarray(weights), 1)
    np.testing.assert_allclose(found, -slopes * weights[1], rtol=1e-5)
    # A loss that opposes the main one loses its say, and one that helps gains.
    main, weighting = np.array([1.0, 0.0]), jw.auxinash(0.1)
    rows = np.stack([main, [0.9, 0.4], [-0.6, 0.8]])
    state = weighting.init(("helps", "main", "opposes"))
    update = jax.jit(weighting.update)
    losses = dict.fromkeys(("helps", "main", "opposes"), jnp.ones(()))
    by_sorted_name = rows[[1, 0, 2]]
    for _ in range(30):
        step, state, _ = update(losses, jnp.asarray(by_sorted_name @ by_sorted_name.T), state)
    logits = np.asarray(state.memory["logits"])
    assert logits[0] > 0.5 and logits[2] < -0.5
    assert isinstance(step, dict)


def test_averaged_and_tracked_gradients_follow_their_papers() -> None:
    averages, tracked, shares = np.zeros((3, 5)), np.zeros((3, 5)), np.full(3, 1 / 3)
    balanced, corrected = [], []
    for place, (losses, rows) in enumerate(zip(LOSSES, GRADIENTS, strict=True), start=1):
        logs = rows / (losses + 1e-8)[:, None]
        averages = logs + 0.8 / place**0.5 * (averages - logs)
        lengths = np.linalg.norm(averages, axis=1)
        balanced.append((lengths.max() / lengths) @ averages)
        tracked = tracked - 0.4 / place**0.5 * (tracked - rows)
        shares = np.asarray(
            solvers.to_simplex(jnp.asarray(shares - 0.2 / place**0.5 * (tracked @ tracked.T @ shares + 0.1 * shares)))
        )
        corrected.append(shares @ tracked)
    found = [step.shared for step in run(jw.db_mtl(0.8, 0.5), LOSSES, GRADIENTS)]
    np.testing.assert_allclose(found, balanced, rtol=1e-8)
    found = [step.shared for step in run(jw.moco(0.4, 0.2, 0.5, 0.1), LOSSES, GRADIENTS)]
    np.testing.assert_allclose(found, corrected, rtol=1e-8)


# -- The Gramian


def explicit_gramian(params: Any, batch: Any) -> np.ndarray:
    def stacked(encoder: Any) -> jax.Array:
        losses = losses_of_latents({**params, "encoder": encoder}, encode(encoder, batch), batch)
        return jnp.stack([losses[name] for name in sorted(losses)])

    jacobian = jax.jacrev(stacked)(params["encoder"])
    rows = np.concatenate([np.reshape(leaf, (3, -1)) for leaf in jax.tree.leaves(jacobian)], axis=1)
    return rows @ rows.T


@contextlib.contextmanager
def recording_weighting(seen: list[Any]) -> Iterator[jw.Weighting]:
    """Yield a weighting that needs a Gramian, and appends each one that it receives to ``seen``."""
    inner = jw.uniform()

    def update(losses: Any, statistics: Any, state: Any) -> Any:
        seen.append(statistics)
        return inner.update(losses, None, state)

    yield inner._replace(needs="gramian", update=update)


def test_both_ways_find_the_explicit_gramian() -> None:
    params, batch = problem(0)
    expected = explicit_gramian(params, batch)
    for mode in ("per_loss", "latents"):

        @jax.jit
        def find(params: Any, batch: Any, mode: Any = mode) -> Any:
            seen: list[Any] = []
            with recording_weighting(seen) as weighting:
                gradient = jw.weighted_grad(losses_of_latents, weighting, encoder_of, mode, encode=encode)
                return gradient(params, weighting.init(tuple(params["heads"])), batch), seen[0]

        result, gramian = find(params, batch)
        assert gramian.dtype == jnp.float64
        np.testing.assert_allclose(gramian, expected, rtol=1e-10)
        np.testing.assert_allclose(gramian, np.asarray(gramian).T)
    assert result.gradient["encoder"]["kernel"].shape == (5, 4)


def test_gramians_through_groups_of_latents_and_of_parts_of_a_batch() -> None:
    """Losses read different latents, and the batch is on two devices: the Gramian is that of the mean losses."""
    params, batch = problem(1, size=24)
    groups = {
        "first": lambda encoder, batch: encode(encoder, batch),
        "twice": lambda encoder, batch: 2 * encode(encoder, batch),
    }

    def losses(params: Any, latents: Any, batch: Any) -> Any:
        found = {name: latents["first"] for name in params["heads"]} | {"far": latents["twice"] / 2}
        return {name: jnp.mean((found[name] @ head - batch[name]) ** 2) for name, head in params["heads"].items()}

    parts = jax.tree.map(lambda leaf: leaf.reshape(2, 12, *leaf.shape[1:]), batch)
    seen: list[Any] = []

    def on_parts(part: Any) -> Any:
        with recording_weighting(seen) as weighting:
            gradient = jw.weighted_grad(
                losses, weighting, encoder_of, "latents", encode=groups, reduce=lambda tree: jax.lax.pmean(tree, "devices")
            )
            gradient(params, weighting.init(tuple(params["heads"])), part)
        return seen[-1]

    found = jax.jit(jax.vmap(on_parts, axis_name="devices"))(parts)
    for each in found:
        np.testing.assert_allclose(each, explicit_gramian(params, batch), rtol=1e-10)


def test_gramians_of_bfloat16_gradients_are_summed_in_float32() -> None:
    rows = np.random.default_rng(0).normal(size=(2, 4096)).astype(jnp.bfloat16)
    found = jw.gramian({"a": jnp.asarray(rows[0]), "b": jnp.asarray(rows[1])})
    exact = rows.astype(np.float64) @ rows.astype(np.float64).T
    assert found.dtype in (jnp.float32, jnp.float64)
    np.testing.assert_allclose(found, exact, rtol=1e-5, atol=1e-3)


ON_SPREAD = ("mgda", "upgrad", "dualproj", "cagrad", "imtl_g", "nash_mtl", "fairgrad", "config", "pcgrad", "gradvac")


@pytest.mark.parametrize("name", ON_SPREAD)
@pytest.mark.parametrize("spread", [1e2, 1e4, 1e6])
def test_gradients_of_many_lengths_are_as_accurate_in_float32(name: str, spread: float) -> None:
    """Regression test: cagrad took no step when one gradient was 300 times longer than another, imtl_g a wrong one at 3,000."""
    weighting = jw.make_weighting(name)
    rows = np.random.default_rng(1).normal(size=(3, 50)) + 0.3
    rows *= spread ** -np.array([[0.0], [0.6], [1.0]])
    steps = []
    for dtype in (np.float32, np.float64):
        losses = {each: jnp.ones((), dtype) for each in NAMES}
        found, _, _ = jax.jit(weighting.update)(losses, jnp.asarray((rows @ rows.T).astype(dtype)), weighting.init(NAMES))
        steps.append(rows.T @ np.array([found[each] for each in NAMES], np.float64))
    assert np.linalg.norm(steps[1]) > 0.0
    assert np.linalg.norm(steps[0] - steps[1]) < 1e-3 * np.linalg.norm(steps[1])
