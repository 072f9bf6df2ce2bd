"""Evidence for learning figures: the evaluations of training runs, in a compact form.

    benchmarks/results/learning/NAME.json             schema, name, configuration, command, device, versions, revision, date
    benchmarks/results/learning/NAME.metrics.jsonl    the run's metrics.jsonl, reduced to evaluations and times

`python -m benchmarks.ledger keep` stores a run. `jaxrl_vis.report.learning` defines "X by N steps".
"""

import dataclasses
import datetime
import json
from pathlib import Path
from typing import Any

from jaxrl_vis.bench.record import SCHEMA, read_json
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.files import write_atomically
from jaxrl_vis.run.command import training_command
from jaxrl_vis.run.storage.folder import RunFolder, read_config, read_record
from jaxrl_vis_envs.documents import parse_json

FOLDER = "learning"
NAME = "learning"
"""Name of the records of runs; see `staleness.MEASURED`."""
_COLUMNS = ("seed", "env_steps", "updates")
_PREFIXES = ("eval/", "time/", "resume/")


@dataclasses.dataclass(frozen=True)
class Evidence:
    """Stored run.

    Attributes:
        record: Contents of NAME.json.
        rows: Contents of NAME.metrics.jsonl, one row per seed and evaluation.
    """

    record: dict[str, Any]
    rows: list[dict[str, Any]]


def keep_run(run: Path, name: str, results: Path) -> tuple[Path, Path]:
    """Store the evidence of a finished run.

    Args:
        run: Run folder.
        name: Name of the evidence.
        results: Folder of records; the evidence goes into `FOLDER` below it.

    Returns:
        Paths of the record and of the file of its rows.

    Raises:
        RequestError: There is no run, or it has no evaluation.
    """
    folder = RunFolder(run)
    run_record, config = read_record(run), read_config(run)
    rows = [
        {column: value for column, value in row.items() if column in _COLUMNS or column.startswith(_PREFIXES)}
        for row in folder.rows()
    ]
    rows = [row for row in rows if any(column.startswith("eval/") for column in row)]
    if not rows:
        raise RequestError(f"{folder.metrics} holds no evaluation: there is nothing to keep")
    ended = datetime.datetime.fromtimestamp(folder.metrics.stat().st_mtime, datetime.UTC)
    record = {
        "schema": SCHEMA,
        "name": NAME,
        "config": dataclasses.asdict(config),
        "command": training_command(config),
        "device": run_record["device"],
        "versions": run_record["versions"],
        "revision": run_record["git_revision"] or "unknown",
        "date": ended.isoformat(timespec="seconds"),
    }
    target = results / FOLDER
    target.mkdir(parents=True, exist_ok=True)
    record_file, metrics_file = target / f"{name}.json", target / f"{name}.metrics.jsonl"
    write_atomically(metrics_file, "".join(json.dumps(row) + "\n" for row in rows))
    write_atomically(record_file, json.dumps(record, indent=1, sort_keys=True) + "\n")
    return record_file, metrics_file


def load(name: str, results: Path) -> Evidence | None:
    """Load evidence by its name; return None if there is none.

    Raises:
        RequestError: A file is damaged.
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
    """Return the duration of a run until its last evaluation, and the time of it that compilation took, s."""
    last = max(rows, key=lambda row: row["time/wall_s"])
    return last["time/wall_s"], last["time/compile_s"]
