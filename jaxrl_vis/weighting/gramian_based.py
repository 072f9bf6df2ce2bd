"""Weightings that need the inner products of all pairs of gradients, the Gramian [K, K]. All losses are treated alike.

Their cost is that of the Gramian (K gradients, or K backward and forward-mode passes through latents) and of a small
optimisation problem over the losses (`solvers`). They are invariant to the order of the losses and to orthogonal
transformations of the parameters. `mgda`, `upgrad` and `dualproj`, and `cagrad` with a sufficiently large radius, give
directions that oppose no gradient.
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
    check_eps,
    next_state,
    start_equal,
    to_vector,
)

Solve = Callable[[jax.Array, WeightingState], tuple[jax.Array, Any]]


class Options(TypedDict, total=False):
    """Options of all weightings that need a Gramian.

    Attributes:
        log: Whether logarithms of the losses are minimised and compared, which makes the result independent of their units.
        eps, main_eps, heads: See `Weighting`. A RequestError is raised unless ``eps`` and ``main_eps`` are positive. Default of
            ``heads`` is always: weights apply to the shared parameters alone.
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
        label: Name of the weighting.
        solve: (Gramian [K, K] of the losses or, with ``log``, of their logarithms; state) -> (weights [K], new memory). With
            ``seed``, it may sample with ``state.key``, folded with ``state.updates``.
        log: Whether logarithms of the losses are minimised and compared, which makes the result independent of their units.
        eps, main_eps, heads: See `Weighting`.
        memory: (K, dtype) -> initial memory; None if there is none.
        seed: Seed of the initial key; None for no key.
    """

    def init(names: Iterable[str], shared: Params = None) -> WeightingState:
        state = start_equal(label, names, key=None if seed is None else jax.random.key(seed))
        if memory is None:
            return state
        return state.replace(memory=memory(len(state.weights), next(iter(state.weights.values())).dtype))

    def update(losses: Losses, statistics: Any, state: WeightingState) -> tuple[Weights, WeightingState, Metrics]:
        slopes = to_vector(weighting.slopes(losses))
        vector, remembered = solve(slopes[:, None] * statistics * slopes[None, :] if log else statistics, state)
        weights = by_name(losses, vector)
        return weights, *next_state(state, weights, memory=remembered)

    weighting = check_eps(
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
    """Build a solver without memory from a function of the Gramian [K, K] that returns weights [K]."""
    return lambda gramian, state: (weights(gramian), None)


def mgda(**options: Unpack[Options]) -> Weighting:
    """Use the minimum-norm vector in the convex hull of the gradients (MGDA; Desideri, 2012; Sener and Koltun, 2018, eq. 3).

    Weights minimise |sum_i w_i g_i|, w in the simplex. If no loss can decrease without another increasing, the step is 0;
    otherwise all decrease, to first order at a common rate or faster. Small gradients get the largest weights, so that progress
    is slow near the minimum of any single loss. Suited to reaching a Pareto front rather than one optimum.

    Args:
        options: See `Options`.
    """
    return of_gramian("mgda", _plain(lambda gramian: solvers.min_norm(gramian)[0]), **options)


def upgrad(**options: Unpack[Options]) -> Weighting:
    """Project each gradient onto the cone that opposes none, and average (UPGrad; Quinton and Rey, 2024, "Jacobian Descent").

    K projections onto the dual cone, {d: <g_i, d> >= 0 for all i}. The result opposes no gradient, scales linearly with each
    gradient's norm, and is a combination of the gradients: the paper shows that no other known method has all three properties.
    A good first choice for conflicting gradients.

    Args:
        options: See `Options`.
    """

    def weights(gramian: jax.Array) -> jax.Array:
        preferences = jnp.eye(len(gramian), dtype=gramian.dtype) / len(gramian)
        return jnp.sum(jax.vmap(lambda preference: solvers.dual_cone(gramian, preference))(preferences), axis=0)

    return of_gramian("upgrad", _plain(weights), **options)


def dualproj(**options: Unpack[Options]) -> Weighting:
    """Project the mean gradient onto the cone that opposes none (DualProj; Lopez-Paz and Ranzato, 2017, eq. 11).

    The direction closest to the mean gradient among those in which no loss increases to first order. Cheaper than `upgrad`, but
    dominated by large gradients.

    Args:
        options: See `Options`.
    """

    def weights(gramian: jax.Array) -> jax.Array:
        return solvers.dual_cone(gramian, jnp.full(len(gramian), 1.0 / len(gramian), gramian.dtype))

    return of_gramian("dualproj", _plain(weights), **options)


def cagrad(radius: float = 0.5, **options: Unpack[Options]) -> Weighting:
    """Improve the worst loss within a ball around the mean gradient (CAGrad; Liu et al., 2021, algorithm 1).

    The direction d that maximises min_i <g_i, d> subject to |d - g_0| <= c |g_0|, g_0 the mean: g_0 + c |g_0| g_w / |g_w|,
    where w in the simplex minimises <g_w, g_0> + c |g_0| |g_w|. c = 0 gives the mean; for c < 1 it converges to a minimum of
    the mean loss, while improving the worst loss on the way.

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
        scaled = gramian / jnp.where(greatest > 0.0, greatest, 1.0)
        of_mean = jnp.sqrt(jnp.maximum(solvers.quadratic(scaled, mean), 0.0))
        # If the hull contains 0, no direction helps all losses: the paper's step is undefined; return 0 instead. The hull then
        # has a point much shorter than the gradients that it combines, which may themselves be short.
        combined = jnp.sqrt(jnp.dot(inside**2, jnp.diagonal(scaled)))
        is_some = length > 10.0 * jnp.finfo(gramian.dtype).eps ** 0.5 * combined
        return jnp.where(is_some, mean + radius * of_mean / jnp.where(is_some, length, 1.0) * inside, 0.0)

    return of_gramian("cagrad", _plain(weights), **options)


