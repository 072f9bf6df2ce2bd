"""Weightings that need the inner products of all pairs of gradients, the Gramian [K, K]. All losses are alike to them.

Their cost is that of the Gramian, K gradients or K passes back and forth through latents, and of a small problem over the
losses (`solvers`). They change neither with the order of the losses nor with an orthogonal change of the parameters. `mgda`,
`upgrad` and `dualproj`, and with more than the least radius `cagrad`, give directions that oppose no gradient.
"""

from collections.abc import Callable, Iterable
from typing import Any, TypedDict, Unpack

import jax
import jax.numpy as jnp

from jaxrl_vis.errors import RequestError
from jaxrl_vis.types import Metrics, Params
from jaxrl_vis.weighting import solvers
from jaxrl_vis.weighting.base import (
    Eps,
    Heads,
    Losses,
    Weighting,
    WeightingState,
    Weights,
    by_name,
    checked,
    moved,
    start_alike,
    to_vector,
)

Solve = Callable[[jax.Array, WeightingState], tuple[jax.Array, Any]]


class Options(TypedDict, total=False):
    """Options of all weightings that need a Gramian.

    Attributes:
        log: True if logarithms of the losses are learned and compared, which makes the result independent of their units.
        eps, main_eps, heads: See `Weighting`. ``heads`` is always if not given: weights apply to the shared parameters alone.
    """

    log: bool
    eps: Eps
    main_eps: float
    heads: Heads


def of_gramian(
    label: str,
    solve: Solve,
    log: bool = False,
    eps: Eps = 0.02,
    main_eps: float = 1e-8,
    heads: Heads = "always",
    memory: Callable[[int, Any], Any] | None = None,
    seed: int | None = None,
) -> Weighting:
    """Build a weighting from a function of the Gramian.

    Args:
        label: Its name.
        solve: (Gramian [K, K] of what is learned, state) -> (weights [K], memory). With ``seed``, it may draw from
            ``state.key``, folded with ``state.updates``.
        log: True if logarithms of the losses are learned and compared, which makes the result independent of their units.
        eps, main_eps, heads: See `Weighting`.
        memory: (K, dtype) -> what is remembered at first; None for nothing.
        seed: Of the key that the state begins with; None for none.
    """

    def init(names: Iterable[str], shared: Params = None) -> WeightingState:
        state = start_alike(label, names, key=None if seed is None else jax.random.key(seed))
        if memory is None:
            return state
        return state.replace(memory=memory(len(state.weights), next(iter(state.weights.values())).dtype))

    def update(losses: Losses, statistics: Any, state: WeightingState) -> tuple[Weights, WeightingState, Metrics]:
        slopes = to_vector(weighting.slopes(losses))
        vector, remembered = solve(slopes[:, None] * statistics * slopes[None, :] if log else statistics, state)
        weights = by_name(losses, vector)
        return weights, *moved(state, weights, memory=remembered)

    weighting = checked(
        Weighting(
            label,
            init,
            update,
            needs="gramian",
            log=log,
            eps=eps,
            main_eps=main_eps,
            heads=heads,
            main=False,
            reads_losses=log,
        )
    )
    return weighting


def _plain(weights: Callable[[jax.Array], jax.Array]) -> Solve:
    """Return a solver without a memory."""
    return lambda gramian, state: (weights(gramian), None)


def mgda(**options: Unpack[Options]) -> Weighting:
    """Take the shortest vector in the convex hull of the gradients (MGDA; Desideri, 2012; Sener and Koltun, 2018, eq. 3).

    Weights minimise |sum_i w_i g_i|, w in the simplex: where no loss can fall without another's rising, the step is 0;
    elsewhere all fall, to first order at one rate or faster. Small gradients weigh most, so that it slows down near any single
    minimum. For fronts that are to be reached rather than one optimum.

    Args:
        options: See `Options`.
    """
    return of_gramian("mgda", _plain(lambda gramian: solvers.min_norm(gramian)[0]), **options)


def upgrad(**options: Unpack[Options]) -> Weighting:
    """Project each gradient onto the cone that opposes none, and average (UPGrad; Quinton and Rey, 2024, "Jacobian Descent").

    K projections onto the dual cone, {d: <g_i, d> >= 0 for all i}. Opposes no gradient, grows linearly with each gradient's
    length, and is a combination of the gradients: the paper shows that no other known method has all three. A first choice
    where gradients conflict.

    Args:
        options: See `Options`.
    """

    def weights(gramian: jax.Array) -> jax.Array:
        each = jnp.eye(len(gramian), dtype=gramian.dtype) / len(gramian)
        return jnp.sum(jax.vmap(lambda one: solvers.dual_cone(gramian, one))(each), axis=0)

    return of_gramian("upgrad", _plain(weights), **options)


