"""Gradients of several losses, the statistics that weightings need, and the weighted sum.

`weighted_grad` is to a dictionary of losses what `jax.grad` is to a single one. It computes gradients in one of two modes,
which agree up to rounding:

    per_loss   one `jax.grad` for each loss: the reference, and the default                    losses, dots, gramian, gradients
    latents    if losses read the shared parameters only through latents z: each loss is
               differentiated with respect to z, giving g_i, and only the main loss and
               the weighted sum with respect to the shared parameters;
               <grad L_main, grad L_i> = <J grad L_main, g_i>, where J grad L_main is the
               tangent of z (`latents`)                                                        losses, dots, gramian

The values of `Weighting.needs` that each supports are on the right. For dots, the second mode makes as many passes through
the shared parameters for ten losses as for two. For a Gramian it makes one backward and one forward-mode pass per loss, one
after the other, so that no [K, parameters] Jacobian is stored. Heads are never differentiated in forward mode. Operations that
are differentiated in forward mode need tangent rules, which `jax.custom_vjp` lacks: ``forwards`` may be a context in which such
operations are replaced during tracing.
"""

import contextlib
import functools
from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp

from jaxrl_vis.errors import RequestError, nearest
from jaxrl_vis.types import Metrics, Params
from jaxrl_vis.weighting import latents
from jaxrl_vis.weighting.base import (
    MAIN,
    Direction,
    Losses,
    Weighting,
    WeightingState,
    Weights,
    check_names,
    dot,
    loss_order,
    split_result,
    to_float32,
    weighted_sum,
)

GradientMode = Literal["per_loss", "latents"]
LossesFunction = Callable[..., Any]
Encode = Callable[..., Any] | Mapping[str, Callable[..., Any]]
Selector = Callable[[Params], Params]


class Weighted(NamedTuple):
    """Result of `weighted_grad`.

    Attributes:
        gradient: Weighted sum of all gradients for the optimiser, shaped like the parameters, float32.
        state: State of the weighting after this step.
        losses: [] float32 by name.
        metrics: [] float32 by name.
        weights: [] float32 by name, weight of each loss in ``gradient``; with a `Direction`, for parameters not shared.
        extra: Auxiliary output of the loss function; None without ``has_aux``.
    """

    gradient: Params
    state: WeightingState
    losses: dict[str, jax.Array]
    metrics: Metrics
    weights: Weights
    extra: Any = None


def identity(params: Params) -> Params:
    """Return the argument: selects all parameters as shared, and reduces nothing."""
    return params


def loss_gradients(
    losses_fn: LossesFunction, params: Params, *args: Any, has_aux: bool = False
) -> tuple[dict[str, jax.Array], dict[str, Params], Any]:
    """Compute each loss with its own gradient.

    Args:
        losses_fn: (params, *args) -> [] floats by name; with ``has_aux``, followed by any auxiliary output.
        params: Parameters with respect to which the losses are differentiated.
        args: Further arguments of ``losses_fn``.
        has_aux: See ``losses_fn``.

    Returns:
        Losses, [] float32 by name; gradients by name, each shaped like the parameters, float32; auxiliary output or None.

    Raises:
        RequestError: ``losses_fn`` does not return a dictionary of scalars.
    """

    def compute(params: Params) -> tuple[dict[str, jax.Array], Any]:
        losses, extra = split_result(losses_fn(params, *args), has_aux)
        return {name: to_float32(jnp.asarray(loss)) for name, loss in losses.items()}, extra

    losses, extra = compute(params)
    gradients = {name: jax.grad(lambda params, name=name: compute(params)[0][name])(params) for name in losses}
    return losses, jax.tree.map(to_float32, gradients), extra


def measure(weighting: Weighting, losses: Losses, gradients: Mapping[str, Params]) -> Any:
    """Compute the ``statistics`` that `Weighting.update` takes, from each loss's own gradient.

    Args:
        weighting: Weighting whose ``needs`` determines the kind of statistics.
        losses: [] float32 by name.
        gradients: Gradients of the losses with respect to the shared parameters alone, by name.
    """
    if weighting.needs == "losses":
        return None
    if weighting.needs == "gradients":
        return dict(gradients)
    if weighting.needs == "gramian":
        return gramian(gradients)
    return {name: dot(gradients[MAIN], gradient) for name, gradient in gradients.items() if name != MAIN}


