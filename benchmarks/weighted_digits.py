"""All weightings on supervised data: a small network with several heads on the digits of scikit-learn.

    python -m benchmarks.weighted_digits [--only NAME ...] [--json FILE]

    pairs       two superimposed digits: classify the upper and the lower one
    attributes  five attributes of one digit: class, parity, above four, number of holes, amount of ink
    auxiliary   the same with 100 images: the digit's class is the main task, the other four are auxiliary

Each method is trained with Adam at `RATES` on seeds 0 to 14; the rate with the best validation accuracy is used for seeds 100
to 114, whose test accuracy is reported. Methods with a main loss are tested only on ``auxiliary``, where only the main task's
accuracy counts. The record is written after each method, and methods that it already holds are not trained again.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from sklearn.datasets import load_digits

import jaxrl_vis.weighting as jw
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host import provenance
from jaxrl_vis.host.files import write_atomically

RATES = (1e-3, 3e-3, 1e-2)
TUNING_SEEDS, TEST_SEEDS = range(15), range(100, 115)  # equally many, so that one program serves both
STEPS, BATCH, WIDTH = 2000, 64, 32
BASELINE = "sum"
TARGET = Path(__file__).parent / "results" / "weighted_digits.json"
_HOLES = np.array([1, 0, 0, 0, 1, 0, 1, 0, 2, 1])  # in digits 0 to 9 as usually written
_LABELLED = 100

Split = dict[str, np.ndarray]  # inputs under x, and labels of each task under its name


class Problem(NamedTuple):
    """Data of one comparison.

    Attributes:
        classes: Number of classes of each task.
        splits: ``train``, ``valid`` and ``test``.
        scored: Tasks whose mean accuracy counts.
    """

    classes: dict[str, int]
    splits: dict[str, Split]
    scored: tuple[str, ...]


def problems() -> dict[str, Problem]:
    """Return the three problems by name; no image is in more than one split."""
    data = load_digits()
    images, digits = data.images.astype(np.float32) / 16.0, data.target
    order = np.random.default_rng(0).permutation(len(images))
    rows = dict(zip(("train", "valid", "test"), np.split(order, (900, 1300)), strict=True))
    ink = images.mean(axis=(1, 2))
    answers = {
        "digit": digits,
        "even": digits % 2,
        "high": (digits > 4).astype(np.int64),
        "holes": _HOLES[digits],
        "ink": np.digitize(ink, np.quantile(ink[rows["train"]], (0.25, 0.5, 0.75))),
    }
    classes = {"digit": 10, "even": 2, "high": 2, "holes": 3, "ink": 4}

    def label(indices: np.ndarray, digit: str = "digit") -> Split:
        named = {digit if name == "digit" else name: values[indices] for name, values in answers.items()}
        return {"x": images[indices].reshape(-1, 64), **named}

    def pair(indices: np.ndarray, seed: int) -> Split:
        upper, lower = indices, np.random.default_rng(seed).permutation(indices)
        canvas = np.zeros((len(indices), 10, 10), np.float32)
        canvas[:, :8, :8] = images[upper]
        canvas[:, 2:, 2:] = np.maximum(canvas[:, 2:, 2:], images[lower])
        return {"x": canvas.reshape(-1, 100), "upper": digits[upper], "lower": digits[lower]}

    few = {**rows, "train": rows["train"][:_LABELLED]}
    return {
        "pairs": Problem(
            {"upper": 10, "lower": 10},
            {name: pair(np.tile(indices, 4), seed) for seed, (name, indices) in enumerate(rows.items())},
            ("upper", "lower"),
        ),
        "attributes": Problem(classes, {name: label(indices) for name, indices in rows.items()}, tuple(classes)),
        "auxiliary": Problem(
            {jw.MAIN if name == "digit" else name: count for name, count in classes.items()},
            {name: label(indices, jw.MAIN) for name, indices in few.items()},
            (jw.MAIN,),
        ),
    }


def init_params(key: jax.Array, problem: Problem) -> Any:
    """Initialise the parameters: a trunk of two layers ([pixels, 64], [64, WIDTH]) and a linear head [WIDTH, classes] per task.

    Biases are omitted; weights are normal with variance 1 / inputs.
    """

    def layer(key: jax.Array, rows: int, columns: int) -> jax.Array:
        return jax.random.normal(key, (rows, columns)) / np.sqrt(rows)

    first, second, *others = jax.random.split(key, 2 + len(problem.classes))
    inputs = problem.splits["train"]["x"].shape[1]
    heads = {name: layer(key, WIDTH, count) for key, (name, count) in zip(others, problem.classes.items(), strict=True)}
    return {"trunk": [layer(first, inputs, 64), layer(second, 64, WIDTH)], "heads": heads}


def logits(params: Any, x: jax.Array) -> dict[str, jax.Array]:
    """Return the logits [N, classes] of each task for images ``x`` [N, pixels]."""
    first, second = params["trunk"]
    features = jax.nn.relu(jax.nn.relu(x @ first) @ second)
    return {name: features @ head for name, head in params["heads"].items()}


def losses(params: Any, batch: dict[str, jax.Array]) -> dict[str, jax.Array]:
    """Return the mean cross-entropy [] of each task over a batch: ``x`` [N, pixels] and labels [N] int by task."""
    outputs = logits(params, batch["x"])
    return {
        name: jnp.mean(optax.softmax_cross_entropy_with_integer_labels(values, batch[name])) for name, values in outputs.items()
    }


def make_training(problem: Problem, weighting: jw.Weighting) -> Callable[[jax.Array, jax.Array], dict[str, jax.Array]]:
    """Return the jitted training of R parallel runs: (rates [R], seeds [R]) -> accuracies [R] on ``valid`` and ``test``.

    The accuracy is the mean over the scored tasks, after `STEPS` steps of Adam.
    """
    gradient = jw.weighted_grad(losses, weighting, shared=lambda params: params["trunk"])
    optimizer = optax.scale_by_adam()
    known = {name: jnp.asarray(values) for name, values in problem.splits["train"].items()}

    def accuracy(params: Any, split: Split) -> jax.Array:
        outputs = logits(params, jnp.asarray(split["x"]))
        return jnp.mean(jnp.stack([jnp.mean(jnp.argmax(outputs[name], axis=-1) == split[name]) for name in problem.scored]))

    def run(rate: jax.Array, seed: jax.Array) -> dict[str, jax.Array]:
        params_key, state_key, data_key = jax.random.split(jax.random.key(seed), 3)
        params = init_params(params_key, problem)
        state = weighting.init(tuple(problem.classes), params["trunk"], *([params] if weighting.hold else []))
        state = state if state.key is None else state.replace(key=state_key)

        def step(carry: Any, key: jax.Array) -> tuple[Any, None]:
            params, moments, state = carry
            rows = jax.random.randint(key, (BATCH,), 0, len(known["x"]))
            result = gradient(params, state, {name: values[rows] for name, values in known.items()})
            change, moments = optimizer.update(result.gradient, moments)
            params = jax.tree.map(lambda leaf, slope: leaf - rate * slope, params, change)
            return (params, moments, result.state), None

        carry = (params, optimizer.init(params), state)
        (params, _, _), _ = jax.lax.scan(step, carry, jax.random.split(data_key, STEPS))
        return {name: accuracy(params, problem.splits[name]) for name in ("valid", "test")}

    return jax.jit(jax.vmap(run))


def measure(problem: Problem, name: str) -> dict[str, Any]:
    """Tune and test one method.

    Returns:
        ``method``, the best ``rate``, ``valid`` (mean validation accuracy at each of `RATES`), ``test`` (test accuracy of each
        test seed at the best rate) and ``seconds`` of the test runs.
    """
    train = make_training(problem, jw.make_weighting(name))
    rates = [jnp.full(len(TUNING_SEEDS), rate) for rate in RATES]
    valid = [float(jnp.mean(train(rate, jnp.array(TUNING_SEEDS))["valid"])) for rate in rates]
    best = int(np.argmax(valid))
    started = time.perf_counter()  # after compilation
    test = np.asarray(train(rates[best], jnp.array(TEST_SEEDS))["test"])
    return {
        "method": name,
        "rate": RATES[best],
        "valid": [round(value, 4) for value in valid],
        "test": [round(float(value), 4) for value in test],
        "seconds": round(time.perf_counter() - started, 2),
    }


def applicable_weightings(problem: Problem) -> Iterator[str]:
    """Yield the names of the weightings applicable to a problem, the baseline first; some require a main task."""
    for name in (BASELINE, *(name for name in jw.WEIGHTINGS if name != BASELINE)):
        weighting = jw.make_weighting(name)
        if jw.MAIN not in problem.classes:
            try:
                weighting.init(tuple(problem.classes), init_params(jax.random.key(0), problem)["trunk"])
            except RequestError:
                continue
        yield name


def main() -> int:
    """Read the command line, train what is missing, and write the record."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=sorted(jw.WEIGHTINGS), help="methods; all if not given")
    parser.add_argument("--json", type=Path, default=TARGET, help="the record")
    options = parser.parse_args()
    record: dict[str, Any] = json.loads(options.json.read_text()) if options.json.exists() else {"problems": {}}
    for title, problem in problems().items():
        rows = record["problems"].setdefault(title, [])
        for name in applicable_weightings(problem):
            if any(row["method"] == name for row in rows) or (options.only and name not in options.only):
                continue
            rows.append(measure(problem, name))
            print(f"{title:10} {name:16} rate {rows[-1]['rate']:g}  test {np.mean(rows[-1]['test']):.4f}", flush=True)
            about = {"device": provenance.device_name(), "versions": provenance.versions(), "revision": provenance.revision()}
            sizes = {"steps": STEPS, "batch": BATCH, "rates": RATES, "labelled": _LABELLED}
            write_atomically(options.json, json.dumps({**about, **sizes, "problems": record["problems"]}, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
