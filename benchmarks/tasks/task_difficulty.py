"""Difficulty of the tasks before learning, as listed by `jaxrl-vis envs`.

    python -m benchmarks.tasks.task_difficulty [ENV ...] [--episodes 1000]

Chance: fraction of episodes that end within the threshold under actions sampled uniformly at every step.
Difficulty: mean distance from start to goal, in thresholds.
"""

import argparse
import os
import sys
from typing import Any

os.environ.setdefault("JAX_PLATFORMS", "cpu")

import jax  # noqa: E402
import mujoco  # noqa: E402
import numpy as np  # noqa: E402

import jaxrl_vis_envs  # noqa: E402
from jaxrl_vis_envs.names import TASKS  # noqa: E402

_BATCH = 200  # parallel episodes


def measure(name: str, episodes: int, seed: int = 0, **overrides: Any) -> tuple[float, float]:
    """Return chance and difficulty of a task: success rate of uniform actions, and mean initial goal distance in thresholds.

    Args:
        name: Name of the task.
        episodes: Number of episodes.
        seed: Seed of starts, goals and actions.
        **overrides: Settings of the task that differ from its defaults.
    """
    env: Any = jaxrl_vis_envs.make(name, **overrides)

    def play(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        env_key, action_key = jax.random.split(key)
        goal_state = env.goal_state(env_key, env.sample_goal(env_key))
        start = env.state_at(env.sample_start(env_key), goal_state)
        actions = jax.random.uniform(action_key, (env.horizon, env.action_size), minval=-1.0)
        end, _ = jax.lax.scan(lambda state, action: (env.advance(state, action), None), start, actions)
        return end.metrics["success"], start.metrics["goal_distance"]

    program, keys = jaxrl_vis_envs.jit(jax.vmap(play)), jax.random.split(jax.random.key(seed), episodes)
    outcomes = [jax.device_get(program(keys[first : first + _BATCH])) for first in range(0, episodes, _BATCH)]
    success, distance = (np.concatenate(parts) for parts in zip(*outcomes, strict=True))
    return float(np.mean(success)), float(np.mean(distance)) / env.threshold


def measure_hand(episodes: int, seed: int = 0) -> tuple[float, float]:
    """Return chance and difficulty of HandReach in C MuJoCo, because the compiled program of its episodes has hung on a CPU."""
    env: Any = jaxrl_vis_envs.make("HandReach")
    model, config, generator = env.mj_model, env.config, np.random.default_rng(seed)
    tips = [model.site(name).id for name in ("fftip", "mftip", "rftip", "lftip", "thtip")]
    low, high = model.actuator_ctrlrange.T
    data = mujoco.MjData(model)

    def tips_after(actions: np.ndarray) -> np.ndarray:
        mujoco.mj_resetDataKeyframe(model, data, model.key("start").id)
        for action in actions:
            data.ctrl[:] = 0.5 * (low + high) + 0.5 * (high - low) * np.clip(action, -1.0, 1.0)
            mujoco.mj_step(model, data, config.substeps)
        mujoco.mj_kinematics(model, data)
        return data.site_xpos[tips].copy()

    start, ends, starts = tips_after(np.empty((0, model.nu))), [], []
    for _ in range(episodes):
        shape = (config.goal_actions, model.nu)
        goal = tips_after(generator.uniform(-1, 1, shape) + config.goal_noise * generator.normal(size=shape))
        end = tips_after(generator.uniform(-1, 1, (config.horizon, model.nu)))
        starts.append(np.linalg.norm(goal - start))
        ends.append(np.linalg.norm(goal - end))
    return float(np.mean(np.array(ends) <= config.threshold)), float(np.mean(starts)) / config.threshold


def main(arguments: list[str] | None = None) -> int:
    """Print one line per task; return the exit status."""
    parser = argparse.ArgumentParser(description="Chance level and difficulty of tasks.")
    parser.add_argument("env", nargs="*", default=list(TASKS), help=f"any of {', '.join(TASKS)}; default: all")
    parser.add_argument("--episodes", type=int, default=1000)
    options = parser.parse_args(arguments)
    for name in options.env:
        of_hand = name == "HandReach"
        chance, difficulty = measure_hand(options.episodes) if of_hand else measure(name, options.episodes)
        error = (chance * (1 - chance) / options.episodes) ** 0.5
        print(f"{name:<12} chance {chance:.4f} +- {error:.4f}   difficulty {difficulty:.2f} thresholds", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