def gramian(gradients: Mapping[str, Params]) -> jax.Array:
    """Compute the inner products of all pairs of gradients: [K, K] float32 or wider, in the sorted order of the names.

    Args:
        gradients: Trees of the same structure, by name.
    """

    def products(*leaves: jax.Array) -> jax.Array:
        rows = to_float32(jnp.stack(leaves)).reshape(len(leaves), -1)
        # At the default precision, a matrix unit would round the factors to 10 bits or fewer.
        return jnp.matmul(rows, rows.T, precision=jax.lax.Precision.HIGHEST)

    names = loss_order(gradients)
    parts = jax.tree.leaves(jax.tree.map(products, *(gradients[name] for name in names)))
    return sum(parts, jnp.zeros((len(names), len(names))))


def weighted_grad(
    losses_fn: LossesFunction,
    weighting: Weighting,
    shared: Selector = identity,
    mode: GradientMode = "per_loss",
    has_aux: bool = False,
    reduce: Callable[[Any], Any] = identity,
    forwards: Callable[[], contextlib.AbstractContextManager] = contextlib.nullcontext,
    encode: Encode | None = None,
) -> Callable[..., Weighted]:
    """Build the function that computes the weighted gradient of a dictionary of losses.

    Args:
        losses_fn: (params, *args) -> [] floats by name, of which one is called `MAIN` if the weighting has a main loss; with
            ``has_aux``, followed by any auxiliary output. Each loss is differentiated with respect to all parameters, those of
            heads and shared ones. With ``encode``: (params, latents, *args).
        weighting: Weighting, such as from `make_weighting`.
        shared: Function that selects the parameters in which gradients are compared, for instance
            ``lambda params: params["encoder"]``. It must return parts of its argument unmodified.
        mode: Mode in which gradients are computed, see the module docstring.
        has_aux: See ``losses_fn``.
        reduce: Function applied to losses, gradients and dots before the weighting reads them, for use if each device has its
            own part of the data and the losses are means: ``lambda tree: jax.lax.pmean(tree, axis)``. Inside `jax.shard_map`
            this needs ``check_vma=False``; otherwise, gradients with respect to replicated parameters are already summed.
        forwards: Factory of the context for tracing forward-mode differentiation.
        encode: (shared parameters, *args) -> latents, any tree of arrays. ``losses_fn`` must read the shared parameters only
            through these. Required by mode latents, optional with per_loss. Or a dictionary of such functions; latents
            are then a dictionary with the same keys, and gradients pass only through those that a loss reads.

    Returns:
        (params, state, *args) -> `Weighted`. The initial state is ``weighting.init(names, shared(params))``, or
        ``weighting.init(names, shared(params), params)`` if ``weighting.hold`` is not None.

    Raises:
        RequestError: The mode is unknown, does not support the weighting, or is latents without ``encode``; from the returned
            function: ``losses_fn`` does not return a dictionary of scalars, or the losses are not those with which the state
            was initialised.
    """
    if mode not in get_args(GradientMode):
        raise RequestError(f"unknown gradient mode {mode!r}{nearest(mode, get_args(GradientMode))}")
    if mode == "latents" and weighting.needs == "gradients":
        raise RequestError(
            f"weighting {weighting.name} needs whole gradients, which mode latents does not compute; use per_loss"
        )
    if mode == "latents":
        if encode is None:
            raise RequestError("mode latents needs the function that computes the latents: give encode")
        return functools.partial(_gradient_by_latents, losses_fn, weighting, shared, has_aux, reduce, forwards, encode)

    def encoded_losses(params: Params, *args: Any) -> Any:
        if encode is None:
            return losses_fn(params, *args)
        picked = shared(params)
        if isinstance(encode, Mapping):
            return losses_fn(params, {name: one(picked, *args) for name, one in encode.items()}, *args)
        return losses_fn(params, encode(picked, *args), *args)

    return functools.partial(_gradient_per_loss, encoded_losses, weighting, shared, has_aux, reduce)


