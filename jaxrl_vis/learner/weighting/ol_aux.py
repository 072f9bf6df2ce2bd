"""OL-AUX: weights that learn online which auxiliary losses help the main one (Lin et al., 2019; thesis, section 5.2.2).

Every N updates, with g_i the gradient of log(L_i + eps) with respect to the shared parameters:

    w_i <- max(0, w_i + beta alpha mean over the N updates of <g_main, g_i>)

The sign is that of the text (equations 5.9 to 5.13): weights rise while gradients agree. Algorithm 1 prints a minus, which
follows from the plus sign in equation 5.8 and would do the opposite.
"""

import math
from collections.abc import Iterable, Mapping
from typing import Any, get_args

import jax
import jax.numpy as jnp

from jaxrl_vis.errors import RequestError, nearest
from jaxrl_vis.learner.weighting.base import (
    MAIN,
    Losses,
    MainGradient,
    Weighting,
    WeightingState,
    Weights,
    auxiliary_names,
    checked,
    dot,
    report,
    scaled,
    start,
    weighted_sum,
)
from jaxrl_vis.types import Metrics, Params


def ol_aux(
    interval: int = 5,
    learning_rate: float = 1e-3,
    beta: float | None = None,
    log: bool = True,
    eps: float = 0.02,
    main_eps: float = 1e-8,
    main_grad: MainGradient = "main",
    window: int = 1,
    minimum: float | None = 0.0,
    multiplicative: bool = False,
    held: bool = False,
) -> Weighting:
    """OL-AUX-N. Weights begin at 1; a step is taken with those from before its own gradients.

    Args:
        interval: N, updates from one change of the weights to the next.
        learning_rate: alpha, the nominal one of the optimiser of the shared parameters, whichever kind it is.
        beta: Step size of the weights; 5 N if None (thesis: 25 for N = 5, 5 for N = 1).
        log: Whether logarithms of the losses are learned and compared.
        eps, main_eps: See `Weighting`. The release adds nothing to the main loss.
        main_grad: main, the gradient of the main loss (thesis), or total, that of everything that is learned, which adds
            w_i |g_i|^2 to each dot (release).
        window: Gradients are averaged over so many latest updates before they are compared; 4 in the release, 1 in the thesis.
            More than 1 keeps that many gradients of each loss.
        minimum: Least weight; None for none (thesis). Without one, weights turn negative and losses grow.
        multiplicative: Compare w_i g_i in the place of g_i, as the authors' quadratic example does.
        held: The ablation of figure 5.7, see `ol_aux_ablation`.

    Raises:
        RequestError: An argument makes no sense; from ``init``: gradients are needed, and ``shared`` is not given; from
            ``update``: the state is another weighting's.
    """
    label = "ol_aux_ablation" if held else "ol_aux"
    _check(label, interval, window, held, main_grad)
    step_size = _step_size(label, interval, beta, learning_rate)
    keeps_gradients = held or window > 1

    def init(names: Iterable[str], shared: Params = None) -> WeightingState:
        others = auxiliary_names(label, names)
        if keeps_gradients and shared is None:
            raise RequestError(f"weighting {label} keeps gradients: give init the shared parameters, too")
        return _begin(others, shared, window, held)

    def update(losses: Losses, statistics: Any, state: WeightingState) -> tuple[Weights, WeightingState, Metrics]:
        if state.sums is None:
            raise RequestError(f"the state is not one of weighting {label}: begin with its own init")
        if held:
            kept, sums = None, jax.tree.map(jnp.add, state.sums, {"losses": dict(losses), "gradients": dict(statistics)})
            mean = dots = _dots_of_held(weighting, sums, state)
        else:
            dots, kept = _dots_of(weighting, window, losses, statistics, state)
            sums = jax.tree.map(jnp.add, state.sums, dots)
            mean = scaled(sums, 1.0 / interval)
        due = (state.updates + 1) % interval == 0
        weights = {MAIN: state.weights[MAIN]}
        for name, value in mean.items():
            old = state.weights[name]
            moved = old + step_size * (old * value if multiplicative else value)
            weights[name] = jnp.where(due, moved if minimum is None else jnp.maximum(moved, minimum), old)
        sums = jax.tree.map(lambda leaf: jnp.where(due, 0.0, leaf), sums)
        after = WeightingState(weights=weights, updates=state.updates + 1, sums=sums, window=kept)
        after = jax.tree.map(lambda new, old: new.astype(old.dtype), after, state)  # a scan's carry keeps its dtypes
        return state.weights, after, report(state.weights, dots)

    weighting = checked(
        Weighting(
            label,
            init,
            update,
            needs="gradients" if keeps_gradients else "dots",
            log=log,
            eps=eps,
            main_eps=main_eps,
            main_grad=main_grad,
            interval=interval,
            held=held,
        )
    )
    return weighting


