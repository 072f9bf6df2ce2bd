"""Small optimisation problems over K <= 32 losses, given the Gramian of their gradients.

    nonnegative      quadratic programme with x >= 0, by block principal pivoting; the next two are special cases
    min_norm         weights of the minimum-norm vector in the convex hull of the gradients
    dual_cone        weights of a combination's projection onto the cone of directions that oppose no gradient
    conflict_averse  weights of the hull's vector that CAGrad adds to the mean
    bargain          positive solution of G a = p a^(-1/s)
    to_simplex       projection onto the simplex

Iterative solvers run a bounded number of K x K linear solves. Gradients are first scaled to unit norm (`unit_gramian`), so that
losses with small gradients are treated as accurately as those with large ones. Gradients may be linearly dependent. All
functions support `jax.vmap`.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

_PIVOTS = 100  # 4 times the maximum observed for Gramians of 32 losses
_PATIENCE = 3  # block exchanges without progress before single ones, which always terminate (Kim and Park, 2011)
_ROOT_STEPS = 60
_NEWTON_STEPS = 60
_HALVINGS = 16


def unit_gramian(gramian: jax.Array, min_length: jax.Array | None = None) -> tuple[jax.Array, jax.Array]:
    """Scale gradients to unit norm.

    Args:
        gramian: [K, K] float.
        min_length: [K] minimum norms by which gradients are divided, relative to the largest; None for the machine epsilon.

    Returns:
        [K, K] Gramian of the scaled gradients; [K] norms of the gradients relative to the largest norm, and not less than
        ``min_length``. If all gradients vanish, the Gramian is 0 and every norm is ``min_length``.
    """
    eps = jnp.finfo(gramian.dtype).eps
    lengths = jnp.sqrt(jnp.maximum(jnp.diagonal(gramian), 0.0))
    greatest = jnp.max(lengths)
    greatest = jnp.where(greatest > 0.0, greatest, 1.0)
    relative = jnp.maximum(lengths / greatest, eps if min_length is None else min_length)
    # Divide by one factor at a time: the product of two small norms might underflow.
    return gramian / greatest / greatest / relative[:, None] / relative[None, :], relative


class _Pivots(NamedTuple):
    free: jax.Array  # [K] bool, components that need not be 0
    solution: jax.Array  # [K], may be negative until the end
    wrong: jax.Array  # [K] bool, components on the wrong side
    fewest: jax.Array  # [] int32, minimum number of wrong components so far
    patience: jax.Array  # [] int32, remaining block exchanges without progress
    steps: jax.Array  # [] int32


def nonnegative(
    matrix: jax.Array, target: jax.Array, free: jax.Array | None = None, passes: int = 3
) -> tuple[jax.Array, jax.Array]:
    """Minimise x^T M x / 2 - b^T x over x >= 0, by block principal pivoting (Kim and Park, 2011, algorithm 3).

    M may be singular: each pass adds the term r |x - x'|^2 / 2 (the proximal point method), where x' is the previous pass's
    solution, initially 0, and r is eps^(2/3) times the maximum M_ii; the factor is 2e-5 in float32 and 4e-11 in float64.

    Args:
        matrix: [K, K] float, M, positive semidefinite.
        target: [K] float, b, in its range.
        free: [K] bool, components initially assumed to be positive; None for none.
        passes: Number of iterations of the proximal point method.

    Returns:
        [K] float, x; [K] bool, components of x that are not fixed at 0.
    """
    ridge = jnp.finfo(matrix.dtype).eps ** (2 / 3) * jnp.max(jnp.diagonal(matrix))
    raised = matrix + ridge * jnp.eye(len(matrix), dtype=matrix.dtype)
    free = jnp.zeros(len(target), bool) if free is None else free
    x = jnp.zeros_like(target)
    for _ in range(passes):
        x, free = _pivot(raised, target + ridge * x, free)
    return x, free


def _pivot(matrix: jax.Array, target: jax.Array, free: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Solve the problem of `nonnegative` for a positive definite matrix, with the same arguments and results."""
    count, eps = len(target), jnp.finfo(matrix.dtype).eps

    def solve(free: jax.Array) -> tuple[jax.Array, jax.Array]:
        both = free[:, None] & free[None, :]
        system = jnp.where(both, matrix, jnp.eye(count, dtype=matrix.dtype))
        x = jnp.where(free, jnp.linalg.solve(system, jnp.where(free, target, 0.0)), 0.0)
        slack = jnp.dot(matrix, x, precision=jax.lax.Precision.HIGHEST) - target
        rounding = 10.0 * eps * (jnp.dot(jnp.abs(matrix), jnp.abs(x)) + jnp.abs(target))
        return x, jnp.where(free, x < -10.0 * eps * jnp.max(jnp.abs(x)), slack < -rounding)

    def step(state: _Pivots) -> _Pivots:
        number = jnp.sum(state.wrong, dtype=jnp.int32)
        progress = number < state.fewest
        last = jnp.arange(count) == jnp.max(jnp.where(state.wrong, jnp.arange(count), -1))
        exchanged = jnp.where(progress | (state.patience > 0), state.wrong, last)
        patience = jnp.where(progress, _PATIENCE, jnp.maximum(state.patience - 1, 0))
        free = state.free ^ exchanged
        return _Pivots(free, *solve(free), jnp.minimum(number, state.fewest), patience, state.steps + 1)

    first = _Pivots(free, *solve(free), jnp.int32(count + 1), jnp.int32(_PATIENCE), jnp.int32(0))
    last = jax.lax.while_loop(lambda state: jnp.any(state.wrong) & (state.steps < _PIVOTS), step, first)
    return jnp.maximum(last.solution, 0.0), last.free