def dualproj(**options: Unpack[Options]) -> Weighting:
    """Project the mean gradient onto the cone that opposes none (DualProj; Lopez-Paz and Ranzato, 2017, eq. 11).

    The direction nearest to the mean gradient, among those that let no loss rise to first order. Cheaper than `upgrad`, but
    large gradients decide.

    Args:
        options: See `Options`.
    """

    def weights(gramian: jax.Array) -> jax.Array:
        return solvers.dual_cone(gramian, jnp.full(len(gramian), 1.0 / len(gramian), gramian.dtype))

    return of_gramian("dualproj", _plain(weights), **options)


def cagrad(radius: float = 0.5, **options: Unpack[Options]) -> Weighting:
    """Improve the worst loss within a ball around the mean gradient (CAGrad; Liu et al., 2021, algorithm 1).

    The direction d of greatest min_i <g_i, d> with |d - g_0| <= c |g_0|, g_0 the mean: g_0 + c |g_0| g_w / |g_w|, where w in
    the simplex minimises <g_w, g_0> + c |g_0| |g_w|. c = 0 is the mean; for c < 1 it converges to a minimum of the mean loss.
    For those who want that, and the worst loss to fall on the way.

    Args:
        radius: c.
        options: See `Options`.

    Raises:
        RequestError: ``radius`` is negative.
    """
    if not radius >= 0.0:
        raise RequestError(f"radius of weighting cagrad must be at least 0, not {radius}")

    def weights(gramian: jax.Array) -> jax.Array:
        mean = jnp.full(len(gramian), 1.0 / len(gramian), gramian.dtype)
        if radius == 0.0:
            return mean
        inside, length = solvers.conflict_averse(gramian, radius)
        greatest = jnp.max(jnp.diagonal(gramian))
        of_mean = jnp.sqrt(jnp.maximum(solvers.quadratic(gramian, mean) / jnp.where(greatest > 0.0, greatest, 1.0), 0.0))
        # Where the hull holds 0, no direction helps all: the paper's step is undefined there, and this one rests.
        is_some = length > 10.0 * jnp.finfo(gramian.dtype).eps ** 0.5
        return jnp.where(is_some, mean + radius * of_mean / jnp.where(is_some, length, 1.0) * inside, 0.0)

    return of_gramian("cagrad", _plain(weights), **options)


def imtl_g(**options: Unpack[Options]) -> Weighting:
    """Give the step the same projection on all gradients (IMTL-G; Liu et al., 2021; for dependent gradients Quinton and
    Rey, 2024).

    Weights are G^+ d / sum(G^+ d), d_i = |g_i|: they sum to 1 and may be negative. No gradient is favoured for its length or
    for the company it keeps. Closed form. Where gradients are opposed, as on the Pareto front, the pseudo-inverse jumps, and
    the step with it.

    Args:
        options: See `Options`.
    """

    def weights(gramian: jax.Array) -> jax.Array:
        raw = jnp.dot(
            solvers.pseudo_inverse(gramian),
            jnp.sqrt(jnp.maximum(jnp.diagonal(gramian), 0.0)),
            precision=jax.lax.Precision.HIGHEST,
        )
        total = jnp.sum(raw)
        is_some = jnp.abs(total) > 10.0 * jnp.finfo(gramian.dtype).eps * jnp.sum(jnp.abs(raw))
        return jnp.where(is_some, raw / jnp.where(is_some, total, 1.0), 0.0)

    return of_gramian("imtl_g", _plain(weights), **options)


def nash_mtl(max_norm: float | None = None, **options: Unpack[Options]) -> Weighting:
    """Take the step that losses would agree on as players of a bargaining game (Nash-MTL; Navon et al., 2022, algorithm 1).

    Weights solve G a = 1 / a, a > 0: the projection of the step on each gradient is in inverse proportion to its weight, and
    the result does not depend on the losses' units. The step's length is sqrt(K), however small the gradients, so let the
    learning rate fall. The paper approximates this by a sequence of convex programmes; here it is solved, by Newton's method.

    Args:
        max_norm: Greatest length of the step, as in the authors' code, where it is 1; None as in the paper.
        options: See `Options`.

    Raises:
        RequestError: ``max_norm`` is not positive.
    """
    if max_norm is not None and not max_norm > 0.0:
        raise RequestError(f"max_norm of weighting nash_mtl must be greater than 0, not {max_norm}")

    def weights(gramian: jax.Array) -> jax.Array:
        found = solvers.bargain(gramian, jnp.ones(len(gramian), gramian.dtype))
        if max_norm is None:
            return found
        length = jnp.sqrt(jnp.maximum(solvers.quadratic(gramian, found), 0.0))
        return found * jnp.minimum(1.0, max_norm / jnp.where(length > 0.0, length, max_norm))

    return of_gramian("nash_mtl", _plain(weights), **options)


