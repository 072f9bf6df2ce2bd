"""Newton's method for constraint forces, written out number by number: a number is one array over the episodes of a batch.

Written so, all of it is arithmetic without memory in between, and one GPU kernel (`newton_kernel`) where a batch of small
matrices takes a library hundreds. Zeros that the structure of the model brings are never computed with (`algebra`).

Source: the primal problem of MuJoCo's documentation, "Computation", constraint model; Newton's method as there.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxrl_vis_envs.physics.algebra import (
    Matrix,
    Numbers,
    add_product,
    add_square,
    dot,
    inner,
    product,
    ratio,
    solve_positive,
    total,
)
from jaxrl_vis_envs.physics.cones import Cone, cone_at
from jaxrl_vis_envs.physics.line_search import lowest

# Where no corners are looked at. After these, steps of the hand are at the lowest point but for rounding errors.
_FEW_LINE_SEARCH_STEPS = 7
_ROUNDING = 1.2e-7  # of float32


class Structure(NamedTuple):
    """What is known of a model's constraint problem before it runs. Joints are those of one degree of freedom.

    Attributes:
        joints: How many.
        mass: Places (row, column) of the mass matrix that are not zero, on the diagonal and below it.
        rows: For each row of the constraints' Jacobian, the joints where it may not be zero.
        equalities: The first rows, so many, which always act.
        frictions: So many rows after those: dry friction, whose force is limited.
        cones: First row and number of rows of each contact with an elliptic cone.
        apart: Rows that are added to the factorized matrix one by one, because they tie any joint to any other.
        iterations: Newton steps.
        warm: Whether the last accelerations may be the first guess.
        exact: Whether one more Newton step is taken whole where it makes the gradient smaller.
        corners: Whether line searches that do not converge go on from the places where the slope bends, as dry friction needs.
    """

    joints: int
    mass: tuple[tuple[int, int], ...]
    rows: tuple[tuple[int, ...], ...]
    equalities: int
    frictions: int
    cones: tuple[tuple[int, int], ...]
    apart: tuple[int, ...]
    iterations: int
    warm: bool
    exact: bool
    corners: bool = True


class Problem(NamedTuple):
    """The arrays of one problem, or their numbers.

    Attributes:
        mass: [N, N], the mass matrix.
        force: [N], on the joints, without constraints.
        warm: [N], the last accelerations.
        damping: [N], that of the joints times the time step.
        jacobian: [R, N].
        stiffness: [R], of the constraints.
        target: [R], the accelerations that constraints ask for.
        most: [R], the greatest friction in rows of dry friction.
        cone: [C, 6], friction of each cone's rows, the first one that of the normal; cones of fewer rows leave the rest unused.
    """

    mass: Any
    force: Any
    warm: Any
    damping: Any
    jacobian: Any
    stiffness: Any
    target: Any
    most: Any
    cone: Any


class Motion(NamedTuple):
    """What comes of a problem: [N] each, or numbers.

    Attributes:
        free: Accelerations without constraints.
        acceleration: With them.
        force: Of the constraints on the joints.
        damped: Accelerations with which Euler's method goes on, implicit in the damping.
    """

    free: Any
    acceleration: Any
    force: Any
    damped: Any


def numbers_of(structure: Structure, read: Callable[..., Any]) -> Problem:
    """A problem's numbers; ``read(name, *place)`` is the number at a place of one of its arrays."""
    joints, rows = range(structure.joints), range(len(structure.rows))
    first_friction = structure.equalities
    return Problem(
        mass={place: read("mass", *place) for place in structure.mass},
        force=[read("force", joint) for joint in joints],
        warm=[read("warm", joint) for joint in joints] if structure.warm else [],
        damping=[read("damping", joint) for joint in joints],
        jacobian=[{joint: read("jacobian", row, joint) for joint in structure.rows[row]} for row in rows],
        stiffness=[read("stiffness", row) for row in rows],
        target=[read("target", row) for row in rows],
        most={row: read("most", row) for row in range(first_friction, first_friction + structure.frictions)},
        cone=[[read("cone", index, part) for part in range(size)] for index, (_, size) in enumerate(structure.cones)],
    )


