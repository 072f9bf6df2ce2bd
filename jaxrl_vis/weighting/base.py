"""Interface of a weighting, which combines several losses of the same parameters into one step.

One gradient step with losses L_i, shared parameters theta and a weighting:

    c_i = w_i s_i,  s_i = 1, or d log(L_i + eps) / d L_i if the weighting uses logarithms         `Weighting.coefficients`
    gradient = sum over i of c_i grad L_i, for all parameters, passed to the optimiser. If ``heads`` is always, weights apply
        to theta alone, and s_i replaces c_i for all other parameters
    statistics = functions of the gradients with respect to theta alone, as the weighting needs them

Some weightings have a main loss, which the others are meant to help (`Weighting.main`); the rest treat all losses alike. Arrays
over the losses, such as the Gramian [K, K], are in the sorted order of their names (`loss_order`). A weighting whose step is
not a weighted sum of the losses' gradients returns a `Direction` in the shared parameters instead.

Losses, dot products and gradients are passed without logarithms; the weighting multiplies them by s_i itself. They can thus be
averaged over devices or minibatches first, which would be wrong for logarithms.
"""

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp

from jaxrl_vis.errors import RequestError
from jaxrl_vis.types import Metrics, Params, Replaceable

MAIN = "main"
"""Name of the main loss, which the others are meant to help, for weightings that have one. Its weight is always 1."""

Needs = Literal["losses", "dots", "gramian", "gradients"]
Heads = Literal["weighted", "always"]
Losses = Mapping[str, jax.Array]  # [] floats by name
Weights = dict[str, jax.Array]
Eps = float | Mapping[str, float]  # one value for all auxiliary losses, or one for each by name


class Direction(NamedTuple):
    """Step of a weighting that is not a weighted sum of the current gradients.

    Attributes:
        shared: Replacement for the gradient in the shared parameters: a tree of the same structure, float32 or wider.
        weights: [] float32 by name, weights of the losses for all other parameters, and wherever only weights can be used.
    """

    shared: Params
    weights: Weights


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class WeightingState(Replaceable):
    """State of a weighting. All shapes are fixed, so it can be scanned, mapped, sharded and saved like parameters.

    Attributes:
        weights: [] float32 by name, for all losses; 1 for a main loss. Weights for combining the next gradients; or the latest
            ones, if they are computed from the gradients that they combine (`cosine`, and weightings that need a Gramian).
        updates: [] int32, number of calls of `Weighting.update` so far.
        sums: Sums over the calls since the weights last changed; None if unused.
        window: Latest gradients by name, [window, ...] each; None without a moving average.
        params: Parameters at which losses and gradients are compared; None for those of each step.
        memory: Further state, such as that of an optax rule; None if there is none.
        key: [] typed key of a random weighting; None for a deterministic one.
    """

    weights: Weights
    updates: jax.Array
    sums: Any = None
    window: Any = None
    params: Params = None
    memory: Any = None
    key: Any = None


