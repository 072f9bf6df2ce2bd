"""Tables of docs/tasks.md: FetchPush learned from states, from the runs in ``results/push``."""

import textwrap
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.ledger.markers import WIDTH
from jaxrl_vis.run.storage.folder import read_record
from jaxrl_vis.run.storage.metrics import read_rows

SUCCESS = "eval/success"
_COLUMNS = ("env_steps", "updates", "train/moved", "train/success", SUCCESS)
_ROWS = 10


def cpu_table(results: Path) -> str | None:
    """Return the table of the run on two cores as Markdown; None without its record."""
    return _table(results / "push" / "states_cpu")


def gpu_table(results: Path) -> str | None:
    """Return the table of the run on an H100 as Markdown; None without its record."""
    return _table(results / "push" / "states_h100")


def _table(folder: Path) -> str | None:
    """Return a table of at most ten evaluations of a run, with the range of success over seeds; None without the folder."""
    if not folder.is_dir():
        return None
    rows = [row for row in read_rows(folder / "metrics.jsonl") if SUCCESS in row]
    seeds = sorted({row["seed"] for row in rows})
    steps = sorted({row["env_steps"] for row in rows})
    every = -(-len(steps) // _ROWS)
    shown = steps[::-1][::every][::-1]
    by_step = {step: [[row[name] for row in rows if row["env_steps"] == step] for name in _COLUMNS] for step in steps}
    lowest = {step: min(by_step[step][-1]) for step in steps}
    reached = next((step for step in steps if all(lowest[later] >= 0.95 for later in steps if later >= step)), None)
    return "\n".join(
        [
            "| environment steps | gradient steps | box moves, with exploration | success with exploration | success |",
            "|---|---|---|---|---|",
            *(_row(by_step[step]) for step in shown),
            "",
            _caption(folder, seeds, rows[-1], reached),
        ]
    )


def _row(columns: Sequence[Sequence[float]]) -> str:
    """Return the row of one evaluation from the values of each of `_COLUMNS` by seed."""
    steps, updates, moved, explored, success = columns
    spread = f" ({min(success):.2f} to {max(success):.2f})" if len(success) > 1 else ""
    means = (f"{np.mean(values):.2f}" for values in (moved, explored, success))
    cells = (f"{steps[0]:,}", f"{updates[0]:,}", *means)
    return "| " + " | ".join(cells) + f"{spread} |"


def _caption(folder: Path, seeds: Sequence[int], last: dict, reached: int | None) -> str:
    """Return a caption with seeds, revision, device and duration of a run, and ``reached``, the steps to a lasting 0.95."""
    record = read_record(folder)
    count = f"{len(seeds)} seeds in one program, mean (minimum to maximum)" if len(seeds) > 1 else "One seed"
    milestone = "" if reached is None else f" Every seed stays at 0.95 or above from {reached:,} steps on."
    minutes = last["time/wall_s"] / 60
    text = f"{count}; {record['git_revision'][:7]} on {record['device']['name']}, {minutes:.0f} minutes in all.{milestone}"
    return textwrap.fill(text, WIDTH)