def min_norm(
    gramian: jax.Array, free: jax.Array | None = None, passes: int = 3, min_length: jax.Array | None = None
) -> tuple[jax.Array, jax.Array]:
    """Compute the weights w >= 0, of sum 1, that minimise w^T G w.

    On the ray through w, min over t of t^2 w^T G w + (t - 1)^2 is q / (1 + q), with q = w^T G w; hence x = t w minimises
    x^T G x + (sum x - 1)^2 over x >= 0.

    Args:
        gramian: [K, K] float, positive semidefinite.
        free, passes: See `nonnegative`.
        min_length: See `unit_gramian`.

    Returns:
        [K] float, w; [K] bool, as in `nonnegative`.
    """
    unit, lengths = unit_gramian(gramian, min_length)
    per_length = jnp.min(lengths) / lengths
    x, free = nonnegative(unit + per_length[:, None] * per_length[None, :], per_length, free, passes)
    weights = per_length * x
    return weights / jnp.sum(weights), free


def dual_cone(gramian: jax.Array, preferences: jax.Array) -> jax.Array:
    """Compute the weights v of the projection of J^T u onto the dual cone, {d: J d >= 0}.

    By Proposition 1 of Quinton and Rey (2024), v minimises v^T G v subject to v >= u.

    Args:
        gramian: [K, K] float, G = J J^T.
        preferences: [K] float, u.

    Returns:
        [K] float, v.
    """
    unit, lengths = unit_gramian(gramian)
    scaled = preferences * lengths
    added, _ = nonnegative(unit, -jnp.dot(unit, scaled, precision=jax.lax.Precision.HIGHEST))
    return preferences + added / lengths


class _Bracket(NamedTuple):
    low: jax.Array  # [] t with |g_w(t)| > t
    high: jax.Array  # [] t with |g_w(t)| <= t
    at_low: jax.Array  # [] |g_w(t)| - t at low, halved if this end was kept twice
    at_high: jax.Array  # [] likewise at high
    last_kept_end: jax.Array  # [] int32, end kept by the last step: -1 low, 1 high
    free: jax.Array  # [K] bool
    error: jax.Array  # [] |g_w(t)| - t at the latest t
    steps: jax.Array


