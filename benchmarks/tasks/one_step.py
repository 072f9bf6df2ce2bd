"""Comparison of one physics step of each task's model with C MuJoCo, from identical states.

    python -m benchmarks.tasks.one_step [TASK ...]

Prints a table of the differences in joint velocities, for docs/tasks.md. Two factors are varied, because each can mask a
difference:

    weld term    C MuJoCo 4 adds the rate of change of a weld's Jacobian to its reference acceleration; MJX lacks the term.
                 Without it in C MuJoCo, the difference shows whether MJX is implemented correctly; with it, how far a task is
                 from unmodified C MuJoCo.
    iterations   iterations of our constraint solver: the task's own, with its contact accuracy; or `MORE_ITERATIONS` with
                 exact contacts. C MuJoCo always takes as many as it needs.
"""

import argparse
import copy
import sys
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import jaxrl_vis_envs
from benchmarks.tasks import environments
from jaxrl_vis_envs.physics import mjx_model, newton
from jaxrl_vis_envs.physics.mjx_model import mjx

MORE_ITERATIONS = (8, 12)
"""Newton iterations, and line search iterations in each, beyond which float32 precision limits every task."""
Iterations = Literal["task", "more"]


class VisitedStates(NamedTuple):
    """N states of episodes, float32: all inputs of a physics step."""

    qpos: np.ndarray  # [N, nq]
    qvel: np.ndarray  # [N, nv]
    qacc_warmstart: np.ndarray  # [N, nv], initial guess of the solver
    ctrl: np.ndarray  # [N, nu]
    mocap_pos: np.ndarray  # [N, nmocap, 3]
    mocap_quat: np.ndarray  # [N, nmocap, 4]


def visited_states(
    mj_model: mujoco.MjModel, starts: np.ndarray, controls: np.ndarray, every: int, mocap: np.ndarray | None = None
) -> VisitedStates:
    """Roll out C MuJoCo and return the visited states.

    Args:
        mj_model: The model.
        starts: [S, nq] joint positions, at rest.
        controls: [S, T, nu], each held for ``every`` physics steps.
        every: Physics steps per control; the state before each control is returned.
        mocap: [S, T, 3], positions of the only mocap body, held as the controls are.

    Returns:
        The S T states before each control, start by start.
    """
    states = []
    data = mujoco.MjData(mj_model)
    for row, start in enumerate(starts):
        mujoco.mj_resetData(mj_model, data)
        data.qpos[:] = start
        for time, control in enumerate(controls[row]):
            data.ctrl[:] = control
            if mocap is not None:
                data.mocap_pos[0] = mocap[row, time]
            states.append([getattr(data, field).astype(np.float32) for field in VisitedStates._fields])
            mujoco.mj_step(mj_model, data, every)
    return VisitedStates(*(np.stack(part) for part in zip(*states)))


def fetch_states(env: Any) -> VisitedStates:
    """Return visited states, with half of the targets in the air, and half that press the fingers onto the table."""
    start, rng = env.sample_start(jax.random.key(0)), np.random.default_rng(0)
    targets = np.asarray(start.xpos[env.mj_model.body("gripper").id]) + rng.uniform(-0.15, 0.15, (24, 10, 3))
    targets[12:, :, 2] -= 0.15
    starts = np.tile(np.asarray(start.qpos, np.float64), (24, 1))
    return visited_states(env.mj_model, starts, np.zeros((24, 10, 0)), every=13, mocap=targets)


def push_states(env: Any) -> VisitedStates:
    """Return visited states, with the gripper starting beside a face of the box, which it pushes or misses."""
    rng = np.random.default_rng(0)
    start = env.sample_start(jax.random.key(0))
    gripper, grip = np.asarray(start.xpos[env.mj_model.body("gripper").id]), np.asarray(start.site_xpos[0])
    angles = 0.5 * np.pi * np.arange(24)
    ways = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    starts = np.tile(np.asarray(start.qpos, np.float64), (24, 1))
    starts[:, env.mj_model.joint("box").qposadr[0] :][:, :2] = grip[:2] + 0.042 * ways + rng.uniform(-0.01, 0.01, (24, 2))
    targets = gripper + rng.uniform(-0.02, 0.02, (24, 10, 3))
    targets[:, :, :2] += 0.01 * np.arange(1, 11)[:, None] * ways[:, None]
    targets[:, :, 2] += 0.02
    return visited_states(env.mj_model, starts, np.zeros((24, 10, 0)), every=13, mocap=targets)


