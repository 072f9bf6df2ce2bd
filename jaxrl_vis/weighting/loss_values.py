"""Weightings that read only the losses' values, and cost no more than the plain sum. All losses are treated alike.

`uniform` and `random` do not read even these. Weights of `geometric_mean` and `stch` follow from the values of one step;
`famo`, `uncertainty`, `imtl_l` and `dwa` are adaptive. The last three apply the weights from before the current losses.
"""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import optax

from jaxrl_vis.errors import RequestError
from jaxrl_vis.types import Metrics, Params
from jaxrl_vis.weighting.base import (
    Direction,
    Losses,
    Weighting,
    WeightingState,
    Weights,
    by_name,
    next_state,
    start_equal,
    to_vector,
)

_MAX_VALUE = 1e6  # bound of ratios and slopes, so that sums of squares do not overflow
Result = tuple[Weights | Direction, WeightingState, Metrics]


def uniform() -> Weighting:
    """Average all losses: weights 1 / K.

    Needs no statistics and costs nothing. The baseline, besides `sum`: with tuned learning rates, few methods outperform it
    (Kurin et al., 2022; Xin et al., 2022).
    """

    def update(losses: Losses, statistics: Any, state: WeightingState) -> Result:
        return state.weights, *next_state(state, state.weights)

    return Weighting("uniform", _make_init("uniform"), update, main=False, reads_losses=False)


def random(seed: int = 0) -> Weighting:
    """Sample new weights at every step (RLW; Lin et al., 2022, "Reasonable Effectiveness of Random Weighting", algorithm 2).

    Weights are the softmax of K standard normal samples, and thus sum to 1. Needs no statistics. A litmus test: a method that
    does no better than this one has learned nothing about the losses.

    Args:
        seed: Seed of the initial key; replace ``state.key`` to make several states sample independently.
    """

    def init(names: Iterable[str], shared: Params = None) -> WeightingState:
        return start_equal("random", names, key=jax.random.key(seed))

    def update(losses: Losses, statistics: Any, state: WeightingState) -> Result:
        drawn = jax.random.normal(jax.random.fold_in(state.key, state.updates), (len(losses),))
        weights = by_name(losses, random_weights(drawn))
        return weights, *next_state(state, weights)

    return Weighting("random", init, update, main=False, reads_losses=False)


def random_weights(normal: jax.Array) -> jax.Array:
    """Compute the weights of `random`, [K], from K standard normal samples."""
    return jax.nn.softmax(normal)


def uncertainty(learning_rate: float = 1e-2) -> Weighting:
    """Weight losses by learned variances (UW; Kendall et al., 2018, section 3.2, with s = log sigma^2).

    The objective is the sum of exp(-s_i) L_i / 2 + s_i / 2; weights are exp(-s_i) / 2, and s_i, initially 0, is optimised by
    Adam. At the optimum exp(s_i) = L_i, so that scaled losses are equal. Suited to losses of different scales, if computing a
    gradient for each loss is too expensive.

    Args:
        learning_rate: Learning rate of Adam for s. The paper uses the model's own optimiser for s.

    Raises:
        RequestError: ``learning_rate`` is not positive.
    """
    return _make_learned(
        "uncertainty", learning_rate, lambda s, losses: (1.0 - jnp.exp(-s) * losses) / 2, lambda s: jnp.exp(-s) / 2
    )


def imtl_l(learning_rate: float = 1e-2) -> Weighting:
    """Weight losses by learned scales (IMTL-L; Liu et al., 2021, "Towards Impartial Multi-task Learning").

    The objective is the sum of exp(s_i) L_i - s_i; weights are exp(s_i), and s_i, initially 0, is optimised by Adam. At the
    optimum all scaled losses are 1, and weights are twice those of `uncertainty`.

    Args:
        learning_rate: Learning rate of Adam for s. The paper uses the model's own optimiser for s.

    Raises:
        RequestError: ``learning_rate`` is not positive.
    """
    return _make_learned("imtl_l", learning_rate, lambda s, losses: jnp.exp(s) * losses - 1.0, jnp.exp)


