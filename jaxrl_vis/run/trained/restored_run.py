"""Use of trained runs and policies: evaluation, and videos of episodes.

A run is given by its folder, or by the name of a policy that comes with the package (`shipped`).
"""

from pathlib import Path
from typing import Literal

import jax
import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.learner.acting.evaluate import num_recorded
from jaxrl_vis.report import videos, viewer
from jaxrl_vis.run.compiled.memory import check_compiled
from jaxrl_vis.run.storage.checkpoint import BEST, FULL, LIGHT, Checkpoints
from jaxrl_vis.run.storage.folder import read_config, read_run_id
from jaxrl_vis.run.storage.restoring import Restored
from jaxrl_vis.run.trained import policy_file
from jaxrl_vis.run.trained.shipped import find
from jaxrl_vis.run.trainer import Trainer, make_trainer
from jaxrl_vis.run.trust import check as check_trusted


def open_run(run_dir: Path | str, cache_programs: bool = False, trust: bool = False, **changes: object) -> Trainer:
    """Create the trainer of a run on one device, with changed fields of its configuration; its folder is not modified.

    Args:
        run_dir: The run folder.
        cache_programs: As in `make_trainer`; programs traced by the training are reused.
        trust: Whether to allow execution of the run's custom code (`jaxrl_vis.run.trust`).
        **changes: New values of fields of `Config`.

    Raises:
        RequestError: There is no run, its code is not trusted, or its trainer cannot be created any more.
    """
    folder = find(run_dir)
    saved = read_config(folder)
    check_trusted(folder, saved, trust)
    config = saved.replace(devices=1, data_devices=None, **changes)
    alone = policy_file.holds_policy(folder)
    if alone:
        config = config.replace(seed=policy_file.read_source(folder).seed, seeds=1)
    return make_trainer(config, cache_programs=cache_programs, policy_alone=alone)


Choice = int | Literal["best"] | None
"""Checkpoint of a run: its iteration, ``best`` for the best one by `RunOptions.best_by`, or None for the newest valid one."""


def load(trainer: Trainer, run_dir: Path | str, checkpoint: Choice = None) -> Restored:
    """Load a saved learner of a run.

    Args:
        trainer: From `open_run`.
        run_dir: The run folder.
        checkpoint: See `Choice`.

    Raises:
        RequestError: There is no such checkpoint, or no usable one.
    """
    run_dir = find(run_dir)
    if policy_file.holds_policy(run_dir):
        train, source = policy_file.read(run_dir, trainer)
        policy_file.check_source(source, checkpoint=checkpoint)
        return Restored(LIGHT, source.iteration, train, None, {})
    checkpoints = Checkpoints(run_dir / "checkpoints", read_only=True, run_id=read_run_id(run_dir))
    if checkpoint == "best":
        return _load_best(trainer, run_dir, checkpoints)
    saved = sorted({*checkpoints.iterations(LIGHT), *checkpoints.iterations(FULL)})
    if checkpoint is not None and saved and checkpoint not in saved:
        available = ", ".join(map(str, saved))
        raise RequestError(f"the run in {run_dir} has no checkpoint of iteration {checkpoint}, only of {available}")
    try:
        restored = checkpoints.restore_train(trainer.shapes, checkpoint)
    finally:
        checkpoints.close()
    if restored is None and saved and checkpoint is not None:
        raise RequestError(f"checkpoint {checkpoint} of the run in {run_dir} is damaged: leave it out for the newest good one")
    if restored is None:
        raise RequestError(f"the run in {run_dir} has no usable checkpoint: train it first")
    return restored


def _load_best(trainer: Trainer, run_dir: Path | str, checkpoints: Checkpoints) -> Restored:
    try:
        iterations = checkpoints.iterations(BEST)
        if not iterations:
            raise RequestError(f"the run in {run_dir} has kept no best checkpoint: train with --best-by, such as success")
        return checkpoints.restore(BEST, checkpoints.manifest(BEST, iterations[-1]), trainer.shapes)
    finally:
        checkpoints.close()


def evaluate_run(
    run_dir: Path | str,
    episodes: int | None = None,
    cache_programs: bool = False,
    trust: bool = False,
    checkpoint: Choice = None,
) -> dict[str, list[float]]:
    """Evaluate a checkpoint of a run.

    Args:
        run_dir: The run folder.
        episodes: Number of episodes; None for that of the training.
        cache_programs, trust: As in `open_run`.
        checkpoint: See `Choice`.

    Returns:
        ``eval/success``, ``eval/goal_distance`` etc.: one number per seed.

    Raises:
        RequestError: There is no run, no usable checkpoint, or too little memory for this number of episodes.
    """
    trainer = open_run(run_dir, cache_programs, trust, **({} if episodes is None else {"eval_episodes": episodes}))
    restored = load(trainer, run_dir, checkpoint)
    check_compiled(trainer.programs.evaluation_programs(), is_allocated=True)
    values = jax.device_get(trainer.evaluate(restored.train))
    return {name: [float(number) for number in value] for name, value in values.items()}


def play_run(
    run_dir: Path | str,
    out: Path | str,
    episodes: int = 6,
    three_dimensional: bool = False,
    cache_programs: bool = False,
    trust: bool = False,
    checkpoint: Choice = None,
) -> None:
    """Roll out the first seed of a run's checkpoint, and write a video.

    Args:
        run_dir: The run folder.
        out: .gif, .mp4 (needs imageio-ffmpeg, the extra ``video``), .html or .png.
        episodes: Number of episodes.
        three_dimensional: Whether to write an .html page for brax's viewer (needs brax) instead of the robot's images; also for
            state variants.
        cache_programs, trust: As in `open_run`.
        checkpoint: See `Choice`.

    Raises:
        RequestError: There is no run, no usable checkpoint, no image to show, or ``out`` cannot be written.
    """
    out = Path(out)
    (viewer.check_page if three_dimensional else videos.check_output)(out)
    trainer = open_run(run_dir, cache_programs, trust, eval_episodes=num_recorded(max(1, episodes)))
    programs = trainer.programs
    if not (programs.shows_images or three_dimensional):
        raise RequestError(
            f"{trainer.config.environment.env} shows the robot no images: play a run on a Visual task, or with --html"
        )
    train = load(trainer, run_dir, checkpoint).train
    if three_dimensional:
        viewer.write_page(programs.program, train, programs.evaluation_key, max(1, episodes), out)
        return
    parts, count = [], 0
    while count < episodes:
        _, recorded = programs.evaluate(train, jax.random.fold_in(programs.evaluation_key, count) if parts else None)
        parts.append(videos.first_seed(recorded))
        count += len(parts[-1].success)
    joined = videos.EpisodeImages(
        *(np.concatenate([getattr(part, name) for part in parts])[:episodes] for name in ("frames", "goals", "success"))
    )
    videos.write_video(joined, out, programs.image_seconds, max_episodes=episodes)
