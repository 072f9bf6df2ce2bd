"""Add the policy of a run to the package, under a name: `python -m benchmarks.ship RUN NAME [--checkpoint best]`.

The folder jaxrl_vis/pretrained/NAME receives the run's config.json, the weights in float16 (observation statistics in float32),
and a card. The card's score is that of the shipped file on fresh episodes, which occurred neither in training nor in its
evaluations, with the score of the float32 weights on the same episodes beside it. The table in docs/play.md must have a row for
each policy; a test compares it with the card.
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path

import jax

from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.files import write_atomically
from jaxrl_vis.run.pushed.card import Score, card, score
from jaxrl_vis.run.pushed.push import public_record
from jaxrl_vis.run.storage.folder import RunFolder, read_config
from jaxrl_vis.run.trained import policy_file, shipped
from jaxrl_vis.run.trained.policy import load_policy
from jaxrl_vis.run.trained.restored_run import Choice, load, open_run

FRESH_KEY = 59_000_000
"""Seed of the fresh episodes: larger than all seeds of runs, and different from that of evaluations."""
MAX_BYTES = 2 * 1024**2


def fresh_score(run_dir: Path, checkpoint: Choice, seed: int, iteration: int, episodes: int) -> Score:
    """Evaluate one seed of a run, or a policy alone, on fresh episodes.

    Args:
        run_dir: Run folder, or folder of a policy.
        checkpoint: Checkpoint of the run; None for the newest, or for a policy.
        seed: Seed of the learner within the run.
        iteration: Iteration of the checkpoint, for the environment steps in the score.
        episodes: Number of episodes.
    """
    trainer = open_run(run_dir, cache_programs=True, eval_episodes=episodes)
    metrics = trainer.evaluate(load(trainer, run_dir, checkpoint).train, jax.random.key(FRESH_KEY))
    row = {name: float(values[trainer.seeds.index(seed)]) for name, values in metrics.items()}
    return score({**row, "env_steps": iteration * trainer.program.steps_per_iteration}, episodes)


def ship(run_dir: Path, name: str, checkpoint: Choice = None, seed: int | None = None, episodes: int = 256) -> Score:
    """Write the folder of a policy in the package; return the score of the shipped weights on fresh episodes.

    Args:
        run_dir: Run folder.
        name: Name of the policy's folder.
        checkpoint: Checkpoint to ship; None for that of `load_policy`.
        seed: Seed to ship; None for that of `load_policy`.
        episodes: Number of fresh episodes.

    Raises:
        RequestError: The run cannot be used, or its policy is too large.
    """
    policy = load_policy(run_dir, seed=seed, checkpoint=checkpoint)
    score_float32 = fresh_score(run_dir, checkpoint, policy.seed, policy.iteration, episodes)
    shipped.FOLDER.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(dir=shipped.FOLDER, prefix=".ship-") as temporary:
        folder = Path(temporary) / name
        folder.mkdir()
        policy_file.write(folder, policy.parameters, policy_file.Source(policy.seed, policy.iteration), bits=16)
        record = public_record(run_dir)
        write_atomically(folder / RunFolder(folder).config.name, json.dumps(record, indent=2) + "\n")
        size = (folder / policy_file.FILE_NAME).stat().st_size
        if size > MAX_BYTES:
            raise RequestError(
                f"the policy of {run_dir} takes {size / 2**20:.1f} MiB: ship one of {MAX_BYTES / 2**20:.0f} MiB or less"
            )
        score_float16 = fresh_score(folder, None, policy.seed, policy.iteration, episodes)
        remark = (
            f"The episodes are fresh ones, drawn from key {FRESH_KEY} after the training. The weights are shipped in float16 "
            f"({size / 1e6:.2f} MB), and the figures are theirs; in float32 success is {score_float32.success:.3f}."
        )
        text = card(
            read_config(run_dir),
            record,
            policy.seed,
            {policy.seed: score_float16},
            policy.env.distance_unit,
            shipped_name=name,
            remark=remark,
        )
        write_atomically(folder / "README.md", text)
        place = shipped.FOLDER / name
        place.mkdir(exist_ok=True)
        for file in folder.iterdir():
            file.replace(place / file.name)
    return score_float16


def main() -> None:
    """Ship the policy that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="the run folder")
    parser.add_argument("name", help="name in the package: a lower-case word")
    parser.add_argument("--checkpoint", help="iteration, or best; the newest if not given")
    parser.add_argument("--seed", type=int, help="seed, of a run with several; the first if not given")
    parser.add_argument("--episodes", type=int, default=256, help="fresh episodes of the evaluation")
    options = parser.parse_args()
    if not options.name.isidentifier() or options.name != options.name.lower():
        sys.exit(f"{options.name} is not a lower-case word")
    checkpoint = int(options.checkpoint) if (options.checkpoint or "").isdecimal() else options.checkpoint
    try:
        result = ship(options.run, options.name, checkpoint, options.seed, options.episodes)
    except RequestError as error:
        sys.exit(str(error))
    print(f"{shipped.FOLDER / options.name}: success {result.success:.3f} ({result.low:.3f} to {result.high:.3f})")


if __name__ == "__main__":
    main()
