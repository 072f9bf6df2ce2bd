"""Newton's method for constraint forces with contacts in lanes: the iterations of `physics.newton`, for one episode per warp.

A scalar of the episode is the same in all lanes; contributions of the contacts to it are summed over the lanes. The iterations
end when a step leaves the set of acting constraints unchanged: the cost is quadratic within a set, so the step has reached the
minimum. A line search ends when it has converged.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxrl_vis_envs.physics.scalar.boxes.lane_rows import COMPONENTS, LaneRows, components
from jaxrl_vis_envs.physics.scalar.sparse_algebra import (
    Column,
    Matrix,
    Row,
    add_square,
    inner,
    row_product,
    solve_positive,
    symmetric_product,
    total,
)

_MAX_STEP, _ROOT_STEPS = 8.0, 8  # of `physics.newton`
_RESOLUTION = 1e-6  # relative change of a step length below which the line search has converged


class LaneProblem(NamedTuple):
    """Constraint problem of N degrees of freedom.

    Attributes:
        mass: Mass matrix, nonzero entries on and below the diagonal.
        force: [N], forces without constraints.
        jacobian: Nonzero entries of each row of a weld or limit.
        stiffness: Stiffness of these rows.
        target: Reference accelerations of these rows.
        equalities: Number of rows of welds, which come first and always act.
        contacts: Rows of the contacts.
        coupled: Pairs (row, column) of degrees of freedom that contacts couple, row >= column.
    """

    mass: Matrix
    force: Column
    jacobian: list[Row]
    stiffness: Column
    target: Column
    equalities: int
    contacts: LaneRows
    coupled: tuple[tuple[int, int], ...]


class _Residual(NamedTuple):
    """Residuals of the rows of welds and limits, and of the contacts' four components (per lane)."""

    rows: Column
    parts: Column


def sum_lanes(number: Any) -> Any:
    """Sum over the lanes, the last axis, and broadcast the sum to all of them."""
    return jnp.broadcast_to(jnp.sum(number, axis=-1, keepdims=number.ndim > 1), number.shape)


def solve(problem: LaneProblem, free: Column, warm: Column, iterations: int) -> tuple[Column, Column]:
    """Solve a constraint problem.

    Args:
        problem: The problem.
        free: Accelerations without constraints.
        warm: Accelerations of the last step, from which the iterations start where they cost less; empty for none.
        iterations: Maximum number of Newton steps.

    Returns:
        Accelerations, and forces of the constraints on the degrees of freedom.
    """
    start = free
    if warm:
        is_better = _cost(problem, warm) < _cost(problem, free)
        start = [jnp.where(is_better, *pair) for pair in zip(warm, free, strict=True)]

    def continues(state: tuple[Any, ...]) -> Any:
        step, changes, *_ = state
        return (step < iterations) & (changes > 0)

    def improve(state: tuple[Any, ...]) -> tuple[Any, ...]:
        step, _, acceleration = state
        acceleration, changes = _improve(problem, acceleration)
        return step + 1, changes, acceleration

    _, _, acceleration = jax.lax.while_loop(continues, improve, (0, jnp.int32(1), start))
    return acceleration, [-part for part in _constraint_slope(problem, _residual(problem, acceleration))]


def _residual(problem: LaneProblem, acceleration: Column) -> _Residual:
    rows = zip(problem.jacobian, problem.target, strict=True)
    parts = zip(components(problem.contacts.jacobian, acceleration), problem.contacts.offset, strict=True)
    return _Residual([row_product(entries, acceleration) - target for entries, target in rows], [a + b for a, b in parts])


def _edges(problem: LaneProblem, parts: Column) -> list[tuple[Any, Any, Any, Any]]:
    """Return for each direction of friction the residuals of its two rows, and their stiffness where they act."""
    normal, edges = parts[0], []
    for row in range(1, COMPONENTS):
        stiffness = problem.contacts.torsional_stiffness if row == COMPONENTS - 1 else problem.contacts.stiffness
        ahead, back = normal + parts[row], normal - parts[row]
        edges.append((ahead, back, jnp.where(ahead < 0, stiffness, 0.0), jnp.where(back < 0, stiffness, 0.0)))
    return edges


def _acting_stiffness(problem: LaneProblem, rows: Column) -> Column:
    """Return the stiffness of the rows of welds and limits where they act, 0 elsewhere."""
    return [
        stiffness if row < problem.equalities else jnp.where(x < 0, stiffness, 0.0)
        for row, (x, stiffness) in enumerate(zip(rows, problem.stiffness, strict=True))
    ]


def _cost(problem: LaneProblem, acceleration: Column) -> Any:
    residual = _residual(problem, acceleration)
    inertial = symmetric_product(problem.mass, acceleration)
    cost = 0.5 * inner(acceleration, inertial) - inner(problem.force, acceleration)
    cost = cost + 0.5 * total(d * x * x for d, x in zip(_acting_stiffness(problem, residual.rows), residual.rows, strict=True))
    edges = _edges(problem, residual.parts)
    return cost + 0.5 * sum_lanes(total(d * x * x + e * y * y for x, y, d, e in edges))


def _constraint_slope(problem: LaneProblem, residual: _Residual) -> Column:
    """Return the gradient of the constraints' cost."""
    pulls: Column = [0.0] * COMPONENTS
    for row, (ahead, back, one, other) in enumerate(_edges(problem, residual.parts), start=1):
        pulls[0] = pulls[0] + (one * ahead + other * back)
        pulls[row] = one * ahead - other * back
    slope = [
        sum_lanes(total(p * g for p, g in zip(pulls, parts, strict=True) if not _is_known(g)))
        for parts in problem.contacts.jacobian
    ]
    for entries, x, stiffness in zip(problem.jacobian, residual.rows, _acting_stiffness(problem, residual.rows), strict=True):
        for joint, entry in entries.items():
            slope[joint] = slope[joint] + entry * (stiffness * x)
    return slope