def conflict_averse(gramian: jax.Array, radius: float) -> tuple[jax.Array, jax.Array]:
    """Minimise <g_w, g_0> + c |g_0| |g_w| over w in the simplex (CAGrad; Liu et al., 2021), g_0 the mean gradient.

    |g_w| is the minimum over t > 0 of (|g_w|^2 / t + t) / 2, and for a given t the problem is that of the shortest vector in
    the hull of g_i + (t / (c |g_0|)) g_0. What remains is the root of the decreasing function |g_w(t)| - t, found by regula
    falsi with the Illinois rule.

    Args:
        gramian: [K, K] float.
        radius: c > 0.

    Returns:
        [K] float, w; [] float, |g_w|; both for gradients scaled so that the largest norm is 1.
    """
    eps = jnp.finfo(gramian.dtype).eps
    greatest = jnp.max(jnp.diagonal(gramian))
    scaled = gramian / jnp.where(greatest > 0.0, greatest, 1.0)
    to_mean = jnp.mean(scaled, axis=1)
    squared = jnp.maximum(jnp.mean(to_mean), 0.0)
    ball = jnp.maximum(radius * jnp.sqrt(squared), eps)

    def evaluate(t: jax.Array, free: jax.Array, passes: int = 1) -> tuple[jax.Array, jax.Array, jax.Array]:
        fraction = t / ball
        shifted = scaled + fraction * (to_mean[:, None] + to_mean[None, :]) + fraction**2 * squared
        # Of a gradient that is shifted close to 0, only the rounding errors of these sums are left. This minimum norm, relative
        # to their terms, keeps them below the ridge that `nonnegative` adds.
        terms = jnp.diagonal(scaled) + 2.0 * fraction * jnp.abs(to_mean) + fraction**2 * squared
        least = eps ** (1 / 6) * jnp.sqrt(terms / jnp.maximum(jnp.max(jnp.diagonal(shifted)), eps**2))
        weights, free = min_norm(shifted, free, passes, min_length=jnp.maximum(least, eps))
        return weights, jnp.sqrt(jnp.maximum(quadratic(scaled, weights), 0.0)), free

    def step(state: _Bracket) -> _Bracket:
        t = (state.low * state.at_high - state.high * state.at_low) / (state.at_high - state.at_low)
        t = jnp.where((t > state.low) & (t < state.high), t, 0.5 * (state.low + state.high))
        _, length, free = evaluate(t, state.free)
        above = length > t
        error = length - t
        at_low = jnp.where(above, error, jnp.where(state.last_kept_end == -1, 0.5 * state.at_low, state.at_low))
        at_high = jnp.where(above, jnp.where(state.last_kept_end == 1, 0.5 * state.at_high, state.at_high), error)
        low, high = jnp.where(above, t, state.low), jnp.where(above, state.high, t)
        return _Bracket(low, high, at_low, at_high, jnp.where(above, 1, -1).astype(jnp.int32), free, error, state.steps + 1)

    def is_open(state: _Bracket) -> jax.Array:
        wide = state.high - state.low > 4.0 * eps * state.high
        return wide & (jnp.abs(state.error) > 4.0 * eps * state.high) & (state.steps < _ROOT_STEPS)

    zero, one = jnp.zeros((), scaled.dtype), jnp.ones((), scaled.dtype)
    _, at_one, free = evaluate(one, jnp.zeros(len(gramian), bool))
    # If the hull contains 0, t = 0 is a root as well, but not the one wanted: treat the error there as 1.
    first = _Bracket(zero, one, one, jnp.minimum(at_one - one, -eps), jnp.int32(0), free, one, jnp.int32(0))
    last = jax.lax.while_loop(is_open, step, first)
    # The last error is that of the end that moved last.
    weights, length, _ = evaluate(jnp.where(last.last_kept_end == 1, last.low, last.high), last.free, passes=3)
    return weights, length


class _Newton(NamedTuple):
    x: jax.Array  # [K], positive
    residual: jax.Array  # [], relative
    steps: jax.Array


