"""MuJoCo's constraint solver for small trees as products of small matrices: what is fastest on a CPU.

MJX's Newton iterations and line searches are loops that end when the last episode of a batch is done, and each iteration calls
a library for one small matrix. Here an iteration is arithmetic on whole batches: elimination is written out, and the line
search is exact and needs no loop, since along a line the cost is a parabola between the points where a constraint starts or
ends. FetchReach, images included, is 1.2 times as fast on two CPU cores with 16 environments, and twice with 256.

`constraints` says where this solver runs, and what runs elsewhere.

Source: the primal problem of MuJoCo's documentation, "Computation", constraint model; Newton's method as there.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.custom_batching import custom_vmap
from mujoco import mjx
from mujoco.mjx._src import support

# Elimination has half the cube of this many multiplications.
_MOST_JOINTS = 12
# Of 800 Newton steps that moved anything, in FetchReach with its joints beyond their limits and its fingers in the table, none
# was longer than 5. Where only rounding errors are left, their quotients reach 1,000, and lead away from what was found.
_LONGEST = 8.0


def fits(model: mjx.Model) -> bool:
    """Whether the functions here can take the place of MJX's.

    They can for few joints of one degree of freedom, pyramidal cones, no friction in joints or tendons, no activations, and the
    Euler (with implicit damping of joints, MuJoCo's default) or Runge-Kutta integrator. Warm starts may be on or off.
    """
    is_newton = model.opt.solver == mujoco.mjtSolver.mjSOL_NEWTON and model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    is_small = model.nq == model.nv <= _MOST_JOINTS and model.na == 0
    is_explicit = model.opt.integrator in (mujoco.mjtIntegrator.mjINT_EULER, mujoco.mjtIntegrator.mjINT_RK4)
    is_damped = not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    has_friction = np.any(model._impl.dof_hasfrictionloss) or np.any(model._impl.tendon_hasfrictionloss)
    return bool(is_newton and is_small and is_explicit and is_damped and not has_friction)


def solve(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """``data`` with the accelerations under constraints (``qacc``), and their forces on the joints (``qfrc_constraint``).

    Args:
        model: A model that `fits`; it takes ``model.opt.iterations`` Newton steps, each with an exact line search.
        data: With constraints and unconstrained accelerations. The first step starts from the latter, or from
            ``qacc_warmstart`` where that costs less and the model does not disable warm starts.
    """
    mass, constraints = support.full_m(model, data), data._impl
    jacobian, stiffness, target = constraints.efc_J, constraints.efc_D, constraints.efc_aref
    is_equality = np.arange(jacobian.shape[0]) < constraints.ne

    def pulls(residual: jax.Array) -> jax.Array:
        """Stiffness of each constraint that acts, 0 of the others."""
        return jnp.where(is_equality | (residual < 0), stiffness, 0.0)

    def cost(acceleration: jax.Array) -> jax.Array:
        residual = _product(jacobian, acceleration) - target
        inertial = 0.5 * jnp.sum(acceleration * _product(mass, acceleration)) - jnp.sum(data.qfrc_smooth * acceleration)
        return inertial + 0.5 * jnp.sum(pulls(residual) * jnp.square(residual))

    def improve(acceleration: jax.Array, _: None) -> tuple[jax.Array, None]:
        residual = _product(jacobian, acceleration) - target
        acting = pulls(residual)
        inertial = _product(mass, acceleration) - data.qfrc_smooth
        slope = inertial + _product(jacobian.T, acting * residual)
        curvature = mass + jnp.sum((acting[:, None] * jacobian)[:, :, None] * jacobian[:, None, :], axis=0)
        direction = -solve_positive(curvature, slope)
        along = _product(jacobian, direction)
        first, second = jnp.sum(direction * inertial), jnp.sum(direction * _product(mass, direction))
        return acceleration + _line_search(residual, along, stiffness, is_equality, first, second) * direction, None

    start = data.qacc_smooth
    if not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_WARMSTART:
        start = jnp.where(cost(data.qacc_warmstart) < cost(start), data.qacc_warmstart, start)
    acceleration = jax.lax.scan(improve, start, length=model.opt.iterations)[0]
    residual = _product(jacobian, acceleration) - target
    return data.replace(qacc=acceleration, qfrc_constraint=-_product(jacobian.T, pulls(residual) * residual))


def _product(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    """``matrix`` [M, N] times ``vector`` [N]: [M]. For so few numbers, XLA's call of a library takes longer than the sums."""
    return jnp.sum(matrix * vector, axis=1)


def without_constraints(model: mjx.Model, data: mjx.Data) -> jax.Array:
    """What the joints of a model that `fits` would do without constraints (``qacc_smooth``): accelerations [nv]."""
    return solve_positive(support.full_m(model, data), data.qfrc_smooth)


def damped(model: mjx.Model, data: mjx.Data) -> jax.Array:
    """Accelerations [nv] with which Euler's method goes on, implicit in the damping of the joints, for a model that `fits`."""
    mass = support.full_m(model, data) + jnp.diag(model.opt.timestep * model.dof_damping)
    return solve_positive(mass, data.qfrc_smooth + data.qfrc_constraint)


def _line_search(
    residual: jax.Array, along: jax.Array, stiffness: jax.Array, is_equality: np.ndarray, first: jax.Array, second: jax.Array
) -> jax.Array:
    """The length of the step along which the cost is least, from 0 to `_LONGEST`.

    Args:
        residual: [R], of the constraints at the start; those that are negative act, and equalities always.
        along: [R], its change for a step of length 1.
        stiffness: [R].
        is_equality: [R] bool.
        first: The rest of the cost is ``first * length + second * length**2 / 2``.
        second: Not negative.
    """

    def slope_at(length: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Slope and curvature of the cost."""
        there = residual + length * along
        acting = jnp.where(is_equality | (there < 0), stiffness, 0.0) * along
        return first + second * length + jnp.sum(acting * there), second + jnp.sum(acting * along)

    # The slope grows along the line, with corners where a constraint starts or ends. Between two of them it is straight.
    corners = jnp.where(is_equality | (along == 0), -1.0, -residual / jnp.where(along == 0, 1.0, along))
    slopes = jax.vmap(slope_at)(corners)[0]
    is_before = (corners > 0) & (slopes <= 0)
    is_after = (corners > 0) & (slopes > 0)
    before = jnp.max(jnp.where(is_before, corners, 0.0))
    after = jnp.min(jnp.where(is_after, corners, jnp.inf))
    middle = jnp.where(jnp.isfinite(after), 0.5 * (before + after), before + 1.0)
    slope, curvature = slope_at(middle)
    length = middle - slope / jnp.where(curvature > 0, curvature, 1.0)  # 0 where every direction is level
    return jnp.clip(length, 0.0, _LONGEST)


@jax.custom_jvp
def solve_positive(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """``matrix`` [N, N], small and positive definite, divides ``right`` [N]: [N].

    Has derivatives of both kinds, forward and reverse, which JAX cannot find through a rule for batches.
    """
    return _eliminate(matrix[None], right[None])[0]


@solve_positive.defjvp
def _differentiate(primals: tuple, tangents: tuple) -> tuple[jax.Array, jax.Array]:
    """Of A x = b: A dx = db - dA x, and A, which is symmetric, divides what comes back in reverse, too."""
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
def _eliminate(matrices: jax.Array, rights: jax.Array) -> jax.Array:
    """`solve_positive` of a batch: matrices [B, N, N] and right sides [B, N] -> [B, N], by Gauss-Jordan elimination.

    The batch comes last in memory, so that all arithmetic is along it. A positive definite matrix needs no pivots. Cholesky's
    factorization, written out number by number, has fewer operations, and takes longer to compile and, for 16 episodes, to run.
    """
    size = rights.shape[-1]
    # Rows, with the right side at their ends; columns that are those of a unit matrix are left out.
    rows = jnp.moveaxis(jnp.concatenate([matrices, rights[:, :, None]], axis=2), 0, 2)
    for pivot in range(size):
        row = rows[pivot, 1:] / rows[pivot, 0]
        rows = (rows[:, 1:] - rows[:, :1] * row).at[pivot].set(row)
    return rows[:, 0].T


@_eliminate.def_vmap
def _(size: int, in_batched: list[bool], matrices: jax.Array, rights: jax.Array) -> tuple[jax.Array, bool]:
    def flat(array: jax.Array, is_batched: bool) -> jax.Array:
        every = array if is_batched else jnp.broadcast_to(array, (size, *array.shape))
        return every.reshape(-1, *every.shape[2:])

    solved = _eliminate(*map(flat, (matrices, rights), in_batched))
    return solved.reshape(size, -1, solved.shape[-1]), True
