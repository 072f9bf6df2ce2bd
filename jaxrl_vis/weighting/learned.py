"""Weightings that need the Gramian and learn parameters by Adam: the weights of GradNorm, the preferences of AuxiNash."""

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
    next_state,
    start_equal,
    to_vector,
)
from jaxrl_vis.weighting.gramian_based import Options, of_gramian

_MIN_FRACTION = 1e-4  # minimum weight of GradNorm before rescaling to mean 1: its rule may overshoot 0


def gradnorm(alpha: float = 1.5, learning_rate: float = 0.025, heads: Heads = "weighted") -> Weighting:
    """Learn weights that equalise the norms of weighted gradients, but favour losses that lag (GradNorm; Chen et al., 2018).

    With r_i = L_i / L_i(0) divided by its mean, Adam minimises sum_i | w_i |g_i| - mean_j(w_j |g_j|) r_i^alpha | with respect
    to w, the mean and r held constant (eq. 2); w is then scaled to the sum K. A step uses the weights from before its own
    gradients. Needs the norms of the gradients; the paper uses those in the last shared layer, and selecting it by ``shared``
    saves time. All losses are treated alike.

    Args:
        alpha: Strength with which lagging losses are favoured; 0 for equal norms.
        learning_rate: Learning rate of Adam for w.
        heads: See `Weighting`.
    """
    rule = optax.adam(learning_rate)

    def init(names: Iterable[str], shared: Params = None) -> WeightingState:
        state = start_equal("gradnorm", names)
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
        after = jnp.maximum(stepped, _MIN_FRACTION)
        after = after * (len(losses) / jnp.sum(after))
        later, _ = next_state(state, by_name(losses, after), memory={"first": first, "rule": rule_state})
        return state.weights, later, {f"weight/{name}": weight for name, weight in state.weights.items()}

    return Weighting("gradnorm", init, update, needs="gramian", heads=heads, main=False)


def auxinash(learning_rate: float = 0.01, **options: Unpack[Options]) -> Weighting:
    """Learn the losses' bargaining preferences so as to decrease the main loss (AuxiNash; Shamsian et al., 2023).

    Weights solve G a = p / a: `nash_mtl` with preferences p, which sum to K. The derivative of a with respect to p is
    (G + diag(p / a^2))^-1 diag(1 / a). p = K softmax(l), and Adam optimises l by the derivative of the main loss after a step
    with the weights a. The paper differentiates a separate loss on held-out data at the optimum of the parameters; this is
    its first step, on the main loss of the same minibatch, and needs no second pass. A loss must be called `MAIN`.

    Args:
        learning_rate: Learning rate of Adam for l.
        options: See `Options`.
    """
    rule = optax.adam(learning_rate)

    def remember(count: int, dtype: Any) -> Any:
        logits = jnp.zeros(count, dtype)
        return {"logits": logits, "rule": rule.init(logits)}

    def solve(gramian: jax.Array, state: WeightingState) -> tuple[jax.Array, Any]:
        logits, main = state.memory["logits"], loss_order(state.weights).index(MAIN)
        count = len(gramian)
        preferences, pullback = jax.vjp(lambda logits: count * jax.nn.softmax(logits), logits)
        weights = solvers.bargain(gramian, preferences)
        (gradient,) = pullback(preference_slope(gramian, preferences, weights, main).astype(logits.dtype))
        changes, rule_state = rule.update(gradient, state.memory["rule"])
        return weights, {"logits": optax.apply_updates(logits, changes), "rule": rule_state}

    weighting = of_gramian("auxinash", solve, memory=remember, **options)

    def init(names: Iterable[str], shared: Params = None) -> WeightingState:
        names = tuple(names)
        auxiliary_names("auxinash", names)
        return weighting.init(names, shared)

    return weighting._replace(init=init)


def preference_slope(gramian: jax.Array, preferences: jax.Array, weights: jax.Array, main: int) -> jax.Array:
    """Compute the derivative of the main loss with respect to the preferences, per unit of step size and of 1 / a_main: [K].

    Args:
        gramian: [K, K] float.
        preferences: [K] float, p.
        weights: [K] float, a, with G a = p / a.
        main: Index of the main loss.
    """
    scaled = weights[:, None] * gramian * weights[None, :]
    return -jnp.linalg.solve(scaled + jnp.diag(preferences), scaled[main])
