"""The constraint solver of the scalar engine."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_steps import Float32Numpy, arithmetic_of, columns

import jaxrl_vis_envs
from benchmarks.tasks import environments
from jaxrl_vis_envs.physics.scalar import scalar_model, sparse_algebra, steps
from jaxrl_vis_envs.physics.scalar.solver import line_search, scalar_newton
from jaxrl_vis_envs.physics.scalar.solver.scalar_newton import Problem, Solution

DRY, CONE = 1, (4, 3)
JOINTS, ITERATIONS = 4, 12
MASS = ((0, 0), (1, 0), (1, 1), (2, 0), (2, 2), (3, 3))
ROWS = ((0, 1, 2, 3), (1,), (3,), (0, 1, 2, 3), *[(0, 1, 2, 3)] * 3)


class Arrays(NamedTuple):
    """Problem with `MASS` and `ROWS` as matrices, or a batch of problems; see `scalar_newton.Problem`."""

    mass: np.ndarray
    force: np.ndarray
    warm: np.ndarray
    damping: np.ndarray
    jacobian: np.ndarray
    stiffness: np.ndarray
    target: np.ndarray
    most: np.ndarray
    cone: np.ndarray


def problems(count: int, seed: int = 0) -> Arrays:
    """Return random problems, float64: an equality, dry friction, a limit, and contacts without and with friction in each."""
    rng = np.random.default_rng(seed)
    roots = rng.normal(size=(count, JOINTS, JOINTS))
    mass = roots @ roots.transpose(0, 2, 1) + 0.5 * np.eye(JOINTS)
    places = np.zeros((JOINTS, JOINTS), bool)
    places[tuple(zip(*MASS))] = True
    mass = np.where(places | places.T, mass, 0.0) + 2.0 * np.eye(JOINTS)
    entries = np.array([[joint in row for joint in range(JOINTS)] for row in ROWS])
    return Arrays(
        mass=mass,
        force=rng.normal(0, 5, (count, JOINTS)),
        warm=rng.normal(0, 5, (count, JOINTS)),
        damping=rng.uniform(0, 1, (count, JOINTS)),
        jacobian=rng.normal(size=(count, len(ROWS), JOINTS)) * entries,
        stiffness=10 ** rng.uniform(-1, 2, (count, len(ROWS))),
        target=rng.normal(0, 3, (count, len(ROWS))),
        most=np.where(np.arange(len(ROWS)) == DRY, rng.uniform(0.1, 3, (count, len(ROWS))), 0.0),
        cone=np.tile(rng.uniform(0.5, 1.5, (count, 1)), (1, CONE[1])),
    )


def in_scalars(arrays: Arrays) -> Problem:
    """Return one problem with scalar entries."""
    return Problem(
        mass={place: arrays.mass[place] for place in MASS},
        force=list(arrays.force),
        warm=list(arrays.warm),
        damping=list(arrays.damping),
        jacobian=[{joint: arrays.jacobian[row, joint] for joint in joints} for row, joints in enumerate(ROWS)],
        stiffness=list(arrays.stiffness),
        target=list(arrays.target),
        equalities=1,
        max_friction={DRY: arrays.most[DRY]},
        cones={CONE[0]: list(arrays.cone)},
    )


def cost(problem: Arrays, acceleration: np.ndarray) -> tuple[float, str]:
    """Return the cost of one problem by MuJoCo's documentation, and the state of the contact: free, stuck or sliding."""
    x = problem.jacobian @ acceleration - problem.target
    total = 0.5 * acceleration @ problem.mass @ acceleration - problem.force @ acceleration
    squares = 0.5 * problem.stiffness * x**2
    knee = problem.most[DRY] / problem.stiffness[DRY]
    dry = squares[DRY] if abs(x[DRY]) < knee else problem.most[DRY] * (abs(x[DRY]) - 0.5 * knee)
    total += squares[0] + dry + sum(squares[row] for row in (2, 3) if x[row] < 0)
    first, size = CONE
    friction = problem.cone[0]
    normal, tangent = friction * x[first], np.linalg.norm(problem.cone[1:size] * x[first + 1 : first + size])
    if normal >= friction * tangent:
        return total, "free"
    if friction * normal + tangent <= 0:
        return total + squares[first : first + size].sum(), "stuck"
    sliding = problem.stiffness[first] / (friction**2 * (1 + friction**2))
    return total + 0.5 * sliding * (normal - friction * tangent) ** 2, "sliding"


