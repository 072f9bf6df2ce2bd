"""The evidence behind learning figures: what a run evaluated, kept small, and what follows from it.

    benchmarks/results/learning/NAME.json             schema, name, configuration, command, device, versions, revision, date
    benchmarks/results/learning/NAME.metrics.jsonl    the run's metrics.jsonl, less everything but evaluations and times

`benchmarks/keep_learning.py` keeps a run. What a figure "X by N steps" means: `jaxrl_vis.report.learning`.
"""

import dataclasses
import datetime
import json
from pathlib import Path
from typing import Any

from jaxrl_vis.bench.record import SCHEMA, read_json
from jaxrl_vis.errors import RequestError
from jaxrl_vis.files import write_atomically
from jaxrl_vis.run.command import training_command
from jaxrl_vis.run.folder import RunFolder, read_config, read_record
from jaxrl_vis_envs.documents import parse_json

FOLDER = "learning"
NAME = "learning"
"""What a record of a run is a record of; see `staleness.MEASURED`."""
_COLUMNS = ("seed", "env_steps", "updates")
_PREFIXES = ("eval/", "time/", "resume/")


@dataclasses.dataclass(frozen=True)
class Evidence:
    """A run that was kept.

    Attributes:
        record: The contents of NAME.json.
        rows: Those of NAME.metrics.jsonl: one for each seed and evaluation.
    """

    record: dict[str, Any]
    rows: list[dict[str, Any]]


def keep(run: Path, name: str, results: Path) -> tuple[Path, Path]:
    """Keeps the evidence of a finished run.

    Args:
        run: The run folder.
        name: What the evidence will be called.
        results: The folder of records; the evidence goes into `FOLDER` below it.

    Returns:
        The two files.

    Raises:
        RequestError: There is no run, or it evaluated nothing.
    """
    folder = RunFolder(run)
    about, config = read_record(run), read_config(run)
    rows = [
        {column: value for column, value in row.items() if column in _COLUMNS or column.startswith(_PREFIXES)}
        for row in folder.rows()
    ]
    rows = [row for row in rows if any(column.startswith("eval/") for column in row)]
    if not rows:
        raise RequestError(f"{folder.metrics} holds no evaluation: there is nothing to keep")
    ended = datetime.datetime.fromtimestamp(folder.metrics.stat().st_mtime, datetime.UTC)
    kept = {
        "schema": SCHEMA,
        "name": NAME,
        "config": dataclasses.asdict(config),
        "command": training_command(config),
        "device": about["device"],
        "versions": about["versions"],
        "revision": about["git_revision"] or "unknown",
        "date": ended.isoformat(timespec="seconds"),
    }
    target = results / FOLDER
    target.mkdir(parents=True, exist_ok=True)
    record_file, metrics_file = target / f"{name}.json", target / f"{name}.metrics.jsonl"
    write_atomically(metrics_file, "".join(json.dumps(row) + "\n" for row in rows))
    write_atomically(record_file, json.dumps(kept, indent=1, sort_keys=True) + "\n")
    return record_file, metrics_file


def load(name: str, results: Path) -> Evidence | None:
    """The evidence of that name; None where none was kept.

    Raises:
        RequestError: A file of it is damaged.
    """
    folder = results / FOLDER
    record_file, metrics_file = folder / f"{name}.json", folder / f"{name}.metrics.jsonl"
    if not (record_file.exists() and metrics_file.exists()):
        return None
    try:
        rows = [parse_json(line) for line in metrics_file.read_text(encoding="utf-8").splitlines()]
    except (OSError, ValueError) as error:
        raise RequestError(f"{metrics_file} has a line that is not JSON ({error}): put back what it held") from error
    return Evidence(read_json(record_file), rows)


def seconds(rows: list[dict[str, Any]]) -> tuple[float, float]:
    """Seconds of a run until its last evaluation, and those of them that went into compiling."""
    last = max(rows, key=lambda row: row["time/wall_s"])
    return last["time/wall_s"], last["time/compile_s"]
