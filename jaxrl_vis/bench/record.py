"""Benchmark records: one JSON file for each benchmark and device, and the change against what it held before.

A file holds the newest record of every configuration; older ones are in its git history.
"""

import dataclasses
import datetime
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from jaxrl_vis import provenance
from jaxrl_vis.files import write_atomically

SCHEMA = 1
REVISION_DIGITS = 12


@dataclasses.dataclass(frozen=True)
class Measurement:
    """One figure.

    Attributes:
        name: What was measured, as ``benchmark/quantity``.
        value: The figure.
        unit: Its unit; larger is better.
        config: What was asked for. Two figures compare only where this and the device agree.
        details: What else was seen: compile time, spread, roofline.
    """

    name: str
    value: float
    unit: str
    config: dict[str, Any]
    details: dict[str, Any] = dataclasses.field(default_factory=dict)


def to_record(measurement: Measurement) -> dict[str, Any]:
    """The measurement with everything that says where it comes from."""
    return {
        "schema": SCHEMA,
        **dataclasses.asdict(measurement),
        "device": provenance.device_name(),
        "versions": provenance.versions(),
        "revision": provenance.revision(REVISION_DIGITS) or "unknown",
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }


def results_folder() -> Path:
    """benchmarks/results of the checkout that this code lies in, or else of the current folder."""
    home = provenance.CHECKOUT if (provenance.CHECKOUT / "pyproject.toml").exists() else Path.cwd()
    return home / "benchmarks" / "results"


def results_path(benchmark: str, folder: Path | None = None) -> Path:
    """The file of one benchmark on this device."""
    slug = re.sub(r"[^a-z0-9]+", "-", provenance.device_name().lower().replace("(r)", "").replace("(tm)", "")).strip("-")
    return (folder or results_folder()) / f"{benchmark}-{slug}.json"


def load(path: Path) -> list[dict[str, Any]]:
    """The records in a file; none where it is missing.

    Raises:
        ValueError: The file holds something else.
    """
    if not path.exists():
        return []
    records = json.loads(path.read_text())
    if not isinstance(records, list) or any(record.get("schema") != SCHEMA for record in records):
        raise ValueError(f"{path} holds no records of schema {SCHEMA}; move it away to start a new one")
    return records


def read_all(folder: Path) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Every record in ``folder`` and below with its file, sorted by file. Files that hold something else are passed over."""
    for path in sorted(folder.rglob("*.json")):
        contents = json.loads(path.read_text(encoding="utf-8"))
        for record in contents if isinstance(contents, list) else [contents]:
            if isinstance(record, dict) and record.get("schema") == SCHEMA:
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


def write_json(path: Path, measurements: list[Measurement]) -> None:
    """Writes the records of one run."""
    _write(path, [to_record(measurement) for measurement in measurements])


def keep(path: Path, record: dict[str, Any]) -> dict[str, Any] | None:
    """Puts a record into a file, in the place of the last one of the same configuration and device, which is returned."""
    record = json.loads(json.dumps(record))  # as it will be read back: tuples are lists
    records = load(path)
    previous = next((old for old in records if _key(old) == _key(record)), None)
    records = [old for old in records if _key(old) != _key(record)] + [record]
    _write(path, sorted(records, key=_key))
    return previous


def describe(record: dict[str, Any], previous: dict[str, Any] | None) -> str:
    """One line: what, how much, and the change."""
    config = " ".join(f"{name}={value}" for name, value in record["config"].items())
    line = f"{record['name']:24} {config:72} {format_figure(record['value']):>12} {record['unit']}"
    if previous is None:
        return line + "  (first record)"
    change = 100 * (record["value"] / previous["value"] - 1) if previous["value"] else float("nan")
    return line + f"  ({change:+.1f} % against {previous['revision']}, {previous['date'][:10]})"


def format_figure(value: float) -> str:
    """Three or more significant figures, with thousands apart."""
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"


def compare_and_keep(benchmark: str, measurement: Measurement, folder: Path | None = None) -> None:
    """Keeps a measurement and prints its line, with its details below."""
    record = to_record(measurement)
    print(describe(record, keep(results_path(benchmark, folder), record)), flush=True)
    if measurement.details:
        print("    " + ", ".join(f"{name} {value}" for name, value in measurement.details.items()), flush=True)