@pytest.fixture(scope="module", params=[False, True], ids=["plain", "in_kernel"])
def solved(request) -> tuple[Arrays, Solution]:
    given = problems(300)
    # With one stiffness in all rows of a contact, as MuJoCo has it: the cost is then continuous.
    given.stiffness[:, CONE[0] :] = given.stiffness[:, CONE[0] : CONE[0] + 1]

    def solve(arrays: Arrays) -> Solution:
        return Solution(*map(jnp.stack, scalar_newton.solve(in_scalars(arrays), ITERATIONS, True, in_kernel=request.param)))

    arrays = jax.tree.map(lambda array: jnp.asarray(array, jnp.float32), given)
    return given, jaxrl_vis_envs.jit(jax.vmap(solve))(arrays)


def test_no_acceleration_near_the_solution_costs_less(solved):
    given, solution = solved
    rng = np.random.default_rng(1)
    where = {"free": 0, "stuck": 0, "sliding": 0}
    for index, acceleration in enumerate(np.asarray(solution.acceleration, np.float64)):
        problem = Arrays(*(array[index] for array in given))
        least, place = cost(problem, acceleration)
        where[place] += 1
        for size in (1e-3, 1e-2, 0.1, 1.0):
            nearby = acceleration + size * rng.normal(size=(20, JOINTS))
            assert min(cost(problem, other)[0] for other in nearby) > least - 1e-4 * size
    assert min(where.values()) > 20, where


def test_the_forces_are_those_of_the_accelerations(solved):
    given, solution = solved
    balance = np.einsum("bij,bj->bi", given.mass, solution.acceleration) - given.force - solution.force
    assert np.abs(balance).max() < 2e-2 and np.median(np.abs(balance)) < 1e-5
    damped_mass = given.mass + np.stack([np.diag(damping) for damping in given.damping])
    damped = np.linalg.solve(damped_mass, (given.force + np.asarray(solution.force))[..., None])[..., 0]
    np.testing.assert_allclose(solution.damped, damped, rtol=1e-3, atol=1e-3)


def test_a_problem_without_damping_has_no_other_accelerations():
    problem = in_scalars(Arrays(*(array[0] for array in problems(1))))._replace(damping=[])
    with arithmetic_of(np):
        solution = scalar_newton.solve(problem, ITERATIONS, True)
        free = scalar_newton.solve(problem._replace(jacobian=[], stiffness=[], target=[], max_friction={}, cones={}), 1, False)
    assert solution.damped == solution.acceleration
    np.testing.assert_allclose(free.acceleration, np.linalg.solve(problems(1).mass[0], problem.force))
    assert free.damped == free.acceleration and not np.any(free.force)