def solve(structure: Structure, problem: Problem, in_kernel: bool = False, exact: Any = True) -> Motion:
    """The motion under a problem's constraints, all in numbers.

    Args:
        structure: Of the problem.
        problem: Its numbers.
        in_kernel: Whether a loop carries numbers for nothing, so that none is computed twice, and whether a branch costs less
            than what is in it, so that no line is searched for the step that is taken whole. On a CPU neither is so.
        exact: If the structure is exact, whether the problem is solved so this time; True or an int32, 1 or 0.
    """
    descent = _Descent(structure, problem, in_kernel)
    free = solve_positive(problem.mass, problem.force)
    damped_mass = dict(problem.mass)
    for joint, damping in enumerate(problem.damping):
        damped_mass[joint, joint] = damped_mass[joint, joint] + damping
    if not structure.rows:
        nothing = [0.0 * number for number in free]
        return Motion(free, free, nothing, solve_positive(damped_mass, problem.force))
    acceleration, residual = free, descent.residual(free)
    if structure.warm:
        warm_residual = descent.residual(problem.warm)
        is_better = descent.cost(problem.warm, warm_residual, free) < descent.cost(free, residual, free)
        acceleration = [jnp.where(is_better, *pair) for pair in zip(problem.warm, free, strict=True)]
        residual = [jnp.where(is_better, *pair) for pair in zip(warm_residual, residual, strict=True)]
    steps = structure.iterations + exact if structure.exact else structure.iterations
    if in_kernel:
        place = jax.lax.fori_loop(0, steps, descent.improve, descent.at(acceleration, residual))
    else:

        def improve(step: Any, acceleration: tuple[Any, ...]) -> tuple[Any, ...]:
            here = descent.at(list(acceleration), descent.residual(acceleration))
            return tuple(descent.improve(step, here).acceleration)

        acceleration = list(jax.lax.fori_loop(0, steps, improve, tuple(acceleration)))
        place = descent.at(acceleration, descent.residual(acceleration))
    forces = [one + other for one, other in zip(problem.force, place.force, strict=True)]
    return Motion(free, place.acceleration, place.force, solve_positive(damped_mass, forces))


class _Place(NamedTuple):
    """Some accelerations, and what comes of them.

    Attributes:
        acceleration: Of the joints.
        residual: By how much each row differs from its target.
        force: Of the constraints on the joints.
        gradient: Of the cost.
    """

    acceleration: Numbers
    residual: Numbers
    force: Numbers
    gradient: Numbers


