"""OL-AUX: weights that learn online which auxiliary losses help the main one (Lin et al., 2019; thesis, section 5.2.2).

Every N updates, with g_i the gradient of log(L_i + eps) with respect to the shared parameters:

    w_i <- max(0, w_i + beta alpha mean over the N updates of <g_main, g_i>)

The sign is that of the text (equations 5.9 to 5.13): weights increase while gradients agree. Algorithm 1 has a minus sign,
which follows from the plus sign in equation 5.8 and would do the opposite. `ol_aux_variants` contains the rule of the authors'
release, and the ablation of figure 5.7.
"""

import math
from collections.abc import Callable, Iterable
from typing import Any

import jax
import jax.numpy as jnp

from jaxrl_vis.errors import RequestError
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
    scale_tree,
    start,
    weight_metrics,
)


def ol_aux(
    interval: int = 5,
    learning_rate: float = 1e-3,
    beta: float | None = None,
    log: bool = True,
    eps: Eps = 0.02,
    main_eps: float = 1e-8,
    minimum: float | None = 0.0,
    maximum: float | None = None,
    heads: Heads = "weighted",
) -> Weighting:
    """Build OL-AUX-N. Weights start at 1; a step uses the weights from before its own gradients.

    Args:
        interval: N, number of updates between changes of the weights.
        learning_rate: alpha, nominal learning rate of the shared parameters' optimiser, regardless of its kind.
        beta: Step size of the weights, in multiples of ``learning_rate``; 5 N if None (thesis: 25 for N = 5, 5 for N = 1).
        log: Whether logarithms of the losses are minimised and compared.
        eps, main_eps: See `Weighting`. The release adds nothing to the main loss.
        minimum: Minimum weight; None if unbounded (thesis). Without a bound, weights can turn negative and losses grow.
        maximum: Maximum weight; None if unbounded (thesis).
        heads: See `Weighting`.

    Raises:
        RequestError: An argument is invalid; from ``update``: the state belongs to another weighting.
    """
    move = make_rule("ol_aux", interval, learning_rate, beta, minimum, maximum)

    def init(names: Iterable[str], shared: Params = None) -> WeightingState:
        others = auxiliary_names("ol_aux", names)
        return start(others, dict.fromkeys(others, 1.0), sums={name: jnp.zeros(()) for name in others})

    def update(losses: Losses, statistics: Any, state: WeightingState) -> tuple[Weights, WeightingState, Metrics]:
        check_state("ol_aux", state)
        slopes = weighting.slopes(losses)
        dots = {name: slopes[MAIN] * slopes[name] * statistics[name] for name in state.sums}
        sums = jax.tree.map(jnp.add, state.sums, dots)
        after = move(state, scale_tree(sums, 1.0 / interval), sums)
        return state.weights, after, weight_metrics(state.weights, dots)

    weighting = check_eps(
        Weighting("ol_aux", init, update, needs="dots", log=log, eps=eps, main_eps=main_eps, heads=heads, interval=interval)
    )
    return weighting


def make_rule(
    label: str,
    interval: int,
    learning_rate: float,
    beta: float | None,
    minimum: float | None,
    maximum: float | None = None,
    multiplicative: bool = False,
) -> Callable[..., WeightingState]:
    """Build the rule that updates weights by the inner products of the auxiliary gradients with the main one.

    Args:
        label: Name of the weighting, for error messages.
        interval, learning_rate, beta, minimum, maximum: See `ol_aux`.
        multiplicative: Whether to compare w_i g_i instead of g_i, as in the authors' quadratic example.

    Returns:
        Function of the state, mean dot products ([] float32 by name), sums of this interval and values of other fields, which
        returns the updated state.

    Raises:
        RequestError: An argument is invalid.
    """
    check_count(label, "interval", interval)
    step_size = (5.0 * interval if beta is None else beta) * learning_rate
    if not math.isfinite(step_size):
        raise RequestError(f"beta and learning_rate of weighting {label} must be finite, not {beta} and {learning_rate}")
    if maximum is not None and not maximum >= max(minimum or 0.0, 0.0):
        raise RequestError(f"maximum of weighting {label} must be at least its minimum, not {maximum}")

    def move(state: WeightingState, mean: dict[str, jax.Array], sums: Any, **fields: Any) -> WeightingState:
        due = (state.updates + 1) % interval == 0
        weights = {MAIN: state.weights[MAIN]}
        for name, value in mean.items():
            old = state.weights[name]
            moved = old + step_size * (old * value if multiplicative else value)
            weights[name] = jnp.where(due, jnp.clip(moved, minimum, maximum), old)
        sums = jax.tree.map(lambda leaf: jnp.where(due, 0.0, leaf), sums)
        after = WeightingState(weights=weights, updates=state.updates + 1, sums=sums, **fields)
        return jax.tree.map(lambda new, old: new.astype(old.dtype), after, state)  # the carry of a scan must keep its dtypes

    return move


def check_count(label: str, name: str, count: float) -> None:
    """Check a number of updates.

    Raises:
        RequestError: The number is not an integer, or less than 1.
    """
    if count % 1 != 0:
        raise RequestError(f"{name} of weighting {label} must be a whole number, not {count}")
    if count < 1:
        raise RequestError(f"{name} of weighting {label} must be at least 1, not {count}")


def check_state(label: str, state: WeightingState) -> None:
    """Check that a state belongs to OL-AUX.

    Raises:
        RequestError: It belongs to another weighting.
    """
    if state.sums is None:
        raise RequestError(f"the state is not one of weighting {label}: begin with its own init")
