"""Recording of episodes of a trained run, for other programs."""

from pathlib import Path

import jax
import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.host import provenance
from jaxrl_vis.recordings.episodes import Recordings
from jaxrl_vis.run.storage.folder import read_record
from jaxrl_vis.run.trained.restored_run import load, open_run
from jaxrl_vis.run.trained.shipped import find


def record_run(run_dir: Path | str, episodes: int = 50, seed: int = 0, trust: bool = False) -> Recordings:
    """Record episodes without exploration, with the first seed of a run's newest valid checkpoint.

    Args:
        run_dir: The run folder.
        episodes: N, number of episodes.
        seed: Seed of the starts and goals: equal seeds give equal episodes.
        trust: As in `restored_run.open_run`.

    Raises:
        RequestError: There is no run or no usable checkpoint, or the task's images do not have 1, 3 or 4 channels per frame.
    """
    trainer = open_run(run_dir, cache_programs=True, trust=trust)
    restored, programs, env = load(trainer, run_dir), trainer.programs, trainer.env
    spec = env.observation_spec
    if len(spec.shape) == 3 and spec.shape[0] // env.frame_stack not in (1, 3, 4):
        raise RequestError(f"{env.name} shows images of {spec.shape[0]} channels: only depth, colour and both can be recorded")
    played = programs.record(restored.train, jax.random.key(seed), episodes)
    first = jax.tree.map(lambda *leaves: np.concatenate([np.asarray(part[0]) for part in leaves])[:episodes], *played)
    recorded, outcome = first
    depth_range = getattr(getattr(env, "config", None), "depth_range", None)
    about = {
        "task": trainer.config.environment.env,
        "control_period": float(env.control_period),
        "frame_stack": env.frame_stack,
        "depth_range": None if depth_range is None else [float(end) for end in depth_range],
        "distance_unit": env.distance_unit,
        "threshold": float(env.threshold),
        "reward": trainer.config.reward.method,
        "run_seed": trainer.config.run.seed,
        "iteration": restored.iteration,
        "episode_seed": seed,
        "trained_by": read_record(find(run_dir)).get("git_revision"),
        "recorded_by": provenance.revision(),
    }
    return Recordings.of_rollout(recorded, outcome["success"], about)
