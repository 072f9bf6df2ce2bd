"""The constraint solver that is written out number by number, and its GPU kernel, which Pallas's interpreter runs here."""

import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from nvidia import lowered_for_nvidia

from benchmarks.tasks import environments
from jaxrl_vis_envs.compilation import KERNELS_VARIABLE, env_jit
from jaxrl_vis_envs.physics import algebra, constraints, descent, line_search, newton_kernel
from jaxrl_vis_envs.physics.descent import Motion, Problem, Structure
from jaxrl_vis_envs.physics.mjx_model import mjx

DRY, CONE = 1, (4, 3)
STRUCTURE = Structure(
    joints=4,
    mass=((0, 0), (1, 0), (1, 1), (2, 0), (2, 2), (3, 3)),
    rows=((0, 1, 2, 3), (1,), (3,), (0, 1, 2, 3), *[(0, 1, 2, 3)] * 3),
    equalities=1,
    frictions=1,
    cones=(CONE,),
    apart=(),
    iterations=12,
    warm=True,
    exact=True,
)


def problems(count: int, seed: int = 0) -> Problem:
    """Random ones of `STRUCTURE`, float64: an equality, dry friction, a limit, a contact without friction, and one with."""
    rng = np.random.default_rng(seed)
    joints, rows = STRUCTURE.joints, len(STRUCTURE.rows)
    roots = rng.normal(size=(count, joints, joints))
    mass = roots @ roots.transpose(0, 2, 1) + 0.5 * np.eye(joints)
    places = np.zeros((joints, joints), bool)
    places[tuple(zip(*STRUCTURE.mass))] = True
    mass = np.where(places | places.T, mass, 0.0) + 2.0 * np.eye(joints)
    columns = np.array([[joint in row for joint in range(joints)] for row in STRUCTURE.rows])
    return Problem(
        mass=mass,
        force=rng.normal(0, 5, (count, joints)),
        warm=rng.normal(0, 5, (count, joints)),
        damping=rng.uniform(0, 1, (count, joints)),
        jacobian=rng.normal(size=(count, rows, joints)) * columns,
        stiffness=10 ** rng.uniform(-1, 2, (count, rows)),
        target=rng.normal(0, 3, (count, rows)),
        most=np.where(np.arange(rows) == DRY, rng.uniform(0.1, 3, (count, rows)), 0.0),
        cone=np.tile(rng.uniform(0.5, 1.5, (count, 1, 1)), (1, 1, 6)),
    )


def cost(problem: Problem, acceleration: np.ndarray) -> tuple[float, str]:
    """The cost of one problem, as MuJoCo's documentation has it, and where the contact is: free, stuck or sliding."""
    x = problem.jacobian @ acceleration - problem.target
    total = 0.5 * acceleration @ problem.mass @ acceleration - problem.force @ acceleration
    squares = 0.5 * problem.stiffness * x**2
    knee = problem.most[DRY] / problem.stiffness[DRY]
    dry = squares[DRY] if abs(x[DRY]) < knee else problem.most[DRY] * (abs(x[DRY]) - 0.5 * knee)
    total += squares[0] + dry + sum(squares[row] for row in (2, 3) if x[row] < 0)
    first, size = CONE
    friction = problem.cone[0, 0]
    normal, tangent = friction * x[first], np.linalg.norm(problem.cone[0, 1:size] * x[first + 1 : first + size])
    if normal >= friction * tangent:
        return total, "free"
    if friction * normal + tangent <= 0:
        return total + squares[first : first + size].sum(), "stuck"
    sliding = problem.stiffness[first] / (friction**2 * (1 + friction**2))
    return total + 0.5 * sliding * (normal - friction * tangent) ** 2, "sliding"


def solve_plainly(structure: Structure, problem: Problem) -> Motion:
    motion = descent.solve(structure, descent.numbers_of(structure, lambda name, *place: getattr(problem, name)[place]))
    return Motion(*map(jnp.stack, motion))