class Weighting(NamedTuple):
    """Rule for the weights of losses. Pure; apart from ``init``, ``update`` and ``hold``, all fields are static.

    Attributes:
        name: Name, as in `make_weighting`.
        init: (names of all losses; shared parameters or their shapes, read if ``needs`` is gradients; with ``hold``, also all
            parameters or their shapes) -> WeightingState. Raises RequestError if names are missing or superfluous.
        update: (losses, statistics, state) -> (weights of this step by name, or a `Direction`; state; metrics of [] float32).
            ``statistics`` is

            - for ``needs`` losses: ignored, may be None;
            - dots: [] float32 for each auxiliary loss, <grad L_main, grad L_i>;
            - gramian: [K, K] float32, <grad L_i, grad L_j>, in the sorted order of the names;
            - gradients: for every loss, grad L_i.

            Gradients are those of the losses without logarithms, with respect to the shared parameters alone.
        needs: Kind of ``statistics``.
        auxiliary: Whether auxiliary losses are minimised at all; if not, their weight is 0 and they need not be computed.
        log: Whether logarithms of the losses are minimised.
        eps: Constant added to auxiliary losses before taking logarithms: one value for all, or one for each by name.
        main_eps: Constant added to the main loss before taking its logarithm.
        heads: Weights for parameters that are not shared. weighted: those of the shared ones, so that a head is not trained
            while the weight of its loss is 0; always: 1.
        interval: N, number of calls of ``update`` between changes of the weights.
        hold: (parameters of this step, WeightingState) -> WeightingState whose ``params`` are those at which losses and
            statistics of this step must be evaluated; None if these are the parameters of the step.
        main: Whether one of the losses must be called `MAIN`, and has weight 1.
        reads_losses: Whether the weights depend on the losses' values.
    """

    name: str
    init: Callable[..., WeightingState]
    update: Callable[[Losses, Any, WeightingState], tuple[Weights | Direction, WeightingState, Metrics]]
    needs: Needs = "losses"
    auxiliary: bool = True
    log: bool = False
    eps: Eps = 0.02
    main_eps: float = 1e-8
    heads: Heads = "weighted"
    interval: int = 1
    hold: Callable[[Params, WeightingState], WeightingState] | None = None
    main: bool = True
    reads_losses: bool = True

    def slopes(self, losses: Losses) -> dict[str, jax.Array]:
        """Compute s_i, the derivative of each loss's logarithm, [] float32 by name; 1 without logarithms."""
        return {name: log_slope(loss, self._loss_eps(name)) if self.log else jnp.ones(()) for name, loss in losses.items()}

    def coefficients(self, weights: Weights, losses: Losses) -> dict[str, jax.Array]:
        """Compute c_i = w_i s_i, the coefficients of the losses' gradients in the total gradient, [] float32 by name."""
        return {name: weights[name] * slope for name, slope in self.slopes(losses).items()}

    def objective(self, weights: Weights, losses: Losses) -> jax.Array:
        """Return the objective: the weighted sum of the losses or of their logarithms, [] float32.

        Its gradient, with constant weights, is the sum of c_i grad L_i.
        """
        weights = jax.lax.stop_gradient(weights)
        learned = {name: log_loss(loss, self._loss_eps(name)) if self.log else loss for name, loss in losses.items()}
        return sum((weights[name] * loss for name, loss in learned.items()), jnp.zeros(()))

    def head_weights(self, weights: Weights) -> Weights:
        """Return the weights for parameters that are not shared, [] float32 by name."""
        return {name: jnp.ones_like(weight) for name, weight in weights.items()} if self.heads == "always" else weights

    def _loss_eps(self, name: str) -> float:
        if name == MAIN:
            return self.main_eps
        if not isinstance(self.eps, Mapping):
            return self.eps
        if name not in self.eps:
            raise RequestError(f"weighting {self.name} has no eps for loss {name!r}; give one, or one number for all losses")
        return self.eps[name]


def log_loss(loss: jax.Array, eps: float) -> jax.Array:
    """Compute log(L + eps), extended linearly below L = 0: finite and increasing everywhere.

    Args:
        loss: [] float.
        eps: Positive constant.
    """
    return jnp.log(jnp.maximum(loss, 0.0) + eps) + jnp.minimum(loss, 0.0) / eps


def log_slope(loss: jax.Array, eps: float) -> jax.Array:
    """Compute the derivative of `log_loss`, 1 / (max(L, 0) + eps), [] float, without gradient."""
    return 1.0 / (jnp.maximum(jax.lax.stop_gradient(loss), 0.0) + eps)


def to_float32(leaf: jax.Array) -> jax.Array:
    """Convert an array to float32, unless its dtype is wider."""
    return leaf.astype(jnp.promote_types(leaf.dtype, jnp.float32))


