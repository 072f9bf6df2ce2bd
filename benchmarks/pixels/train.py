"""Trains brax's PPO on MuJoCo Playground's CartpoleBalance from 64x64 images, and records the time to 900 of 1,000.

    python -m benchmarks.pixels.train [--seed N]          on a GPU, as published: 1,024 environments, 1,000,000 steps
    python -m benchmarks.pixels.train --smoke             the same program on any machine, as small as it goes

The environment is `jaxrl_vis_envs.pixels.wrap`'s, the wrapper around it Playground's, and the trainer and the networks brax's.
The settings are those that Playground published for its images by Madrona (its release 0.0.4), which took 57 s on an RTX 4090.
An observation is the last three RGB images, where theirs is in grey. Returns are of the deterministic policy; times are from
the first call of the trainer on, with compilation and evaluations, and without either. Record: pixels-DEVICE.json.
"""

import argparse
import functools
import os
import pathlib
import sys
import time
from collections.abc import Mapping, Sequence
from typing import Any

ROOT = pathlib.Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "envs")]
if __name__ == "__main__":  # brax compiles by itself: see docs/pixels.md
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_cpu_use_fusion_emitters=false".strip()

from benchmarks.ledger.records import RESULTS  # noqa: E402
from benchmarks.pixels import playground  # noqa: E402
from jaxrl_vis.bench.conditions import Watch  # noqa: E402
from jaxrl_vis.bench.record import Measurement, compare_and_keep  # noqa: E402
from jaxrl_vis.errors import RequestError  # noqa: E402
from jaxrl_vis_envs import pixels  # noqa: E402
from jaxrl_vis_envs.adapters.brax import lend_jax  # noqa: E402

TASK, IMAGE_SIZE, FRAMES = "CartpoleBalance", 64, 3
TARGET = 900.0  # of 1,000
SETTINGS: dict[str, Any] = {
    "num_timesteps": 1_000_000,
    "num_evals": 6,
    "episode_length": 1000,
    "num_envs": 1024,
    "num_eval_envs": 128,
    "batch_size": 256,
    "num_minibatches": 8,
    "num_updates_per_batch": 8,
    "unroll_length": 10,
    "discounting": 0.97,
    "learning_rate": 5e-4,
    "entropy_cost": 5e-3,
    "reward_scaling": 0.1,
    "max_grad_norm": 1.0,
    "normalize_observations": False,
    "deterministic_eval": True,
}
SMOKE: dict[str, Any] = {
    "num_timesteps": 64,
    "num_evals": 2,
    "episode_length": 20,
    "num_envs": 4,
    "num_eval_envs": 4,
    "batch_size": 4,
    "num_minibatches": 2,
    "num_updates_per_batch": 1,
    "unroll_length": 4,
}
HIDDEN_LAYERS = (256, 256)


def make_env() -> pixels.PixelEnv:
    """Make the task with images alone as its observation: the lines that a user writes."""
    env = playground.load(TASK)
    return pixels.wrap(env, "fixed", IMAGE_SIZE, frames=FRAMES, layout="images")


def train(settings: dict[str, Any], seed: int) -> list[dict[str, float]]:
    """Train, and print the evaluations.

    Args:
        settings: Arguments of brax's trainer.
        seed: Random seed.

    Returns:
        Evaluations in order: ``env_steps``, ``episode_return``, seconds since the call of the trainer (``wall_s``), and
        those of training alone (``training_s``).
    """
    from brax.training.agents.ppo import networks_vision
    from brax.training.agents.ppo import train as ppo
    from mujoco_playground import wrapper  # pyright: ignore[reportMissingImports]

    evaluations: list[dict[str, float]] = []
    start = time.perf_counter()

    def report(env_steps: int, metrics: Mapping[str, Any]) -> None:
        evaluation = {
            "env_steps": int(env_steps),
            "episode_return": round(float(metrics["eval/episode_reward"]), 1),
            "wall_s": round(time.perf_counter() - start, 1),
            "training_s": round(float(metrics.get("training/walltime", 0.0)), 1),
        }
        evaluations.append(evaluation)
        print(", ".join(f"{name} {value:,}" for name, value in evaluation.items()), flush=True)

    # Of any type: brax's protocols know their own environments and networks alone.
    env: Any = make_env()
    networks: Any = functools.partial(
        networks_vision.make_ppo_networks_vision,
        policy_hidden_layer_sizes=HIDDEN_LAYERS,
        value_hidden_layer_sizes=HIDDEN_LAYERS,
        normalise_channels=True,
    )
    with lend_jax():
        ppo.train(
            environment=env,
            wrap_env_fn=wrapper.wrap_for_brax_training,
            network_factory=networks,
            progress_fn=report,
            vision=True,
            seed=seed,
            **settings,
        )
    return evaluations


def measurements(evaluations: list[dict[str, float]], settings: dict[str, Any], seed: int) -> list[Measurement]:
    """Return the records of a run: its last return, and its speed to the target if it was reached."""
    config = {"task": TASK, "image_size": IMAGE_SIZE, "frames": FRAMES, "seed": seed, **settings}
    details = {"evaluations": evaluations}
    records = [Measurement("pixels/return", evaluations[-1]["episode_return"], "of 1,000", config, details)]
    reached = next((evaluation for evaluation in evaluations if evaluation["episode_return"] >= TARGET), None)
    if reached is not None:
        speed = round(1.0 / reached["wall_s"], 6)
        records.append(Measurement("pixels/speed_to_900", speed, "1/s", config, {**details, **reached}))
    return records


def main(arguments: Sequence[str] | None = None) -> int:
    """Train, and store the record; a smoke run stores none."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="a few steps of a few environments, without a record")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--timesteps", type=int, help=f"environment steps (default: {SETTINGS['num_timesteps']:,})")
    parser.add_argument("--envs", type=int, help=f"environments (default: {SETTINGS['num_envs']:,})")
    parser.add_argument("--results", type=pathlib.Path, default=RESULTS, help="folder of stored records")
    options = parser.parse_args(arguments)
    settings = {**SETTINGS, **(SMOKE if options.smoke else {})}
    settings |= {"num_timesteps": options.timesteps} if options.timesteps else {}
    settings |= {"num_envs": options.envs} if options.envs else {}
    try:
        if settings["batch_size"] * settings["num_minibatches"] % settings["num_envs"]:
            batch = settings["batch_size"] * settings["num_minibatches"]
            raise RequestError(
                f"--envs must be a divisor of {batch} (minibatches times their size), got {settings['num_envs']}"
            )
        playground.suite()
        watch = None if options.smoke else Watch()
        evaluations = train(settings, options.seed)
    except RequestError as error:
        print(error, file=sys.stderr)
        return 2
    if watch is not None:
        for measurement in measurements(evaluations, settings, options.seed):
            compare_and_keep("pixels", measurement, options.results, watch.conditions())
    return 0


if __name__ == "__main__":
    sys.exit(main())
