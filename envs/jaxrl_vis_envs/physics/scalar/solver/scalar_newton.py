"""Newton's method for constraint forces in scalars: a scalar is an array over a batch of episodes.

The code is unrolled arithmetic without intermediate arrays in memory. It becomes part of one GPU kernel (`steps_kernel`), where
a library would launch hundreds for a batch of small matrices. Structural zeros generate no operations (`sparse_algebra`).

Source: the primal problem of MuJoCo's documentation, "Computation", constraint model, and its Newton solver.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxrl_vis_envs.physics.scalar.solver.friction_cones import Cone, evaluate_cone
from jaxrl_vis_envs.physics.scalar.solver.line_search import minimize_along_line
from jaxrl_vis_envs.physics.scalar.sparse_algebra import (
    Column,
    Matrix,
    Row,
    add_product,
    add_square,
    inner,
    row_product,
    safe_divide,
    solve_positive,
    symmetric_product,
    total,
)

# For problems without corners. After these, steps of the hand are at the minimum up to rounding errors.
_SMOOTH_LINE_SEARCH_STEPS = 7
_EPSILON = 1.2e-7  # of float32


class Problem(NamedTuple):
    """Constraint problem of N joints and R rows. Keys of dictionaries are structure; values are scalars.

    Rows are ordered: equalities, dry friction, limits, contacts.

    Attributes:
        mass: Mass matrix, nonzero entries on and below the diagonal.
        force: [N], forces on the joints without constraints.
        warm: [N], accelerations of the last step; empty to start from the unconstrained ones.
        damping: [N], damping of the joints times the time step; empty if the integrator is explicit in the damping.
        jacobian: [R], nonzero entries of each row.
        stiffness: [R], ``efc_D``.
        target: [R], reference accelerations.
        equalities: Number of equality rows, which always act.
        max_friction: Maximum force of each row of dry friction, by row.
        cones: Friction of the rows of each elliptic contact, normal first, by the contact's first row.
    """

    mass: Matrix
    force: Column
    warm: Column
    damping: Column
    jacobian: list[Row]
    stiffness: Column
    target: Column
    equalities: int
    max_friction: Row
    cones: dict[int, Sequence[Any]]


class Solution(NamedTuple):
    """Solution of a problem, [N] each.

    Attributes:
        acceleration: Accelerations under the constraints.
        force: Constraint forces on the joints.
        damped: Accelerations for Euler's method, implicit in the damping; ``acceleration`` for a problem without ``damping``.
    """

    acceleration: Column
    force: Column
    damped: Column


def solve(problem: Problem, iterations: int, exact: Any, in_kernel: bool = False) -> Solution:
    """Solve a constraint problem.

    Args:
        problem: The problem.
        iterations: Number of Newton steps with a line search.
        exact: Take one more, full Newton step where it reduces the gradient (see `mjx_model.step`): a bool, or an int32 scalar,
            1 or 0, that is known only at run time.
        in_kernel: Generate code for a GPU kernel: loops carry intermediate values, since registers are free, and the line
            search is skipped by a branch for the full step. On a CPU, recomputation and selection are faster.
    """
    free = solve_positive(problem.mass, problem.force)
    damped_mass = dict(problem.mass)
    for joint, damping in enumerate(problem.damping):
        damped_mass[joint, joint] = damped_mass[joint, joint] + damping
    if not problem.jacobian:
        zeros = [0.0 * number for number in free]
        return Solution(free, zeros, solve_positive(damped_mass, problem.force) if problem.damping else free)
    solver = _NewtonSolver(problem, iterations, exact is not False, in_kernel)
    acceleration, residual = free, solver.residual(free)
    if problem.warm:
        warm_residual = solver.residual(problem.warm)
        is_better = solver.cost(problem.warm, warm_residual, free) < solver.cost(free, residual, free)
        acceleration = [jnp.where(is_better, *pair) for pair in zip(problem.warm, free, strict=True)]
        residual = [jnp.where(is_better, *pair) for pair in zip(warm_residual, residual, strict=True)]
    steps = iterations + exact if exact is not False else iterations
    if in_kernel:
        iterate = jax.lax.fori_loop(0, steps, solver.improve, solver.evaluate(acceleration, residual))
    else:

        def improve(step: Any, acceleration: tuple[Any, ...]) -> tuple[Any, ...]:
            current = solver.evaluate(list(acceleration), solver.residual(acceleration))
            return tuple(solver.improve(step, current).acceleration)

        acceleration = list(jax.lax.fori_loop(0, steps, improve, tuple(acceleration)))
        iterate = solver.evaluate(acceleration, solver.residual(acceleration))
    if not problem.damping:
        return Solution(iterate.acceleration, iterate.force, iterate.acceleration)
    forces = [one + other for one, other in zip(problem.force, iterate.force, strict=True)]
    return Solution(iterate.acceleration, iterate.force, solve_positive(damped_mass, forces))


class _Iterate(NamedTuple):
    """Accelerations and the quantities derived from them.

    Attributes:
        acceleration: Accelerations of the joints.
        residual: Residual of each row: its acceleration minus the reference acceleration.
        force: Constraint forces on the joints.
        gradient: Gradient of the cost.
    """

    acceleration: Column
    residual: Column
    force: Column
    gradient: Column


class _NewtonSolver:
    """Cost of a problem, and Newton steps on it."""

    def __init__(self, problem: Problem, iterations: int, may_be_exact: bool, in_kernel: bool) -> None:
        self._problem, self._iterations = problem, iterations
        self._may_be_exact, self._in_kernel = may_be_exact, in_kernel
        in_cones = {row for first in problem.cones for row in self._cone_rows(first)}
        self._separate = [row for row in range(len(problem.jacobian)) if row not in in_cones]

    def residual(self, acceleration: Sequence[Any]) -> Column:
        """Return the residual of each row: its acceleration minus the reference acceleration."""
        rows = zip(self._problem.jacobian, self._problem.target, strict=True)
        return [row_product(entries, acceleration) - target for entries, target in rows]

    def cost(self, acceleration: Column, residual: Column, free: Column) -> Any:
        """Return the cost: that of the constraints, plus the inertial cost of deviating from the unconstrained ``free``."""
        problem = self._problem
        cost: Any = 0.0
        if acceleration is not free:
            inertial = symmetric_product(problem.mass, acceleration)
            terms = zip(inertial, problem.force, acceleration, free, strict=True)
            cost = 0.5 * total((inertia - force) * (value - start) for inertia, force, value, start in terms)
        for row in self._separate:
            x, bound, stiffness = residual[row], self._max_friction(row), problem.stiffness[row]
            if bound is None:
                cost = cost + 0.5 * self._acting_stiffness(row, x) * x * x
            else:
                slides = self._slides(row, x)
                cost = cost + jnp.where(slides, bound * (jnp.abs(x) - 0.5 * bound / stiffness), 0.5 * stiffness * x * x)
        for first in problem.cones:
            cone = self._cone(first, residual)
            stuck = total(problem.stiffness[row] * residual[row] * residual[row] for row in self._cone_rows(first))
            gap = cone.normal - cone.friction * cone.tangent
            cost = cost + 0.5 * jnp.where(cone.is_stuck, stuck, cone.stiffness * gap * gap)
        return cost

    def improve(self, step: Any, current: _Iterate) -> _Iterate:
        """Take Newton step number ``step``: with a line search or, for the exact step, in full if it reduces the gradient."""
        direction = self._direction(current)
        # The cost does not resolve gains below its rounding error; the step is then no longer than Newton's.
        gain = -inner(current.gradient, direction)
        forces = zip(self._problem.force, current.force, current.acceleration, strict=True)
        work = total((jnp.abs(free) + jnp.abs(pull)) * jnp.abs(value) for free, pull, value in forces)
        is_last = step == self._iterations if self._may_be_exact else False

        def search() -> Any:
            is_resolved = gain > _EPSILON * work
            length = self._line_search(current, direction, is_resolved)
            return jnp.where(is_resolved, length, jnp.minimum(length, 1.0))

        if not self._may_be_exact:
            length = search()
        elif self._in_kernel:
            length = jax.lax.cond(is_last, lambda: 0.0 * gain + 1.0, search)
        else:
            length = jnp.where(is_last, 1.0, search())
        moved = [start + length * part for start, part in zip(current.acceleration, direction, strict=True)]
        proposal = self.evaluate(moved, self.residual(moved))
        if self._may_be_exact:
            is_better = total(part * part for part in proposal.gradient) < total(part * part for part in current.gradient)
            is_better = is_better | jnp.logical_not(is_last)
            pairs = zip(proposal, current, strict=True)
            proposal = _Iterate(*([jnp.where(is_better, *pair) for pair in zip(*columns, strict=True)] for columns in pairs))
        return proposal

    def evaluate(self, acceleration: Column, residual: Column) -> _Iterate:
        """Compute forces and gradient at given accelerations."""
        problem = self._problem
        pull: Column = [0.0] * len(residual)
        for row in self._separate:
            x, bound, stiffness = residual[row], self._max_friction(row), problem.stiffness[row]
            if bound is None:
                pull[row] = -self._acting_stiffness(row, x) * x
            else:
                pull[row] = jnp.where(self._slides(row, x), jnp.where(x < 0, bound, -bound), -stiffness * x)
        for first in problem.cones:
            cone = self._cone(first, residual)
            for row, force in zip(self._cone_rows(first), cone.forces(), strict=True):
                pull[row] = force - jnp.where(cone.is_stuck, problem.stiffness[row], 0.0) * residual[row]
        force: Column = [0.0] * len(problem.force)
        for row, entries in enumerate(problem.jacobian):
            for joint, entry in entries.items():
                force[joint] = force[joint] + entry * pull[row]
        # Joints without constraints get arrays of the same shape as the others, so that loops can carry them.
        force = [0.0 * value if isinstance(part, float) else part for part, value in zip(force, acceleration, strict=True)]
        inertial = symmetric_product(problem.mass, acceleration)
        gradient = [left - right - pulled for left, right, pulled in zip(inertial, problem.force, force, strict=True)]
        return _Iterate(acceleration, residual, force, gradient)

    def _max_friction(self, row: int) -> Any:
        """Return the maximum force of a row of dry friction; None for other rows."""
        return self._problem.max_friction.get(row)

    def _acting_stiffness(self, row: int, residual: Any) -> Any:
        """Return a row's stiffness where it acts, 0 elsewhere."""
        stiffness = self._problem.stiffness[row]
        return stiffness if row < self._problem.equalities else jnp.where(residual < 0, stiffness, 0.0)

    def _curvature(self, row: int, residual: Any) -> Any:
        """Return the cost's second derivative with respect to the residual of a row outside of cones."""
        if self._max_friction(row) is None:
            return self._acting_stiffness(row, residual)
        return jnp.where(self._slides(row, residual), 0.0, self._problem.stiffness[row])

    def _slides(self, row: int, residual: Any) -> Any:
        """Return True where dry friction is saturated. As in MJX, friction with a maximum force of 0 never slides."""
        bound = self._problem.max_friction[row]
        return (jnp.abs(residual) * self._problem.stiffness[row] >= bound) & (bound > 0)

    def _cone_rows(self, first: int) -> range:
        return range(first, first + len(self._problem.cones[first]))

    def _cone(self, first: int, residual: Column) -> Cone:
        rows = [residual[row] for row in self._cone_rows(first)]
        return evaluate_cone(list(self._problem.cones[first]), rows, self._problem.stiffness[first])

    def _direction(self, iterate: _Iterate) -> Column:
        """Return the Newton direction."""
        problem = self._problem
        matrix: Matrix = dict(problem.mass)
        stiffness = {row: self._curvature(row, iterate.residual[row]) for row in self._separate}
        for row in self._separate:
            add_square(matrix, problem.jacobian[row], stiffness[row])
        for first in problem.cones:
            cone, rows = self._cone(first, iterate.residual), self._cone_rows(first)
            for (left, right), value in cone.curvature().items():
                stuck = jnp.where(cone.is_stuck, problem.stiffness[rows[left]], 0.0) if left == right else 0.0
                add_product(matrix, problem.jacobian[rows[left]], problem.jacobian[rows[right]], value + stuck)
        return [-part for part in solve_positive(matrix, iterate.gradient)]

    def _line_search(self, iterate: _Iterate, direction: Column, is_resolved: Any) -> Any:
        """Return the step length of minimum cost; in a kernel, iterate only until it has converged where ``is_resolved``."""
        active = is_resolved if self._in_kernel else None
        problem = self._problem
        rate = [row_product(entries, direction) for entries in problem.jacobian]
        pulling = {row: problem.stiffness[row] * rate[row] for row in self._separate if self._max_friction(row) is None}
        # The inertial part of the slope at the start is the gradient's less the constraints'.
        linear = total((g + f) * d for g, f, d in zip(iterate.gradient, iterate.force, direction, strict=True))
        quadratic = total(m * d for m, d in zip(symmetric_product(problem.mass, direction), direction, strict=True))

        def slope_at(length: Any) -> tuple[Any, Any]:
            slope, curvature = linear + length * quadratic, quadratic
            moved = [x + length * v for x, v in zip(iterate.residual, rate, strict=True)]
            for row in self._separate:
                x, v, bound, stiffness = moved[row], rate[row], self._max_friction(row), problem.stiffness[row]
                if bound is None:
                    acting = pulling[row] if row < problem.equalities else jnp.where(x < 0, pulling[row], 0.0)
                    slope, curvature = slope + acting * x, curvature + acting * v
                else:
                    slides = self._slides(row, x)
                    slope = slope + v * jnp.where(slides, jnp.where(x < 0, -bound, bound), stiffness * x)
                    curvature = curvature + jnp.where(slides, 0.0, stiffness * v * v)
            for start in problem.cones:
                cone, rows = self._cone(start, moved), self._cone_rows(start)
                stuck_slope = total(problem.stiffness[row] * moved[row] * rate[row] for row in rows)
                stuck_curvature = total(problem.stiffness[row] * rate[row] * rate[row] for row in rows)
                cone_slope, cone_curvature = cone.slope_along([rate[row] for row in rows])
                slope = slope + jnp.where(cone.is_stuck, stuck_slope, cone_slope)
                curvature = curvature + jnp.where(cone.is_stuck, stuck_curvature, cone_curvature)
            return slope, curvature

        if not (problem.max_friction or problem.cones):
            return minimize_along_line(slope_at, [], linear, _SMOOTH_LINE_SEARCH_STEPS, active)
        return minimize_along_line(slope_at, self._corners(iterate, rate), linear, active=active)

    def _corners(self, iterate: _Iterate, rate: Column) -> Column:
        """Return the step lengths at which rows start or stop acting, sliding or being stuck."""
        corners: Column = []
        for row in self._separate[self._problem.equalities :]:
            x, v, bound, stiffness = iterate.residual[row], rate[row], self._max_friction(row), self._problem.stiffness[row]
            ends = [0.0] if bound is None else [bound / stiffness, -bound / stiffness]
            corners += [safe_divide(end - x, v) for end in ends]
        for start in self._problem.cones:
            corners += self._cone(start, iterate.residual).corners([rate[row] for row in self._cone_rows(start)])
        return corners
