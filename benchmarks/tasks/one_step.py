"""One physics step of a task's own model by ours and by C MuJoCo, from identical states.

    python -m benchmarks.tasks.one_step [TASK ...]

Prints a table of the differences of joint velocities, which docs/tasks.md keeps. Two things are measured both with and
without, because each hides a difference that a task has:

    weld term    C MuJoCo 4 adds to the acceleration that a weld asks for how fast its Jacobian turns; MJX lacks the term. Taken
                 away from C MuJoCo, what is left says whether MJX does what it sets out to do. With it, how far a task is from
                 C MuJoCo as it is.
    iterations   of our constraint solver: as few as the task takes, contacts as exact as it asks for; or `MORE_ITERATIONS`, and
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
"""Newton iterations, and line search iterations in each, after which more do not help in any task: float32 is at its end."""
Iterations = Literal["task", "more"]


class Visited(NamedTuple):
    """N states of an episode, float32: all that a step depends on."""

    qpos: np.ndarray  # [N, nq]
    qvel: np.ndarray  # [N, nv]
    qacc_warmstart: np.ndarray  # [N, nv], where the solver starts from
    ctrl: np.ndarray  # [N, nu]
    mocap_pos: np.ndarray  # [N, nmocap, 3]
    mocap_quat: np.ndarray  # [N, nmocap, 4]


def visited_states(
    mj_model: mujoco.MjModel, starts: np.ndarray, controls: np.ndarray, every: int, mocap: np.ndarray | None = None
) -> Visited:
    """States that C MuJoCo passes through.

    Args:
        mj_model: The model.
        starts: [S, nq] joint positions, at rest.
        controls: [S, T, nu], each held for ``every`` physics steps.
        every: A state is kept before each control, after so many physics steps.
        mocap: [S, T, 3], positions of the only mocap body, held as the controls are.
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
            states.append([getattr(data, field).astype(np.float32) for field in Visited._fields])
            mujoco.mj_step(mj_model, data, every)
    return Visited(*(np.stack(part) for part in zip(*states)))


def fetch_states(env: Any) -> Visited:
    """Half of the targets are in the air, half press the fingers on the table."""
    start, rng = env.sample_start(jax.random.key(0)), np.random.default_rng(0)
    targets = np.asarray(start.xpos[env.mj_model.body("gripper").id]) + rng.uniform(-0.15, 0.15, (24, 10, 3))
    targets[12:, :, 2] -= 0.15
    starts = np.tile(np.asarray(start.qpos, np.float64), (24, 1))
    return visited_states(env.mj_model, starts, np.zeros((24, 10, 0)), every=13, mocap=targets)


def push_states(env: Any) -> Visited:
    """The gripper starts beside one of the faces of the box, and pushes or misses it."""
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


def finger_states(env: Any) -> Visited:
    """Random torques, from 24 starts of episodes."""
    starts = environments.reset(env, jax.random.split(jax.random.key(3), 24))[0].data.qpos
    held = np.repeat(np.random.default_rng(0).uniform(-1, 1, (24, 10, 2)), 5, axis=1)
    return visited_states(env.mj_model, np.asarray(starts, np.float64), held, every=7)


def hand_states(env: Any) -> Visited:
    """Every joint is sent to one end of its range or the other."""
    low, high = env.mj_model.actuator_ctrlrange.T
    controls = low + (high - low) * np.random.default_rng(0).integers(0, 2, (8, 12, 20))
    start = np.asarray(env.sample_start(jax.random.key(0)).qpos, np.float64)
    return visited_states(env.mj_model, np.tile(start, (8, 1)), controls, every=17)


def reacher_states(env: Any) -> Visited:
    """Half of the starts are near the limit of the elbow, the only constraint, on either side of it."""
    rng = np.random.default_rng(0)
    near_limit = rng.choice([-1.0, 1.0], 32) * rng.uniform(2.9, 3.1, 32)
    starts = np.stack([rng.uniform(-6, 6, 64), np.concatenate([rng.uniform(-3, 3, 32), near_limit])], axis=1)
    return visited_states(env.mj_model, starts, rng.uniform(-1, 1, (64, 4, 2)), every=3)


def sawyer_states(env: Any) -> Visited:
    """Targets all over the box of goals."""
    rng = np.random.default_rng(0)
    targets = np.array(env.config.goal_centre) + np.array(env.config.goal_size) * rng.uniform(-0.5, 0.5, (12, 10, 3))
    starts = np.tile(np.asarray(env.sample_start(jax.random.key(0)).qpos, np.float64), (12, 1))
    return visited_states(env.mj_model, starts, np.zeros((12, 10, 0)), every=13, mocap=targets)


