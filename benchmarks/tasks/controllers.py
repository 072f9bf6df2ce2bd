"""Scripted controllers with access to the true state, which verify that every goal can be reached.

    python -m benchmarks.tasks.controllers [ENV ...] [--episodes 1000]

Prints the fraction of episodes that end within the threshold, at the last step. Exit status: 0 if all are at least .95, else 1.
"""

import argparse
import os
import sys
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np

import jaxrl_vis_envs
from benchmarks.tasks import environments
from jaxrl_vis_envs.tasks import stalk_arm

MIN_SUCCESS = 0.95
Policy = Callable[[Any, Any, Any], tuple[jax.Array, Any]]
"""Function (state, configuration of the goal, memory) -> (action [A], memory). It is returned with its initial memory, None if
unused."""


def fetch_reach(env: Any) -> tuple[Policy, Any]:
    """Return a proportional controller of the gripper's position."""

    def act(state: Any, goal: Any, memory: Any) -> tuple[jax.Array, Any]:
        return jnp.append(20.0 * (state.goal_state - state.achieved_state), 0.0), memory

    return act, None


def fetch_push(env: Any) -> tuple[Policy, Any]:
    """Return a pusher: above the box, down behind it, and along the table towards the goal; up again if it loses the box."""
    behind, high, low, lost = 0.06, 0.49, 0.425, 0.02  # m

    def act(state: Any, goal: Any, memory: Any) -> tuple[jax.Array, Any]:
        grip, box = env.observe_state(state.data)[:6].reshape(2, 3)
        left = jnp.linalg.norm((state.goal_state - box)[:2])
        way = (state.goal_state - box)[:2] / jnp.maximum(left, 1e-6)
        before = (box - grip)[:2] @ way
        across = (box - grip)[:2] - before * way
        there = box[:2] - behind * way - grip[:2]
        is_near, is_low = jnp.linalg.norm(there) < 0.03, grip[2] < 0.455
        push = jnp.append(10.0 * across + jnp.clip(5.0 * left, 0.2, 0.6) * way, 20.0 * (low - grip[2]))
        over = jnp.append(jnp.where(is_near | (grip[2] > 0.465), 20.0 * there, 0.0), 20.0 * (high - grip[2]))
        down = jnp.append(20.0 * there, 20.0 * (low - grip[2]))
        pushes = is_low & (jnp.linalg.norm(across) < lost) & (before > lost)
        move = jnp.where(pushes, push, jnp.where(is_near, down, jnp.where(is_low, jnp.array([0.0, 0.0, 1.0]), over)))
        return jnp.append(jnp.where(left < 0.015, 0.0, jnp.clip(move, -1.0, 1.0)), 0.0), memory

    return act, None


def sawyer_reach(env: Any) -> tuple[Policy, Any]:
    """Return a controller that moves straight to the goal at full speed."""

    def act(state: Any, goal: Any, memory: Any) -> tuple[jax.Array, Any]:
        return (state.goal_state - state.data.mocap_pos[0]) / env.config.action_scale, memory

    return act, None


def stalk_reach(env: Any) -> tuple[Policy, Any]:
    """Return a controller that aligns direction and height with the stalk's current pose, then extends from the shoulder."""
    shoulder = jnp.asarray(stalk_arm.SHOULDER)

    def act(state: Any, goal: Any, memory: Any) -> tuple[jax.Array, Any]:
        grip = stalk_arm.grip_at(state.data.qpos[:3])
        there = grip + state.goal_state - state.achieved_state
        away = there[:2] - shoulder
        reach = jnp.linalg.norm(grip[:2] - shoulder)
        distance = jnp.linalg.norm(away)
        before = jnp.append(shoulder + away * (jnp.minimum(reach, distance - 0.04) / distance), there[2])
        aside = jnp.abs((away[0] * (grip - there)[1] - away[1] * (grip - there)[0]) / distance)
        wanted = jnp.where((aside < 0.012) | (jnp.abs(reach - distance) < 0.015), there, before)
        return (wanted - stalk_arm.grip_at(state.data.ctrl)) / env.config.action_scale, memory

    return act, None


