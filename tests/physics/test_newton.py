"""The constraint solver for small trees against MJX, NumPy and brute force, and which solver a model has."""

import copy

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import jaxrl_vis_envs
from benchmarks.tasks import environments
from jaxrl_vis_envs.compiling.compilation import kernels, tracing_for
from jaxrl_vis_envs.physics import mjx_model, newton, scalar
from jaxrl_vis_envs.physics.mjx_model import mjx


def test_the_solution_of_small_systems():
    rng = np.random.default_rng(0)
    roots = rng.normal(size=(50, 9, 9))
    matrices = roots @ roots.transpose(0, 2, 1) + 0.1 * np.eye(9)
    truth = rng.normal(size=(50, 9))
    right = np.einsum("bij,bj->bi", matrices, truth)
    solved = jax.jit(jax.vmap(newton.solve_positive))(jnp.asarray(matrices, jnp.float32), jnp.asarray(right, jnp.float32))
    np.testing.assert_allclose(solved, truth, atol=2e-3)


def test_one_matrix_for_many_right_sides():
    """Right sides have a batch axis that the matrices lack."""
    rng = np.random.default_rng(0)
    roots, right = rng.normal(size=(3, 4, 4)), rng.normal(size=(3, 5, 4))
    matrices = roots @ roots.transpose(0, 2, 1) + np.eye(4)
    solve = jax.vmap(jax.vmap(newton.solve_positive, (None, 0)))
    solved = solve(jnp.asarray(matrices, jnp.float32), jnp.asarray(right, jnp.float32))
    np.testing.assert_allclose(solved, np.linalg.solve(matrices[:, None], right[..., None])[..., 0], atol=1e-4)


def test_derivatives_of_the_solution_of_small_systems():
    """Forward and reverse derivatives of batches are correct, even if only the tangents are a batch, as in `jax.jacfwd`."""
    rng = np.random.default_rng(0)
    roots, right = rng.normal(size=(3, 4, 4)), rng.normal(size=(3, 4))
    matrices = roots @ roots.transpose(0, 2, 1) + np.eye(4)
    inverses = np.linalg.inv(matrices)
    solutions = np.einsum("bij,bj->bi", inverses, right)
    by_matrix = -np.einsum("bij,bk->bijk", inverses, solutions)  # of entry [j, k]
    for differentiate in (jax.jacfwd, jax.jacrev):
        both = jax.jit(jax.vmap(differentiate(newton.solve_positive, argnums=(0, 1))))
        of_matrix, of_right = both(jnp.asarray(matrices, jnp.float32), jnp.asarray(right, jnp.float32))
        np.testing.assert_allclose(of_matrix, by_matrix, atol=1e-4)
        np.testing.assert_allclose(of_right, inverses, atol=1e-4)


def test_a_control_step_can_be_differentiated_in_both_directions():
    env = environments.make("Reacher")
    start = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(env.reset, jax.random.key(0)))
    for differentiate in (jax.jacfwd, jax.grad):
        slope = differentiate(lambda action: env.advance(start, action).metrics["goal_distance"])
        assert jax.eval_shape(slope, jnp.zeros(env.action_size)).shape == (env.action_size,)


def test_the_line_search_finds_the_least_cost():
    """Costs are sums of parabolas of 1 to 100 constraints; some are equalities, some do not change along the line."""
    rng = np.random.default_rng(1)
    lengths = np.linspace(0, 10, 100_001)
    search = jax.jit(newton._line_search)
    for rows in (1, 3, 12, 100) * 8:
        residual, along = rng.normal(size=(2, rows))
        along[rng.random(rows) < 0.2] = 0.0
        stiffness, is_equality = rng.uniform(0.1, 10, rows), rng.random(rows) < 0.3
        second = rng.uniform(0.1, 1)
        slope = np.where(is_equality | (residual < 0), stiffness, 0) @ (residual * along)
        first = -abs(rng.normal()) - max(slope, 0.0)  # downhill at the start, as Newton's direction is
        found = search(*map(np.float32, (residual, along, stiffness)), is_equality, first, second)
        there = residual[:, None] + along[:, None] * lengths
        acting = np.where(is_equality[:, None] | (there < 0), stiffness[:, None], 0)
        costs = first * lengths + 0.5 * second * lengths**2 + 0.5 * (acting * there**2).sum(axis=0)
        assert float(found) == pytest.approx(min(lengths[costs.argmin()], newton._MAX_STEP), abs=1e-3)


def test_nothing_moves_where_nothing_pulls():
    """Where no constraint acts, the direction is 0, and so is the curvature along it."""
    still = jnp.zeros(2)
    length = newton._line_search(still, still, jnp.ones(2), np.array([False, True]), jnp.float32(0), jnp.float32(0))
    assert np.isfinite(length)