STATES: dict[str, Callable[[Any], Visited]] = {
    "FetchPush": push_states,
    "FetchReach": fetch_states,
    "FingerTurn": finger_states,
    "HandReach": hand_states,
    "Reacher": reacher_states,
    "SawyerReach": sawyer_states,
}


def our_step(env: Any, visited: Visited, iterations: Iterations) -> np.ndarray:
    """Joint velocities [N, nv] after one step of ours, with the solver's iterations and exactness of the task, or with more."""
    mj_model = env.mj_model
    if iterations == "more":
        mj_model = copy.copy(mj_model)
        mj_model.opt.iterations, mj_model.opt.ls_iterations = MORE_ITERATIONS
    model, still = mjx.put_model(mj_model), mjx_model.still_data(mj_model)
    exact = iterations == "more" or env.exact_contacts

    def step(visited: Visited) -> jax.Array:
        return mjx_model.take_steps(model, still.replace(**visited._asdict()), 1, exact).qvel

    return np.asarray(jaxrl_vis_envs.jit(jax.vmap(step))(jax.tree.map(jnp.asarray, visited)))


class MujocoStep(NamedTuple):
    """Result of C MuJoCo for N states."""

    qvel: np.ndarray  # [N, nv], after one step
    contacts: np.ndarray  # [N], how many there were


def mujoco_step(mj_model: mujoco.MjModel, visited: Visited, weld_term: bool) -> MujocoStep:
    """One step of C MuJoCo, with as many iterations as it takes.

    Args:
        mj_model: The model.
        visited: The states.
        weld_term: C MuJoCo as it is. False takes the turning of equalities' Jacobians away; then the integrator has to be
            Euler's, whose step comes in two halves, or the model without equalities.
    """
    exact = copy.copy(mj_model)
    exact.opt.iterations, exact.opt.ls_iterations = 100, 50
    qvel, contacts = np.empty((len(visited.qvel), mj_model.nv)), np.zeros(len(visited.qvel), int)
    data = mujoco.MjData(exact)
    for index, row in enumerate(zip(*visited)):
        for field, value in zip(Visited._fields, row):
            getattr(data, field)[:] = value
        if weld_term or mj_model.neq == 0:
            mujoco.mj_step(exact, data)
        else:
            assert exact.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
            mujoco.mj_step1(exact, data)
            _take_weld_term_away(data)
            mujoco.mj_step2(exact, data)
        qvel[index], contacts[index] = data.qvel, data.ncon
    return MujocoStep(qvel, contacts)


def _take_weld_term_away(data: mujoco.MjData) -> None:
    """Set the accelerations that equalities ask for to what they are in MJX, without the turning of their Jacobians."""
    rows = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
    stiffness, damping, impedance, _ = data.efc_KBIP[rows].T
    data.efc_aref[rows] = -damping * data.efc_vel[rows] - stiffness * impedance * data.efc_pos[rows]


def in_bounds(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """The greatest difference of joint velocities [N, nv] in multiples of the bound that tests set: [N].

    The bound is 1e-4 of the greatest velocity + 1e-5 (rad/s, m/s).
    """
    return np.abs(ours - theirs).max(axis=1) / (1e-4 * np.abs(theirs).max(axis=1) + 1e-5)


def rows(name: str) -> list[str]:
    """The lines of the table for one task."""
    env = environments.make(name)
    visited = STATES[name](env)
    steps = {iterations: our_step(env, visited, iterations) for iterations in ("task", "more")}
    own, more = (env.mj_model.opt.iterations, env.mj_model.opt.ls_iterations), MORE_ITERATIONS
    model = mjx.put_model(env.mj_model)
    if newton.supports(model) or mjx_model.prefers_scalar_engine(model):  # line searches of ours have no such number
        own, more = own[:1], more[:1]
    lines = []
    for weld_term in (True, False) if env.mj_model.neq else (True,):
        theirs = mujoco_step(env.mj_model, visited, weld_term)
        truth = "C MuJoCo as it is" if weld_term else "C MuJoCo less the weld term"
        for iterations, counts in (("task", own), ("more", more)):
            multiples = in_bounds(steps[iterations], theirs.qvel)
            label = ("the task's " if iterations == "task" else "") + " / ".join(map(str, counts))
            numbers = f"{_short(np.median(multiples))} | {_short(multiples.max())} | {100 * (multiples <= 1).mean():.0f} %"
            lines.append(f"| {name} | {truth} | {label} | {len(multiples)} | {(theirs.contacts > 0).sum()} | {numbers} |")
    return lines


def _short(number: float) -> str:
    """Two digits, or all of a larger number."""
    return f"{number:,.0f}" if number >= 10 else f"{number:.1g}" if number < 0.1 else f"{number:.2g}"


def main(arguments: list[str] | None = None) -> int:
    """Print the table, in Markdown."""
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
