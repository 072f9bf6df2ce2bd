"""Time of our weightings for several numbers of losses on a trunk, alone and with backward passes, compared with TorchJD's.

The trunk has three tanh layers, 1 M parameters at the default width; each loss is the mean squared error of a linear head on
it. Parameters and batch are float32. One compiled function is timed:

    alone    from gradients of all losses, or their Gramian, to weights or a direction
    step     from a batch to the gradient of all parameters: forward and backward passes, weighting, weighted sum
"""

import dataclasses
import json
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

import jaxrl_vis.weighting as jw
from jaxrl_vis.bench.record import results_path
from jaxrl_vis.host import provenance
from jaxrl_vis.host.files import write_atomically

TARGETS = 16
"""Output size of each head."""
PASSES = 10
"""Calls of the function per timing."""
BUDGET = 1.0
"""Time after which a function with three timings gets no more, s; TorchJD's solvers on the host take up to a second a call."""
METHODS = tuple(name for name in jw.WEIGHTINGS if name not in ("none", "none_log", "fixed", "ol_aux_ablation"))


@dataclasses.dataclass(frozen=True)
class Size:
    """Sizes of the problem.

    Attributes:
        losses: Numbers of losses.
        width: Width of the trunk's layers and of the input.
        batch_size: Number of examples.
        repeats: Number of timings of each function; the median counts.
    """

    losses: tuple[int, ...]
    width: int
    batch_size: int
    repeats: int


def names_of(count: int) -> tuple[str, ...]:
    """Return the names of K losses, the main one first."""
    return (jw.MAIN, *(f"other_{index}" for index in range(count - 1)))


def problem(size: Size, count: int) -> tuple[dict[str, Any], dict[str, jax.Array]]:
    """Sample parameters of a trunk and K = ``count`` heads, and a batch, all float32.

    Returns:
        Parameters: ``trunk``, three kernels [width, width], and ``heads``, a kernel [width, TARGETS] by name. Batch: ``inputs``
        [B, width], and the targets [B, TARGETS] of each head by its name.
    """
    keys = jax.random.split(jax.random.key(0), 3 + 2 * count)
    width = size.width
    layers = [jax.random.normal(key, (width, width)) / width**0.5 for key in keys[:3]]
    names = names_of(count)
    heads = {name: jax.random.normal(key, (width, TARGETS)) / width**0.5 for name, key in zip(names, keys[3:], strict=False)}
    batch = {
        name: jax.random.normal(key, (size.batch_size, TARGETS)) for name, key in zip(names, keys[3 + count :], strict=True)
    }
    inputs = jax.random.normal(keys[0], (size.batch_size, width))
    return {"trunk": layers, "heads": heads}, {"inputs": inputs, **batch}


def encode(trunk: list[jax.Array], batch: dict[str, jax.Array]) -> jax.Array:
    """Compute the trunk's features [B, width]."""
    hidden = batch["inputs"]
    for layer in trunk:
        hidden = jnp.tanh(hidden @ layer)
    return hidden


def losses_of(params: Any, features: jax.Array, batch: dict[str, jax.Array]) -> dict[str, jax.Array]:
    """Compute the mean squared error [] of each head, by name."""
    return {name: jnp.mean(jnp.square(features @ head - batch[name])) for name, head in params["heads"].items()}


def time_call(function: Callable[..., Any], arguments: tuple[Any, ...], repeats: int) -> float:
    """Return the median time of a call, s, without compilation: of three timings, or up to ``repeats`` within `BUDGET`."""
    call = jax.jit(function)
    jax.block_until_ready(call(*arguments))
    seconds, end = [], time.perf_counter() + BUDGET
    for count in range(repeats):
        if count >= 3 and time.perf_counter() > end:
            break
        started = time.perf_counter()
        result = None
        for _ in range(PASSES):
            result = call(*arguments)
        jax.block_until_ready(result)
        seconds.append((time.perf_counter() - started) / PASSES)
    return statistics.median(seconds)