def ol_aux_ablation(interval: int = 5, **options: Any) -> Weighting:
    """OL-AUX-N (Ablation) of figure 5.7: the one-step rule, every N updates, on as much data as OL-AUX-N sees in them.

    Gradients and losses of N minibatches, all of them taken at the parameters that the interval began with, are averaged as if
    they were one minibatch of N times the size, and compared once. So the weights follow what helps within one step, from
    gradients that are as smooth as those of OL-AUX-N.

    Args:
        interval: N.
        options: Those of `ol_aux`.
    """
    return ol_aux(interval, held=True, **options)


def _begin(others: tuple[str, ...], shared: Params, window: int, held: bool) -> WeightingState:
    """The state of `ol_aux` before its first update, with these auxiliary losses."""
    state = start(others, dict.fromkeys(others, 1.0))
    sums = {name: jnp.zeros(()) for name in others}
    if held:
        return state.replace(sums={"losses": {MAIN: jnp.zeros(()), **sums}, "gradients": _zeros((MAIN, *others), shared)})
    return state.replace(sums=sums, window=_zeros((MAIN, *others), shared, window) if window > 1 else None)


def _learned(weighting: Weighting, losses: Losses, gradients: Mapping[str, Params]) -> dict[str, Params]:
    """Gradients of the losses as those of what is learned."""
    return {name: scaled(gradients[name], slope) for name, slope in weighting.slopes(losses).items()}


def _direction(weighting: Weighting, gradients: Mapping[str, Params], weights: Weights) -> Params:
    """What the others are compared with, of gradients of what is learned."""
    return gradients[MAIN] if weighting.main_grad == "main" else weighted_sum(gradients, weights)


def _dots_of(
    weighting: Weighting, window: int, losses: Losses, statistics: Any, state: WeightingState
) -> tuple[dict[str, jax.Array], Any]:
    """The dots of one update, of what is learned, and the new window."""
    if window == 1:
        slopes = weighting.slopes(losses)
        # The combined gradient is one of what is learned already.
        of_main = slopes[MAIN] if weighting.main_grad == "main" else 1.0
        return {name: of_main * slopes[name] * statistics[name] for name in state.sums}, None
    latest = _learned(weighting, losses, statistics)
    latest[MAIN] = _direction(weighting, latest, state.weights)
    kept = jax.tree.map(lambda old, new: jnp.concatenate([old[1:], new[None]]), state.window, latest)
    count = jnp.minimum(state.updates + 1, window)  # the window begins with zeros
    mean = jax.tree.map(lambda leaf: jnp.sum(leaf, axis=0) / count, kept)
    return {name: dot(mean[MAIN], mean[name]) for name in state.sums}, kept


def _dots_of_held(weighting: Weighting, sums: Any, state: WeightingState) -> dict[str, jax.Array]:
    """Dots of the gradients of all minibatches since the weights last moved, as of one large minibatch."""
    mean = scaled(sums, 1.0 / (state.updates % weighting.interval + 1))
    gradients = _learned(weighting, mean["losses"], mean["gradients"])
    main = _direction(weighting, gradients, state.weights)
    return {name: dot(main, gradient) for name, gradient in gradients.items() if name != MAIN}


def _zeros(names: Iterable[str], shared: Params, *leading: int) -> dict[str, Params]:
    """A tree of zeros for each name, at least float32."""

    def zeros(leaf: Any) -> jax.Array:
        return jnp.zeros((*leading, *leaf.shape), jnp.promote_types(leaf.dtype, jnp.float32))

    return {name: jax.tree.map(zeros, shared) for name in names}


def _step_size(label: str, interval: int, beta: float | None, learning_rate: float) -> float:
    step_size = (5.0 * interval if beta is None else beta) * learning_rate
    if not math.isfinite(step_size):
        raise RequestError(f"beta and learning_rate of weighting {label} must be finite, not {beta} and {learning_rate}")
    return step_size


def _check(label: str, interval: int, window: int, held: bool, main_grad: str) -> None:
    for name, count in (("interval", interval), ("window", window)):
        if count % 1 != 0:
            raise RequestError(f"{name} of weighting {label} must be a whole number, not {count}")
        if count < 1:
            raise RequestError(f"{name} of weighting {label} must be at least 1, not {count}")
    if held and window > 1:
        raise RequestError(f"weighting {label} averages gradients over its interval already; leave window at 1")
    if main_grad not in get_args(MainGradient):
        raise RequestError(
            f"main_grad of weighting {label} cannot be {main_grad!r}{nearest(main_grad, get_args(MainGradient))}"
        )
