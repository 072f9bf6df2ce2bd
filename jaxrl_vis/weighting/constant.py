"""Memoryless weightings: weights are constant, or follow from the gradients of the current step."""

import math
from collections.abc import Iterable, Mapping
from typing import Any

import jax.numpy as jnp

from jaxrl_vis.errors import RequestError, nearest
from jaxrl_vis.types import Metrics, Params
from jaxrl_vis.weighting.base import (
    MAIN,
    Eps,
    Heads,
    Losses,
    Weighting,
    WeightingState,
    Weights,
    auxiliary_names,
    check_eps,
    start,
    start_equal,
    weight_metrics,
)


def none() -> Weighting:
    """Use the main loss alone (thesis 5.2.3.3, "No Auxiliary Losses")."""
    return _constant("none", 0.0, auxiliary=False)


def none_log(main_eps: float = 1e-8) -> Weighting:
    """Use the logarithm of the main loss alone, to separate its effect from that of auxiliary losses.

    Args:
        main_eps: See `Weighting`.

    Raises:
        RequestError: ``main_eps`` is not positive.
    """
    return _constant("none_log", 0.0, auxiliary=False, log=True, main_eps=main_eps)


def plain_sum() -> Weighting:
    """Sum all losses, with weight 1; no main loss is required."""
    return _constant("sum", 1.0, main=False)


def balance(eps: Eps = 0.02, main_eps: float = 1e-8) -> Weighting:
    """Sum the logarithms of all losses (thesis 5.2.3.3, "Gradient Balancing").

    Args:
        eps, main_eps: See `Weighting`.

    Raises:
        RequestError: ``eps`` or ``main_eps`` is not positive.
    """
    return _constant("balance", 1.0, log=True, eps=eps, main_eps=main_eps)


def fixed(weights: float | Mapping[str, float] = 1.0, log: bool = True, eps: Eps = 0.02, main_eps: float = 1e-8) -> Weighting:
    """Use constant weights, chosen by hand.

    Args:
        weights: One weight for all auxiliary losses, or a weight for each by name.
        log: Whether to minimise the logarithms of the losses.
        eps, main_eps: See `Weighting`.

    Raises:
        RequestError: A weight is not finite, or ``eps`` or ``main_eps`` is not positive; from ``init``: a loss has no weight,
            or a weight has no loss.
    """
    for weight in weights.values() if isinstance(weights, Mapping) else [weights]:
        if not math.isfinite(weight):
            raise RequestError(f"a fixed weight must be a finite number, not {weight}")
    return _constant("fixed", weights, log=log, eps=eps, main_eps=main_eps)


def cosine(log: bool = False, eps: Eps = 0.02, main_eps: float = 1e-8, heads: Heads = "always") -> Weighting:
    """Use an auxiliary loss in the shared parameters, with weight 1, only if its gradient does not oppose the main one's.

    The weight is 1 if the cosine of the two gradients is at least 0, else 0 (Du et al., 2018; thesis 5.2.3.3, "Cosine
    Similarity"). Only the sign matters, so no norm is needed, and logarithms do not change the weights.

    Args:
        log: Whether to minimise the logarithms of the losses.
        eps, main_eps: See `Weighting`.
        heads: See `Weighting`; always in the thesis, so that the head of a loss with weight 0 continues to be trained.

    Raises:
        RequestError: ``eps`` or ``main_eps`` is not positive.
    """

    def init(names: Iterable[str], shared: Params = None) -> WeightingState:
        others = auxiliary_names("cosine", names)
        return start(others, dict.fromkeys(others, 1.0))

    def update(losses: Losses, statistics: Any, state: WeightingState) -> tuple[Weights, WeightingState, Metrics]:
        slopes = weighting.slopes(losses)
        dots = {name: slopes[MAIN] * slopes[name] * statistics[name] for name in state.weights if name != MAIN}
        main_weight = state.weights[MAIN]
        # Use the sign of the dot product itself: slopes are positive, but a small product might underflow.
        weights = {MAIN: main_weight} | {
            name: jnp.where(statistics[name] >= 0.0, main_weight, 0.0 * main_weight) for name in dots
        }
        return weights, state.replace(weights=weights, updates=state.updates + 1), weight_metrics(weights, dots)

    weighting = check_eps(Weighting("cosine", init, update, needs="dots", log=log, eps=eps, main_eps=main_eps, heads=heads))
    return weighting


def _constant(name: str, weights: float | Mapping[str, float], auxiliary: bool = True, **options: Any) -> Weighting:
    def init(names: Iterable[str], shared: Params = None) -> WeightingState:
        if not options.get("main", True):
            ones = start_equal(name, names)
            return ones.replace(weights={loss: jnp.ones_like(weight) for loss, weight in ones.weights.items()})
        others = auxiliary_names(name, names, needed=auxiliary)
        if not isinstance(weights, Mapping):
            return start(others, dict.fromkeys(others, weights))
        for wrong in sorted(set(weights) - set(others)):
            raise RequestError(f"there is no auxiliary loss {wrong!r} to weight{nearest(wrong, others)}")
        for missing in sorted(set(others) - set(weights)):
            raise RequestError(f"there is no weight for loss {missing!r}; give one, or one number for all losses")
        return start(others, weights)

    def update(losses: Losses, statistics: Any, state: WeightingState) -> tuple[Weights, WeightingState, Metrics]:
        return state.weights, state.replace(updates=state.updates + 1), weight_metrics(state.weights) if auxiliary else {}

    reads_losses = options.get("log", False)
    return check_eps(Weighting(name, init, update, auxiliary=auxiliary, reads_losses=reads_losses, **options))
