"""Table of docs/algorithms.md: forms of contrastive RL on FetchReach from states, from the runs in ``results/contrastive``."""

from pathlib import Path

import numpy as np

from jaxrl_vis.config import config_from_dict
from jaxrl_vis.run.storage.folder import read_record
from jaxrl_vis.run.storage.metrics import read_rows

SUCCESS = "eval/success"
_FORMS = {
    "nce": ("binary cross-entropy", "as DDPG's"),
    "balanced": ("the same, positives as heavy as negatives", "as DDPG's"),
    "nce_stabilised": ("binary cross-entropy", "stabilised"),
    "infonce_plain": ("symmetric InfoNCE", "as DDPG's"),
    "stable": ("symmetric InfoNCE", "stabilised"),
}
"""Loss and networks by form, in the order of the rows."""


def forms_table(results: Path) -> str | None:
    """Return the table as Markdown; None without records."""
    folders = sorted(folder for folder in (results / "contrastive").glob("*") if folder.is_dir())
    if not folders:
        return None
    rows = sorted((_row(folder) for folder in folders), key=lambda row: row[0])
    lines = [
        "| form | loss | networks | gradient steps in 1,000 steps | seeds | mean success | success at the end |",
        "|---|---|---|---|---|---|---|",
        *(line for _, line, _ in rows),
        "",
        f"Made by {', '.join(sorted({revision for *_, revision in rows}))}.",
    ]
    return "\n".join(lines)


def _row(folder: Path) -> tuple[tuple[int, int], str, str]:
    """Return the sort key of a run in the table, its row as Markdown, and its revision and device as text."""
    record = read_record(folder)
    config = config_from_dict(record["config"])
    named = config.run.algorithm
    form = config.contrastive.contrastive_form if named == "contrastive" else named.partition(":")[2]
    rows = [row for row in read_rows(folder / "metrics.jsonl") if SUCCESS in row]
    seeds = sorted({row["seed"] for row in rows})
    means = [np.mean([row[SUCCESS] for row in rows if row["seed"] == seed]) for seed in seeds]
    last = [[row[SUCCESS] for row in rows if row["seed"] == seed][-1] for seed in seeds]
    share = rows[-1]["updates"] / rows[-1]["env_steps"]
    loss, networks = _FORMS[form]
    cells = (
        f"`{form}`",
        loss,
        networks,
        f"{1000 * share:,.0f}",
        ", ".join(map(str, seeds)),
        ", ".join(f"{value:.2f}" for value in means),
        ", ".join(f"{value:.2f}" for value in last),
    )
    place = list(_FORMS).index(form), rows[-1]["updates"]
    return place, "| " + " | ".join(cells) + " |", f"{record['git_revision'][:7]} on {record['device']['kind']}"