def time_method(name: str, size: Size, count: int) -> list[dict[str, Any]]:
    """Time one weighting for K losses, s: a row for the weighting alone, and one for a step by each method that it allows."""
    weighting, (params, batch) = jw.make_weighting(name), problem(size, count)
    state = weighting.init(names_of(count), params["trunk"])
    losses = {loss: jnp.float32(1.0) for loss in names_of(count)}
    gradients = {
        loss: [jax.random.normal(jax.random.key(index), layer.shape) for layer in params["trunk"]]
        for index, loss in enumerate(names_of(count))
    }
    statistics_of = jax.jit(lambda gradients: jw.measure(weighting, losses, gradients))(gradients)
    base = {"method": name, "losses": count}
    rows = [base | {"what": "alone", "seconds": time_call(weighting.update, (losses, statistics_of, state), size.repeats)}]
    for mode in ("per_loss", "latents") if weighting.needs != "gradients" else ("per_loss",):
        gradient = jw.weighted_grad(losses_of, weighting, lambda params: params["trunk"], mode, encode=encode)

        def step(params: Any, state: Any, batch: Any, gradient: Any = gradient) -> Any:
            result = gradient(params, state, batch)
            return result.gradient, result.state, result.weights

        rows.append(base | {"what": f"step, {mode}", "seconds": time_call(step, (params, state, batch), size.repeats)})
    return rows


def measure_all(size: Size, python: Path | None, results: Path) -> int:
    """Time all methods on both sides, print a table and update the record after each number of losses; return the exit status.

    The record keeps the rows of other numbers of losses if device, versions and sizes are the same.
    """
    path = results_path("weighting_cost", results)
    for count in size.losses:
        theirs = time_peer(size, count, python)
        rows: list[dict[str, Any]] = []
        for name in METHODS:
            rows += (measured := time_method(name, size, count))
            print(
                *(f"{row['method']:16}{count:4} {row['what']:16}{1e6 * row['seconds']:10.0f} us" for row in measured), sep="\n"
            )
        for row in theirs["rows"]:
            print(f"TorchJD {row['method']:16}{count:4} {row['what']:16}{1e6 * row['seconds']:10.0f} us", flush=True)
        update(path, size, {"ours": rows, "torchjd": theirs["rows"]}, {**provenance.versions(), **theirs["versions"]})
    return 0


def time_peer(size: Size, count: int, python: Path | None) -> dict[str, Any]:
    """Return TorchJD's ``rows`` for K losses and its ``versions``; both empty without its interpreter."""
    from benchmarks.peers.torchjd.__main__ import run_peer

    if python is None:
        return {"rows": [], "versions": {}}
    settings = {**dataclasses.asdict(size), "losses": [count], "targets": TARGETS, "passes": PASSES, "budget": BUDGET}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cost.json"
        run_peer(python, "peer_cost.py", json.dumps(settings), str(path))
        return json.loads(path.read_text())


def update(path: Path, size: Size, rows: dict[str, list[dict[str, Any]]], versions: dict[str, Any]) -> None:
    """Replace the rows of the numbers of losses in ``rows`` in the record, or start it anew if its conditions differ."""
    sizes = {**dataclasses.asdict(size), "losses": []}
    device = provenance.device_name()
    empty = {"device": device, "versions": versions, "size": sizes, "revisions": {}, "ours": [], "torchjd": []}
    record = json.loads(path.read_text()) if path.exists() else empty
    if any(record[name] != empty[name] for name in ("device", "versions")) or {**record["size"], "losses": []} != sizes:
        record = empty
    fresh = {row["losses"] for side in rows.values() for row in side}
    for side, measured in rows.items():
        remaining = [row for row in record[side] if row["losses"] not in fresh]
        record[side] = sorted(remaining + measured, key=lambda row: row["losses"])
    record["size"]["losses"] = sorted({*record["size"]["losses"], *fresh})
    record["revisions"] = {**record["revisions"], **{str(count): provenance.revision() for count in fresh}}
    write_atomically(path, json.dumps(record, indent=1) + "\n")