def split_result(result: Any, has_aux: bool) -> tuple[Losses, Any]:
    """Split the result of a loss function, or its shapes, into losses and auxiliary output (None without ``has_aux``).

    Raises:
        RequestError: The result is not of this form, or a loss is not a scalar.
    """
    is_pair = isinstance(result, tuple) and len(result) == 2
    losses, extra = result if has_aux and is_pair else (result, None)
    if not isinstance(losses, Mapping) or (has_aux and not is_pair):
        wanted = "losses by name, and an auxiliary output" if has_aux else "a dictionary of losses by name"
        hint = "" if has_aux or not is_pair else "; has_aux=True takes an auxiliary output, too"
        raise RequestError(f"losses_fn must return {wanted}, not a {type(result).__name__}{hint}")
    for name, loss in losses.items():
        if shape := getattr(loss, "shape", ()):
            raise RequestError(f"loss {name!r} has shape {shape} and must be one number, such as its mean")
    return losses, extra


def check_names(losses: Losses, state: WeightingState) -> None:
    """Check that the losses are those with which the state was initialised.

    Raises:
        RequestError: Their names differ.
    """
    if set(losses) != set(state.weights):
        known, expected = (", ".join(sorted(names)) for names in (losses, state.weights))
        raise RequestError(f"losses are {known}, but the weighting began with {expected}; give init the names of all losses")


def dot(left: Params, right: Params) -> jax.Array:
    """Compute the scalar inner product of two trees in float32 or wider, regardless of their dtypes.

    Elementwise products are summed instead of using a matrix unit, which on accelerators would round factors to 10 bits.
    """

    def products(first: jax.Array, second: jax.Array) -> jax.Array:
        dtype = jnp.promote_types(jnp.promote_types(first.dtype, second.dtype), jnp.float32)
        return jnp.sum(first.astype(dtype) * second.astype(dtype))

    return sum(jax.tree.leaves(jax.tree.map(products, left, right)), jnp.zeros(()))


def scale_tree(tree: Params, factor: jax.Array | float) -> Params:
    """Multiply all leaves of a tree by a scalar."""
    return jax.tree.map(lambda leaf: factor * leaf, tree)


def weighted_sum(gradients: Mapping[str, Params], coefficients: Mapping[str, jax.Array]) -> Params:
    """Compute the sum of c_i g_i over the losses, in float32 or wider: a tree like each gradient.

    Args:
        gradients: Trees of the same structure, by name.
        coefficients: [] float32 by name.
    """

    def total(*leaves: jax.Array) -> jax.Array:
        return sum(coefficients[name] * leaf for name, leaf in zip(gradients, leaves, strict=True))  # type: ignore[return-value]

    return jax.tree.map(total, *gradients.values())


def loss_order(names: Iterable[str]) -> tuple[str, ...]:
    """Return the names in the order used by arrays over the losses."""
    return tuple(sorted(names))


def to_vector(by_name: Mapping[str, jax.Array]) -> jax.Array:
    """Stack the scalars of all losses in the order of `loss_order`: [K], float32 or wider."""
    return jnp.stack([to_float32(jnp.asarray(by_name[name])) for name in loss_order(by_name)])


def by_name(names: Iterable[str], vector: jax.Array) -> dict[str, jax.Array]:
    """Split a vector [K], in the order of `loss_order`, into scalars by the names of the losses."""
    return {name: vector[index] for index, name in enumerate(loss_order(names))}


def keep_dtypes(updated: WeightingState, previous: WeightingState) -> WeightingState:
    """Cast a state to the dtypes of the previous one, as required for the carry of a scan."""
    return jax.tree.map(lambda new, old: new if new.dtype == old.dtype else new.astype(old.dtype), updated, previous)


def all_names(weighting: str, names: Iterable[str]) -> tuple[str, ...]:
    """Return the names of the losses, for a weighting without a main loss, in the order used by arrays over them.

    Args:
        weighting: Name of the weighting, for error messages.
        names: Names of all losses.

    Raises:
        RequestError: There are none, or a name occurs twice.
    """
    names = tuple(names)
    if not names:
        raise RequestError(f"weighting {weighting} has no loss to weight; give init the names of all losses")
    _check_unique(names)
    return loss_order(names)


def _check_unique(names: tuple[str, ...]) -> None:
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise RequestError(f"two losses are called {twice[0]!r}; give each a name of its own")


