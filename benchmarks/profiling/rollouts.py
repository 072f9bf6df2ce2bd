"""Physics alone on a GPU: environment steps per second, kernels of a physics step, and deviation from a CPU's results.

    python -m benchmarks.profiling.rollouts [TASK ...] [--counts 500 8192]

The deviation is measured over one control step from the same 64 states, five control steps into an episode, with the same
actions, on the GPU and on the CPU backend of the same process: in ``qpos``, and in ``qvel`` relative to the state's largest
velocity.
"""

import argparse
import sys
import time
from typing import Any

import jax
import numpy as np

import jaxrl_vis_envs
from benchmarks.profiling.kernels import kernels
from jaxrl_vis_envs.compiling.compilation import compiler_options

STEPS, NUM_COMPARED, NUM_SHOWN = 10, 64, 6


def rollout(env: Any, count: int, steps: int) -> Any:
    """Return the function (states, key) -> states after ``steps`` control steps with random actions."""

    def run(states: Any, key: jax.Array) -> Any:
        def step(states: Any, key: jax.Array) -> tuple[Any, None]:
            actions = jax.random.uniform(key, (count, env.action_size), minval=-1.0, maxval=1.0)
            return jax.vmap(env.advance)(states, actions), None

        return jax.lax.scan(step, states, jax.random.split(key, steps))[0]

    return run


def reset(env: Any, count: int) -> Any:
    """Return the initial states of ``count`` environments."""
    return jaxrl_vis_envs.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), count))


def report_speed(name: str, env: Any, count: int) -> None:
    """Print the speed of ``count`` parallel environments, and the kernels that take most of the time."""
    states, key = jax.block_until_ready(reset(env, count)), jax.random.key(1)
    began = time.perf_counter()
    program = jaxrl_vis_envs.jit(rollout(env, count, STEPS)).lower(states, key).compile()
    compile_s = time.perf_counter() - began

    def call() -> Any:
        return jax.block_until_ready(program(states, key))

    final = np.asarray(call().data.qpos)
    assert len(np.unique(final, axis=0)) == count, "environments that were to differ do not"
    walls = []
    for _ in range(5):
        began = time.perf_counter()
        call()
        walls.append(time.perf_counter() - began)
    wall, substeps = float(np.median(walls)), STEPS * env.config.substeps
    spent, launches = kernels(call)
    print(
        f"{name}, {count} environments: {count * STEPS / wall:,.0f} env-steps/s, {wall / STEPS * 1e3:.2f} ms a control step, "
        f"{sum(launches.values()) / substeps:.0f} kernels and {wall / substeps * 1e6:.0f} us a physics step, "
        f"compiled in {compile_s:.0f} s",
        flush=True,
    )
    for kernel, nanoseconds in spent.most_common(NUM_SHOWN):
        print(f"    {nanoseconds / substeps / 1e3:8.1f} us  {kernel[:90]}")


def report_deviation(name: str, env: Any) -> None:
    """Print the deviation of a control step on the default device (a GPU) from one on a CPU, from states after 5 steps.

    Args:
        name: Label of the line.
        env: The environment.
    """
    data = jaxrl_vis_envs.jit(rollout(env, NUM_COMPARED, 5))(reset(env, NUM_COMPARED), jax.random.key(3)).data
    actions = jax.random.uniform(jax.random.key(4), (NUM_COMPARED, env.action_size), minval=-1.0, maxval=1.0)
    here = jaxrl_vis_envs.jit(jax.vmap(env.act))(data, actions)
    moved = jax.device_put((data, actions), jax.devices("cpu")[0])
    there = jax.jit(jax.vmap(env.act), compiler_options=compiler_options("cpu"))(*moved)
    position = np.abs(np.asarray(here.qpos) - np.asarray(there.qpos)).max(axis=1)
    size = np.abs(np.asarray(there.qvel)).max(axis=1) + 1e-3
    velocity = np.abs(np.asarray(here.qvel) - np.asarray(there.qvel)).max(axis=1) / size
    print(
        f"{name}, from a CPU's control step: qpos median {np.median(position):.1e}, greatest {position.max():.1e}; "
        f"qvel median {np.median(velocity):.1e}, greatest {velocity.max():.1e} of the largest",
        flush=True,
    )


def main() -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tasks", nargs="*", default=["FingerTurn", "HandReach", "FetchReach"])
    parser.add_argument("--counts", nargs="+", type=int, default=[500, 8192], help="environments side by side")
    options = parser.parse_args()
    if jax.default_backend() != "gpu":
        print("this measures a GPU, and JAX sees none: see `jaxrl-vis doctor`", file=sys.stderr)
        return 2
    for name in options.tasks:
        env = jaxrl_vis_envs.make(name)
        for count in options.counts:
            report_speed(name, env, count)
        report_deviation(name, env)
    return 0


if __name__ == "__main__":
    sys.exit(main())