def _is_known(number: Any) -> bool:
    return isinstance(number, float)


def _curvature(problem: LaneProblem, residual: _Residual) -> Matrix:
    matrix: Matrix = dict(problem.mass)
    for entries, stiffness in zip(problem.jacobian, _acting_stiffness(problem, residual.rows), strict=True):
        add_square(matrix, entries, stiffness)
    edges = _edges(problem, residual.parts)
    both = [one + other for *_, one, other in edges]
    mixed = [one - other for *_, one, other in edges]
    jacobian = problem.contacts.jacobian
    weighted = []
    for normal, *across in jacobian:
        first = total(both) * normal + total(m * g for m, g in zip(mixed, across, strict=True) if not _is_known(g))
        rest = [m * normal if _is_known(g) else m * normal + b * g for m, b, g in zip(mixed, both, across, strict=True)]
        weighted.append((first, *rest))
    for row, column in problem.coupled:
        terms = (w * g for w, g in zip(weighted[row], jacobian[column], strict=True) if not _is_known(g))
        value = sum_lanes(total(terms))
        matrix[row, column] = matrix[row, column] + value if (row, column) in matrix else value
    return matrix


def _improve(problem: LaneProblem, acceleration: Column) -> tuple[Column, Any]:
    """Take a Newton step; return the accelerations, and 1 if rows start or stop acting in it, else 0."""
    residual = _residual(problem, acceleration)
    inertial = [
        moved - force for moved, force in zip(symmetric_product(problem.mass, acceleration), problem.force, strict=True)
    ]
    slope = [one + other for one, other in zip(inertial, _constraint_slope(problem, residual), strict=True)]
    direction = [-part for part in solve_positive(_curvature(problem, residual), slope)]
    rate = _Residual(
        [row_product(entries, direction) for entries in problem.jacobian], components(problem.contacts.jacobian, direction)
    )
    linear, quadratic = inner(direction, inertial), inner(direction, symmetric_product(problem.mass, direction))
    length = _line_search(problem, residual, rate, linear, quadratic)
    moved = _Residual(*([x + length * v for x, v in zip(*pair, strict=True)] for pair in zip(residual, rate, strict=True)))
    after = [start + length * part for start, part in zip(acceleration, direction, strict=True)]
    return after, _changes(problem, residual, moved)


def _changes(problem: LaneProblem, before: _Residual, after: _Residual) -> Any:
    """Return 1 if any row starts or stops acting between two residuals, else 0: an int32 without lanes."""
    changed: Any = 0.0
    for old, new in zip(_acting_stiffness(problem, before.rows), _acting_stiffness(problem, after.rows), strict=True):
        changed = changed + jnp.abs(old - new)
    for old, new in zip(_edges(problem, before.parts), _edges(problem, after.parts), strict=True):
        changed = changed + jnp.abs(old[2] - new[2]) + jnp.abs(old[3] - new[3])
    return jnp.max(jnp.where(changed > 0, 1, 0))


def _line_search(problem: LaneProblem, residual: _Residual, rate: _Residual, linear: Any, quadratic: Any) -> Any:
    """Return the step length of minimum cost, between 0 and `_MAX_STEP`, by Newton's method within a bracket.

    Args:
        problem: The problem.
        residual: Residuals at the start.
        rate: Their change per unit of step length.
        linear: Linear coefficient of the remaining cost, ``linear * length + quadratic * length**2 / 2``.
        quadratic: Quadratic coefficient, not negative.
    """

    def slope_at(length: Any) -> tuple[Any, Any]:
        rows = [x + length * v for x, v in zip(residual.rows, rate.rows, strict=True)]
        parts = [x + length * v for x, v in zip(residual.parts, rate.parts, strict=True)]
        slope, curvature = linear + quadratic * length, quadratic
        for x, v, stiffness in zip(rows, rate.rows, _acting_stiffness(problem, rows), strict=True):
            slope, curvature = slope + stiffness * x * v, curvature + stiffness * v * v
        lane_slope: Any = 0.0
        lane_curvature: Any = 0.0
        normal = rate.parts[0]
        for row, (ahead, back, one, other) in enumerate(_edges(problem, parts), start=1):
            faster, slower = normal + rate.parts[row], normal - rate.parts[row]
            lane_slope = lane_slope + one * ahead * faster + other * back * slower
            lane_curvature = lane_curvature + one * faster * faster + other * slower * slower
        return slope + sum_lanes(lane_slope), curvature + sum_lanes(lane_curvature)

    def continues(state: tuple[Any, ...]) -> Any:
        step, is_moving, *_ = state
        return (step < _ROOT_STEPS) & (is_moving > 0)

    def narrow(state: tuple[Any, ...]) -> tuple[Any, ...]:
        step, _, low, high, length = state
        slope, curvature = slope_at(length)
        low, high = jnp.where(slope <= 0, length, low), jnp.where(slope > 0, length, high)
        onward = length - slope / jnp.where(curvature > 0, curvature, 1.0)
        after = jnp.where((onward >= low) & (onward <= high), onward, 0.5 * (low + high))
        is_moving = jnp.abs(after - length) > _RESOLUTION * jnp.abs(length)
        return step + 1, jnp.max(jnp.where(is_moving, 1, 0)), low, high, after

    zero = 0.0 * linear
    state = (0, jnp.int32(1), zero, zero + _MAX_STEP, zero + 1.0)
    return jnp.minimum(jnp.maximum(jax.lax.while_loop(continues, narrow, state)[4], 0.0), _MAX_STEP)