class _Descent:
    """The cost of a problem, and steps down from it."""

    def __init__(self, structure: Structure, problem: Problem, in_kernel: bool) -> None:
        self._structure, self._problem, self._in_kernel = structure, problem, in_kernel
        in_cones = {row for first, size in structure.cones for row in range(first, first + size)}
        self._alone = [row for row in range(len(structure.rows)) if row not in in_cones]

    def residual(self, acceleration: Sequence[Any]) -> Numbers:
        """By how much each row differs from its target."""
        rows = zip(self._problem.jacobian, self._problem.target, strict=True)
        return [dot(entries, acceleration) - target for entries, target in rows]

    def cost(self, acceleration: Numbers, residual: Numbers, free: Numbers) -> Any:
        """The cost, up to a constant."""
        problem = self._problem
        cost: Any = 0.0
        if acceleration is not free:
            inertial = product(problem.mass, acceleration)
            pairs = zip(inertial, problem.force, acceleration, free, strict=True)
            cost = 0.5 * total((inertia - force) * (there - start) for inertia, force, there, start in pairs)
        for row in self._alone:
            x, most, stiffness = residual[row], self._most(row), problem.stiffness[row]
            if most is None:
                cost = cost + 0.5 * self._acting(row, x) * x * x
            else:
                slides = self._slides(row, x)
                cost = cost + jnp.where(slides, most * (jnp.abs(x) - 0.5 * most / stiffness), 0.5 * stiffness * x * x)
        for index in range(len(self._structure.cones)):
            cone = self._cone(index, residual)
            stuck = total(problem.stiffness[row] * residual[row] * residual[row] for row in self._cone_rows(index))
            gap = cone.normal - cone.friction * cone.tangent
            cost = cost + 0.5 * jnp.where(cone.is_stuck, stuck, cone.stiffness * gap * gap)
        return cost

    def improve(self, step: Any, here: _Place) -> _Place:
        """One Newton step: as long as the cost is least along it, and the last one, if exact, whole or not at all."""
        direction = self._direction(here)
        # A line tells nothing where what there is to gain is less than rounding errors: then no further than Newton's own step.
        gain = -inner(here.gradient, direction)
        forces = zip(self._problem.force, here.force, here.acceleration, strict=True)
        work = total((jnp.abs(free) + jnp.abs(pull)) * jnp.abs(there) for free, pull, there in forces)
        is_last = step == self._structure.iterations if self._structure.exact else False

        def search() -> Any:
            tells = gain > _ROUNDING * work
            length = self._line_search(here, direction, tells)
            return jnp.where(tells, length, jnp.minimum(length, 1.0))

        if not self._structure.exact:
            length = search()
        elif self._in_kernel:
            length = jax.lax.cond(is_last, lambda: 0.0 * gain + 1.0, search)
        else:
            length = jnp.where(is_last, 1.0, search())
        moved = [start + length * part for start, part in zip(here.acceleration, direction, strict=True)]
        there = self.at(moved, self.residual(moved))
        if self._structure.exact:
            is_better = total(part * part for part in there.gradient) < total(part * part for part in here.gradient)
            is_better = is_better | jnp.logical_not(is_last)
            pairs = zip(there, here, strict=True)
            there = _Place(*([jnp.where(is_better, *pair) for pair in zip(*numbers, strict=True)] for numbers in pairs))
        return there

    def at(self, acceleration: Numbers, residual: Numbers) -> _Place:
        """Forces and gradient at some accelerations."""
        problem = self._problem
        pull: Numbers = [0.0] * len(residual)
        for row in self._alone:
            x, most, stiffness = residual[row], self._most(row), problem.stiffness[row]
            if most is None:
                pull[row] = -self._acting(row, x) * x
            else:
                pull[row] = jnp.where(self._slides(row, x), jnp.where(x < 0, most, -most), -stiffness * x)
        for index in range(len(self._structure.cones)):
            cone = self._cone(index, residual)
            for row, force in zip(self._cone_rows(index), cone.forces(), strict=True):
                pull[row] = force - jnp.where(cone.is_stuck, problem.stiffness[row], 0.0) * residual[row]
        force: Numbers = [0.0] * self._structure.joints
        for row, entries in enumerate(problem.jacobian):
            for joint, entry in entries.items():
                force[joint] = force[joint] + entry * pull[row]
        inertial = product(problem.mass, acceleration)
        gradient = [left - right - pulled for left, right, pulled in zip(inertial, problem.force, force, strict=True)]
        return _Place(acceleration, residual, force, gradient)

    def _most(self, row: int) -> Any:
        """The greatest force of a row of dry friction; None for other rows."""
        return self._problem.most.get(row)

    def _acting(self, row: int, residual: Any) -> Any:
        """A row's stiffness where it acts, 0 elsewhere."""
        stiffness = self._problem.stiffness[row]
        return stiffness if row < self._structure.equalities else jnp.where(residual < 0, stiffness, 0.0)

    def _curvature(self, row: int, residual: Any) -> Any:
        """The cost's second derivative by the residual of a row that acts by itself."""
        if self._most(row) is None:
            return self._acting(row, residual)
        return jnp.where(self._slides(row, residual), 0.0, self._problem.stiffness[row])

    def _slides(self, row: int, residual: Any) -> Any:
        """Whether dry friction is at its greatest; as in MJX, a greatest friction of 0 holds for ever."""
        most = self._problem.most[row]
        return (jnp.abs(residual) * self._problem.stiffness[row] >= most) & (most > 0)

    def _cone_rows(self, index: int) -> range:
        first, size = self._structure.cones[index]
        return range(first, first + size)

    def _cone(self, index: int, residual: Numbers) -> Cone:
        rows = self._cone_rows(index)
        return cone_at(self._problem.cone[index], [residual[row] for row in rows], self._problem.stiffness[rows.start])

    def _direction(self, place: _Place) -> Numbers:
        """Newton's direction: downhill, as far as the cost's lowest point if nothing started or ended on the way."""
        problem, apart = self._problem, self._structure.apart
        matrix: Matrix = dict(problem.mass)
        stiffness = {row: self._curvature(row, place.residual[row]) for row in self._alone}
        for row in self._alone:
            if row not in apart:
                add_square(matrix, problem.jacobian[row], stiffness[row])
        for index in range(len(self._structure.cones)):
            cone, rows = self._cone(index, place.residual), self._cone_rows(index)
            for (left, right), value in cone.curvature().items():
                stuck = jnp.where(cone.is_stuck, problem.stiffness[rows[left]], 0.0) if left == right else 0.0
                add_product(matrix, problem.jacobian[rows[left]], problem.jacobian[rows[right]], value + stuck)
        roots = [jnp.sqrt(stiffness[row]) for row in apart]
        added = [
            {j: entry * root for j, entry in problem.jacobian[row].items()} for row, root in zip(apart, roots, strict=True)
        ]
        return [-part for part in solve_positive(matrix, place.gradient, added)]

    def _line_search(self, place: _Place, direction: Numbers, tells: Any) -> Any:
        """The length of the step along ``direction`` for which the cost is least, where the line ``tells`` it."""
        matters = tells if self._in_kernel else None
        problem = self._problem
        along = [dot(entries, direction) for entries in problem.jacobian]
        pulling = {row: problem.stiffness[row] * along[row] for row in self._alone if self._most(row) is None}
        # The inertial part of the slope at the start is the gradient's less the constraints'.
        first = total((g + f) * d for g, f, d in zip(place.gradient, place.force, direction, strict=True))
        second = total(m * d for m, d in zip(product(problem.mass, direction), direction, strict=True))

        def slope_at(length: Any) -> tuple[Any, Any]:
            slope, curvature = first + length * second, second
            there = [x + length * v for x, v in zip(place.residual, along, strict=True)]
            for row in self._alone:
                x, v, most, stiffness = there[row], along[row], self._most(row), problem.stiffness[row]
                if most is None:
                    acting = pulling[row] if row < self._structure.equalities else jnp.where(x < 0, pulling[row], 0.0)
                    slope, curvature = slope + acting * x, curvature + acting * v
                else:
                    slides = self._slides(row, x)
                    slope = slope + v * jnp.where(slides, jnp.where(x < 0, -most, most), stiffness * x)
                    curvature = curvature + jnp.where(slides, 0.0, stiffness * v * v)
            for index in range(len(self._structure.cones)):
                cone, rows = self._cone(index, there), self._cone_rows(index)
                stuck_slope = total(problem.stiffness[row] * there[row] * along[row] for row in rows)
                stuck_curvature = total(problem.stiffness[row] * along[row] * along[row] for row in rows)
                cone_slope, cone_curvature = cone.along([along[row] for row in rows])
                slope = slope + jnp.where(cone.is_stuck, stuck_slope, cone_slope)
                curvature = curvature + jnp.where(cone.is_stuck, stuck_curvature, cone_curvature)
            return slope, curvature

        if not self._structure.corners:
            return lowest(slope_at, [], first, _FEW_LINE_SEARCH_STEPS, matters)
        corners: Numbers = []
        for row in self._alone[self._structure.equalities :]:
            x, v, most = place.residual[row], along[row], self._most(row)
            ends = [0.0] if most is None else [most / problem.stiffness[row], -most / problem.stiffness[row]]
            corners += [ratio(end - x, v) for end in ends]
        for index in range(len(self._structure.cones)):
            corners += self._cone(index, place.residual).corners([along[row] for row in self._cone_rows(index)])
        return lowest(slope_at, corners, first, matters=matters)
