"""Table of docs/indicator_rewards.md: rewards compared with the true ones, from the records of `jaxrl-vis audit --json`."""

import textwrap
from pathlib import Path
from typing import Any

from benchmarks.claims.markdown import origin_sentence
from benchmarks.claims.records import Record
from benchmarks.ledger.markers import WIDTH
from jaxrl_vis.bench.record import read_json
from jaxrl_vis.studies.audit.report import COLUMNS
from jaxrl_vis.studies.audit.rewards import BUILT_IN

FOLDER = "audit"


def audit_table(results: Path) -> str | None:
    """Return a table with a row for each task and reward as Markdown; None without records."""
    files = sorted((results / FOLDER).glob("*.json"))
    return rows([read_json(file) for file in files]) if files else None


def rows(records: list[dict[str, Any]]) -> str:
    """Return a table of the records of several audits as Markdown, followed by their settings and origins."""
    lines = ["| " + " | ".join(["task", "reward", *COLUMNS.values()]) + " |", "|" + "---|" * (len(COLUMNS) + 2)]
    for record in records:
        task = _task(record["audit"])
        for name, measures in record["rewards"].items():
            cells = [task, _reward(name), *(f"{measures[key]:.3f}" for key in COLUMNS)]
            lines.append("|" + "".join(f" {cell} |" if cell else " |" for cell in cells))
            task = ""
    origins = frozenset(f"{(record['revision'] or 'unknown')[:7]} on {record['device']}" for record in records)
    made = " ".join(origin_sentence([Record(FOLDER, (), origins)]).split())
    return "\n".join([*lines, "", textwrap.fill(f"{_settings([record['audit'] for record in records])}. {made}", WIDTH)])


def _task(options: dict[str, Any]) -> str:
    """Return a task with its images and camera noise, which can differ from row to row, as text."""
    size, noise = options["image_size"], options["noise"]
    return f"{options['env']}, {size}x{size} {options['pixels']}" + (f", noise {noise:g}" if noise else "")


def _reward(name: str) -> str:
    """Return the name of a reward in the table; a run folder is named after the model that was trained in it."""
    return f"`{name}`" if name in BUILT_IN or ":" in name else f"{Path(name).name}, trained"


def _settings(audits: list[dict[str, Any]]) -> str:
    """Return the settings of audits as text, with the tasks of each if they differ."""
    tasks: dict[str, list[str]] = {}
    for options in audits:
        counts = f"{options['episodes']} episodes, {options['goals']} goals with {options['sequences']} action sequences each"
        tolerance = f"{options['tolerance']:g} grey levels in {options['tolerance_share']:g} of the elements"
        text = f"{counts}; `indicator_tolerance` tolerates {tolerance}"
        tasks.setdefault(text, []).append(options["env"])
    if len(tasks) == 1:
        return next(iter(tasks))
    return ". ".join(f"{', '.join(names)}: {text}" for text, names in tasks.items())
