"""Gradients of several losses, what weightings need to know about them, and their weighted sum.

`weighted_grad` is to a dictionary of losses what `jax.grad` is to a single one. It finds gradients in one of four ways, which
agree up to rounding:

    per_loss   one `jax.grad` for each loss: the reference, and the default                    losses, dots, gradients
    one_hot    one `jax.vjp` of all losses, mapped over one-hot cotangents                     losses, dots, gradients
    jvp        one backward pass for the direction d that losses are compared with, one
               `jax.jvp` of all losses along d (its tangents are all dots), and one backward
               pass for the weighted sum; with weightings that need losses, the last alone     losses, dots
    latents    likewise, where losses read the shared parameters through latents z alone:
               each loss is differentiated down to z, g_i, and only d and the weighted sum
               farther; <d, grad L_i> = <J d, g_i>, where J d is the tangent of z (`latents`)  losses, dots

On the right are the `Weighting.needs` that each can serve. The last two pass through the shared parameters as often for ten
losses as for two; latents, which differentiates no head forwards, is the faster one. What is differentiated forwards must have
tangent rules, which operations of `jax.custom_vjp` lack: ``forwards`` may be a context in which it is traced without those.
"""

import contextlib
import dataclasses
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp

from jaxrl_vis.errors import RequestError, nearest
from jaxrl_vis.learner.weighting import latents
from jaxrl_vis.learner.weighting.base import MAIN, Losses, Weighting, WeightingState, Weights, dot, weighted_sum
from jaxrl_vis.types import Metrics, Params

Way = Literal["per_loss", "one_hot", "jvp", "latents"]
LossesFunction = Callable[..., Any]
Encode = Callable[..., Any] | Mapping[str, Callable[..., Any]]
Selector = Callable[[Params], Params]
_FORWARD_WAYS = ("jvp", "latents")


class Weighted(NamedTuple):
    """What `weighted_grad` finds.

    Attributes:
        gradient: For the optimiser: the weighted sum of all gradients, shaped like the parameters, float32.
        state: Of the weighting, after this step.
        losses: [] float32 by name.
        metrics: [] float32 by name.
        weights: What each loss weighed in ``gradient``, [] float32 by name.
        extra: What the losses' function returned beside them; None without ``has_aux``.
    """

    gradient: Params
    state: WeightingState
    losses: dict[str, jax.Array]
    metrics: Metrics
    weights: Weights
    extra: Any = None


def everything(params: Params) -> Params:
    """Selects all parameters as shared."""
    return params


def loss_gradients(
    losses_fn: LossesFunction, params: Params, *args: Any, way: Way = "per_loss", has_aux: bool = False
) -> tuple[dict[str, jax.Array], dict[str, Params], Any]:
    """Each loss, and its gradient by itself.

    Args:
        losses_fn: (params, *args) -> [] floats by name; with ``has_aux``, and anything else beside these.
        params: What is differentiated.
        args: More arguments.
        way: per_loss or one_hot.
        has_aux: See ``losses_fn``.

    Returns:
        Losses, [] float32 by name; gradients by name, each shaped like the parameters, float32; what else there was.

    Raises:
        RequestError: What ``losses_fn`` returns is no dictionary of numbers.
    """
    whole = _in_float32(losses_fn, has_aux)
    if way == "one_hot":
        losses, pullback, extra = jax.vjp(lambda params: whole(params, *args), params, has_aux=True)
        rows = dict(zip(losses, jnp.eye(len(losses), dtype=jnp.result_type(*losses.values())).T))
        (stacked,) = jax.vmap(pullback)(rows)
        gradients = {name: jax.tree.map(lambda leaf, row=row: leaf[row], stacked) for row, name in enumerate(losses)}
    else:
        losses, extra = whole(params, *args)
        gradients = {name: jax.grad(lambda params, name=name: whole(params, *args)[0][name])(params) for name in losses}
    return losses, jax.tree.map(_to_float32, gradients), extra


def measure(weighting: Weighting, losses: Losses, gradients: Mapping[str, Params], state: WeightingState) -> Any:
    """The ``statistics`` that `Weighting.update` takes, from each loss's own gradient.

    Args:
        weighting: What needs them.
        losses: [] float32 by name.
        gradients: Of these, with respect to the shared parameters alone.
        state: Of the weighting, before the update.
    """
    if weighting.needs == "losses":
        return None
    if weighting.needs == "gradients":
        return dict(gradients)
    direction = gradients[MAIN]
    if weighting.main_grad == "total":
        direction = weighted_sum(gradients, weighting.coefficients(state.weights, losses))
    return {name: dot(direction, gradient) for name, gradient in gradients.items() if name != MAIN}