def test_a_matrix_that_fills_in_is_divided_by():
    """The matrix is the mass matrix of a tree, plus squares of rows that couple its branches."""
    rng = np.random.default_rng(2)
    given = problems(1)
    matrix = {place: jnp.float32(given.mass[0][place]) for place in MASS}
    rows, right = rng.normal(size=(2, JOINTS)), rng.normal(size=JOINTS)
    for row in rows:
        sparse_algebra.add_square(matrix, dict(enumerate(map(jnp.float32, row))), 0.5)
    truth = given.mass[0] + 0.5 * rows.T @ rows
    solution = sparse_algebra.solve_positive(matrix, list(map(jnp.float32, right)))
    np.testing.assert_allclose(solution, np.linalg.solve(truth, right), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(sparse_algebra.symmetric_product(matrix, solution), right, rtol=1e-4, atol=1e-5)


def test_dry_friction_is_not_jumped_over():
    """The slope rises within two thousandths of the line, between two almost flat parts whose own zeros are outside of it."""

    def slope_at(length):
        knee = jnp.clip(1000.0 * (length - 0.3), -1.0, 1.0)
        return knee + 0.1 * (length - 0.3), jnp.where(jnp.abs(length - 0.3) < 1e-3, 1000.1, 0.1)

    corners = [jnp.float32(0.299), jnp.float32(0.301), jnp.float32(-4.0)]
    assert float(line_search.minimize_along_line(slope_at, corners, jnp.float32(1.0))) == pytest.approx(0.3, abs=1e-5)


@functools.partial(jax.jit, static_argnums=5)
def lowest_over_parabolas(residual, along, stiffness, first, second, in_kernel):
    def slope_at(length):
        there = residual + length * along
        acting = jnp.where(there < 0, stiffness, 0.0) * along
        return first + second * length + acting @ there, second + acting @ along

    return line_search.minimize_along_line(
        slope_at, list(-residual / along), jnp.float32(1.0), active=jnp.bool_(True) if in_kernel else None
    )


@pytest.mark.parametrize("in_kernel", [False, True])
def test_the_line_search_finds_the_least_cost(in_kernel):
    """Costs are sums of parabolas of 1 to 12 constraints that become active or inactive along the line."""
    rng = np.random.default_rng(1)
    lengths = np.linspace(0, 40, 400_001)
    for rows in (1, 3, 12) * 8:
        residual, along, stiffness = rng.normal(size=rows), rng.normal(size=rows), rng.uniform(0.1, 10, rows)
        second = rng.uniform(0.1, 1)
        first = -abs(rng.normal()) - max(np.where(residual < 0, stiffness, 0) @ (residual * along), 0.0)  # downhill

        found = lowest_over_parabolas(*(np.float32(each) for each in (residual, along, stiffness, first, second)), in_kernel)
        there = residual[:, None] + along[:, None] * lengths
        costs = first * lengths + 0.5 * second * lengths**2
        costs += 0.5 * (np.where(there < 0, stiffness[:, None], 0) * there**2).sum(axis=0)
        assert float(found) == pytest.approx(lengths[costs.argmin()], abs=1e-3)


@functools.cache
def problem_of_the_hand() -> Problem:
    """Return the problem of the hand's first step; tests use its structure."""
    env = environments.make("HandReach")
    constants = scalar_model.build_scalar_model(env._model)
    start = env.sample_start(jax.random.key(0))
    state = steps.JointState(*(columns(np.asarray(part)[None]) for part in (start.qpos, start.qvel, start.qacc, start.qacc)))
    control = columns(np.zeros((1, env.mj_model.nu)))
    with arithmetic_of(Float32Numpy()):
        inputs = steps.StepInputs(0.01, control, columns(np.zeros((1, 24))), {})
        problem, _ = steps.constraint_problem(constants, state, inputs)
    return problem


def test_most_constraints_of_the_hand_tie_few_joints():
    problem = problem_of_the_hand()
    assert len(problem.jacobian) > 28 and not problem.cones and not problem.equalities
    assert len(problem.mass) < 120  # of 300, below the diagonal of 24 joints
    assert {len(row) for row in problem.jacobian[:28]} == {1, 2}
    assert max(len(row) for row in problem.jacobian[28:]) <= 12


def test_a_problem_of_the_hand_is_solved():
    """The hand has 24 joints: contacts fill in the factorization of a tree.

    NumPy computes it, in float32, too: compilation takes minutes, and JAX without compilation takes ten seconds.
    """
    structure = problem_of_the_hand()
    rng = np.random.default_rng(3)
    count, joints, rows = 8, len(structure.force), len(structure.jacobian)

    def draw(low: float, high: float) -> np.ndarray:
        return rng.uniform(low, high, count).astype(np.float32)

    problem = Problem(
        mass={(one, other): draw(-0.1, 0.1) + np.float32(one == other) for one, other in structure.mass},
        force=[draw(-1.5, 1.5) for _ in range(joints)],
        warm=[],
        damping=[draw(0, 1) for _ in range(joints)],
        jacobian=[{joint: draw(-1.5, 1.5) for joint in row} for row in structure.jacobian],
        stiffness=[10 ** draw(0, 2) for _ in range(rows)],
        target=[draw(-1.5, 1.5) for _ in range(rows)],
        equalities=0,
        max_friction={},
        cones={},
    )
    with arithmetic_of(np):
        solution = Solution(*(np.stack(part, axis=1) for part in scalar_newton.solve(problem, 10, True)))
    assert solution.acceleration.dtype == np.float32
    mass, jacobian = np.zeros((count, joints, joints)), np.zeros((count, rows, joints))
    for (one, other), value in problem.mass.items():
        mass[:, one, other] = mass[:, other, one] = value
    for row, entries in enumerate(problem.jacobian):
        for joint, value in entries.items():
            jacobian[:, row, joint] = value
    residual = np.einsum("brj,bj->br", jacobian, solution.acceleration) - np.stack(problem.target, axis=1)
    pull = np.where(residual < 0, -np.stack(problem.stiffness, axis=1) * residual, 0.0)
    assert (pull[:, 28:] > 0).any(axis=1).all() and (pull[:, 28:] == 0).any()
    force = np.einsum("brj,br->bj", jacobian, pull)
    balance = np.einsum("bij,bj->bi", mass, solution.acceleration) - np.stack(problem.force, axis=1) - force
    assert np.abs(balance).max() < 1e-3 * np.abs(force).max()
    np.testing.assert_allclose(solution.force, force, atol=1e-3 * np.abs(force).max())
