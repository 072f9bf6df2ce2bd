"""Benchmark records: one JSON file per benchmark and device, and the change since the record that was there before.

A file holds the newest record of every configuration. Records lie in the user's cache, unless a folder is named; those that the
README quotes lie in benchmarks/results, whose git history has the older ones.
"""

import dataclasses
import datetime
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from jaxrl_vis import files, provenance
from jaxrl_vis.bench.conditions import why_not_comparable
from jaxrl_vis.errors import RequestError
from jaxrl_vis.files import user_cache, write_atomically

SCHEMA = 1
REVISION_DIGITS = 12


@dataclasses.dataclass(frozen=True)
class Measurement:
    """One figure.

    Attributes:
        name: What was measured, as ``benchmark/quantity``.
        value: The figure.
        unit: Its unit; larger is better.
        config: What was asked for. Two figures can be compared only where this and the device agree.
        details: Whatever else was observed: compilation time, spread, roofline.
    """

    name: str
    value: float
    unit: str
    config: dict[str, Any]
    details: dict[str, Any] = dataclasses.field(default_factory=dict)


def to_record(measurement: Measurement, conditions: dict[str, Any] | None = None) -> dict[str, Any]:
    """The measurement with its provenance and the conditions it was made under (see `conditions`), as it is kept."""
    return {
        "schema": SCHEMA,
        **dataclasses.asdict(measurement),
        "conditions": conditions,
        "device": provenance.device_name(),
        "versions": provenance.versions(),
        "revision": provenance.revision(REVISION_DIGITS) or "unknown",
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }


def user_folder() -> Path:
    """Where a user's records lie."""
    return user_cache() / "bench"


def results_folder() -> Path:
    """The records that the README quotes: benchmarks/results of the checkout that holds this code, or of the current folder."""
    home = provenance.CHECKOUT if (provenance.CHECKOUT / "pyproject.toml").exists() else Path.cwd()
    return home / "benchmarks" / "results"


def results_path(benchmark: str, folder: Path | None = None) -> Path:
    """The file of one benchmark on this device."""
    slug = re.sub(r"[^a-z0-9]+", "-", provenance.device_name().lower().replace("(r)", "").replace("(tm)", "")).strip("-")
    return (folder or user_folder()) / f"{benchmark}-{slug}.json"


def load(path: Path) -> list[dict[str, Any]]:
    """The records in a file; none where it is missing.

    Raises:
        RequestError: The file holds something else.
    """
    if not path.exists():
        return []
    records = read_json(path)
    if not isinstance(records, list) or not all(isinstance(each, dict) and each.get("schema") == SCHEMA for each in records):
        raise RequestError(f"{path} holds no records of schema {SCHEMA}; move it away to start a new one")
    return records


def read_json(path: Path) -> Any:
    """What a JSON file holds.

    Raises:
        RequestError: It holds something else, or cannot be read.
    """
    return files.read_json(path, object, "move it away, or put back what it held")


def read_all(folder: Path) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Every record in ``folder`` and below with its file, sorted by file. JSON files of something else are passed over.

    Raises:
        RequestError: There is no such folder, or a file is not JSON, or cannot be read.
    """
    if not folder.is_dir():
        raise RequestError(f"there is no folder of records {folder}: name one with --results")
    for path in sorted(folder.rglob("*.json")):
        contents = read_json(path)
        for record in contents if isinstance(contents, list) else [contents]:
            # The configuration of a run has a schema, too, but neither name nor value.
            if isinstance(record, dict) and record.get("schema") == SCHEMA and "name" in record:
                yield path, record


def is_of_cpu(record: dict[str, Any]) -> bool:
    """Whether a record was made on a CPU; its device is a name (`provenance.device_name`) or, of a run, a dictionary."""
    device = record["device"]
    return device["platform"] == "cpu" if isinstance(device, dict) else device.endswith(" cores")


def _key(record: dict[str, Any]) -> str:
    return json.dumps([record["name"], record["unit"], record["device"], record["config"]], sort_keys=True)


def _write(path: Path, records: list[dict[str, Any]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, json.dumps(records, indent=1, sort_keys=True) + "\n")


def write_json(path: Path, records: list[dict[str, Any]]) -> None:
    """Writes the records of one run."""
    _write(path, records)


def keep(path: Path, record: dict[str, Any]) -> dict[str, Any] | None:
    """Puts a record into a file. It replaces the one of the same configuration and device, which is returned."""
    record = json.loads(json.dumps(record))  # as it will be read back: tuples are lists
    records = load(path)
    previous = next((old for old in records if _key(old) == _key(record)), None)
    records = [old for old in records if _key(old) != _key(record)] + [record]
    _write(path, sorted(records, key=_key))
    return previous


def describe(record: dict[str, Any], previous: dict[str, Any] | None) -> str:
    """One line: what was measured, the figure, and its change where that says something about the code."""
    config = " ".join(f"{name}={value}" for name, value in record["config"].items())
    line = f"{record['name']:24} {config:72} {format_figure(record['value']):>12} {record['unit']}"
    if previous is None:
        return line + "  (first record)"
    before = f"{format_figure(previous['value'])} of {previous['revision']}, {previous['date'][:10]}"
    why = why_not_comparable(record["conditions"], previous.get("conditions"))
    if why is not None:
        return line + f"  (not compared with {before}: {why})"
    change = record["value"] / previous["value"] - 1 if previous["value"] else float("nan")
    spread = max(each["details"].get("spread", 0.0) for each in (record, previous))
    noise = f", no more than the spread of the repeats, {100 * spread:.1f} %" if abs(change) <= spread else ""
    return line + f"  ({100 * change:+.1f} % against {before}, the same machine at the same speed{noise})"


def format_figure(value: float) -> str:
    """At least three significant figures, with thousands separators."""
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"


def compare_and_keep(
    benchmark: str, measurement: Measurement, folder: Path | None = None, conditions: dict[str, Any] | None = None
) -> dict[str, Any]:
    """Keeps a measurement and prints its line, with its details below; returns the record.

    Args:
        benchmark: Its name.
        measurement: The figure.
        folder: Where it is kept; None: `user_folder`.
        conditions: See `conditions.Watch`.
    """
    record = to_record(measurement, conditions)
    print(describe(record, keep(results_path(benchmark, folder), record)), flush=True)
    if measurement.details:
        print("    " + ", ".join(f"{name} {value}" for name, value in measurement.details.items()), flush=True)
    return record