def weighted_grad(
    losses_fn: LossesFunction,
    weighting: Weighting,
    shared: Selector = everything,
    way: Way = "per_loss",
    has_aux: bool = False,
    reduce: Selector = everything,
    forwards: Callable[[], contextlib.AbstractContextManager] = contextlib.nullcontext,
    encode: Encode | None = None,
) -> Callable[..., Weighted]:
    """The gradient of a dictionary of losses, weighted.

    Args:
        losses_fn: (params, *args) -> [] floats by name, of which one is called `MAIN`; with ``has_aux``, and anything else
            beside these. A gradient is taken for each loss as a whole, heads and shared parameters alike. With ``encode``:
            (params, latents, *args).
        weighting: From `make_weighting`.
        shared: Selects the parameters in which gradients are compared, for instance ``lambda params: params["encoder"]``. It
            may only pick: what it returns must be parts of its argument.
        way: How gradients are found, see above.
        has_aux: See ``losses_fn``.
        reduce: Applied to losses, gradients and dots before the weighting sees them, where each device has its own part of the
            data and the losses are means: ``lambda tree: jax.lax.pmean(tree, axis)``.
        forwards: Makes the context in which what is differentiated forwards is traced.
        encode: (what ``shared`` selects, *args) -> latents, any tree of arrays. ``losses_fn`` must read the shared parameters
            through these alone. Way latents needs it; the others take it, too. Or a dictionary of such functions, where latents
            are a dictionary of the same names: gradients then pass only through those that a loss reads.

    Returns:
        (params, state, *args) -> `Weighted`, with state from ``weighting.init(names, shared(params))``. A weighting with
        ``held`` takes one more argument by name, ``held``: the parameters that its interval began with, at which gradients are
        compared.

    Raises:
        RequestError: There is no such way, or it does not find what the weighting needs; from the function returned: what
            ``losses_fn`` returns is no dictionary of numbers, the losses are not those that the state began with, ``held`` is
            missing, or given without need.
    """
    _check_way(way, weighting, encode is not None)
    return _Finder(losses_fn, weighting, shared, way, has_aux, reduce, forwards, encode).find


@dataclasses.dataclass(frozen=True)
class _Finder:
    """What `weighted_grad` was given, and each way as a method."""

    losses_fn: LossesFunction
    weighting: Weighting
    shared: Selector
    way: Way
    has_aux: bool
    reduce: Selector
    forwards: Callable[[], contextlib.AbstractContextManager]
    encode: Encode | None

    def find(self, params: Params, state: WeightingState, *args: Any, held: Params = None) -> Weighted:
        if self.weighting.held and held is None:
            raise RequestError(f"weighting {self.weighting.name} needs held=, the parameters that its interval began with")
        if not self.weighting.held and held is not None:
            raise RequestError(f"weighting {self.weighting.name} holds no parameters; leave out held")
        if self.way in _FORWARD_WAYS:
            return (self._by_jvp if self.way == "jvp" else self._by_latents)(params, state, *args)
        return self._by_gradients(params, state, *args, held=held)

    def _losses_of(self, params: Params, *args: Any) -> Any:
        if self.encode is None:
            return self.losses_fn(params, *args)
        picked = self.shared(params)
        if isinstance(self.encode, Mapping):
            return self.losses_fn(params, {name: encode(picked, *args) for name, encode in self.encode.items()}, *args)
        return self.losses_fn(params, self.encode(picked, *args), *args)

    def _by_gradients(self, params: Params, state: WeightingState, *args: Any, held: Params = None) -> Weighted:
        losses, gradients, extra = loss_gradients(self._losses_of, params, *args, way=self.way, has_aux=self.has_aux)
        _check_names(losses, state)
        losses, gradients = self.reduce((losses, gradients))
        seen, compared = losses, gradients
        if self.weighting.held:
            seen, compared = self.reduce(loss_gradients(self._losses_of, held, *args, way=self.way, has_aux=self.has_aux)[:2])
        statistics = measure(self.weighting, seen, {name: self.shared(tree) for name, tree in compared.items()}, state)
        weights, state, metrics = self.weighting.update(seen, statistics, state)
        combined = weighted_sum(gradients, self.weighting.coefficients(weights, losses))
        return Weighted(combined, state, losses, metrics, weights, extra)

    def _by_jvp(self, params: Params, state: WeightingState, *args: Any) -> Weighted:
        whole = _in_float32(self._losses_of, self.has_aux)
        local, pullback, extra = jax.vjp(lambda params: whole(params, *args), params, has_aux=True)
        _check_names(local, state)
        losses = self.reduce(local)

        def backward(coefficients: Mapping[str, jax.Array]) -> Params:
            (gradient,) = pullback({name: coefficients[name].astype(loss.dtype) for name, loss in local.items()})
            return self.reduce(jax.tree.map(_to_float32, gradient))

        combined = statistics = None
        if self.weighting.needs == "dots":
            if self.weighting.main_grad == "total":
                direction = combined = backward(self.weighting.coefficients(state.weights, losses))
            else:
                direction = backward({name: jnp.full_like(loss, name == MAIN) for name, loss in losses.items()})
            along = latents.like(_embed(self.shared, params, self.shared(direction)), params)
            with self.forwards():
                _, tangents = jax.jvp(lambda params: whole(params, *args)[0], (params,), (along,))
            statistics = self.reduce({name: tangent for name, tangent in tangents.items() if name != MAIN})
        weights, state, metrics = self.weighting.update(losses, statistics, state)
        if combined is None:
            combined = backward(self.weighting.coefficients(weights, losses))
        return Weighted(combined, state, losses, metrics, weights, extra)

    def _by_latents(self, params: Params, state: WeightingState, *args: Any) -> Weighted:
        assert self.encode is not None
        whole = _in_float32(self.losses_fn, self.has_aux)
        through = latents.encode(self.encode, self.shared(params), *args)
        found = latents.differentiate(whole, through, params, *args)
        _check_names(found.losses, state)
        losses = self.reduce(found.losses)
        statistics = of_shared = None
        if self.weighting.needs == "dots":
            is_total = self.weighting.main_grad == "total"
            first = self.weighting.coefficients(state.weights, losses) if is_total else {MAIN: jnp.ones(())}
            of_first = through.backward(found.at_latents, first)
            with self.forwards():
                dots = through.dots(self.reduce(of_first), found.at_latents)
            statistics = self.reduce(dots)
            of_shared = None if is_total else of_first
        weights, state, metrics = self.weighting.update(losses, statistics, state)
        coefficients = self.weighting.coefficients(weights, losses)
        rest = coefficients if of_shared is None else {name: each for name, each in coefficients.items() if name != MAIN}
        added = through.backward(found.at_latents, rest)
        if of_shared is not None:  # the main loss's own has been found already, and gradients add up
            added = jax.tree.map(lambda main, other: coefficients[MAIN] * main + other, of_shared, added)
        combined = jax.tree.map(jnp.add, found.combined(params, coefficients), _embed(self.shared, params, added))
        return Weighted(self.reduce(combined), state, losses, metrics, weights, found.extra)