def finger_states(env: Any) -> VisitedStates:
    """Return visited states under random torques from 24 initial states."""
    starts = environments.reset(env, jax.random.split(jax.random.key(3), 24))[0].data.qpos
    held = np.repeat(np.random.default_rng(0).uniform(-1, 1, (24, 10, 2)), 5, axis=1)
    return visited_states(env.mj_model, np.asarray(starts, np.float64), held, every=7)


def hand_states(env: Any) -> VisitedStates:
    """Return visited states, with every joint driven to a random end of its range."""
    low, high = env.mj_model.actuator_ctrlrange.T
    controls = low + (high - low) * np.random.default_rng(0).integers(0, 2, (8, 12, 20))
    start = np.asarray(env.sample_start(jax.random.key(0)).qpos, np.float64)
    return visited_states(env.mj_model, np.tile(start, (8, 1)), controls, every=17)


def reacher_states(env: Any) -> VisitedStates:
    """Return visited states, with half of the starts near the elbow's limit, the only constraint, on either side of it."""
    rng = np.random.default_rng(0)
    near_limit = rng.choice([-1.0, 1.0], 32) * rng.uniform(2.9, 3.1, 32)
    starts = np.stack([rng.uniform(-6, 6, 64), np.concatenate([rng.uniform(-3, 3, 32), near_limit])], axis=1)
    return visited_states(env.mj_model, starts, rng.uniform(-1, 1, (64, 4, 2)), every=3)


def sawyer_states(env: Any) -> VisitedStates:
    """Return visited states, with targets distributed over the goal box."""
    rng = np.random.default_rng(0)
    targets = np.array(env.config.goal_centre) + np.array(env.config.goal_size) * rng.uniform(-0.5, 0.5, (12, 10, 3))
    starts = np.tile(np.asarray(env.sample_start(jax.random.key(0)).qpos, np.float64), (12, 1))
    return visited_states(env.mj_model, starts, np.zeros((12, 10, 0)), every=13, mocap=targets)


STATES: dict[str, Callable[[Any], VisitedStates]] = {
    "FetchPush": push_states,
    "FetchReach": fetch_states,
    "FingerTurn": finger_states,
    "HandReach": hand_states,
    "Reacher": reacher_states,
    "SawyerReach": sawyer_states,
}


def our_step(env: Any, visited: VisitedStates, iterations: Iterations) -> np.ndarray:
    """Return our joint velocities [N, nv] float32 after one step.

    Args:
        env: The task.
        visited: N states.
        iterations: ``task`` for the task's solver iterations and contact accuracy, ``more`` for `MORE_ITERATIONS` with exact
            contacts.
    """
    mj_model = env.mj_model
    if iterations == "more":
        mj_model = copy.copy(mj_model)
        mj_model.opt.iterations, mj_model.opt.ls_iterations = MORE_ITERATIONS
    model, still = mjx.put_model(mj_model), mjx_model.rest_data(mj_model)
    exact = iterations == "more" or env.exact_contacts

    def step(visited: VisitedStates) -> jax.Array:
        return mjx_model.take_steps(model, still.replace(**visited._asdict()), 1, exact).qvel

    return np.asarray(jaxrl_vis_envs.jit(jax.vmap(step))(jax.tree.map(jnp.asarray, visited)))


class MujocoStep(NamedTuple):
    """Result of C MuJoCo for N states."""

    qvel: np.ndarray  # [N, nv], after one step
    contacts: np.ndarray  # [N], number of contacts