def point_mass(env: Any) -> tuple[Policy, Any]:
    """Return a proportional-derivative controller of the ball."""

    def act(state: Any, goal: Any, memory: Any) -> tuple[jax.Array, Any]:
        return 10.0 * (state.goal_state - state.data.qpos) - 2.0 * state.data.qvel, memory

    return act, None


def reacher(env: Any) -> tuple[Policy, Any]:
    """Return a velocity controller that moves each joint to its angle at the goal, with the elbow bent to the left."""
    upper, fore = 0.1, 0.11  # m
    unit_turn = 0.95  # rotation of a joint by an action of 1, rad

    def act(state: Any, goal: Any, memory: Any) -> tuple[jax.Array, Any]:
        x, y = state.goal_state
        cosine = (x * x + y * y - upper**2 - fore**2) / (2 * upper * fore)
        elbow = jnp.minimum(jnp.arccos(jnp.clip(cosine, -1.0, 1.0)), 2.99)
        shoulder = jnp.arctan2(y, x) - jnp.arctan2(fore * jnp.sin(elbow), upper + fore * jnp.cos(elbow))
        change = jnp.array([shoulder, elbow]) - state.data.qpos
        change = change.at[0].set((change[0] + jnp.pi) % (2 * jnp.pi) - jnp.pi)
        return change / unit_turn, memory

    return act, None


def hand_reach(env: Any) -> tuple[Policy, Any]:
    """Return an integral controller of the actuated joints towards their angles at the goal."""
    joints = env.mj_model.actuator_trnid[:, 0]
    low, high = env.mj_model.actuator_ctrlrange.T
    centre, half_range = 0.5 * (low + high), 0.5 * (high - low)

    def act(state: Any, goal: Any, integral: jax.Array) -> tuple[jax.Array, jax.Array]:
        integral = jnp.clip(integral + 0.3 * (goal.qpos - state.data.qpos)[joints], -0.5, 0.5)
        return (goal.qpos[joints] + integral - centre) / half_range, integral

    return act, jnp.zeros(len(joints))


POLICIES: dict[str, Callable[[Any], tuple[Policy, Any]]] = {
    "FetchPush": fetch_push,
    "FetchReach": fetch_reach,
    "HandReach": hand_reach,
    "PointMass": point_mass,
    "Reacher": reacher,
    "SawyerReach": sawyer_reach,
    "StalkReach": stalk_reach,
}


def success_rate(name: str, episodes: int, seed: int = 0, **overrides: Any) -> float:
    """Return the success rate of a task's controller at the last step.

    Args:
        name: Key of `POLICIES`, or ``FingerTurn``.
        episodes: Number of episodes.
        seed: Seed of starts and goals.
        **overrides: Settings of the task that differ from its defaults.
    """
    env = environments.make(name, **overrides)
    state, goals = environments.reset(env, jax.random.split(jax.random.key(seed), episodes))
    if name == "FingerTurn":
        return finger_turn_success(env, state, np.random.default_rng(seed))
    policy, memory = POLICIES[name](env)
    act = jaxrl_vis_envs.jit(jax.vmap(policy))
    memory = jax.tree.map(lambda leaf: jnp.tile(leaf, (episodes, 1)), memory)
    for _ in range(env.horizon):
        action, memory = act(state, goals, memory)
        state = environments.advance(env, state, action)
    return float(np.mean(state.metrics["success"]))


