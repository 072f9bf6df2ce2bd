"""Weightings that need the Gramian and learn, by Adam: GradNorm's weights, and AuxiNash's preferences."""

from collections.abc import Iterable
from typing import Any, Unpack

import jax
import jax.numpy as jnp
import optax

from jaxrl_vis.types import Metrics, Params
from jaxrl_vis.weighting import solvers
from jaxrl_vis.weighting.base import (
    MAIN,
    Heads,
    Losses,
    Weighting,
    WeightingState,
    Weights,
    auxiliary_names,
    by_name,
    loss_order,
    moved,
    start_alike,
    to_vector,
)
from jaxrl_vis.weighting.gramian_based import Options, of_gramian

_LEAST_SHARE = 1e-4  # of the mean weight, below which GradNorm lets none fall: its rule may overshoot 0


def gradnorm(alpha: float = 1.5, learning_rate: float = 0.025, heads: Heads = "weighted") -> Weighting:
    """Learn weights that bring weighted gradients to one length, longer for losses that lag (GradNorm; Chen et al., 2018).

    With r_i = L_i / L_i(0) over its mean, weights w follow the gradient of sum_i | w_i |g_i| - mean_j(w_j |g_j|) r_i^alpha |,
    the mean and r held constant (eq. 2), and are then scaled to the sum K. A step uses the weights from before. Needs the
    lengths of the gradients, in the paper those in the last shared layer: choose ``shared`` so to save time. All losses are
    alike.

    Args:
        alpha: Strength of the pull on losses that lag; 0 for equal lengths.
        learning_rate: Of Adam for w.
        heads: See `Weighting`.
    """
    rule = optax.adam(learning_rate)

    def init(names: Iterable[str], shared: Params = None) -> WeightingState:
        state = start_alike("gradnorm", names)
        weights = {name: jnp.ones_like(weight) for name, weight in state.weights.items()}
        vector = to_vector(weights)
        return state.replace(weights=weights, memory={"first": jnp.zeros_like(vector), "rule": rule.init(vector)})

    def update(losses: Losses, statistics: Any, state: WeightingState) -> tuple[Weights, WeightingState, Metrics]:
        values, weights = to_vector(losses), to_vector(state.weights)
        first = jnp.where(state.updates == 0, values, state.memory["first"])
        rates = jnp.where(first > 0.0, jnp.maximum(values, 0.0) / jnp.where(first > 0.0, first, 1.0), 1.0)
        mean_rate = jnp.mean(rates)
        relative = jnp.where(mean_rate > 0.0, rates / jnp.where(mean_rate > 0.0, mean_rate, 1.0), 1.0)
        lengths = jnp.sqrt(jnp.maximum(jnp.diagonal(statistics), 0.0))
        slope = jnp.sign(weights * lengths - jnp.mean(weights * lengths) * relative**alpha) * lengths
        changes, rule_state = rule.update(slope.astype(weights.dtype), state.memory["rule"])
        stepped: Any = optax.apply_updates(weights, changes)
        after = jnp.maximum(stepped, _LEAST_SHARE)
        after = after * (len(losses) / jnp.sum(after))
        later, _ = moved(state, by_name(losses, after), memory={"first": first, "rule": rule_state})
        return state.weights, later, {f"weight/{name}": weight for name, weight in state.weights.items()}

    return Weighting("gradnorm", init, update, needs="gramian", heads=heads, main=False)


def auxinash(learning_rate: float = 0.01, **options: Unpack[Options]) -> Weighting:
    """Learn how much say each loss has in the bargain, for the main one's sake (AuxiNash; Shamsian et al., 2023).

    Weights solve G a = p / a : `nash_mtl` with preferences p, which sum to K. The derivative of a by p is
    (G + diag(p / a^2))^-1 diag(1 / a). p = K softmax(l), and l follows by Adam the derivative of the main loss
    after a step along G a. The paper differentiates a separate loss on held-out data at the optimum of the parameters; this is
    its first step, on the main loss of the same minibatch, and needs no second pass. A loss must be called `MAIN`.

    Args:
        learning_rate: Of Adam for l.
        options: See `Options`.
    """
    rule = optax.adam(learning_rate)

    def remember(count: int, dtype: Any) -> Any:
        logits = jnp.zeros(count, dtype)
        return {"logits": logits, "rule": rule.init(logits)}

    def solve(gramian: jax.Array, state: WeightingState) -> tuple[jax.Array, Any]:
        logits, main = state.memory["logits"], loss_order(state.weights).index(MAIN)
        count = len(gramian)
        shares, pullback = jax.vjp(lambda logits: count * jax.nn.softmax(logits), logits)
        weights = solvers.bargain(gramian, shares)
        (gradient,) = pullback(preference_slope(gramian, shares, weights, main).astype(logits.dtype))
        changes, rule_state = rule.update(gradient, state.memory["rule"])
        return weights, {"logits": optax.apply_updates(logits, changes), "rule": rule_state}

    weighting = of_gramian("auxinash", solve, memory=remember, **options)

    def init(names: Iterable[str], shared: Params = None) -> WeightingState:
        names = tuple(names)
        auxiliary_names("auxinash", names)
        return weighting.init(names, shared)

    return weighting._replace(init=init)


def preference_slope(gramian: jax.Array, shares: jax.Array, weights: jax.Array, main: int) -> jax.Array:
    """Compute the main loss's derivative by the preferences of a bargain, per unit of step size and of 1 / a_main: [K].

    Args:
        gramian: [K, K] float.
        shares: [K] float, p.
        weights: [K] float, a, with G a = p / a.
        main: Place of the main loss.
    """
    scaled = weights[:, None] * gramian * weights[None, :]
    return -jnp.linalg.solve(scaled + jnp.diag(shares), scaled[main])