def imtl_g(**options: Unpack[Options]) -> Weighting:
    """Find the step with equal projections onto all gradients (IMTL-G; Liu et al., 2021; for dependent gradients Quinton and
    Rey, 2024).

    Weights are G^+ d / sum(G^+ d), d_i = |g_i|: they sum to 1 and may be negative. No gradient is favoured for its norm or its
    similarity to others. Closed form. For opposed gradients, as on the Pareto front, the pseudo-inverse is discontinuous, and
    so is the step.

    Args:
        options: See `Options`.
    """

    def weights(gramian: jax.Array) -> jax.Array:
        # Independent gradients are inverted at unit norm, so that short ones are not taken for dependent ones.
        unit, lengths = solvers.unit_gramian(gramian)
        of_unit, is_independent = solvers.pseudo_inverse(unit, rounding=16.0)
        norms = jnp.sqrt(jnp.maximum(jnp.diagonal(gramian), 0.0))
        of_dependent = jnp.dot(solvers.pseudo_inverse(gramian)[0], norms, precision=jax.lax.Precision.HIGHEST)
        raw = jnp.where(is_independent, jnp.sum(of_unit, axis=1) / lengths, of_dependent)
        total = jnp.sum(raw)
        is_some = jnp.abs(total) > 10.0 * jnp.finfo(gramian.dtype).eps * jnp.sum(jnp.abs(raw))
        return jnp.where(is_some, raw / jnp.where(is_some, total, 1.0), 0.0)

    return of_gramian("imtl_g", _plain(weights), **options)


def nash_mtl(max_norm: float | None = None, **options: Unpack[Options]) -> Weighting:
    """Use the Nash bargaining solution with the losses as players (Nash-MTL; Navon et al., 2022, algorithm 1).

    Weights solve G a = 1 / a, a > 0: the inner product of the step with each gradient is the inverse of its weight, and the
    result does not depend on the losses' units. The norm of the step is sqrt(K), no matter how small the gradients, so decay
    the learning rate. The paper approximates the solution by a sequence of convex programmes; here Newton's method computes it.

    Args:
        max_norm: Maximum norm of the step, 1 in the authors' code; None for no maximum, as in the paper.
        options: See `Options`.

    Raises:
        RequestError: ``max_norm`` is not positive.
    """
    if max_norm is not None and not max_norm > 0.0:
        raise RequestError(f"max_norm of weighting nash_mtl must be greater than 0, not {max_norm}")

    def weights(gramian: jax.Array) -> jax.Array:
        solution = solvers.bargain(gramian, jnp.ones(len(gramian), gramian.dtype))
        if max_norm is None:
            return solution
        length = jnp.sqrt(jnp.maximum(solvers.quadratic(gramian, solution), 0.0))
        return solution * jnp.minimum(1.0, max_norm / jnp.where(length > 0.0, length, max_norm))

    return of_gramian("nash_mtl", _plain(weights), **options)


