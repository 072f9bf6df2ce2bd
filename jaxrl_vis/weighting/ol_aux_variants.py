"""Variants of OL-AUX that need whole gradients: the rule of the authors' release, and the ablation of figure 5.7.

They keep gradients or parameters in their state, and take one backward pass through the shared parameters per loss.
"""

from collections.abc import Iterable, Mapping
from typing import Any, Literal, get_args

import jax
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
    dot,
    scale_tree,
    start,
    weight_metrics,
    weighted_sum,
    zeros_for,
)
from jaxrl_vis.weighting.ol_aux import check_count, check_state, make_rule

MainGradient = Literal["main", "total"]


def ol_aux_window(
    interval: int = 5,
    learning_rate: float = 1e-3,
    beta: float | None = None,
    log: bool = True,
    eps: Eps = 0.02,
    main_eps: float = 1e-8,
    main_grad: MainGradient = "main",
    window: int = 1,
    minimum: float | None = 0.0,
    multiplicative: bool = False,
    maximum: float | None = None,
    heads: Heads = "weighted",
) -> Weighting:
    """Build OL-AUX-N as in the authors' release: gradients are averaged over the latest updates before they are compared.

    Args:
        interval, learning_rate, beta, log, eps, main_eps, minimum, maximum, heads: See `ol_aux.ol_aux`.
        main_grad: main for the gradient of the main loss (thesis), or total for that of the whole weighted objective, which
            adds the sum over auxiliary losses j of w_j <g_j, g_i>, and thus w_i |g_i|^2, to each dot product (release).
        window: Number of latest updates over which gradients are averaged; 4 in the release, 1 in the thesis.
        multiplicative: Whether to compare w_i g_i instead of g_i, as in the authors' quadratic example.

    Raises:
        RequestError: An argument is invalid; from ``init``: ``shared`` is not given; from ``update``: the state belongs to
            another weighting.
    """
    label = "ol_aux"
    check_count(label, "window", window)
    _check_main_grad(label, main_grad)
    move = make_rule(label, interval, learning_rate, beta, minimum, maximum, multiplicative)

    def init(names: Iterable[str], shared: Params = None) -> WeightingState:
        others = auxiliary_names(label, names)
        sums = {name: jnp.zeros(()) for name in others}
        return start(others, dict.fromkeys(others, 1.0), sums=sums, window=zeros_for(label, (MAIN, *others), shared, window))

    def update(losses: Losses, statistics: Any, state: WeightingState) -> tuple[Weights, WeightingState, Metrics]:
        check_state(label, state)
        latest = _log_gradients(weighting, losses, statistics)
        latest[MAIN] = _direction(main_grad, latest, state.weights)
        gradients = jax.tree.map(lambda old, new: jnp.concatenate([old[1:], new[None]]), state.window, latest)
        count = jnp.minimum(state.updates + 1, window)  # the window begins with zeros
        mean = jax.tree.map(lambda leaf: jnp.sum(leaf, axis=0) / count, gradients)
        dots = {name: dot(mean[MAIN], mean[name]) for name in state.sums}
        sums = jax.tree.map(jnp.add, state.sums, dots)
        after = move(state, scale_tree(sums, 1.0 / interval), sums, window=gradients)
        return state.weights, after, weight_metrics(state.weights, dots)

    weighting = check_eps(
        Weighting(label, init, update, needs="gradients", log=log, eps=eps, main_eps=main_eps, heads=heads, interval=interval)
    )
    return weighting


def ol_aux_ablation(
    interval: int = 5,
    learning_rate: float = 1e-3,
    beta: float | None = None,
    log: bool = True,
    eps: Eps = 0.02,
    main_eps: float = 1e-8,
    main_grad: MainGradient = "main",
    minimum: float | None = 0.0,
) -> Weighting:
    """Build OL-AUX-N (Ablation) of figure 5.7: the one-step rule every N updates, on as much data as OL-AUX-N uses.

    Gradients and losses of N minibatches, all evaluated at the parameters from the start of the interval, are averaged as if
    they were one minibatch of N times the size, and compared once. The weights thus follow the benefit within one step, with
    gradients as smooth as those of OL-AUX-N.

    Args:
        interval: N.
        learning_rate, beta, log, eps, main_eps, minimum: See `ol_aux.ol_aux`.
        main_grad: See `ol_aux_window`.

    Raises:
        RequestError: An argument is invalid; from ``init``: ``shared`` or ``params`` is not given; from ``update``: the state
            belongs to another weighting.
    """
    label = "ol_aux_ablation"
    _check_main_grad(label, main_grad)
    move = make_rule(label, interval, learning_rate, beta, minimum)

    def init(names: Iterable[str], shared: Params = None, params: Params = None) -> WeightingState:
        others = auxiliary_names(label, names)
        if params is None:
            raise RequestError(f"weighting {label} keeps parameters: give init all of them, too")
        sums = {name: jnp.zeros(()) for name in (MAIN, *others)}
        sums = {"losses": sums, "gradients": zeros_for(label, (MAIN, *others), shared)}
        zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), params)
        return start(others, dict.fromkeys(others, 1.0), sums=sums, params=zeros)

    def hold(params: Params, state: WeightingState) -> WeightingState:
        is_new = state.updates % interval == 0
        return state.replace(
            params=jax.tree.map(lambda new, old: jnp.where(is_new, new.astype(old.dtype), old), params, state.params)
        )

    def update(losses: Losses, statistics: Any, state: WeightingState) -> tuple[Weights, WeightingState, Metrics]:
        check_state(label, state)
        sums = jax.tree.map(jnp.add, state.sums, {"losses": dict(losses), "gradients": dict(statistics)})
        # Means, as those of one large minibatch.
        mean = scale_tree(sums, 1.0 / (state.updates % interval + 1))
        gradients = _log_gradients(weighting, mean["losses"], mean["gradients"])
        direction = _direction(main_grad, gradients, state.weights)
        dots = {name: dot(direction, gradient) for name, gradient in gradients.items() if name != MAIN}
        return state.weights, move(state, dots, sums, params=state.params), weight_metrics(state.weights, dots)

    weighting = check_eps(
        Weighting(label, init, update, needs="gradients", log=log, eps=eps, main_eps=main_eps, interval=interval, hold=hold)
    )
    return weighting


def _check_main_grad(label: str, main_grad: str) -> None:
    if main_grad not in get_args(MainGradient):
        raise RequestError(
            f"main_grad of weighting {label} cannot be {main_grad!r}{nearest(main_grad, get_args(MainGradient))}"
        )


def _log_gradients(weighting: Weighting, losses: Losses, gradients: Mapping[str, Params]) -> dict[str, Params]:
    """Convert gradients of the losses to those of their logarithms, if the weighting minimises these."""
    return {name: scale_tree(gradients[name], slope) for name, slope in weighting.slopes(losses).items()}


def _direction(main_grad: MainGradient, gradients: Mapping[str, Params], weights: Weights) -> Params:
    """Return the gradient with which those of auxiliary losses are compared: the main loss's, or the weighted sum of all."""
    return gradients[MAIN] if main_grad == "main" else weighted_sum(gradients, weights)
