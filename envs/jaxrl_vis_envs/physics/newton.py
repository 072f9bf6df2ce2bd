"""Newton solver for the constraints of small trees in small matrices, the fastest on CPUs.

MJX's Newton iterations and line searches are loops that end when the last episode of a batch has converged, and each iteration
calls a library for one small matrix. Here an iteration is arithmetic on whole batches: elimination is unrolled, and the line
search is exact without a loop, since along a line the cost is a parabola between the points where a constraint starts or stops
acting. FetchReach, images included, is 1.2 times as fast on two CPU cores with 16 environments, and twice as fast with 256.

Source: the primal problem of MuJoCo's documentation, "Computation", constraint model, and its Newton solver.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.custom_batching import custom_vmap
from mujoco import mjx
from mujoco.mjx._src import support

# Elimination takes half the cube of this number of multiplications.
_MAX_JOINTS = 12
# Of 800 Newton steps in FetchReach, with joints beyond their limits and fingers in the table, none was longer than 5. If the
# gradient consists of rounding errors only, step lengths reach 1,000 and lead away from the solution.
_MAX_STEP = 8.0
# With more constraints, an iterative search replaces the exact line search, whose cost grows with the square of their number.
_MAX_CORNERS = 64
_ROOT_STEPS = 8


def supports(model: mjx.Model) -> bool:
    """Return True if this solver can replace MJX's for a model.

    It supports up to 12 hinges and slides plus one free joint, the Newton solver with pyramidal cones, and the integrators RK4
    (without a free joint) and Euler, unless implicit damping is disabled; but neither dry friction nor activations.
    """
    is_free = np.asarray(model.jnt_type) == mujoco.mjtJoint.mjJNT_FREE
    has_few_joints = model.nv - 6 * is_free.sum() <= _MAX_JOINTS and is_free.sum() <= 1 and model.nq == model.nv + is_free.sum()
    is_newton = model.opt.solver == mujoco.mjtSolver.mjSOL_NEWTON and model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    is_small = has_few_joints and model.na == 0
    is_euler = model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
    is_explicit = is_euler or (model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4 and not is_free.any())
    is_damped = not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    has_friction = np.any(model._impl.dof_hasfrictionloss) or np.any(model._impl.tendon_hasfrictionloss)
    return bool(is_newton and is_small and is_explicit and is_damped and not has_friction)


def solve(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Return ``data`` with accelerations under constraints (``qacc``) and constraint forces on joints (``qfrc_constraint``).

    Args:
        model: Model that the solver `supports`; it takes ``model.opt.iterations`` Newton steps with exact line searches.
        data: State with constraints and unconstrained accelerations. The first step starts from the latter, or from
            ``qacc_warmstart`` where that has a lower cost and warm starts are enabled.
    """
    mass, constraints = support.full_m(model, data), data._impl
    jacobian, stiffness, target = constraints.efc_J, constraints.efc_D, constraints.efc_aref
    is_equality = np.arange(jacobian.shape[0]) < constraints.ne

    def acting_stiffness(residual: jax.Array) -> jax.Array:
        """Return the stiffness of constraints that act, 0 for the others."""
        return jnp.where(is_equality | (residual < 0), stiffness, 0.0)

    def cost(acceleration: jax.Array) -> jax.Array:
        residual = _product(jacobian, acceleration) - target
        inertial = 0.5 * jnp.sum(acceleration * _product(mass, acceleration)) - jnp.sum(data.qfrc_smooth * acceleration)
        return inertial + 0.5 * jnp.sum(acting_stiffness(residual) * jnp.square(residual))

    def improve(acceleration: jax.Array, _: None) -> tuple[jax.Array, None]:
        residual = _product(jacobian, acceleration) - target
        acting = acting_stiffness(residual)
        inertial = _product(mass, acceleration) - data.qfrc_smooth
        slope = inertial + _product(jacobian.T, acting * residual)
        curvature = mass + _weighted_square(jacobian, acting)
        direction = -solve_positive(curvature, slope)
        rate = _product(jacobian, direction)
        linear, quadratic = jnp.sum(direction * inertial), jnp.sum(direction * _product(mass, direction))
        return acceleration + _line_search(residual, rate, stiffness, is_equality, linear, quadratic) * direction, None

    start = data.qacc_smooth
    if not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_WARMSTART:
        start = jnp.where(cost(data.qacc_warmstart) < cost(start), data.qacc_warmstart, start)
    acceleration = jax.lax.scan(improve, start, length=model.opt.iterations)[0]
    residual = _product(jacobian, acceleration) - target
    return data.replace(qacc=acceleration, qfrc_constraint=-_product(jacobian.T, acting_stiffness(residual) * residual))