def fairgrad(alpha: float = 2.0, **options: Unpack[Options]) -> Weighting:
    """Share the decrease fairly among the losses (FairGrad; Ban and Ji, 2024, eq. 4).

    Weights solve G w = w^(-1/alpha): the step maximises the sum of <g_i, d>^(1 - alpha) / (1 - alpha). Alpha = 1 is `nash_mtl`;
    in the limit of infinity only the smallest decrease counts, as with `mgda`.

    Args:
        alpha: Exponent of alpha-fairness, positive.
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
    """Make the gradients orthogonal and of equal norm with the smallest change (Aligned-MTL; Senushkin et al., 2023).

    With eigenvalues l and eigenvectors V of the Gramian, weights are the row means of sqrt(l_min) V l^(-1/2) V^T, over the
    nonzero eigenvalues: all principal components of the gradients are rescaled to the norm of the smallest, which makes the
    step stable (algorithm 1). Closed form. Steps are as short as the smallest component. Components shorter than sqrt(K eps)
    times the longest, in float32 about a thousandth, count as 0.

    Args:
        options: See `Options`.
    """

    def weights(gramian: jax.Array) -> jax.Array:
        count = len(gramian)
        values, vectors = jnp.linalg.eigh(gramian)
        some = values > count * jnp.finfo(gramian.dtype).eps * jnp.max(values)
        inverse = jnp.where(some, 1.0 / jnp.sqrt(jnp.where(some, values, 1.0)), 0.0)
        smallest = jnp.sqrt(jnp.min(jnp.where(some, values, jnp.inf)))
        mean = jnp.full(count, 1.0 / count, gramian.dtype)
        components = jnp.dot(vectors.T, mean, precision=jax.lax.Precision.HIGHEST)
        combination = jnp.dot(vectors, inverse * components, precision=jax.lax.Precision.HIGHEST)
        return jnp.where(jnp.any(some), jnp.where(jnp.isfinite(smallest), smallest, 0.0) * combination, mean)

    return of_gramian("aligned_mtl", _plain(weights), **options)


def config(**options: Unpack[Options]) -> Weighting:
    """Use the direction with equal cosines to all gradients (ConFIG; Liu et al., 2024, eq. 2).

    With U the gradients at unit norm, the direction is U^+ 1, and its norm the sum of the gradients' projections onto it. For
    linearly independent gradients it opposes none. Closed form, designed for the losses of physics-informed networks.

    Args:
        options: See `Options`.
    """

    def weights(gramian: jax.Array) -> jax.Array:
        lengths = jnp.sqrt(jnp.maximum(jnp.diagonal(gramian), 0.0))
        inverse = jnp.where(lengths > 0.0, 1.0 / jnp.where(lengths > 0.0, lengths, 1.0), 0.0)
        unit = gramian * inverse[:, None] * inverse[None, :]
        of_unit = jnp.sum(solvers.pseudo_inverse(unit, rounding=16.0)[0], axis=1)
        raw = inverse * of_unit
        squared = solvers.quadratic(gramian, raw)
        # The norm of U^+ 1 is at least 1 / sqrt(K), unless no direction has equal cosines: then the step is 0.
        is_some = solvers.quadratic(unit, of_unit) > 10.0 * len(gramian) * jnp.finfo(gramian.dtype).eps
        projections = jnp.sum(jnp.dot(gramian, raw, precision=jax.lax.Precision.HIGHEST))
        return jnp.where(is_some, projections / jnp.where(is_some, squared, 1.0), 0.0) * raw

    return of_gramian("config", _plain(weights), **options)
