"""The quadratic example: the package's weightings, compared with plain transcriptions in NumPy."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrl_vis import cli
from jaxrl_vis.studies import quadratic
from jaxrl_vis.weighting import MAIN, make_weighting, weighted_grad

HALF = np.array([0.5, 0.5])


def transcription(start: tuple[float, float], steps: int, step_size: float) -> tuple[np.ndarray, np.ndarray]:
    """Return points [steps + 1, 2] and weights [steps + 1, 2] by the authors' rule, in float64."""
    point, weights = np.array(start), np.ones(2)
    points, history = [point], [weights]
    for _ in range(steps):
        main = 2 * point
        others = np.stack([2 * (point - HALF), -main])
        point = point - step_size * (main + weights @ others)
        weights = weights + step_size * (weights[:, None] * others) @ main
        points.append(point)
        history.append(weights)
    return np.stack(points), np.stack(history)


@pytest.fixture(scope="module")
def adaptive() -> quadratic.Paths:
    return quadratic.descend(quadratic.authors_rule())


def test_the_paths_are_those_of_the_authors_rule(adaptive: quadratic.Paths) -> None:
    for place, start in enumerate(quadratic.STARTS):
        points, weights = transcription(start, 1000, 0.01)
        np.testing.assert_allclose(adaptive.points[place], points, atol=2e-5)
        for column, name in enumerate(quadratic.AUXILIARY):
            np.testing.assert_allclose(adaptive.weights[name][place], weights[:, column], atol=5e-5)


def test_adaptive_weights_find_the_main_minimum_and_fixed_ones_do_not(adaptive: quadratic.Paths) -> None:
    assert np.linalg.norm(adaptive.points[:, -1], axis=-1).max() < 0.1
    helpful = adaptive.weights["shifted"]
    assert (helpful.max(axis=1) > 2).all() and (helpful.argmax(axis=1) < 50).all() and (helpful[:, -1] < 0.2).all()
    assert (adaptive.weights["opposed"][:, -1] < 0.05).all()
    fixed = quadratic.descend(make_weighting("sum"))
    np.testing.assert_allclose(fixed.points[:, -1], np.tile(HALF, (4, 1)), atol=1e-3)


def positive_losses(point: Any) -> dict[str, Any]:
    """Return losses that are positive everywhere: a bowl, a shifted one, and one that falls where the first rises."""
    main = (point**2).sum()
    return {MAIN: main, "shifted": ((point - 0.5) ** 2).sum(), "opposed": 1.0 / (1.0 + main)}


def algorithm_1(start: np.ndarray, steps: int, interval: int, alpha: float, beta: float, eps: float) -> np.ndarray:
    """Return x, y and both weights, [steps + 1, 4], by the thesis's algorithm 1 with a plus and a bound at 0, in float64."""
    point, weights, total = start.astype(np.float64), np.ones(2), np.zeros(2)
    rows = [[*point, *weights]]
    for t in range(steps):
        values = positive_losses(point)
        main = 2 * point
        raw = np.stack([2 * (point - 0.5), -main / (1 + values[MAIN]) ** 2])
        main_log = main / (values[MAIN] + eps)
        logs = raw / (np.array([values["shifted"], values["opposed"]]) + eps)[:, None]
        point = point - alpha * (main_log + weights @ logs)
        total += logs @ main_log
        if (t + 1) % interval == 0:
            weights = np.maximum(weights + beta * alpha * total / interval, 0.0)
            total = np.zeros(2)
        rows.append([*point, *weights])
    return np.array(rows)


@pytest.mark.parametrize("interval", [1, 5])
def test_algorithm_1_is_its_transcription(interval: int) -> None:
    """Both take 1,002 steps, not a multiple of 5, in float64, because rounding of float32 would grow along the way."""
    start, alpha, beta, eps, steps = np.array([1.8, 1.0]), 0.002, 5.0 * interval, 0.05, 1002
    with jax.enable_x64(True):
        weighting = make_weighting("ol_aux", interval=interval, learning_rate=alpha, beta=beta, eps=eps, main_eps=eps)
        gradient = weighted_grad(positive_losses, weighting)

        def step(carry: Any, _: None) -> Any:
            point, state = carry
            result = gradient(point, state)
            after = (point - alpha * result.gradient, result.state)
            return after, jnp.stack([*after[0], after[1].weights["shifted"], after[1].weights["opposed"]])

        first = (jnp.asarray(start), weighting.init((MAIN, "shifted", "opposed")))
        _, rows = jax.jit(lambda: jax.lax.scan(step, first, length=steps))()
        result = np.asarray(rows)
    expected = algorithm_1(start, steps, interval, alpha, beta, eps)[1:]
    assert result.dtype == np.float64
    np.testing.assert_allclose(result, expected, atol=1e-6)
    assert expected[-1, 3] == 0.0 and expected[:, 2].max() > 1.05  # the opposed task is dropped, the shifted one helps
    assert np.linalg.norm(expected[-1, :2]) < 0.5 * np.linalg.norm(start)


def test_figure_is_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "new" / "q.png"
    assert cli.main(["figure", "quadratic", "--out", str(path)]) == 0
    assert capsys.readouterr().out.strip() == str(path)
    assert path.read_bytes().startswith(b"\x89PNG") and path.stat().st_size > 20_000


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        (["quadratc"], ["unknown figure 'quadratc'", "did you mean quadratic"]),
        ([], ["no figure given", "quadratic"]),
        (["quadratic", "--ot", "x"], ["unknown option --ot", "--out"]),
        (["quadratic", "--out", "x.avi"], ["--out x.avi", ".png"]),
        (["quadratic", "--out", "/proc/x.png"], ["cannot write --out /proc/x.png"]),
    ],
)
def test_bad_figures_get_one_line(words: list[str], parts: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["figure", *words]) == 2
    output = capsys.readouterr()
    assert output.out == "" and len(output.err.splitlines()) == 1
    for part in parts:
        assert part in output.err