def _product(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    """Multiply ``matrix`` [M, N] by ``vector`` [N] without a library call, which takes longer than these few sums."""
    return jnp.sum(matrix * vector, axis=1)


def _weighted_square(matrix: jax.Array, weights: jax.Array) -> jax.Array:
    """Compute ``matrix.T @ diag(weights) @ matrix`` for ``matrix`` [M, N] and ``weights`` [M]: [N, N]."""
    weighted = weights[:, None] * matrix
    if len(weights) > _MAX_CORNERS:  # above this size, a library call is faster
        return jnp.matmul(matrix.T, weighted, precision="highest")
    return jnp.sum(weighted[:, :, None] * matrix[:, None, :], axis=0)


def unconstrained_accelerations(model: mjx.Model, data: mjx.Data) -> jax.Array:
    """Return accelerations without constraints (``qacc_smooth``): [nv]."""
    return solve_positive(support.full_m(model, data), data.qfrc_smooth)


def damped_accelerations(model: mjx.Model, data: mjx.Data) -> jax.Array:
    """Return accelerations for Euler's method, implicit in the joints' damping: [nv]."""
    mass = support.full_m(model, data) + jnp.diag(model.opt.timestep * model.dof_damping)
    return solve_positive(mass, data.qfrc_smooth + data.qfrc_constraint)


def _line_search(
    residual: jax.Array, rate: jax.Array, stiffness: jax.Array, is_equality: np.ndarray, linear: jax.Array, quadratic: jax.Array
) -> jax.Array:
    """Return the step length of minimum cost, between 0 and `_MAX_STEP`.

    Args:
        residual: [R], residuals of the constraints at the start; equalities and negative residuals act.
        rate: [R], change of the residuals per unit of step length.
        stiffness: [R], stiffness of the constraints.
        is_equality: [R] bool, True for equalities.
        linear: Linear coefficient of the remaining cost, ``linear * length + quadratic * length**2 / 2``.
        quadratic: Quadratic coefficient, not negative.
    """

    def slope_at(length: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return slope and curvature of the cost."""
        moved = residual + length * rate
        acting = jnp.where(is_equality | (moved < 0), stiffness, 0.0) * rate
        return linear + quadratic * length + jnp.sum(acting * moved), quadratic + jnp.sum(acting * rate)

    if len(residual) > _MAX_CORNERS:
        return jnp.clip(_bracketed_root(slope_at), 0.0, _MAX_STEP)
    # The slope increases along the line and is linear between the corners where a constraint starts or stops acting.
    corners = jnp.where(is_equality | (rate == 0), -1.0, -residual / jnp.where(rate == 0, 1.0, rate))
    slopes = jax.vmap(slope_at)(corners)[0]
    is_before = (corners > 0) & (slopes <= 0)
    is_after = (corners > 0) & (slopes > 0)
    before = jnp.max(jnp.where(is_before, corners, 0.0))
    after = jnp.min(jnp.where(is_after, corners, jnp.inf))
    middle = jnp.where(jnp.isfinite(after), 0.5 * (before + after), before + 1.0)
    slope, curvature = slope_at(middle)
    length = middle - slope / jnp.where(curvature > 0, curvature, 1.0)  # 0 where every direction is level
    return jnp.clip(length, 0.0, _MAX_STEP)


def _bracketed_root(slope_at: Callable[[jax.Array], tuple[jax.Array, jax.Array]]) -> jax.Array:
    """Return the step length at which the slope of the cost is 0, by Newton's method within a bracket.

    Args:
        slope_at: Function from a step length to slope and curvature of the cost; the slope increases, and is not positive at 0.
    """

    def improve(bracket: tuple, _: None) -> tuple[tuple, None]:
        low, high, length = bracket
        slope, curvature = slope_at(length)
        low, high = jnp.where(slope <= 0, length, low), jnp.where(slope > 0, length, high)
        newton = length - slope / jnp.where(curvature > 0, curvature, 1.0)
        is_between = (newton >= low) & (newton <= high)
        return (low, high, jnp.where(is_between, newton, 0.5 * (low + high))), None

    start = (jnp.zeros(()), jnp.float32(_MAX_STEP), jnp.ones(()))
    return jax.lax.scan(improve, start, length=_ROOT_STEPS)[0][2]


@jax.custom_jvp
def solve_positive(matrix: jax.Array, rhs: jax.Array) -> jax.Array:
    """Solve a small positive definite system, ``matrix`` [N, N] and ``rhs`` [N]: [N].

    Forward and reverse derivatives are defined here, since JAX cannot derive them through a batching rule.
    """
    return _eliminate(matrix[None], rhs[None])[0]


@solve_positive.defjvp
def _differentiate(primals: tuple, tangents: tuple) -> tuple[jax.Array, jax.Array]:
    """Differentiate A x = b: A dx = db - dA x; A is symmetric, so the transposed system is solved by the same function."""
    matrix, right = primals
    matrix_change, right_change = tangents
    solution = solve_positive(matrix, right)
    change = jax.lax.custom_linear_solve(
        lambda vector: _product(matrix, vector),
        right_change - _product(matrix_change, solution),
        lambda _, vector: solve_positive(matrix, vector),
        symmetric=True,
    )
    return solution, change


@custom_vmap
def _eliminate(matrices: jax.Array, rhs: jax.Array) -> jax.Array:
    """Solve a batch of systems, matrices [B, N, N] and right-hand sides ``rhs`` [B, N], by Gauss-Jordan elimination: [B, N].

    The batch comes last in memory, so that arithmetic is vectorized along it. Positive definite matrices need no pivoting. An
    unrolled Cholesky factorization has fewer operations but takes longer to compile and, for 16 episodes, to run.
    """
    size = rhs.shape[-1]
    # Rows with their right-hand sides appended, without the columns that have become those of the identity.
    rows = jnp.moveaxis(jnp.concatenate([matrices, rhs[:, :, None]], axis=2), 0, 2)
    for pivot in range(size):
        row = rows[pivot, 1:] / rows[pivot, 0]
        rows = (rows[:, 1:] - rows[:, :1] * row).at[pivot].set(row)
    return rows[:, 0].T


@_eliminate.def_vmap
def _(size: int, in_batched: list[bool], matrices: jax.Array, rhs: jax.Array) -> tuple[jax.Array, bool]:
    def flat(array: jax.Array, is_batched: bool) -> jax.Array:
        batch = array if is_batched else jnp.broadcast_to(array, (size, *array.shape))
        return batch.reshape(-1, *batch.shape[2:])

    solved = _eliminate(*map(flat, (matrices, rhs), in_batched))
    return solved.reshape(size, -1, solved.shape[-1]), True
