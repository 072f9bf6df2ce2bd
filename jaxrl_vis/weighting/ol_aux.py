"""OL-AUX: weights that learn online which auxiliary losses help the main one (Lin et al., 2019; thesis, section 5.2.2).

Every N updates, with g_i the gradient of log(L_i + eps) with respect to the shared parameters:

    w_i <- max(0, w_i + beta alpha mean over the N updates of <g_main, g_i>)

The sign is that of the text (equations 5.9 to 5.13): weights rise while gradients agree. Algorithm 1 prints a minus, which
follows from the plus sign in equation 5.8 and would do the opposite. `ol_aux_variants` has the authors' release's rule, and the
ablation of figure 5.7.
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
    checked,
    report,
    scaled,
    start,
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
        interval: N, updates from one change of the weights to the next.
        learning_rate: alpha, the nominal one of the optimiser of the shared parameters, whichever kind it is.
        beta: Step size of the weights; 5 N if None (thesis: 25 for N = 5, 5 for N = 1).
        log: True if logarithms of the losses are learned and compared.
        eps, main_eps: See `Weighting`. The release adds nothing to the main loss.
        minimum: Least weight; None for none (thesis). Without one, weights turn negative and losses grow.
        maximum: Greatest weight; None for none (thesis).
        heads: See `Weighting`.

    Raises:
        RequestError: An argument makes no sense; from ``update``: the state is another weighting's.
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
        after = move(state, scaled(sums, 1.0 / interval), sums)
        return state.weights, after, report(state.weights, dots)

    weighting = checked(
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
    """Build the rule that updates weights by the inner products of their losses' gradients with the main one's.

    Args:
        label: Name of the weighting, for messages.
        interval, learning_rate, beta, minimum, maximum: As of `ol_aux`.
        multiplicative: Compare w_i g_i instead of g_i, as in the authors' quadratic example.

    Returns:
        (state; [] float32 by name, the mean of the dots; sums of this interval; further fields) -> the state after this update.

    Raises:
        RequestError: An argument makes no sense.
    """
    check_count(label, "interval", interval)
    step_size = (5.0 * interval if beta is None else beta) * learning_rate
    if not math.isfinite(step_size):
        raise RequestError(f"beta and learning_rate of weighting {label} must be finite, not {beta} and {learning_rate}")
    if maximum is not None and not maximum >= max(minimum or 0.0, 0.0):
        raise RequestError(f"maximum of weighting {label} must be at least its minimum, not {maximum}")

    def move(state: WeightingState, mean: dict[str, jax.Array], sums: Any, **more: Any) -> WeightingState:
        due = (state.updates + 1) % interval == 0
        weights = {MAIN: state.weights[MAIN]}
        for name, value in mean.items():
            old = state.weights[name]
            moved = old + step_size * (old * value if multiplicative else value)
            weights[name] = jnp.where(due, jnp.clip(moved, minimum, maximum), old)
        sums = jax.tree.map(lambda leaf: jnp.where(due, 0.0, leaf), sums)
        after = WeightingState(weights=weights, updates=state.updates + 1, sums=sums, **more)
        return jax.tree.map(lambda new, old: new.astype(old.dtype), after, state)  # a scan's carry keeps its dtypes

    return move


def check_count(label: str, name: str, count: float) -> None:
    """Check a number of updates.

    Raises:
        RequestError: It is not a whole number, or less than 1.
    """
    if count % 1 != 0:
        raise RequestError(f"{name} of weighting {label} must be a whole number, not {count}")
    if count < 1:
        raise RequestError(f"{name} of weighting {label} must be at least 1, not {count}")


def check_state(label: str, state: WeightingState) -> None:
    """Check that a state is one of OL-AUX.

    Raises:
        RequestError: It is another weighting's.
    """
    if state.sums is None:
        raise RequestError(f"the state is not one of weighting {label}: begin with its own init")
