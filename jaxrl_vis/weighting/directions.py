"""Weightings that return a direction in the shared parameters instead of weights, and need whole gradients.

They accumulate or mask gradients, so that their step is not a weighted sum of the current ones. All losses are treated alike.
Memory and time grow with K times the shared parameters; all other parameters are trained on the plain sum of the losses, or
that of their logarithms (``heads`` is always).
"""

from collections.abc import Iterable, Mapping
from typing import Any

import jax
import jax.numpy as jnp

from jaxrl_vis.errors import RequestError
from jaxrl_vis.types import Metrics, Params
from jaxrl_vis.weighting import solvers
from jaxrl_vis.weighting.base import (
    Direction,
    Eps,
    Losses,
    Weighting,
    WeightingState,
    all_names,
    by_name,
    check_eps,
    dot,
    next_state,
    scale_tree,
    start_equal,
    to_float32,
    to_vector,
    weighted_sum,
    zeros_for,
)
from jaxrl_vis.weighting.gradients import gramian

Result = tuple[Direction, WeightingState, Metrics]


def graddrop(leak: float = 0.0, seed: int = 0) -> Weighting:
    """Keep only gradients of one sign in each parameter (GradDrop; Chen et al., 2020, "Just Pick a Sign", algorithm 1).

    Positive gradients are kept with probability P = (1 + sum_i g_i / sum_i |g_i|) / 2, otherwise negative ones. The paper masks
    gradients of a layer's activations, with f = identity; this function masks those of the parameters, as other implementations
    do. The noise vanishes where losses agree.

    Args:
        leak: Fraction of each gradient that is kept regardless of its sign.
        seed: Seed of the initial key; replace ``state.key`` to make several states sample independently.

    Raises:
        RequestError: ``leak`` is not between 0 and 1.
    """
    _check_fraction("graddrop", "leak", leak)

    def init(names: Iterable[str], shared: Params = None) -> WeightingState:
        state = start_equal("graddrop", names, key=jax.random.key(seed))
        return state.replace(weights={name: jnp.ones_like(weight) for name, weight in state.weights.items()})

    def update(losses: Losses, statistics: Any, state: WeightingState) -> Result:
        key = jax.random.fold_in(state.key, state.updates)
        model = next(iter(statistics.values()))
        leaves, structure = jax.tree.flatten(model)
        keys = jax.tree.unflatten(structure, list(jax.random.split(key, len(leaves))))
        uniform = jax.tree.map(lambda key, leaf: jax.random.uniform(key, leaf.shape, leaf.dtype), keys, model)
        step = Direction(graddrop_direction(statistics, uniform, leak), state.weights)
        return step, *next_state(state, state.weights)

    return Weighting("graddrop", init, update, needs="gradients", heads="always", main=False, reads_losses=False)


def graddrop_direction(gradients: Mapping[str, Params], uniform: Params, leak: float = 0.0) -> Params:
    """Compute the direction of `graddrop`: a tree like each gradient.

    Args:
        gradients: Trees of the same structure, by name.
        uniform: Tree of the same structure, samples of the uniform distribution on [0, 1).
        leak: See `graddrop`.
    """

    def masked(uniform: jax.Array, *leaves: jax.Array) -> jax.Array:
        rows = to_float32(jnp.stack(leaves))
        total = jnp.sum(jnp.abs(rows), axis=0)
        purity = 0.5 * (1.0 + jnp.where(total > 0.0, jnp.sum(rows, axis=0) / jnp.where(total > 0.0, total, 1.0), 0.0))
        selected = jnp.where(purity > uniform, rows > 0.0, rows < 0.0)
        return jnp.sum((leak + (1.0 - leak) * selected) * rows, axis=0)

    return jax.tree.map(masked, uniform, *gradients.values())