def mujoco_step(mj_model: mujoco.MjModel, visited: VisitedStates, weld_term: bool) -> MujocoStep:
    """Take one step of C MuJoCo, with as many solver iterations as it needs.

    Args:
        mj_model: The model.
        visited: The states.
        weld_term: True for unmodified C MuJoCo; False removes the derivative of equality constraints' Jacobians, which
            requires the Euler integrator (its step can be split in two) or a model without equalities.
    """
    exact = copy.copy(mj_model)
    exact.opt.iterations, exact.opt.ls_iterations = 100, 50
    qvel, contacts = np.empty((len(visited.qvel), mj_model.nv)), np.zeros(len(visited.qvel), int)
    data = mujoco.MjData(exact)
    for index, row in enumerate(zip(*visited)):
        for field, value in zip(VisitedStates._fields, row):
            getattr(data, field)[:] = value
        if weld_term or mj_model.neq == 0:
            mujoco.mj_step(exact, data)
        else:
            assert exact.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
            mujoco.mj_step1(exact, data)
            _remove_weld_term(data)
            mujoco.mj_step2(exact, data)
        qvel[index], contacts[index] = data.qvel, data.ncon
    return MujocoStep(qvel, contacts)


def _remove_weld_term(data: mujoco.MjData) -> None:
    """Set the reference accelerations of equality constraints to MJX's, without the derivative of their Jacobians; in place."""
    rows = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
    stiffness, damping, impedance, _ = data.efc_KBIP[rows].T
    data.efc_aref[rows] = -damping * data.efc_vel[rows] - stiffness * impedance * data.efc_pos[rows]


def relative_to_bound(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """Return the maximum difference [N] of joint velocities [N, nv], in multiples of the bound of the tests.

    The bound is 1e-4 of the maximum velocity + 1e-5 (rad/s, m/s).
    """
    return np.abs(ours - theirs).max(axis=1) / (1e-4 * np.abs(theirs).max(axis=1) + 1e-5)


def rows(name: str) -> list[str]:
    """Return the rows of the Markdown table for one task, a key of `STATES`."""
    env = environments.make(name)
    visited = STATES[name](env)
    steps = {iterations: our_step(env, visited, iterations) for iterations in ("task", "more")}
    own, more = (env.mj_model.opt.iterations, env.mj_model.opt.ls_iterations), MORE_ITERATIONS
    model = mjx.put_model(env.mj_model)
    if newton.supports(model) or mjx_model.prefers_scalar_engine(model):  # these solvers have no line search iterations
        own, more = own[:1], more[:1]
    lines = []
    for weld_term in (True, False) if env.mj_model.neq else (True,):
        theirs = mujoco_step(env.mj_model, visited, weld_term)
        truth = "C MuJoCo as it is" if weld_term else "C MuJoCo less the weld term"
        for iterations, counts in (("task", own), ("more", more)):
            multiples = relative_to_bound(steps[iterations], theirs.qvel)
            label = ("the task's " if iterations == "task" else "") + " / ".join(map(str, counts))
            share = f"{100 * (multiples <= 1).mean():.0f} %"
            numbers = f"{_format_short(np.median(multiples))} | {_format_short(multiples.max())} | {share}"
            lines.append(f"| {name} | {truth} | {label} | {len(multiples)} | {(theirs.contacts > 0).sum()} | {numbers} |")
    return lines


def _format_short(number: float) -> str:
    """Format with two significant digits (one below 0.1), or as an integer from 10 on."""
    return f"{number:,.0f}" if number >= 10 else f"{number:.1g}" if number < 0.1 else f"{number:.2g}"


def main(arguments: list[str] | None = None) -> int:
    """Print the table as Markdown; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tasks", nargs="*", metavar="TASK", help=f"any of {', '.join(STATES)}; default: all")
    options = parser.parse_args(arguments)
    for name in options.tasks:
        if name not in STATES:
            parser.error(f"unknown task {name!r}: choose {', '.join(STATES)}")
    print("| task | compared with | our iterations | states | with contacts | median | greatest | within the bound |")
    print("|---|---|---|---|---|---|---|---|")
    for name in options.tasks or STATES:
        print("\n".join(rows(name)), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
