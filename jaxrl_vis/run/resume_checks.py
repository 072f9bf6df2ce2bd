"""Checks before a run is resumed: whether it is finished, and whether its files are consistent."""

import sys
from collections.abc import Callable, Collection
from pathlib import Path

import jax.numpy as jnp

from jaxrl_vis.config import Config
from jaxrl_vis.errors import RequestError
from jaxrl_vis.run.compiled.programs import Programs
from jaxrl_vis.run.storage import metrics, scores
from jaxrl_vis.run.storage.checkpoint import DAMAGED, FOREIGN, FULL, LIGHT, Checkpoints
from jaxrl_vis.run.storage.folder import RunFolder, read_run_id
from jaxrl_vis.run.storage.progress import Progress
from jaxrl_vis.run.storage.restoring import Restored
from jaxrl_vis.types import LoopState


def is_finished(
    folder: RunFolder, checkpoints: Checkpoints, programs: Programs, total: int, echo: Callable[[str], None]
) -> bool:
    """Return True if a run is complete, with a valid last checkpoint, its evaluation, and its images.

    The last checkpoint is that after ``total`` iterations, or after an early end. If it cannot be read, one line is passed to
    ``echo``, and the run is not complete.
    """
    last = _last_saved(checkpoints)
    if last < total and not has_ended_early(folder, programs.config, programs.seeds, last):
        return False
    restored = checkpoints.restore_train(programs.shapes)
    if restored is None or restored.iteration < min(last, total):
        echo("the last checkpoint is not usable, so the run is not finished: resuming from the last good one")
        return False
    files = [folder.curve, folder.video] if programs.shows_images else [folder.curve]
    return is_evaluated(folder, programs.seeds, restored) and all(file.exists() for file in files)


def has_ended_early(folder: RunFolder, config: Config, seeds: Collection[int], iteration: int) -> bool:
    """Return True if the evaluation after ``iteration`` has reached the level at which the run stops."""
    return config.run.stop_at is not None and iteration in scores.enough_at(config, folder.rows(), seeds)


def finished_message(folder: RunFolder, checkpoints: Checkpoints, config: Config, total: int) -> str:
    """Return the message for a complete run, including how to continue it."""
    last = _last_saved(checkpoints)
    if last < total:
        reached = f"{last} of {total} iterations, --stop-at {config.run.stop_at:g} is reached"
        return f"{folder.path} is finished already ({reached}): ask for another --stop-at to go on"
    return f"{folder.path} is finished already ({total} iterations): ask for more --env-steps to go on"


def _last_saved(checkpoints: Checkpoints) -> int:
    return max([0, *checkpoints.iterations(LIGHT), *checkpoints.iterations(FULL)])


def state_without_replay(programs: Programs, restored: Restored) -> LoopState:
    """Build the state for resuming from a light checkpoint, which has no replay.

    Networks, optimisers, statistics and the iteration (and with it the random draws) are restored; the replay starts empty.
    Until it has filled up again, updates sample from fewer and newer episodes: a valid run, but not a continuation of the
    interrupted one.
    """
    fresh, layout = programs.init(programs.run_keys), programs.layout
    iteration = layout.put(jnp.asarray(restored.iteration, fresh.iteration.dtype), layout.replicated)
    return fresh.replace(train=restored.train, iteration=iteration)


def is_evaluated(folder: RunFolder, seeds: Collection[int], restored: Restored) -> bool:
    """Return True if the evaluation at the restored iteration exists for all seeds and none is due."""
    rows = [row for row in folder.rows() if row["iteration"] == restored.iteration and "eval/success" in row]
    is_due = Progress.from_dict(restored.progress).evaluation_due
    return not is_due and {row["seed"] for row in rows} >= set(seeds)


def last_evaluation(restored: Restored) -> int:
    """Return the iteration of the last scheduled evaluation before a checkpoint; 0 if there was none, or none is recorded."""
    since = restored.progress.get("since_evaluation")
    return 0 if since is None else restored.iteration - len(since)


def check_missing_rows(folder: RunFolder, restored: Restored) -> None:
    """Check that metrics.jsonl contains the evaluations before a checkpoint.

    Damaged lines and rows of another run count as possible evaluations, because a single flipped bit produces either. So do
    lines that an earlier resumption moved to the damaged or foreign checkpoints.

    Raises:
        RequestError: Evaluations are missing.
    """
    evaluated = last_evaluation(restored)
    rows, contents = folder.rows(), metrics.read_contents(folder.metrics)
    last = max((row["iteration"] for row in rows), default=0)
    has_others = len(contents.rows) > len(rows) or any(aside.exists() for aside in _asides(folder))
    if last < evaluated and not (contents.damaged or contents.torn or has_others):
        raise RequestError(
            f"checkpoint {restored.tier}/{restored.iteration} of {folder.path} comes after an evaluation at iteration "
            f"{evaluated}, but {folder.metrics.name} ends at {last}: put back the whole file, or move the checkpoints after "
            f"iteration {last} away to train those iterations again"
        )


def truncate_metrics(
    folder: RunFolder, checkpoints: Checkpoints, last: int, keeps_later: bool = False, evaluated: int = 0
) -> str | None:
    """Truncate metrics.jsonl to the run's rows up to iteration ``last``; other arguments as for `metrics.truncate`."""
    return metrics.truncate(folder.metrics, last, checkpoints.run_id, *_asides(folder), keeps_later, evaluated)


def set_foreign_files_aside(folder: RunFolder, checkpoints: Checkpoints) -> list[str]:
    """Move other runs' files aside before this folder's run is deleted; return lines that report it."""
    try:
        checkpoints.run_id = read_run_id(folder.path)
    except RequestError:  # without an id, no file can be attributed
        return []
    moved = checkpoints.set_aside_foreign_runs()
    report = truncate_metrics(folder, checkpoints, sys.maxsize)
    return [*map(foreign_message, moved), *([report] if report else [])]


def foreign_message(path: Path) -> str:
    """Return a message about another run's file and its new location."""
    return f"not of this run, and left out: {path}"


def _asides(folder: RunFolder) -> tuple[Path, Path]:
    """Return the files for damaged lines, and for rows of other runs."""
    return folder.checkpoints / DAMAGED / folder.metrics.name, folder.checkpoints / FOREIGN / folder.metrics.name