def _gradient_per_loss(
    losses_fn: LossesFunction,
    weighting: Weighting,
    shared: Selector,
    has_aux: bool,
    reduce: Callable[[Any], Any],
    params: Params,
    state: WeightingState,
    *args: Any,
) -> Weighted:
    """Compute the weighted gradient from the whole gradient of each loss; arguments as for `weighted_grad`."""
    losses, gradients, extra = loss_gradients(losses_fn, params, *args, has_aux=has_aux)
    check_names(losses, state)
    losses, gradients = reduce((losses, gradients))
    compared_losses, compared = losses, gradients
    if weighting.hold is not None:
        state = weighting.hold(params, state)
        compared_losses, compared = reduce(loss_gradients(losses_fn, state.params, *args, has_aux=has_aux)[:2])
    statistics = measure(weighting, compared_losses, {name: shared(tree) for name, tree in compared.items()})
    step, state, metrics = weighting.update(compared_losses, statistics, state)
    weights = step.weights if isinstance(step, Direction) else step
    combined = weighted_sum(gradients, weighting.coefficients(weights, losses))
    if weighting.heads == "always":
        in_heads = weighted_sum(gradients, weighting.coefficients(weighting.head_weights(weights), losses))
        combined = _replace_subtree(shared, params, combined, in_heads)
    if isinstance(step, Direction):
        combined = _replace_subtree(shared, params, _embed(shared, params, step.shared), combined)
    return Weighted(combined, state, losses, metrics, weights, extra)


def _gradient_by_latents(
    losses_fn: LossesFunction,
    weighting: Weighting,
    shared: Selector,
    has_aux: bool,
    reduce: Callable[[Any], Any],
    forwards: Callable[[], contextlib.AbstractContextManager],
    encode: Encode,
    params: Params,
    state: WeightingState,
    *args: Any,
) -> Weighted:
    """Compute the weighted gradient from the gradients with respect to latents; arguments as for `weighted_grad`."""
    encoding = latents.encode(encode, shared(params), *args)
    # Trace the losses to find which latents and parameters each of them reads.
    program, results = jax.make_jaxpr(losses_fn, return_shape=True)(params, encoding.argument, *args)
    differentiated = latents.differentiate(losses_fn, has_aux, encoding, (program, results), params, *args)
    check_names(differentiated.losses, state)
    losses = reduce(differentiated.losses)
    statistics = of_main = None
    if weighting.needs == "dots":
        of_main = encoding.backward(differentiated.at_latents, {MAIN: jnp.ones(())})
        others = {name: at for name, at in differentiated.at_latents.items() if name != MAIN}
        with forwards():
            dots = encoding.dots(reduce(of_main), others)
        statistics = reduce(dots)
    elif weighting.needs == "gramian":
        with forwards():
            statistics = reduce(encoding.gramian(differentiated.at_latents, reduce))
    step, state, metrics = weighting.update(losses, statistics, state)
    assert not isinstance(step, Direction)  # only weightings that need whole gradients return one
    weights = step
    coefficients = weighting.coefficients(weights, losses)
    rest = coefficients
    if of_main is not None:
        rest = {name: coefficient for name, coefficient in coefficients.items() if name != MAIN}
    added = encoding.backward(differentiated.at_latents, rest)
    if of_main is not None:  # add the main loss's gradient, which is known already
        added = jax.tree.map(lambda main, other: coefficients[MAIN] * main + other, of_main, added)
    in_heads = differentiated.combine_heads(params, weighting.coefficients(weighting.head_weights(weights), losses))
    combined = jax.tree.map(jnp.add, in_heads, _embed(shared, params, added))
    return Weighted(reduce(combined), state, losses, metrics, weights, differentiated.extra)


def _replace_subtree(shared: Selector, params: Params, inside: Params, outside: Params) -> Params:
    """Merge two trees like the parameters: shared parameters from ``inside``, all others from ``outside``."""
    is_shared = _embed(shared, params, jax.tree.map(jnp.ones_like, shared(outside)))
    return jax.tree.map(
        lambda mask, shared_leaf, other_leaf: jnp.where(mask > 0, shared_leaf, other_leaf), is_shared, inside, outside
    )


def _embed(shared: Selector, params: Params, subset: Params) -> Params:
    """Place ``subset`` in the shared parameters and zero in all others, in the dtypes of ``subset`` or float32."""
    dtype = jnp.result_type(jnp.float32, *jax.tree.leaves(subset))
    shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, dtype), params)
    subset = jax.tree.map(lambda leaf: leaf.astype(dtype), subset)
    (placed,) = jax.linear_transpose(shared, shapes)(subset)  # the transpose of a selection inserts its parts
    return placed