def finger_turn_success(env: Any, state: Any, generator: np.random.Generator) -> float:
    """Return the success rate of random shooting on FingerTurn: take the first action of the best of many plans in C MuJoCo.

    Args:
        env: FingerTurn.
        state: Initial states of E episodes.
        generator: Source of the plans.
    """
    threads = [mujoco.MjData(env.mj_model) for _ in range(os.cpu_count() or 1)]
    plans = np.zeros((len(state.reward), _PLAN_STEPS, 2))
    with mujoco.rollout.Rollout(nthread=len(threads)) as pool:

        def try_out(initial: np.ndarray, controls: np.ndarray) -> np.ndarray:
            return np.asarray(pool.rollout(env.mj_model, threads, initial, controls)[0])[:, -1]

        for _ in range(env.horizon):
            start = np.concatenate([np.zeros((len(plans), 1)), state.data.qpos, state.data.qvel], axis=1)
            goals = np.asarray(state.goal_state)
            plans = _plan(try_out, start, np.arctan2(goals[:, 0], goals[:, 1]), plans, env.config.substeps, generator)
            state = environments.advance(env, state, plans[:, 0])
            plans = np.concatenate([plans[:, 1:], np.zeros_like(plans[:, :1])], axis=1)
    return float(np.mean(state.metrics["success"]))


_PLAN_STEPS = 3  # control steps
_PLANS = 64
_NEAR_ENOUGH = 0.3  # rad; the threshold is .54


def _plan(
    try_out: Callable[[np.ndarray, np.ndarray], np.ndarray],
    start: np.ndarray,
    goal_angle: np.ndarray,
    last_plans: np.ndarray,
    substeps: int,
    generator: np.random.Generator,
) -> np.ndarray:
    """Return the plans [E, _PLAN_STEPS, 2] that bring the spinner nearest to its goal, or zeros where these suffice.

    Args:
        try_out: Function from initial states [M, 7] and controls [M, T, 2] to final states [M, 7].
        start: [E, 7], time, joint positions and joint velocities.
        goal_angle: [E], rad.
        last_plans: [E, _PLAN_STEPS, 2], also considered.
        substeps: Physics steps per control step.
        generator: Source of the plans.
    """
    episodes = np.arange(len(start))
    plans = generator.uniform(-1.0, 1.0, (len(start), _PLANS, _PLAN_STEPS, 2))
    plans[:, : _PLANS // 2] = plans[:, : _PLANS // 2, :1]  # half of them hold one action
    plans[:, 0], plans[:, 1] = 0.0, last_plans
    controls = np.repeat(plans.reshape(-1, _PLAN_STEPS, 2), substeps, axis=1)
    ends = try_out(np.repeat(start, _PLANS, axis=0), controls).reshape(len(start), _PLANS, -1)[:, :, 1:4]
    # The spinner's axis points to -y: a positive angle turns its tip from +z towards -x.
    error = np.abs((-ends[..., 2] - goal_angle[:, None] + np.pi) % (2 * np.pi) - np.pi)
    # Far from the spinner no plan has an effect, so the final distance to it is penalised, too.
    upper, fore = ends[..., 0], ends[..., 0] + ends[..., 1]
    x, z = 0.18 * np.cos(upper) + 0.16 * np.cos(fore), 0.18 * np.sin(upper) + 0.16 * np.sin(fore)
    distance = np.hypot(x - 0.4, z)  # m, from fingertip to the spinner's hinge
    best = np.argmin(error + 0.5 * np.maximum(distance - 0.1, 0.0), axis=1)
    return plans[episodes, np.where(error[:, 0] < _NEAR_ENOUGH, 0, best)]


def main(arguments: list[str] | None = None) -> int:
    """Print the success rate of each controller; return 1 if one is below the bound, else 0."""
    parser = argparse.ArgumentParser(description="Success of scripted controllers that see the true state.")
    names = sorted([*POLICIES, "FingerTurn"])
    parser.add_argument("env", nargs="*", default=names, help=f"any of {', '.join(names)}; default: all")
    parser.add_argument("--episodes", type=int, default=1000)
    options = parser.parse_args(arguments)
    status = 0
    for name in options.env:
        rate = success_rate(name, options.episodes)
        print(f"{name:<12} {rate:.4f} of {options.episodes} episodes", flush=True)
        status |= rate < MIN_SUCCESS
    return int(status)


if __name__ == "__main__":
    sys.exit(main())
