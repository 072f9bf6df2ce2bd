"""Leftovers of an earlier part of a run: was it finished, do its files belong together, and how it goes on."""

import sys
from collections.abc import Callable, Collection
from pathlib import Path

import jax.numpy as jnp

from jaxrl_vis.errors import RequestError
from jaxrl_vis.run import metrics
from jaxrl_vis.run.checkpoint import DAMAGED, FOREIGN, FULL, LIGHT, Checkpoints, Restored
from jaxrl_vis.run.compiled.programs import Programs
from jaxrl_vis.run.folder import RunFolder, read_run_id
from jaxrl_vis.run.progress import Progress
from jaxrl_vis.types import LoopState


def is_finished(
    folder: RunFolder, checkpoints: Checkpoints, programs: Programs, total: int, say: Callable[[str], None]
) -> bool:
    """Returns whether a run was trained for ``total`` iterations: a good checkpoint, a row for it, and what it draws."""
    if max([0, *checkpoints.iterations(LIGHT), *checkpoints.iterations(FULL)]) < total:
        return False
    restored = checkpoints.restore_train(programs.shapes)
    if restored is None or restored.iteration < total:
        say("the last checkpoint is not usable, so the run is not finished: going on from the last good one")
        return False
    files = [folder.curve, folder.video] if programs.shows_images else [folder.curve]
    return is_evaluated(folder, programs.seeds, restored) and all(file.exists() for file in files)


def without_replay(programs: Programs, restored: Restored) -> LoopState:
    """The state that a run goes on with from a light checkpoint, which has no replay.

    Networks, optimisers, statistics and the iteration go on (and with it the random draws); the replay starts empty, and knows
    that it is. Until it has filled up again, updates see fewer and newer episodes than they would have: a sound run, but not
    the one that was interrupted.
    """
    fresh, layout = programs.init(programs.run_keys), programs.layout
    iteration = layout.put(jnp.asarray(restored.iteration, fresh.iteration.dtype), layout.everywhere)
    return fresh.replace(train=restored.train, iteration=iteration)


def is_evaluated(folder: RunFolder, seeds: Collection[int], restored: Restored) -> bool:
    """Returns whether the evaluation that a run ends with is there, of all seeds, if what was restored is its end."""
    rows = [row for row in folder.rows() if row["iteration"] == restored.iteration and "eval/success" in row]
    is_due = Progress.from_dict(restored.progress).evaluation_due
    return not is_due and {row["seed"] for row in rows} >= set(seeds)


def last_evaluation(restored: Restored) -> int:
    """The last iteration that a checkpoint knows to have been evaluated; 0 for none."""
    since = restored.progress.get("since_evaluation")
    return 0 if since is None else restored.iteration - len(since)


def refuse_missing_rows(folder: RunFolder, restored: Restored) -> None:
    """Checks that metrics.jsonl has what was evaluated before a checkpoint was saved; damaged lines may have been that, those
    of an earlier resumption too, which lie with the damaged checkpoints.

    Raises:
        RequestError: It ends earlier.
    """
    evaluated = last_evaluation(restored)
    last = max((row["iteration"] for row in folder.rows()), default=0)
    contents = metrics.read_contents(folder.metrics)
    if last < evaluated and not contents.damaged and not contents.torn and not _aside(folder).exists():
        raise RequestError(
            f"checkpoint {restored.tier}/{restored.iteration} of {folder.path} comes after an evaluation at iteration "
            f"{evaluated}, but {folder.metrics.name} ends at {last}: put back the whole file, or move the checkpoints after "
            f"iteration {last} away to train those iterations again"
        )


def cut_back(folder: RunFolder, checkpoints: Checkpoints, last: int, keeps_later: bool, evaluated: int = 0) -> str | None:
    """Keeps rows of the run up to an iteration in metrics.jsonl; `metrics.cut_back` has the rest."""
    others = folder.checkpoints / FOREIGN / folder.metrics.name
    return metrics.cut_back(folder.metrics, last, checkpoints.run_id, _aside(folder), others, keeps_later, evaluated)


def set_others_aside(folder: RunFolder, checkpoints: Checkpoints) -> list[str]:
    """Keeps what other runs left in this folder before the run in it is deleted; lines that say so."""
    try:
        checkpoints.run_id = read_run_id(folder.path)
    except RequestError:  # so nothing tells whose anything is
        return []
    moved = checkpoints.set_foreign_aside()
    said = cut_back(folder, checkpoints, sys.maxsize, keeps_later=False)
    return [*map(say_foreign, moved), *([said] if said else [])]


def say_foreign(path: Path) -> str:
    """Words for what another run left, and where it is now."""
    return f"not of this run, and left out: {path}"


def _aside(folder: RunFolder) -> Path:
    return folder.checkpoints / DAMAGED / folder.metrics.name
