"""Wrappers of weightings that bound and rescale the weights, or add cosines between gradients to the metrics."""

import math
from typing import Any

import jax.numpy as jnp

from jaxrl_vis.errors import RequestError
from jaxrl_vis.types import Metrics
from jaxrl_vis.weighting.base import MAIN, Direction, Losses, Weighting, WeightingState, Weights, by_name, loss_order

Result = tuple[Weights | Direction, WeightingState, Metrics]


def limited(
    weighting: Weighting, minimum: float | None = None, maximum: float | None = None, total: float | None = None
) -> Weighting:
    """Bound the weights of a weighting, and scale them to a fixed sum.

    The weight of a main loss stays at 1. Only the returned weights are bounded, not those in the weighting's state.

    Args:
        weighting: Weighting that returns weights, not a direction.
        minimum: Minimum weight; None if unbounded.
        maximum: Maximum weight; None if unbounded.
        total: Sum to which the bounded weights are scaled, excluding that of a main loss that is always 1; None for no
            scaling. Scaled weights may exceed the bounds. Weights that sum to 0 are not scaled.

    Raises:
        RequestError: The bounds are invalid; from ``update``: the weighting returns a direction.
    """
    if minimum is not None and maximum is not None and not minimum <= maximum:
        raise RequestError(f"maximum of weighting {weighting.name} must be at least its minimum, not {maximum}")
    if total is not None and not (math.isfinite(total) and total > 0.0):
        raise RequestError(f"total of weighting {weighting.name} must be greater than 0, not {total}")

    def update(losses: Losses, statistics: Any, state: WeightingState) -> Result:
        step, state, metrics = weighting.update(losses, statistics, state)
        if isinstance(step, Direction):
            raise RequestError(f"weighting {weighting.name} gives a direction, and no weights that could be limited")
        chosen = [name for name in step if not (weighting.main and name == MAIN)]
        bounded = {name: jnp.clip(step[name], minimum, maximum) for name in chosen}
        if total is not None:
            before = sum(bounded.values(), jnp.zeros(()))
            factor = jnp.where(before > 0.0, total / jnp.where(before > 0.0, before, 1.0), 1.0)
            bounded = {name: factor * weight for name, weight in bounded.items()}
        shown = {f"weight/{name}": weight for name, weight in bounded.items()}
        return {**step, **bounded}, state, {**metrics, **{name: shown[name] for name in shown if name in metrics}}

    return weighting._replace(update=update)


def with_cosines(weighting: Weighting) -> Weighting:
    """Add cosines of the losses' gradients in the shared parameters to the metrics of a weighting.

    ``cosine/least`` is the minimum over all pairs; ``cosine/NAME`` that of each loss and the main one, if there is one. The
    resulting weighting needs the Gramian; a wrapped one that needs dots gets its row of the main loss.

    Args:
        weighting: Weighting that does not need whole gradients.

    Raises:
        RequestError: The weighting needs whole gradients.
    """
    if weighting.needs == "gradients":
        raise RequestError(f"weighting {weighting.name} needs whole gradients, and its cosines are not logged")

    def update(losses: Losses, statistics: Any, state: WeightingState) -> Result:
        names = loss_order(losses)
        inner = statistics if weighting.needs == "gramian" else None
        if weighting.needs == "dots":
            row = by_name(names, statistics[names.index(MAIN)])
            inner = {name: value for name, value in row.items() if name != MAIN}
        step, state, metrics = weighting.update(losses, inner, state)
        lengths = jnp.sqrt(jnp.maximum(jnp.diagonal(statistics), 0.0))
        products = lengths[:, None] * lengths[None, :]
        cosines = jnp.where(products > 0.0, statistics / jnp.where(products > 0.0, products, 1.0), 0.0)
        metrics = {**metrics, "cosine/least": jnp.min(cosines)}
        if MAIN in names:
            row = by_name(names, cosines[names.index(MAIN)])
            metrics |= {f"cosine/{name}": value for name, value in row.items() if name != MAIN}
        return step, state, metrics

    return weighting._replace(update=update, needs="gramian")