def bargain(gramian: jax.Array, preferences: jax.Array, exponent: float = 1.0) -> jax.Array:
    """Solve G a = p a^(-1/s) for a > 0, by Newton's method on a convex function.

    a minimises a^T G a / 2 - sum_i p_i phi(a_i), where phi'(a) = a^(-1/s); phi is the logarithm for s = 1.

    Args:
        gramian: [K, K] float.
        preferences: [K] float, p > 0.
        exponent: s > 0.

    Returns:
        [K] float, a.
    """
    eps, power = jnp.finfo(gramian.dtype).eps, 1.0 / exponent
    unit, relative = unit_gramian(gramian)
    unit = unit + len(unit) * eps * jnp.eye(len(unit), dtype=unit.dtype)  # keeps the solution finite
    greatest = jnp.sqrt(jnp.maximum(jnp.max(jnp.diagonal(gramian)), 0.0))
    lengths = relative * jnp.where(greatest > 0.0, greatest, 1.0)
    # With a = x scale / lengths, the equation is unit x = ratios x^(-power), where the maximum of ratios is 1.
    targets = preferences * lengths ** (power - 1.0)
    scale = jnp.max(targets) ** (1.0 / (1.0 + power))
    ratios = targets / jnp.max(targets)

    def objective(x: jax.Array) -> jax.Array:
        utility = jnp.log(x) if power == 1.0 else x ** (1.0 - power) / (1.0 - power)
        return 0.5 * quadratic(unit, x) - jnp.sum(ratios * utility)

    def step(state: _Newton) -> _Newton:
        pull = ratios * state.x**-power
        slope = jnp.dot(unit, state.x, precision=jax.lax.Precision.HIGHEST) - pull
        hessian = unit + jnp.diag(power * pull / state.x)
        change = -jnp.linalg.solve(hessian, slope)
        decrement = -jnp.dot(slope, change)
        # Up to 0.99 of the way to the nearest x_i = 0.
        farthest = jnp.minimum(1.0, 0.99 / jnp.maximum(jnp.max(-change / state.x), eps))
        lengths = farthest * 0.5 ** jnp.arange(_HALVINGS, dtype=state.x.dtype)
        values = jax.vmap(lambda length: objective(state.x + length * change))(lengths)
        # Close to the minimum, the objective no longer distinguishes steps, and full ones converge quadratically.
        length = jnp.where(decrement < 1e-2, farthest, lengths[jnp.argmin(values)])
        x = state.x + length * change
        pull = ratios * x**-power
        slope = jnp.dot(unit, x, precision=jax.lax.Precision.HIGHEST) - pull
        return _Newton(x, jnp.max(jnp.abs(slope) / pull), state.steps + 1)

    first = _Newton(ratios ** (1.0 / (1.0 + power)), jnp.full((), jnp.inf, unit.dtype), jnp.int32(0))
    last = jax.lax.while_loop(lambda state: (state.residual > 20.0 * eps) & (state.steps < _NEWTON_STEPS), step, first)
    return last.x * scale / lengths


def to_simplex(vector: jax.Array) -> jax.Array:
    """Project a vector [K] onto the simplex, {w >= 0, sum w = 1}."""
    ordered = jnp.sort(vector)[::-1]
    excess = (jnp.cumsum(ordered) - 1.0) / jnp.arange(1, len(vector) + 1)
    last = jnp.max(jnp.where(ordered > excess, jnp.arange(len(vector)), 0))
    return jnp.maximum(vector - excess[last], 0.0)


def quadratic(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    """Compute x^T M x, [], of a matrix [K, K] and a vector [K] at full matrix-multiplication precision."""
    precision: Any = jax.lax.Precision.HIGHEST
    return jnp.dot(vector, jnp.dot(matrix, vector, precision=precision), precision=precision)


def pseudo_inverse(gramian: jax.Array, rounding: float = 1.0) -> tuple[jax.Array, jax.Array]:
    """Compute the pseudo-inverse of a Gramian; eigenvalues up to ``rounding`` K eps times the largest count as 0.

    Args:
        gramian: [K, K] float.
        rounding: See above.

    Returns:
        [K, K] pseudo-inverse; [] bool, True if no eigenvalue counts as 0.
    """
    values, vectors = jnp.linalg.eigh(gramian)
    cut = rounding * len(gramian) * jnp.finfo(gramian.dtype).eps * jnp.max(jnp.abs(values))
    inverse = jnp.where(values > cut, 1.0 / jnp.where(values > cut, values, 1.0), 0.0)
    return jnp.matmul(vectors * inverse, vectors.T, precision=jax.lax.Precision.HIGHEST), jnp.all(values > cut)
