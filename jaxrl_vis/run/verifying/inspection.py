"""Inspection of a run folder without computation: missing, damaged or foreign contents. Nothing is written."""

import collections
import dataclasses
import json
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxrl_vis.config import OPTIONS, Config
from jaxrl_vis.host.files import is_count
from jaxrl_vis.run.goodput import read_processes
from jaxrl_vis.run.storage.checkpoint import BEST, DAMAGED, FOREIGN, FULL, LIGHT, RECENT
from jaxrl_vis.run.storage.folder import EXPORT_FOLDER, LOGGER_FOLDERS, WANDB_STATE, RunFolder
from jaxrl_vis.run.storage.lock import FILE_NAME as LOCK_NAME
from jaxrl_vis.run.storage.metrics import RUN_ID, RowKeys
from jaxrl_vis.run.storage.recent import foreign_names

LOST = "resume/replay_lost_at"
"""Key of a row: the last iteration at which the run resumed without its replay."""

_PLAYED = ("play.gif", "play.mp4", "play.html", "play.png", "play_aux.gif")
_ASIDE = {DAMAGED: "damaged", FOREIGN: "another run's"}
_SHOWN = 5  # maximum number of list entries quoted in a message


@dataclasses.dataclass
class Findings:
    """Findings about a run folder, as lines of text.

    Attributes:
        problems: Contents that an untouched run never has.
        notes: Other information.
    """

    problems: list[str] = dataclasses.field(default_factory=list)
    notes: list[str] = dataclasses.field(default_factory=list)


@dataclasses.dataclass(frozen=True)
class RowConditions:
    """Conditions that every row of a run must meet.

    Attributes:
        seeds: Seeds of the run, in order.
        updates, env_steps: Gradient steps and environment steps in an iteration, per seed.
        eval_interval: Iterations between evaluations.
        run_id: Id of the run.
    """

    seeds: Sequence[int]
    updates: int
    env_steps: int
    eval_interval: int
    run_id: str


def format_list(values: Iterable[Any]) -> str:
    """Format the first few values, and the number of further ones."""
    words = [str(value) for value in values]
    return ", ".join(words[:_SHOWN]) + (f" and {len(words) - _SHOWN} more" if len(words) > _SHOWN else "")


def _is_metric(value: Any) -> bool:
    return value is None or (isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value))


def _read_line(line: bytes) -> dict[str, Any] | str:
    """Parse a row, or describe its fault."""
    try:
        row = json.loads(line.decode("utf-8"))
    except (ValueError, RecursionError):  # UnicodeDecodeError and JSONDecodeError are ValueErrors
        return "is damaged"
    if not isinstance(row, dict) or not all(is_count(row.get(name)) for name in RowKeys._fields):
        return f"is not a row: {', '.join(RowKeys._fields)} must be numbers"
    return row


def read_file(path: Path, expected: RowConditions, is_written: bool, findings: Findings) -> list[dict[str, Any]]:
    """Read the rows of a run from a metrics file, in the order of the file; faults of other lines are reported.

    Args:
        path: metrics.jsonl.
        expected: Conditions on every row.
        is_written: Whether another process may be writing, so that the last line may be incomplete.
        findings: Findings, to which this adds.
    """
    *lines, rest = path.read_bytes().split(b"\n") if path.exists() else [b""]
    if rest and not is_written:
        findings.problems.append(f"{path.name}: the last line is cut off")
    rows: list[dict[str, Any]] = []
    for number, line in enumerate(lines, 1):
        row = _read_line(line)
        fault = row if isinstance(row, str) else _fault(row, expected)
        if fault:
            findings.problems.append(f"{path.name}, line {number}: {fault}")
        elif isinstance(row, dict):
            rows.append(row)
    _check_order(path.name, rows, expected, findings)
    return rows


def _fault(row: Mapping[str, Any], expected: RowConditions) -> str:
    """Describe a contradiction between a row and the configuration; empty if there is none."""
    iteration = row["iteration"]
    if row.get(RUN_ID) != expected.run_id:
        return f"is another run's ({row[RUN_ID]})" if RUN_ID in row else "names no run"
    if row["seed"] not in expected.seeds:
        return f"is of seed {row['seed']}, which config.json does not have"
    for name, per_iteration in (("updates", expected.updates), ("env_steps", expected.env_steps)):
        if row[name] != iteration * per_iteration:
            return f"{name} is {row[name]}, not {iteration * per_iteration} as config.json implies for {iteration} iterations"
    if LOST in row and not (is_count(row[LOST]) and row[LOST] <= iteration):
        return f"{LOST} is {row[LOST]!r}, which does not fit iteration {iteration}"
    wrong = [name for name, value in row.items() if name != RUN_ID and not _is_metric(value)]
    if wrong or "eval/success" not in row:
        return f"{', '.join(wrong)}: not a number" if wrong else "holds no evaluation"
    return ""


def _check_order(name: str, rows: Sequence[Mapping[str, Any]], expected: RowConditions, findings: Findings) -> None:
    keys = [(row["iteration"], row["seed"]) for row in rows]
    twice = sorted(key for key, count in collections.Counter(keys).items() if count > 1)
    for iteration, seed in twice:
        findings.problems.append(f"{name}: iteration {iteration}, seed {seed} occurs more than once")
    unique = list(dict.fromkeys(keys))
    if unique != sorted(unique):
        first = next(after for before, after in zip(unique, unique[1:], strict=False) if after < before)
        findings.problems.append(f"{name}: iteration {first[0]}, seed {first[1]} is out of order")
    lost = [row[LOST] for row in rows if LOST in row]
    if lost != sorted(lost) or (lost and any(LOST not in row for row in rows if row["iteration"] > lost[0])):
        findings.problems.append(f"{name}: {LOST} goes back")