def _check_way(way: str, weighting: Weighting, has_latents: bool) -> None:
    if way not in get_args(Way):
        raise RequestError(f"unknown way to find gradients {way!r}{nearest(way, get_args(Way))}")
    if way in _FORWARD_WAYS and weighting.needs == "gradients":
        raise RequestError(
            f"weighting {weighting.name} needs whole gradients, which {way} does not find; use one_hot or per_loss"
        )
    if way == "latents" and not has_latents:
        raise RequestError("way latents needs to know what the latents are: give encode, or use jvp")


def _check_names(losses: Losses, state: WeightingState) -> None:
    if set(losses) != set(state.weights):
        _raise_names(losses, state.weights)


def _raise_names(there: Iterable[str], known: Iterable[str]) -> None:
    there, known = (", ".join(sorted(names)) for names in (there, known))
    raise RequestError(f"losses are {there}, but the weighting began with {known}; give init the names of all losses")


def _to_float32(leaf: jax.Array) -> jax.Array:
    return leaf.astype(jnp.promote_types(leaf.dtype, jnp.float32))


def _in_float32(losses_fn: LossesFunction, has_aux: bool) -> Callable[..., tuple[dict[str, jax.Array], Any]]:
    """The same losses, at least float32, and what comes beside them, or None."""

    def whole(params: Params, *args: Any) -> tuple[dict[str, jax.Array], Any]:
        losses, extra = _parts(losses_fn(params, *args), has_aux)
        return {name: _to_float32(jnp.asarray(loss)) for name, loss in losses.items()}, extra

    return whole


def _parts(returned: Any, has_aux: bool) -> tuple[Losses, Any]:
    """What a function of losses returned: the losses, and what is beside them, or None.

    Raises:
        RequestError: It is not that, or a loss is not a single number.
    """
    is_pair = isinstance(returned, tuple) and len(returned) == 2
    losses, extra = returned if has_aux and is_pair else (returned, None)
    if not isinstance(losses, Mapping) or (has_aux and not is_pair):
        wanted = "losses by name, and what is beside them" if has_aux else "a dictionary of losses by name"
        mend = "" if has_aux or not is_pair else "; has_aux=True takes what is beside them"
        raise RequestError(f"losses_fn must return {wanted}, not a {type(returned).__name__}{mend}")
    for name, loss in losses.items():
        if jnp.shape(loss):
            raise RequestError(f"loss {name!r} has shape {jnp.shape(loss)} and must be one number, such as its mean")
    return losses, extra


def _embed(shared: Selector, params: Params, part: Params) -> Params:
    """``part`` in the shared parameters and zero in all others, in the dtypes of ``part`` or float32."""
    dtype = jnp.result_type(jnp.float32, *jax.tree.leaves(part))
    shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, dtype), params)
    part = jax.tree.map(lambda leaf: leaf.astype(dtype), part)
    (placed,) = jax.linear_transpose(shared, shapes)(part)  # of a function that only picks, the transpose puts back
    return placed