@pytest.fixture(scope="module")
def solved() -> tuple[Problem, Motion]:
    given = problems(300)
    # With one stiffness in all rows of a contact, as MuJoCo has it: the cost is then continuous.
    given.stiffness[:, CONE[0] :] = given.stiffness[:, CONE[0] : CONE[0] + 1]
    given.cone[:, :, 0] = given.cone[:, :, 1]
    arrays = jax.tree.map(lambda array: jnp.asarray(array, jnp.float32), given)
    return given, env_jit(jax.vmap(functools.partial(solve_plainly, STRUCTURE)))(arrays)


def test_no_acceleration_near_the_solution_costs_less(solved):
    given, motion = solved
    rng = np.random.default_rng(1)
    where = {"free": 0, "stuck": 0, "sliding": 0}
    for index, acceleration in enumerate(np.asarray(motion.acceleration, np.float64)):
        problem = Problem(*(array[index] for array in given))
        least, place = cost(problem, acceleration)
        where[place] += 1
        for size in (1e-3, 1e-2, 0.1, 1.0):
            nearby = acceleration + size * rng.normal(size=(20, STRUCTURE.joints))
            assert min(cost(problem, other)[0] for other in nearby) > least - 1e-4 * size
    assert min(where.values()) > 20, where


def test_the_forces_are_those_of_the_accelerations(solved):
    given, motion = solved
    free = np.linalg.solve(given.mass, given.force[..., None])[..., 0]
    np.testing.assert_allclose(motion.free, free, rtol=1e-3, atol=1e-3)
    balance = np.einsum("bij,bj->bi", given.mass, motion.acceleration) - given.force - motion.force
    assert np.abs(balance).max() < 2e-2 and np.median(np.abs(balance)) < 1e-5
    damped_mass = given.mass + np.stack([np.diag(damping) for damping in given.damping])
    damped = np.linalg.solve(damped_mass, (given.force + np.asarray(motion.force))[..., None])[..., 0]
    np.testing.assert_allclose(motion.damped, damped, rtol=1e-3, atol=1e-3)


def test_rows_that_are_added_one_by_one_change_nothing():
    """The factorized matrix of a tree, with and without the rows that would fill in its zeros."""
    rng = np.random.default_rng(2)
    given = problems(1)
    mass = {place: jnp.float32(given.mass[0][place]) for place in STRUCTURE.mass}
    rows = rng.normal(size=(2, 4))
    right = rng.normal(size=4)
    added = [dict(enumerate(map(jnp.float32, row))) for row in rows]
    solution = algebra.solve_positive(mass, list(map(jnp.float32, right)), added)
    np.testing.assert_allclose(solution, np.linalg.solve(given.mass[0] + rows.T @ rows, right), rtol=1e-4, atol=1e-5)


def test_dry_friction_is_not_jumped_over():
    """A slope that turns within a thousandth of the line, between two flat stretches, whose own zeros are outside of it."""

    def slope_at(length):
        knee = jnp.clip(1000.0 * (length - 0.3), -1.0, 1.0)
        return knee + 0.1 * (length - 0.3), jnp.where(jnp.abs(length - 0.3) < 1e-3, 1000.1, 0.1)

    corners = [jnp.float32(0.299), jnp.float32(0.301), jnp.float32(-4.0)]
    assert float(line_search.lowest(slope_at, corners, jnp.float32(1.0))) == pytest.approx(0.3, abs=1e-5)


@functools.partial(jax.jit, static_argnums=5)
def lowest_over_parabolas(residual, along, stiffness, first, second, in_kernel):
    def slope_at(length):
        there = residual + length * along
        acting = jnp.where(there < 0, stiffness, 0.0) * along
        return first + second * length + acting @ there, second + acting @ along

    return line_search.lowest(
        slope_at, list(-residual / along), jnp.float32(1.0), matters=jnp.bool_(True) if in_kernel else None
    )


@pytest.mark.parametrize("in_kernel", [False, True])
def test_the_line_search_finds_the_least_cost(in_kernel):
    """Over parabolas of 1 to 12 constraints that start or end along the line."""
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