def geometric_mean(eps: float = 1e-8) -> Weighting:
    """Minimise the geometric mean of the losses (GLS; Chennupati et al., 2019, "MultiNet++").

    Weights are the derivatives of (prod_i L_i)^(1/K), which are this mean divided by K L_i. Scaling a loss scales all gradients
    alike, so that units do not matter. For positive losses; negative ones are clipped to 0. A loss near 0 dominates: `balance`,
    the sum of the logarithms, has the same minima, but less of this effect.

    Args:
        eps: Constant added to the losses.
    """

    def update(losses: Losses, statistics: Any, state: WeightingState) -> Result:
        values = jnp.maximum(to_vector(losses), 0.0) + eps
        mean = jnp.exp(jnp.mean(jnp.log(values)))
        weights = by_name(losses, mean / (len(losses) * values))
        return weights, *next_state(state, weights)

    return Weighting("geometric_mean", _make_init("geometric_mean"), update, main=False)


def stch(mu: float = 0.1, reference: Mapping[str, float] | None = None) -> Weighting:
    """Minimise a smooth maximum of the losses (STCH; Lin et al., 2024, "Smooth Tchebycheff Scalarization").

    The objective is mu log sum_i exp((L_i - z_i) / (K mu)); weights are its derivatives, which sum to 1 / K. Suited to losses
    of the same unit whose maximum matters, such as errors of groups. The smaller mu, the closer to the maximum.

    Args:
        mu: Width of the smoothing, in units of L / K.
        reference: z by name, lower bounds of the losses (the ideal point); 0 for missing names, or for all if None.

    Raises:
        RequestError: ``mu`` is not positive.
    """
    _check_positive("stch", "mu", mu)

    def update(losses: Losses, statistics: Any, state: WeightingState) -> Result:
        count = len(losses)
        values = to_vector({name: loss - (reference or {}).get(name, 0.0) for name, loss in losses.items()})
        # Subtract the maximum before dividing: with a fused multiply-add, 1e15 / mu minus itself may be -3e7.
        weights = by_name(losses, jax.nn.softmax((values - jnp.max(values)) / (count * mu)) / count)
        return weights, *next_state(state, weights)

    return Weighting("stch", _make_init("stch"), update, main=False)


def dwa(temperature: float = 2.0, epoch: int = 100) -> Weighting:
    """Weight losses by how slowly they decrease (dynamic weight average; Liu et al., 2019, "End-to-End Multi-Task Learning
    with Attention", eq. 7).

    Weights are K times the softmax of r_i / T, where r_i is the mean loss of the last epoch divided by that of the epoch before
    it; 1 in the first two epochs. Epochs should contain many minibatches, as ratios of single ones are dominated by noise.

    Args:
        temperature: T; the larger, the more equal the weights.
        epoch: Number of updates in an epoch.

    Raises:
        RequestError: ``temperature`` or ``epoch`` is not positive.
    """
    _check_positive("dwa", "temperature", temperature)
    _check_positive("dwa", "epoch", epoch)

    def init(names: Iterable[str], shared: Params = None) -> WeightingState:
        state = start_equal("dwa", names)
        weights = {name: jnp.ones_like(weight) for name, weight in state.weights.items()}
        zeros = jnp.zeros(len(weights), weights[next(iter(weights))].dtype)
        return state.replace(weights=weights, memory={"sum": zeros, "last": jnp.zeros_like(zeros)})

    def update(losses: Losses, statistics: Any, state: WeightingState) -> Result:
        total, last = state.memory["sum"] + to_vector(losses), state.memory["last"]
        is_last = (state.updates + 1) % epoch == 0
        mean = total / epoch
        rate = jnp.where(last == 0.0, 1.0, mean / jnp.where(last == 0.0, 1.0, last))
        later = jax.nn.softmax(jnp.clip(rate, -_MAX_VALUE, _MAX_VALUE) / temperature) * len(losses)
        later = jnp.where(state.updates < epoch, 1.0, later)  # there is no ratio after the first epoch
        before = to_vector(state.weights)
        memory = {"sum": jnp.where(is_last, 0.0, total), "last": jnp.where(is_last, mean, last)}
        after, _ = next_state(state, by_name(losses, jnp.where(is_last, later, before)), memory=memory)
        return state.weights, after, {f"weight/{name}": weight for name, weight in state.weights.items()}

    return Weighting("dwa", init, update, main=False)


