"""The files that an earlier part of a run has left: whether it was finished, and whether they belong together."""

from collections.abc import Collection
from pathlib import Path

from jaxrl_vis.errors import RequestError
from jaxrl_vis.run import metrics
from jaxrl_vis.run.checkpoint import DAMAGED, Checkpoints, Restored
from jaxrl_vis.run.folder import RunFolder
from jaxrl_vis.run.progress import Progress


def is_evaluated(folder: RunFolder, seeds: Collection[int], restored: Restored) -> bool:
    """Whether the evaluation that a run ends with is there, of all seeds, if what was restored is its end."""
    rows = [row for row in folder.rows() if row["iteration"] == restored.iteration and "eval/success" in row]
    is_due = Progress.from_dict(restored.progress).evaluation_due
    return not is_due and {row["seed"] for row in rows} >= set(seeds)


def refuse_missing_rows(folder: RunFolder, restored: Restored) -> None:
    """Checks that metrics.jsonl has what was evaluated before a checkpoint was saved; damaged lines may have been that, those
    of an earlier resumption too, which lie with the damaged checkpoints.

    Raises:
        RequestError: It ends earlier.
    """
    since = restored.progress.get("since_evaluation")
    evaluated = 0 if since is None else restored.iteration - len(since)
    last = max((row["iteration"] for row in folder.rows()), default=0)
    if last < evaluated and not metrics.read_contents(folder.metrics).damaged and not _aside(folder).exists():
        raise RequestError(
            f"checkpoint {restored.tier}/{restored.iteration} of {folder.path} comes after an evaluation at iteration "
            f"{evaluated}, but {folder.metrics.name} ends at {last}: put back the whole file, or move the checkpoints after "
            f"iteration {last} away to train those iterations again"
        )


def cut_back(folder: RunFolder, checkpoints: Checkpoints, last: int, keeps_later: bool) -> str | None:
    """Keeps rows of the run up to an iteration in metrics.jsonl; `metrics.cut_back` has the rest."""
    return metrics.cut_back(folder.metrics, last, checkpoints.run_id, _aside(folder), keeps_later)


def _aside(folder: RunFolder) -> Path:
    return folder.checkpoints / DAMAGED / folder.metrics.name
