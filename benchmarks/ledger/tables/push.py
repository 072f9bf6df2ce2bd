"""Tables of docs/tasks.md: FetchPush learned from states and from images, from the runs in ``results/push``."""

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
_IMAGES = {
    "images_oracle": "true success",
    "images_oracle_aux": "true success, five auxiliary losses (OL-AUX)",
    "images_oracle_td3": "true success, TD3",
    "images_oracle_plain": "true success, critic observes images",
    "images_filter_mask": "`indicator_balance_filter`, box's pixels",
    "images_filter_mask_td3": "`indicator_balance_filter`, box's pixels, TD3",
    "images_tolerance_mask": "`indicator_tolerance`, box's pixels",
    "images_filter": "`indicator_balance_filter`, whole image",
    "images_autoencoder": "`autoencoder`",
    "images_contrastive": "contrastive RL without a reward, critic observes images",
}
"""Rows of `images_table`: folders of the runs, and their reward."""
_IMAGES_STEPS = (250_000, 500_000, 750_000, 1_000_000)


def cpu_table(results: Path) -> str | None:
    """Return the table of the run on two cores as Markdown; None without its record."""
    return _table(results / "push" / "states_cpu")


def gpu_table(results: Path) -> str | None:
    """Return the table of the run on an H100 as Markdown; None without its record."""
    return _table(results / "push" / "states_h100")


def images_table(results: Path) -> str | None:
    """Return the success of all runs from images after some environment steps as Markdown; None without records."""
    rows, sources = [], set()
    for name, label in _IMAGES.items():
        folder = results / "push" / name
        if not folder.is_dir():
            continue
        evaluations = [row for row in read_rows(folder / "metrics.jsonl") if SUCCESS in row]
        by_step = {step: [row for row in evaluations if row["env_steps"] == step] for step in _IMAGES_STEPS}
        cells = [_mean_and_range([row[SUCCESS] for row in by_step[step]]) for step in _IMAGES_STEPS]
        last = evaluations[-1]
        seeds = len({row["seed"] for row in evaluations})
        moved = np.mean([row["eval/moved"] for row in evaluations if row["env_steps"] == last["env_steps"]])
        end = "" if last["env_steps"] >= _IMAGES_STEPS[-1] else f", stopped after {last['env_steps']:,}"
        minutes = f"{last['time/wall_s'] / 60:.0f} min{end}"
        rows.append("| " + " | ".join((label, str(seeds), *cells, f"{moved:.2f}", minutes)) + " |")
        record = read_record(folder)
        sources.add(f"{record['git_revision'][:7]} on {record['device']['name']}")
    if not rows:
        return None
    steps = " | ".join(f"{step:,}" for step in _IMAGES_STEPS)
    caption = f"Mean (minimum to maximum) over seeds, all in one program; {'; '.join(sorted(sources))}."
    heading = f"| reward | seeds | {steps} steps | box moves | in all |"
    return "\n".join([heading, "|---" * (len(_IMAGES_STEPS) + 4) + "|", *rows, "", textwrap.fill(caption, WIDTH)])


def _mean_and_range(values: Sequence[float]) -> str:
    """Return the mean of seeds' values with their range, if there are several; an empty cell without values."""
    spread = f" ({min(values):.2f} to {max(values):.2f})" if len(values) > 1 else ""
    return f"{np.mean(values):.2f}{spread}" if values else ""


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
    steps_to_target = next((step for step in steps if all(lowest[later] >= 0.95 for later in steps if later >= step)), None)
    return "\n".join(
        [
            "| environment steps | gradient steps | box moves, with exploration | success with exploration | success |",
            "|---|---|---|---|---|",
            *(_row(by_step[step]) for step in shown),
            "",
            _caption(folder, seeds, rows[-1], steps_to_target),
        ]
    )


def _row(columns: Sequence[Sequence[float]]) -> str:
    """Return the row of one evaluation from the values of each of `_COLUMNS` by seed."""
    steps, updates, moved, explored, success = columns
    spread = f" ({min(success):.2f} to {max(success):.2f})" if len(success) > 1 else ""
    means = (f"{np.mean(values):.2f}" for values in (moved, explored, success))
    cells = (f"{steps[0]:,}", f"{updates[0]:,}", *means)
    return "| " + " | ".join(cells) + f"{spread} |"


def _caption(folder: Path, seeds: Sequence[int], last: dict, steps_to_target: int | None) -> str:
    """Return a caption with seeds, revision, device and duration of a run, and the steps to a lasting 0.95."""
    record = read_record(folder)
    count = f"{len(seeds)} seeds in one program, mean (minimum to maximum)" if len(seeds) > 1 else "One seed"
    milestone = "" if steps_to_target is None else f" Every seed stays at 0.95 or above from {steps_to_target:,} steps on."
    minutes = last["time/wall_s"] / 60
    text = f"{count}; {record['git_revision'][:7]} on {record['device']['name']}, {minutes:.0f} minutes in all.{milestone}"
    return textwrap.fill(text, WIDTH)
