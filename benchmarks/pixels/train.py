"""Train brax's PPO from images added to a task by `jaxrl_vis_envs.pixels.wrap`, and record the time to a target.

    python -m benchmarks.pixels.train [--seed N]                on a GPU: CartpoleBalance, to 900 of 1,000
    python -m benchmarks.pixels.train --task FetchReach         the gripper at the goal in 80 % of the steps
    python -m benchmarks.pixels.train --smoke [--task TASK]     the same program on any machine, with minimum sizes

The trainer and the networks are brax's; the tasks and their settings are in `training_tasks`. Evaluations use the deterministic
policy; times are measured from the first call of the trainer, both with and without compilation and evaluations. Record:
pixels-DEVICE.json.
"""

import argparse
import functools
import os
import pathlib
import sys
import time
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any

ROOT = pathlib.Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "envs")]
if __name__ == "__main__" and version("jaxlib").startswith("0.10."):  # brax compiles by itself: see docs/pixels.md
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_cpu_use_fusion_emitters=false".strip()

from benchmarks.ledger.records import RESULTS  # noqa: E402
from benchmarks.pixels.training_tasks import IMAGE_SIZE, SMOKE, TASKS, Task  # noqa: E402
from jaxrl_vis.bench.conditions import ConditionMonitor  # noqa: E402
from jaxrl_vis.bench.record import Measurement, compare_and_keep  # noqa: E402
from jaxrl_vis.errors import RequestError  # noqa: E402
from jaxrl_vis_envs.adapters.brax import share_jax_with_brax  # noqa: E402


def train(task: Task, settings: dict[str, Any], seed: int) -> list[dict[str, float]]:
    """Train, and print the evaluations.

    Args:
        task: The task.
        settings: Arguments of brax's trainer.
        seed: Random seed.

    Returns:
        Evaluations in order: ``env_steps``, the task's ``measure``, time since the call of the trainer (``wall_s``, s), and
        time of training alone (``training_s``, s).
    """
    # Typed Any, because brax's protocols accept only its own environments and networks.
    env: Any = task.make()
    from brax.training.agents.ppo import networks_vision
    from brax.training.agents.ppo import train as ppo

    evaluations: list[dict[str, float]] = []
    start = time.perf_counter()

    def report(env_steps: int, metrics: Mapping[str, Any]) -> None:
        evaluation = {
            "env_steps": int(env_steps),
            task.measure: task.score(metrics),
            "wall_s": round(time.perf_counter() - start, 1),
            "training_s": round(float(metrics.get("training/walltime", 0.0)), 1),
        }
        evaluations.append(evaluation)
        print(", ".join(f"{name} {value:,}" for name, value in evaluation.items()), flush=True)

    networks: Any = functools.partial(networks_vision.make_ppo_networks_vision, **task.networks)
    with share_jax_with_brax():
        ppo.train(
            environment=env,
            eval_env=task.make_evaluated() if task.make_evaluated else None,
            wrap_env_fn=task.wrapper(),
            network_factory=networks,
            progress_fn=report,
            vision=True,
            seed=seed,
            **settings,
        )
    return evaluations


def measurements(name: str, evaluations: list[dict[str, float]], settings: dict[str, Any], seed: int) -> list[Measurement]:
    """Return the records of a run on the task ``name``: its last evaluation, and its speed to the target if it was reached."""
    task = TASKS[name]
    config = {"task": name, "image_size": IMAGE_SIZE, **task.inputs, "seed": seed, **settings}
    details = {"evaluations": evaluations}
    records = [Measurement(f"pixels/{task.measure}", evaluations[-1][task.measure], task.unit, config, details)]
    reached = next((evaluation for evaluation in evaluations if evaluation[task.measure] >= task.target), None)
    if reached is not None:
        speed = round(1.0 / reached["wall_s"], 6)
        records.append(Measurement(f"pixels/speed_to_{task.target:g}", speed, "1/s", config, {**details, **reached}))
    return records


def main(arguments: Sequence[str] | None = None) -> int:
    """Train, and store the record unless it is a smoke run; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", choices=TASKS, default="CartpoleBalance")
    parser.add_argument("--smoke", action="store_true", help="a few steps of a few environments, without a record")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--timesteps", type=int, help="environment steps (default: the task's, 1,000,000 or 3,000,000)")
    parser.add_argument("--envs", type=int, help="environments (default: the task's, 1,024 or 2,048)")
    parser.add_argument("--results", type=pathlib.Path, default=RESULTS, help="folder of stored records")
    options = parser.parse_args(arguments)
    task = TASKS[options.task]
    settings = {**task.settings, **(SMOKE if options.smoke else {})}
    settings |= {"num_timesteps": options.timesteps} if options.timesteps else {}
    settings |= {"num_envs": options.envs} if options.envs else {}
    try:
        if settings["batch_size"] * settings["num_minibatches"] % settings["num_envs"]:
            batch = settings["batch_size"] * settings["num_minibatches"]
            raise RequestError(
                f"--envs must be a divisor of {batch} (minibatches times their size), got {settings['num_envs']}"
            )
        monitor = None if options.smoke else ConditionMonitor()
        evaluations = train(task, settings, options.seed)
    except RequestError as error:
        print(error, file=sys.stderr)
        return 2
    if monitor is not None:
        for measurement in measurements(options.task, evaluations, settings, options.seed):
            compare_and_keep("pixels", measurement, options.results, monitor.conditions())
    return 0


if __name__ == "__main__":
    sys.exit(main())
