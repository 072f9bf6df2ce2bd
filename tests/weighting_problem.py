"""Problem for tests of weightings: three losses of a network small enough to differentiate by finite differences."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis.weighting import MAIN, Weighting, make_weighting, weighted_grad

NAMES = (MAIN, "near", "far")
OPTIONS: dict[str, dict[str, Any]] = {
    "none": {},
    "none_log": {},
    "sum": {},
    "fixed": {"weights": {"near": 0.1, "far": 10.0}},
    "balance": {},
    "cosine": {},
    "cosine of logarithms": {"log": True},
    "ol_aux": {"interval": 2, "learning_rate": 0.01},
    "ol_aux total": {"interval": 2, "learning_rate": 0.01, "main_grad": "total"},
    "ol_aux window": {"interval": 2, "learning_rate": 0.01, "window": 3},
    "ol_aux as released": {"learning_rate": 0.01, "main_grad": "total", "window": 4},
    "ol_aux_ablation": {"interval": 2, "learning_rate": 0.01},
}


def weighting_of(case: str) -> Weighting:
    return make_weighting(case.split()[0], **OPTIONS[case])


def begin(weighting: Weighting, shared: Any) -> Any:
    """Return the initial state of a weighting of `NAMES` for parameters that are all shared."""
    return weighting.init(NAMES, shared, *((shared,) if weighting.hold is not None else ()))


def problem(seed: int = 0, size: int = 12) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Sample parameters of an encoder and three heads, and a minibatch of ``size`` examples, as float64."""
    random = np.random.default_rng(seed)
    encoder = {"kernel": random.normal(size=(5, 4)), "bias": random.normal(size=4)}
    heads = {"main": random.normal(size=4), "near": random.normal(size=(4, 2)), "far": random.normal(size=(4, 3))}
    targets = {"main": random.normal(size=size), "near": random.normal(size=(size, 2)), "far": random.normal(size=(size, 3))}
    return {"encoder": encoder, "heads": heads}, {"x": random.normal(size=(size, 5)), **targets}


def encode(encoder: Any, batch: Any, module: Any = jnp) -> Any:
    return module.tanh(batch["x"] @ encoder["kernel"] + encoder["bias"])


def losses_of_latents(params: Any, latent: Any, batch: Any, module: Any = jnp) -> dict[str, Any]:
    return {name: module.mean((latent @ head - batch[name]) ** 2) for name, head in params["heads"].items()}


def losses_of(params: Any, batch: Any, module: Any = jnp) -> dict[str, Any]:
    """Compute the mean squared errors of three linear heads on one encoder, in JAX or NumPy (``module``), by name."""
    return losses_of_latents(params, encode(params["encoder"], batch, module), batch, module)


def encoder_of(params: Any) -> Any:
    return params["encoder"]


def in_float32(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: np.asarray(leaf, np.float32), tree)


def encoder_gradients(params: Any, batch: Any) -> dict[str, np.ndarray]:
    """Compute reference gradients [P] float64 of each loss with respect to the encoder, flattened, by central differences."""
    leaves, structure = jax.tree.flatten(params["encoder"])
    found: dict[str, list[float]] = {name: [] for name in NAMES}
    for leaf in leaves:
        for place in np.ndindex(leaf.shape):
            sides = []
            for step in (1e-5, -1e-5):
                old = leaf[place]
                leaf[place] = old + step
                sides.append(losses_of({**params, "encoder": jax.tree.unflatten(structure, leaves)}, batch, np))
                leaf[place] = old
            for name, values in found.items():
                values.append((sides[0][name] - sides[1][name]) / 2e-5)
    return {name: np.array(values) for name, values in found.items()}


def assert_close(one: Any, other: Any, tolerance: float = 2e-5) -> None:
    assert jax.tree.structure(one) == jax.tree.structure(other)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance), one, other)


MODES: tuple[Any, ...] = ("per_loss", "latents")


def modes_of(weighting: Weighting) -> tuple[Any, ...]:
    return MODES[:1] if weighting.needs == "gradients" else MODES


def gradient_by(way: Any, weighting: Weighting, **options: Any) -> Any:
    """Return `weighted_grad` of the problem in a mode of `MODES`, with the encoder for ``latents``."""
    if way != "latents":
        return weighted_grad(losses_of, weighting, encoder_of, way, **options)
    return weighted_grad(losses_of_latents, weighting, encoder_of, way, encode=encode, **options)
