"""Tables of docs/lab/target_decay.md, written from the stored runs by `make tables`."""

import collections
import dataclasses
import itertools
import re
import textwrap
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.claims.permutation import permutation_p_value
from benchmarks.ledger.markers import WIDTH
from benchmarks.ledger.records import RESULTS
from jaxrl_vis.config import config_from_dict
from jaxrl_vis.report.learning import curve, steps_to
from jaxrl_vis.report.plots import format_steps
from jaxrl_vis.run.storage.folder import read_record
from jaxrl_vis.run.storage.metrics import read_rows
from jaxrl_vis.studies.figures.authors import mean_difference, released_curves
from jaxrl_vis.studies.seed_statistics import bootstrap_interval, interquartile_mean

SUCCESS = "eval/success"
RELEASED_DECAY = 0.98
VARIANTS = {"none": "without", "ol_aux_5": "OL-AUX-5"}
TASKS = {
    "VisualFetchReach": ("VisualFetchReach", (0.5, 0.9), 240_000),
    "VisualFingerTurn": ("VisualFingerTurn", (0.3, 0.5, 0.9), 1_000_000),
    "VisualHandReach-view=fingertips": ("VisualHandReach as the authors saw it", (0.1, 0.2, 0.3), 1_000_000),
}
"""Heading, success levels, and budget of the mean success (environment steps), by the task in a record's name."""


@dataclasses.dataclass(frozen=True)
class Group:
    """All seeds of one task, variant and decay.

    Attributes:
        rows: Evaluations of all seeds.
        revisions: Revisions and devices of the runs, as text.
    """

    rows: list[dict[str, Any]]
    revisions: frozenset[str]

    @property
    def seeds(self) -> list[int]:
        """Seeds, ascending."""
        return sorted({row["seed"] for row in self.rows})

    @property
    def points(self) -> list[tuple[int, float]]:
        """Points (environment steps, median success) at the evaluations common to all seeds."""
        return curve(self.rows, SUCCESS)

    def means(self, budget: int) -> np.ndarray:
        """Return the mean success over the evaluations up to ``budget`` environment steps, [S]."""
        return np.array(
            [
                np.mean([row[SUCCESS] for row in self.rows if row["seed"] == seed and row["env_steps"] <= budget])
                for seed in self.seeds
            ]
        )


def read_groups(studies: Path) -> dict[tuple[str, str, float], Group]:
    """Read the runs by task, variant and decay.

    For `RELEASED_DECAY` without runs of its own, use those of figure 5.4 (seeds 0 to 4).

    Args:
        studies: Folder with the subfolders ``target_decay`` and ``ol_aux``.
    """
    folders = collections.defaultdict(list)
    for folder in sorted((studies / "target_decay").iterdir()):
        task, variant, decay = re.fullmatch(r"(.+)-(\w+)-paper-decay([\d.]+)-seeds\d+to\d+", folder.name).groups()
        folders[task, variant, float(decay)].append(folder)
    for task, variant in itertools.product(TASKS, VARIANTS):
        env, _, view = task.partition("-")
        name = f"{env}-{variant}-paper-{view and view + '-*-'}seeds[0-9]to*"
        folders.setdefault((task, variant, RELEASED_DECAY), sorted((studies / "ol_aux").glob(name)))
    return {key: _read_group(key[2], parts) for key, parts in folders.items()}


def _read_group(decay: float, folders: list[Path]) -> Group:
    records = [read_record(folder) for folder in folders]
    assert all(config_from_dict(record["config"]).ddpg.target_decay == decay for record in records), folders
    rows = [row for folder in folders for row in read_rows(folder / "metrics.jsonl") if SUCCESS in row]
    revisions = {f"{record['git_revision'][:7]} on {record['device']['kind']}" for record in records}
    return Group(rows, frozenset(revisions))


def steps_cell(group: Group, level: float) -> str:
    """Format the environment steps until the median success reaches a level, or ``> STEPS`` of the last evaluation if never."""
    steps = steps_to(group.points, level)
    return f"> {format_steps(group.points[-1][0])}" if steps is None else format_steps(steps)


def task_table(task: str, groups: dict[tuple[str, str, float], Group]) -> list[str]:
    """Return the lines of a task's Markdown table, one row per variant and decay (descending)."""
    title, levels, budget = TASKS[task]
    theirs = released_curves()
    lines = [
        f"| {title} | decay | seeds | {' | '.join(f'steps to {level:g}' for level in levels)} | mean success to "
        f"{format_steps(budget)}, IQM (95 %) | distance to the authors' curve |",
        "|---|---|---|" + "---|" * len(levels) + "---|---|",
    ]
    for variant, label in VARIANTS.items():
        for (_, _, decay), group in sorted(groups.items(), key=lambda item: -item[0][2]):
            if (task, variant, decay) not in groups or groups[task, variant, decay] is not group:
                continue
            means = group.means(budget)
            low, high = bootstrap_interval([means])
            distance = mean_difference(group.points, theirs[task.partition("-")[0], variant])
            lines.append(
                f"| {label} | {decay:g} | {group.seeds[0]} to {group.seeds[-1]} | "
                + " | ".join(steps_cell(group, level) for level in levels)
                + f" | {interquartile_mean([means]):.3f} ({low:.3f} to {high:.3f}) | {distance:.3f} |"
            )
    return lines


def comparison_table(groups: dict[tuple[str, str, float], Group]) -> list[str]:
    """Return the lines of the Markdown table of OL-AUX-5's gain at every decay: means, and p-value of a permutation test."""
    lines = ["| task | decay | without | OL-AUX-5 | seeds | p |", "|---|---|---|---|---|---|"]
    for task, (title, _, budget) in TASKS.items():
        for decay in sorted({key[2] for key in groups if key[0] == task}, reverse=True):
            pair = [groups.get((task, variant, decay)) for variant in VARIANTS]
            if None in pair:
                continue
            means = [group.means(budget) for group in pair]
            p = permutation_p_value(*means)
            lines.append(
                f"| {title} | {decay:g} | {means[0].mean():.3f} | {means[1].mean():.3f} | "
                f"{len(means[0])} and {len(means[1])} | {p:.3f} |"
            )
    return lines


def tables(results: Path = RESULTS) -> str:
    """Return all tables of the page as Markdown, followed by the runs' revisions and devices."""
    groups = read_groups(results / "studies")
    parts = [line for task in TASKS for line in [*task_table(task, groups), ""]]
    revisions = sorted({text for group in groups.values() for text in group.revisions})
    runs = textwrap.fill(f"Runs: {', '.join(revisions)}.", WIDTH)
    return "\n".join([*parts, *comparison_table(groups), "", runs]) + "\n"