def test_a_step_is_that_of_mjx():
    """There are external forces, joints beyond their limits, and fingers in the table."""
    env = environments.make("FetchReach")
    mj_model = copy.copy(env.mj_model)
    mj_model.opt.iterations, mj_model.opt.ls_iterations = 20, 20
    model, start = mjx.put_model(mj_model), env.sample_start(jax.random.key(0))
    assert newton.supports(model)
    rng = np.random.default_rng(2)
    count = 16
    arm, fingers = slice(0, 7), slice(7, 9)
    qpos = np.tile(np.asarray(start.qpos, np.float64), (count, 1))
    qpos[:, fingers] += rng.normal(0, 0.002, (count, 2))
    qpos[::2, arm] += rng.normal(0, 0.03, (count // 2, 7))
    qpos[::2, 1] += np.linspace(0.1, 0.3, count // 2)  # the shoulder, down
    qpos[1::2, arm] += rng.normal(0, 1.0, (count // 2, 7))
    numbers = {
        "qpos": qpos,
        "qvel": rng.normal(0, 0.5, (count, model.nv)),
        "qfrc_applied": rng.normal(0, 5, (count, model.nv)),
        "xfrc_applied": rng.normal(0, 5, (count, model.nbody, 6)),
    }
    data = jax.vmap(lambda varied: start.replace(**varied))({name: jnp.float32(value) for name, value in numbers.items()})
    ours = jaxrl_vis_envs.jit(jax.vmap(lambda data: mjx_model.step(model, data, exact=False)))(data)
    theirs = jaxrl_vis_envs.jit(jax.vmap(lambda data: mjx.step(model, data)))(data)
    forces = np.abs(theirs._impl.efc_force)
    assert (forces[:, :6] > 0).all()  # the weld
    assert (forces[:, 6:12] > 0).any(axis=0).sum() >= 4  # limits, those of the fingers too
    assert forces[:, 12:18].any() and forces[:, 18:].any()  # contacts of both fingers
    scale = np.abs(theirs.qvel).max(axis=1, keepdims=True)
    assert (np.abs(theirs.qvel - data.qvel) / scale).max() > 0.1
    np.testing.assert_allclose(ours.qvel / scale, theirs.qvel / scale, atol=5e-5)
    np.testing.assert_allclose(ours.qpos, theirs.qpos, atol=1e-5)
    np.testing.assert_allclose(ours.time, theirs.time)


@pytest.mark.parametrize(
    ("joint", "option", "is_of_newton", "is_of_scalars"),
    [
        ('<joint type="hinge"/>', "", True, True),
        ('<joint type="hinge" frictionloss="1"/>', "", False, True),
        ('<joint type="hinge"/>', '<option cone="elliptic"/>', False, True),
        ('<joint type="hinge"/>', '<option solver="CG"/>', False, False),
        ("<freejoint/>", "", True, False),
        ("<freejoint/>", '<option integrator="RK4"/>', False, False),
        ('<joint type="ball"/>', "", False, False),
        ('<joint type="hinge"/>', '<option><flag eulerdamp="disable"/></option>', False, False),
        ('<joint type="hinge"/>', '<option><flag warmstart="disable"/></option>', True, True),
        ('<joint type="hinge"/>', '<option integrator="RK4"/>', True, True),
        ('<joint type="hinge"/>', '<option integrator="implicitfast"/>', False, False),
    ],
)
def test_what_is_not_small_and_simple_is_left_to_mjx(joint, option, is_of_newton, is_of_scalars):
    body = f'<body>{joint}<geom type="sphere" size=".1"/></body>'
    model = mjx.put_model(mujoco.MjModel.from_xml_string(f"<mujoco>{option}<worldbody>{body}</worldbody></mujoco>"))
    assert newton.supports(model) is is_of_newton
    assert scalar.supports(model) is is_of_scalars


# The speed of a task rests on it: VisualReacher makes 1.73 M steps a second on an H100 with ours, 0.78 M with MJX's.
# The finger has elliptic cones and friction in a joint, the hand 24 joints.
ON_A_CPU = {
    "FetchPush": "newton",
    "FetchReach": "newton",
    "FingerTurn": "scalar",
    "HandReach": "mjx",
    "PointMass": "newton",
    "Reacher": "newton",
    "SawyerReach": "newton",
    "StalkReach": "newton",
}


@pytest.mark.parametrize("name", ON_A_CPU)
def test_the_engine_of_each_task(name):
    model = mjx.put_model(environments.make(name).mj_model)
    assert scalar.supports(model)
    assert mjx_model.prefers_scalar_engine(model) is (ON_A_CPU[name] == "scalar")
    assert newton.supports(model) is (ON_A_CPU[name] == "newton")
    with tracing_for("cuda"), kernels(True):
        assert mjx_model.prefers_scalar_engine(model)
    with tracing_for("cuda"), kernels(False):
        assert not mjx_model.prefers_scalar_engine(model)


def test_without_warm_starts_the_last_accelerations_do_not_matter():
    """The reacher's elbow is near its limit, and the last accelerations are far off; one iteration gives MJX's step."""
    mj_model = copy.copy(environments.make("Reacher").mj_model)
    mj_model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER  # four forward dynamics in a program take long to compile
    assert mj_model.opt.iterations == 1 and mj_model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_WARMSTART
    model, still = mjx.put_model(mj_model), mjx_model.rest_data(mj_model)
    rng = np.random.default_rng(0)
    count = 32
    elbow = rng.choice([-1.0, 1.0], count) * rng.uniform(2.9, 3.1, count)
    numbers = {
        "qpos": np.stack([rng.uniform(-3, 3, count), elbow], axis=1),
        "qvel": rng.normal(0, 5, (count, 2)),
        "ctrl": rng.uniform(-1, 1, (count, 2)),
        "qacc_warmstart": rng.normal(0, 1000, (count, 2)),
    }
    data = jax.vmap(lambda varied: still.replace(**varied))({name: jnp.float32(value) for name, value in numbers.items()})
    ours = jaxrl_vis_envs.jit(jax.vmap(lambda data: mjx_model.step(model, data, exact=False)))(data)
    theirs = jaxrl_vis_envs.jit(jax.vmap(lambda data: mjx.step(model, data)))(data)
    assert 0.2 < (np.abs(theirs.qfrc_constraint[:, 1]) > 0).mean() < 0.8
    np.testing.assert_allclose(ours.qacc, theirs.qacc, rtol=1e-4, atol=1e-2)
    np.testing.assert_allclose(ours.qvel, theirs.qvel, rtol=1e-5, atol=1e-4)