def db_mtl(beta: float = 0.9, sigma: float = 0.0, eps: Eps = 1e-8, main_eps: float = 1e-8) -> Weighting:
    """Balance losses by logarithms, and their averaged gradients by norm (DB-MTL; Lin et al., 2023, "Dual-Balancing").

    Each gradient of log(L_i + eps) is averaged over steps, m_i <- g_i + (beta / t^sigma) (m_i - g_i), initially 0; the
    direction is the sum of all m_i, each rescaled to the largest of their norms. Suited to losses of any units. The noise of a
    loss close to its minimum is amplified to that norm as well.

    Args:
        beta: Decay rate of the moving averages.
        sigma: Exponent of the decrease of that rate with the step t.
        eps, main_eps: See `Weighting`.

    Raises:
        RequestError: ``beta`` is not between 0 and 1, or ``eps`` or ``main_eps`` is not positive.
    """
    _check_fraction("db_mtl", "beta", beta)

    def init(names: Iterable[str], shared: Params = None) -> WeightingState:
        names = all_names("db_mtl", names)
        return start_equal("db_mtl", names, memory=zeros_for("db_mtl", names, shared))

    def update(losses: Losses, statistics: Any, state: WeightingState) -> Result:
        slopes = weighting.slopes(losses)
        past = beta / (state.updates + 1.0) ** sigma
        averages = {
            name: jax.tree.map(
                lambda new, old: new + past * (old - new), scale_tree(statistics[name], slope), state.memory[name]
            )
            for name, slope in slopes.items()
        }
        lengths = {name: jnp.sqrt(dot(average, average)) for name, average in averages.items()}
        longest = jnp.max(to_vector(lengths))
        weights = {
            name: jnp.where(length > 0.0, longest / jnp.where(length > 0.0, length, 1.0), 0.0)
            for name, length in lengths.items()
        }
        return Direction(weighted_sum(averages, weights), weights), *next_state(state, weights, memory=averages)

    weighting = check_eps(
        Weighting("db_mtl", init, update, needs="gradients", log=True, eps=eps, main_eps=main_eps, heads="always", main=False)
    )
    return weighting


def moco(beta: float = 0.5, gamma: float = 0.1, sigma: float = 0.5, rho: float = 0.0) -> Weighting:
    """Approach the minimum-norm vector in the hull of tracked gradients (MoCo; Fernando et al., 2023, algorithm 1).

    Tracks gradients by y_i <- y_i - beta_t (y_i - g_i), initially 0, then updates weights by
    l <- P(l - gamma_t (Y^T Y + rho I) l), initially 1 / K, where P is the projection onto the simplex; the direction is Y l.
    MGDA for noisy gradients: MGDA computes weights from a single minibatch, with a bias that does not vanish; this avoids it.

    Args:
        beta: Initial step size of y; decreases as t^-sigma.
        gamma: Initial step size of l; decreases as t^-sigma.
        sigma: Exponent of both decreases.
        rho: Strength of the regularisation of l towards equal weights.

    Raises:
        RequestError: ``beta`` is not between 0 and 1.
    """
    _check_fraction("moco", "beta", beta)

    def init(names: Iterable[str], shared: Params = None) -> WeightingState:
        names = all_names("moco", names)
        return start_equal("moco", names, memory=zeros_for("moco", names, shared))

    def update(losses: Losses, statistics: Any, state: WeightingState) -> Result:
        decay = (state.updates + 1.0) ** -sigma
        tracked = {
            name: jax.tree.map(lambda old, new: old - beta * decay * (old - new), state.memory[name], statistics[name])
            for name in state.memory
        }
        before = to_vector(state.weights)
        slope = jnp.dot(gramian(tracked), before, precision=jax.lax.Precision.HIGHEST) + rho * before
        weights = by_name(state.weights, solvers.to_simplex(before - gamma * decay * slope))
        return Direction(weighted_sum(tracked, weights), weights), *next_state(state, weights, memory=tracked)

    return Weighting("moco", init, update, needs="gradients", heads="always", main=False, reads_losses=False)


def _check_fraction(label: str, name: str, value: float) -> None:
    """Raise a RequestError if a number is not between 0 and 1."""
    if not 0.0 <= value <= 1.0:
        raise RequestError(f"{name} of weighting {label} must be between 0 and 1, not {value}")
