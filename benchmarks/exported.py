"""Evaluate the policies of the package as they are shipped, and exported to ONNX, on a CPU.

    python -m benchmarks.exported [NAME ...] [--episodes 256]

Each policy is exported, checked against its golden frames, and run for a number of fresh episodes twice: by JAX and by
onnxruntime, with equal starts and goals. Latency is measured with one observation and one goal in memory, on one thread.
Record: exported-DEVICE.json, with a row for each policy; docs/export.md has a table of it.
"""

import argparse
import json
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("JAX_PLATFORMS", "cpu")

import jax  # noqa: E402
import numpy as np  # noqa: E402

import jaxrl_vis  # noqa: E402
import jaxrl_vis_envs  # noqa: E402
from benchmarks.ledger.records import RESULTS  # noqa: E402
from benchmarks.ship import FRESH_KEY  # noqa: E402
from jaxrl_vis.bench.record import results_path  # noqa: E402
from jaxrl_vis.host import provenance  # noqa: E402
from jaxrl_vis.host.files import write_atomically  # noqa: E402
from jaxrl_vis.run.exported.export import export_run  # noqa: E402
from jaxrl_vis.run.exported.onnx_file import Model  # noqa: E402
from jaxrl_vis.run.trained import shipped  # noqa: E402
from jaxrl_vis.run.trained.policy import Policy  # noqa: E402

BATCH = 64  # environments
CALLS = 200

Act = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Function from observations [N, C, H, W] uint8 and goals of the same shape to actions [N, A] float32."""


def run_episodes(policy: Policy, acts: list[Act], episodes: int) -> list[dict[str, float]]:
    """Run the same episodes with each function.

    Args:
        policy: Policy, whose environment is used.
        acts: Functions from observations and goals [`BATCH`, ...] to actions.
        episodes: Number of episodes.

    Returns:
        Mean ``success`` and ``goal_distance`` at the last step, for each function.
    """
    env = policy.env
    reset, step = jaxrl_vis_envs.jit(jax.vmap(env.reset)), jaxrl_vis_envs.jit(jax.vmap(env.step))
    metrics: list[list[Any]] = [[] for _ in acts]
    for key in jax.random.split(jax.random.key(FRESH_KEY + 1), -(-episodes // BATCH)):
        start = reset(jax.random.split(key, BATCH))
        for act, rows in zip(acts, metrics, strict=True):
            state = start
            for _ in range(env.horizon):
                state = step(state, act(np.asarray(state.obs["observation"]), np.asarray(state.obs["desired_goal"])))
            rows.append({name: np.asarray(state.metrics[name]) for name in ("success", "goal_distance")})
    return [
        {name: float(np.concatenate([row[name] for row in rows])[:episodes].mean()) for name in rows[0]} for rows in metrics
    ]


def measure_latency(act: Act, shape: tuple[int, ...]) -> float:
    """Return the median time of a call with one observation and one goal, s.

    Args:
        act: Function to time.
        shape: Shape of an observation; each of the `CALLS` random inputs is uint8.
    """
    images = np.random.default_rng(0).integers(0, 256, (CALLS + 20, 2, 1, *shape), np.uint8)
    seconds = []
    for observation, goal in images:
        start = time.perf_counter()
        act(observation, goal)
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds[20:])


def measure(name: str, episodes: int) -> dict[str, Any]:
    """Export a shipped policy to ONNX, evaluate it in JAX and in onnxruntime, and return its row of the record."""
    policy = jaxrl_vis.load_policy(name)
    call = jax.jit(jax.vmap(policy))

    def by_jax(observation: np.ndarray, goal: np.ndarray) -> np.ndarray:
        return np.asarray(call(observation, goal))

    with tempfile.TemporaryDirectory() as folder:
        check = export_run(name, "onnx", Path(folder) / "onnx")
        by_onnx = Model(check.file)
        rows = run_episodes(policy, [by_jax, by_onnx], episodes)
        shape = policy.observation_spec.shape
        return {
            "name": name,
            "task": policy.env_name,
            "episodes": episodes,
            "golden_difference": check.difference,
            "onnx_bytes": check.file.stat().st_size,
            **{f"jax_{key}": value for key, value in rows[0].items()},
            **{f"onnx_{key}": value for key, value in rows[1].items()},
            "jax_latency_s": measure_latency(by_jax, shape),
            "onnx_latency_s": measure_latency(by_onnx, shape),
        }


def main() -> int:
    """Measure the named policies, or all, and update the record after each; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help="policies; all if none")
    parser.add_argument("--episodes", type=int, default=256)
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of records")
    options = parser.parse_args()
    path = results_path("exported", options.results)
    rows = {row["name"]: row for row in json.loads(path.read_text())["rows"]} if path.exists() else {}
    for name in options.names or shipped.names():
        rows[name] = row = {**measure(name, options.episodes), "revision": provenance.revision()}
        print(json.dumps(row), flush=True)
        record = {"device": provenance.device_name(), "versions": provenance.versions()}
        write_atomically(path, json.dumps({**record, "rows": [rows[key] for key in sorted(rows)]}, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