def missing_rows(
    rows: Sequence[Mapping[str, Any]],
    expected: RowConditions,
    last_written: int,
    total: int,
    without: Collection[int],
    is_written: bool,
) -> list[str]:
    """List required rows that are missing, as lines of text.

    Args:
        rows: The rows of the file.
        expected: Conditions on the rows.
        last_written: Last iteration whose rows were written, according to checkpoints, or 0.
        total: Iterations of the run; the last one is always evaluated.
        without: Scheduled iterations without an evaluation.
        is_written: Whether another process may be writing rows of the last iteration.
    """
    seeds_at: dict[int, set[int]] = {}
    for row in rows:
        seeds_at.setdefault(row["iteration"], set()).add(row["seed"])
    last = max([last_written, *seeds_at])
    scheduled = set(range(expected.eval_interval, last + 1, expected.eval_interval)) - set(without)
    scheduled |= {total} if last_written == total else set()
    absent = sorted(scheduled - set(seeds_at))
    lines = []
    if absent:
        lines.append(
            f"metrics.jsonl: rows of iteration {format_list(absent)} are missing (every {expected.eval_interval}, "
            "unless a part of the run before a resumption had another eval_interval)"
        )
    for iteration, seeds in sorted(seeds_at.items()):
        if seeds < set(expected.seeds) and not (is_written and iteration == max(seeds_at)):
            lines.append(
                f"metrics.jsonl: iteration {iteration} has no row of seed {format_list(sorted(set(expected.seeds) - seeds))}"
            )
    return lines


def check_record(record: Mapping[str, Any], config: Config, findings: Findings) -> None:
    """Report contradictions and omissions in config.json.

    Args:
        record: Contents of the file.
        config: The configuration in it.
        findings: Findings, to which this adds.
    """
    if record.get("preset") != config.run.preset:
        findings.problems.append(
            f"config.json: preset is {record.get('preset')!r} above and {config.run.preset!r} in the configuration"
        )
    device = record.get("device")
    count = device.get("count") if isinstance(device, Mapping) else None
    if count is None:
        findings.problems.append("config.json: does not name the device of the run")
    elif is_count(count) and config.run.devices > count:
        findings.problems.append(f"config.json: the run is on {config.run.devices} devices, but only {count} existed")
    if not isinstance(record.get("versions"), Mapping):
        findings.problems.append("config.json: does not name the versions of the libraries")
    saved = record.get("config")
    groups = saved.values() if isinstance(saved, Mapping) else ()
    unset = sorted(set(OPTIONS).difference(*(group for group in groups if isinstance(group, Mapping))))
    if unset:
        findings.notes.append(f"config.json does not have {format_list(unset)}: taken to be the default")


def check_files(folder: RunFolder, is_finished: bool, shows_images: bool, findings: Findings) -> None:
    """Report foreign files, incomplete and set aside checkpoints, and files that a finished run lacks.

    Args:
        folder: The run folder.
        is_finished: Whether the run is complete.
        shows_images: Whether the task has images, so that a complete run has a video.
        findings: Findings, to which this adds.
    """
    files = (folder.config, folder.metrics, folder.processes, folder.curve, folder.video)
    of_run = {file.name for file in files} | {LOCK_NAME, WANDB_STATE, *_PLAYED}
    of_run |= {folder.checkpoints.name, folder.nonfinite.name, EXPORT_FOLDER, *LOGGER_FOLDERS}
    foreign = [entry.name for entry in folder.path.iterdir() if entry.name not in of_run]
    if folder.checkpoints.is_dir():
        names = [entry.name for entry in folder.checkpoints.iterdir()]
        foreign += [f"checkpoints/{name}" for name in names if name not in (LIGHT, FULL, BEST, RECENT, *_ASIDE)]
        for tier in (LIGHT, FULL, BEST):
            entries = list((folder.checkpoints / tier).iterdir()) if (folder.checkpoints / tier).is_dir() else []
            names = {entry.name for entry in entries if not (entry.is_dir() and entry.name.isdigit())}
            half = sorted(name for name in names if ".orbax-checkpoint-tmp" in name)
            findings.notes += [f"checkpoints/{tier}/{name} is half-written" for name in half]
            foreign += [f"checkpoints/{tier}/{name}" for name in names - set(half)]
        foreign += [f"checkpoints/{RECENT}/{name}" for name in foreign_names(folder.checkpoints / RECENT)]
        for name, reason in _ASIDE.items():
            if (folder.checkpoints / name).is_dir():
                aside = sorted(entry.name for entry in (folder.checkpoints / name).iterdir())
                findings.notes.append(f"set aside before as {reason}: {format_list(aside)}")
    if None in read_processes(folder.processes):
        findings.notes.append(f"{folder.processes.name} has a damaged line: the goodput of the run is unknown")
    if folder.nonfinite.is_dir():
        findings.notes.append(f"the run has met a non-finite number: {folder.nonfinite.name}/ has its state")
    if foreign:
        findings.notes.append(f"not files of a run: {format_list(sorted(foreign))}")
    if is_finished:
        wanted = [folder.curve, *([folder.video] if shows_images else [])]
        findings.problems += [f"{file.name} is missing, though the run is finished" for file in wanted if not file.exists()]