def famo(learning_rate: float = 0.025, decay: float = 1e-3, reference: float = 0.0, eps: float = 1e-8) -> Weighting:
    """Decrease all losses at the same rate (FAMO; Liu et al., 2023, "Fast Adaptive Multitask Optimization", algorithm 2).

    With z the softmax of learned logits w, weights are c z_i / L_i, c = 1 / sum_i z_i / L_i. Adam minimises
    sum_i z_i log(L_i before / L_i after) with respect to w, so that losses that decrease less gain weight. The paper evaluates
    the losses again after each step; here those of the next update are used, which is the same if both use the same data, and
    otherwise adds the noise of a minibatch. Needs no gradients of single losses, while its aim is that of MGDA on logarithms.

    Args:
        learning_rate: Learning rate of Adam for w.
        decay: Weight decay of w, added to its gradient (gamma).
        reference: Lower bound common to all losses.
        eps: Constant added to the losses after subtracting ``reference``.

    Raises:
        RequestError: ``eps`` is not positive.
    """
    _check_positive("famo", "eps", eps)
    rule = optax.chain(optax.add_decayed_weights(decay), optax.adam(learning_rate))

    def init(names: Iterable[str], shared: Params = None) -> WeightingState:
        state = start_equal("famo", names)
        logits = jnp.zeros(len(state.weights), state.weights[next(iter(state.weights))].dtype)
        return state.replace(memory={"logits": logits, "rule": rule.init(logits), "logs": jnp.zeros_like(logits)})

    def update(losses: Losses, statistics: Any, state: WeightingState) -> Result:
        above = jnp.maximum(to_vector(losses) - reference, 0.0) + eps
        memory = state.memory
        _, pullback = jax.vjp(jax.nn.softmax, memory["logits"])
        (gradient,) = pullback((memory["logs"] - jnp.log(above)).astype(memory["logits"].dtype))
        changes, rule_state = rule.update(gradient, memory["rule"], memory["logits"])
        learned = {"logits": optax.apply_updates(memory["logits"], changes), "rule": rule_state}
        previous = {name: memory[name] for name in learned}
        # There are no losses before the first ones.
        current = jax.tree.map(lambda new, old: jnp.where(state.updates > 0, new, old), learned, previous)
        ratios = jax.nn.softmax(current["logits"]) / above
        weights = by_name(losses, ratios / jnp.sum(ratios))
        return weights, *next_state(state, weights, memory={**current, "logs": jnp.log(above)})

    return Weighting("famo", init, update, main=False)


def _make_init(label: str) -> Callable[..., WeightingState]:
    def init(names: Iterable[str], shared: Params = None) -> WeightingState:
        return start_equal(label, names)

    return init


def _make_learned(
    label: str,
    learning_rate: float,
    slope: Callable[[jax.Array, jax.Array], jax.Array],
    to_weights: Callable[[jax.Array], jax.Array],
) -> Weighting:
    """Build a weighting with parameters s [K] that are learned by Adam.

    Args:
        label: Name of the weighting.
        learning_rate: Learning rate of Adam.
        slope: (s, losses [K]) -> derivative of the objective with respect to s.
        to_weights: s -> weights.
    """
    _check_positive(label, "learning_rate", learning_rate)
    rule = optax.adam(learning_rate)

    def init(names: Iterable[str], shared: Params = None) -> WeightingState:
        state = start_equal(label, names)
        scales = jnp.zeros(len(state.weights), state.weights[next(iter(state.weights))].dtype)
        weights = by_name(state.weights, to_weights(scales))
        return state.replace(weights=weights, memory={"scales": scales, "rule": rule.init(scales)})

    def update(losses: Losses, statistics: Any, state: WeightingState) -> Result:
        scales = state.memory["scales"]
        gradient = jnp.clip(slope(scales, to_vector(losses)), -_MAX_VALUE, _MAX_VALUE).astype(scales.dtype)
        changes, rule_state = rule.update(gradient, state.memory["rule"])
        scales: Any = optax.apply_updates(scales, changes)
        after, _ = next_state(state, by_name(losses, to_weights(scales)), memory={"scales": scales, "rule": rule_state})
        return state.weights, after, {f"weight/{name}": weight for name, weight in state.weights.items()}

    return Weighting(label, init, update, main=False)


def _check_positive(label: str, name: str, value: float) -> None:
    """Raise a RequestError if a number is not greater than 0."""
    if not value > 0.0:
        raise RequestError(f"{name} of weighting {label} must be greater than 0, not {value}")