def fairgrad(alpha: float = 2.0, **options: Unpack[Options]) -> Weighting:
    """Share the decrease fairly among the losses (FairGrad; Ban and Ji, 2024, eq. 4).

    Weights solve G w = w^(-1/alpha): the step maximises the sum of <g_i, d>^(1 - alpha) / (1 - alpha). Alpha = 1 is `nash_mtl`;
    towards infinity the least decrease counts, as with `mgda`.

    Args:
        alpha: Kind of fairness.
        options: See `Options`.

    Raises:
        RequestError: ``alpha`` is not positive.
    """
    if not alpha > 0.0:
        raise RequestError(f"alpha of weighting fairgrad must be greater than 0, not {alpha}; use uniform for 0")

    def weights(gramian: jax.Array) -> jax.Array:
        return solvers.bargain(gramian, jnp.ones(len(gramian), gramian.dtype), alpha)

    return of_gramian("fairgrad", _plain(weights), **options)


def aligned_mtl(**options: Unpack[Options]) -> Weighting:
    """Make the gradients orthogonal and equally long, as little as that takes (Aligned-MTL; Senushkin et al., 2023).

    With eigenvalues l and eigenvectors V of the Gramian, weights are sqrt(l_min) V l^(-1/2) V^T / K, over the eigenvalues that
    are not 0: principal components of all gradients get the length of the smallest, so that the step is stable (algorithm 1).
    Closed form. Steps are as short as the smallest component.

    Args:
        options: See `Options`.
    """

    def weights(gramian: jax.Array) -> jax.Array:
        count = len(gramian)
        values, vectors = jnp.linalg.eigh(gramian)
        some = values > count * jnp.finfo(gramian.dtype).eps * jnp.max(values)
        inverse = jnp.where(some, 1.0 / jnp.sqrt(jnp.where(some, values, 1.0)), 0.0)
        least = jnp.sqrt(jnp.min(jnp.where(some, values, jnp.inf)))
        mean = jnp.full(count, 1.0 / count, gramian.dtype)
        components = jnp.dot(vectors.T, mean, precision=jax.lax.Precision.HIGHEST)
        found = jnp.dot(vectors, inverse * components, precision=jax.lax.Precision.HIGHEST)
        return jnp.where(jnp.any(some), jnp.where(jnp.isfinite(least), least, 0.0) * found, mean)

    return of_gramian("aligned_mtl", _plain(weights), **options)


def config(**options: Unpack[Options]) -> Weighting:
    """Take the direction of equal cosines with all gradients (ConFIG; Liu et al., 2024, eq. 2).

    With U the gradients at unit length, the direction is U^+ 1, and its length the sum of the gradients' projections on it.
    Where gradients are independent it opposes none. Closed form, made for the losses of physics-informed networks.

    Args:
        options: See `Options`.
    """

    def weights(gramian: jax.Array) -> jax.Array:
        lengths = jnp.sqrt(jnp.maximum(jnp.diagonal(gramian), 0.0))
        inverse = jnp.where(lengths > 0.0, 1.0 / jnp.where(lengths > 0.0, lengths, 1.0), 0.0)
        unit = gramian * inverse[:, None] * inverse[None, :]
        of_unit = jnp.sum(solvers.pseudo_inverse(unit, rounding=16.0), axis=1)
        raw = inverse * of_unit
        squared = solvers.quadratic(gramian, raw)
        # Of length 1 / sqrt(K) or more, unless no direction has any cosine in common: then the step is 0.
        is_some = solvers.quadratic(unit, of_unit) > 10.0 * len(gramian) * jnp.finfo(gramian.dtype).eps
        projections = jnp.sum(jnp.dot(gramian, raw, precision=jax.lax.Precision.HIGHEST))
        return jnp.where(is_some, projections / jnp.where(is_some, squared, 1.0), 0.0) * raw

    return of_gramian("config", _plain(weights), **options)