def auxiliary_names(weighting: str, names: Iterable[str], needed: bool = True) -> tuple[str, ...]:
    """Return the names without `MAIN`.

    Args:
        weighting: Name of the weighting, for error messages.
        names: Names of all losses.
        needed: Whether there must be at least one auxiliary loss.

    Raises:
        RequestError: `MAIN` is missing, a name occurs twice, or a required auxiliary loss is missing.
    """
    names = tuple(names)
    _check_unique(names)
    if MAIN not in names:
        raise RequestError(f"no loss is called {MAIN!r}, only {', '.join(names) or 'none at all'}; name the main one so")
    if needed and len(names) == 1:
        raise RequestError(f"weighting {weighting} has no auxiliary loss to weight; add one, or use none or none_log")
    return tuple(name for name in names if name != MAIN)


def check_eps(weighting: Weighting) -> Weighting:
    """Check the ``eps`` and ``main_eps`` of a weighting, and return it.

    Raises:
        RequestError: One of them is not positive and finite.
    """
    for field in ("eps", "main_eps"):
        values = getattr(weighting, field)
        for value in values.values() if isinstance(values, Mapping) else [values]:
            if not (math.isfinite(value) and value > 0.0):
                raise RequestError(f"{field} of weighting {weighting.name} must be greater than 0, not {value}")
    return weighting


def start(names: Iterable[str], weights: Mapping[str, float], **fields: Any) -> WeightingState:
    """Return the initial state of a weighting with a main loss.

    Args:
        names: Names of the auxiliary losses.
        weights: Initial weights of the auxiliary losses, by name.
        fields: Values of other fields.
    """
    filled = {MAIN: jnp.ones(())} | {name: jnp.asarray(weights[name], jnp.ones(()).dtype) for name in names}
    return WeightingState(weights=filled, updates=jnp.zeros((), jnp.int32), **fields)


def start_equal(label: str, names: Iterable[str], **fields: Any) -> WeightingState:
    """Return the initial state of a weighting without a main loss: equal weights that sum to 1.

    Args:
        label: Name of the weighting, for error messages.
        names: Names of all losses.
        fields: Values of other fields.
    """
    ordered = all_names(label, names)
    weights = {name: jnp.full((), 1.0 / len(ordered), jnp.ones(()).dtype) for name in ordered}
    return WeightingState(weights=weights, updates=jnp.zeros((), jnp.int32), **fields)


def next_state(state: WeightingState, weights: Weights, **fields: Any) -> tuple[WeightingState, Metrics]:
    """Return the state after an update, and metrics ``weight/NAME`` of all losses.

    Args:
        state: Previous state.
        weights: Weights of this step; or of the next one, if they do not depend on the gradients that they combine.
        fields: New values of other fields.
    """
    after = keep_dtypes(state.replace(weights=weights, updates=state.updates + 1, **fields), state)
    return after, {f"weight/{name}": weight for name, weight in after.weights.items()}


def zeros_for(label: str, names: Iterable[str], shared: Params, *leading: int) -> dict[str, Params]:
    """Return a tree of zeros like the shared parameters for each loss, float32 or wider.

    Args:
        label: Name of the weighting, for error messages.
        names: Names of the losses.
        shared: Shared parameters or their shapes.
        leading: Sizes of leading axes to prepend to those of each parameter.

    Raises:
        RequestError: ``shared`` is not given.
    """
    if shared is None:
        raise RequestError(f"weighting {label} keeps gradients: give init the shared parameters, too")

    def zeros(leaf: Any) -> jax.Array:
        return jnp.zeros((*leading, *leaf.shape), jnp.promote_types(leaf.dtype, jnp.float32))

    return {name: jax.tree.map(zeros, shared) for name in names}


def weight_metrics(weights: Weights, dots: Mapping[str, jax.Array] | None = None) -> Metrics:
    """Return the metrics ``weight/NAME`` of each auxiliary loss, and ``dot/NAME`` if ``dots`` is given, [] float32 each."""
    shown = {f"weight/{name}": weight for name, weight in weights.items() if name != MAIN}
    return shown | {f"dot/{name}": value for name, value in (dots or {}).items()}