def test_the_kernel_has_the_same_motion(solved):
    given, motion = solved
    first = jax.tree.map(lambda array: jnp.asarray(array[:4], jnp.float32).reshape(2, 2, *array.shape[1:]), given)
    # Two axes, as in training: seeds and environments.
    kernel = functools.partial(newton_kernel.solve, STRUCTURE, interpret=True)
    for ours, theirs in zip(jax.jit(jax.vmap(jax.vmap(kernel)))(first), motion, strict=True):
        np.testing.assert_allclose(ours.reshape(4, -1), theirs[:4], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("name", ["FingerTurn", "HandReach", "FetchReach"])
def test_the_kernel_of_each_task_is_one_for_nvidia(name, monkeypatch):
    monkeypatch.delenv(KERNELS_VARIABLE, raising=False)
    env = environments.make(name)
    structure = constraints.structure_of(mjx.put_model(env.mj_model), env.exact_contacts)
    joints, rows = structure.joints, len(structure.rows)
    shapes = [(joints, joints), *[(joints,)] * 3, (rows, joints), *[(rows,)] * 3, (len(structure.cones), 6)]
    arrays = Problem(*(jax.ShapeDtypeStruct((8, *shape), jnp.float32) for shape in shapes))
    program = jax.jit(jax.vmap(functools.partial(newton_kernel.solve, structure)))
    assert lowered_for_nvidia(lambda: program.trace(arrays)).count("solve_constraints") >= 1


def test_the_hand_has_few_rows_that_tie_any_joint_to_any_other():
    env = environments.make("HandReach")
    structure = constraints.structure_of(mjx.put_model(env.mj_model), exact=True)
    assert len(structure.apart) == 8 and not structure.cones
    assert len(structure.mass) < 120  # of 300, below the diagonal of 24 joints
    assert {len(row) for row in structure.rows[:28]} == {1, 2}


def loop_of_numpy(first, last, body, state):
    for number in range(first, last):
        state = body(number, state)
    return state


def test_a_problem_of_the_hand_is_solved(monkeypatch):
    """24 joints: a tree's factorization, and contacts added one by one.

    NumPy does the arithmetic, in float32, too: to compile it takes minutes, and JAX takes ten seconds for it number by number.
    """
    for module in (algebra, descent, line_search):
        monkeypatch.setattr(module, "jnp", np)
    for module in (descent, line_search):
        monkeypatch.setattr(module, "jax", SimpleNamespace(lax=SimpleNamespace(fori_loop=loop_of_numpy)))
    env = environments.make("HandReach")
    structure = constraints.structure_of(mjx.put_model(env.mj_model), exact=True)._replace(iterations=10, warm=False)
    rng = np.random.default_rng(3)
    count, joints, rows = 8, structure.joints, len(structure.rows)
    places = np.zeros((joints, joints), bool)
    places[tuple(zip(*structure.mass))] = True
    mass = np.where(places | places.T, rng.uniform(-0.1, 0.1, (count, joints, joints)), 0.0)
    mass = 0.5 * (mass + mass.transpose(0, 2, 1)) + np.eye(joints)
    columns = np.array([[joint in row for joint in range(joints)] for row in structure.rows])
    given = Problem(
        mass=mass,
        force=rng.normal(0, 1, (count, joints)),
        warm=np.zeros((count, joints)),
        damping=rng.uniform(0, 1, (count, joints)),
        jacobian=rng.normal(size=(count, rows, joints)) * columns,
        stiffness=10 ** rng.uniform(0, 2, (count, rows)),
        target=rng.normal(0, 1, (count, rows)),
        most=np.zeros((count, rows)),
        cone=np.zeros((count, 0, 6)),
    )
    given = Problem(*(array.astype(np.float32) for array in given))
    numbers = descent.numbers_of(structure, lambda name, *place: getattr(given, name)[(slice(None), *place)])
    motion = Motion(*(np.stack(part, axis=1) for part in descent.solve(structure, numbers)))
    assert motion.acceleration.dtype == np.float32
    residual = np.einsum("brj,bj->br", given.jacobian, motion.acceleration) - given.target
    pull = np.where(residual < 0, -given.stiffness * residual, 0.0)
    assert (pull[:, 28:] > 0).any(axis=1).all() and (pull[:, 28:] == 0).any()
    force = np.einsum("brj,br->bj", given.jacobian, pull)
    balance = np.einsum("bij,bj->bi", mass, motion.acceleration) - given.force - force
    assert np.abs(balance).max() < 1e-3 * np.abs(force).max()
    np.testing.assert_allclose(motion.force, force, atol=1e-3 * np.abs(force).max())
