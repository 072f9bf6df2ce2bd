"""Benchmark records: one JSON file per benchmark and device, and the change since the previous record.

A file holds the newest record of every configuration. Records are stored in the user's cache unless a folder is named.
"""

import dataclasses
import datetime
import json
import re
from pathlib import Path
from typing import Any

from jaxrl_vis.bench.conditions import comparison_fault
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host import files, provenance
from jaxrl_vis.host.files import user_cache, write_atomically

SCHEMA = 1
REVISION_DIGITS = 12


@dataclasses.dataclass(frozen=True)
class Measurement:
    """Result of one measurement.

    Attributes:
        name: Measured quantity, as ``benchmark/quantity``.
        value: Measured value; larger is better.
        unit: Unit of the value.
        config: Requested configuration. Two values are comparable only if this and the device agree.
        details: Further observations: compilation time, spread, roofline.
    """

    name: str
    value: float
    unit: str
    config: dict[str, Any]
    details: dict[str, Any] = dataclasses.field(default_factory=dict)


def to_record(measurement: Measurement, conditions: dict[str, Any] | None = None) -> dict[str, Any]:
    """Return the record of a measurement: the value, its provenance and its conditions (see `conditions`)."""
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
    """Return the folder of a user's records."""
    return user_cache() / "bench"


def results_path(benchmark: str, folder: Path | None = None) -> Path:
    """Return the path of the file for one benchmark on this device, in ``folder`` or, if that is None, in `user_folder`."""
    slug = re.sub(r"[^a-z0-9]+", "-", provenance.device_name().lower().replace("(r)", "").replace("(tm)", "")).strip("-")
    return (folder or user_folder()) / f"{benchmark}-{slug}.json"


def load(path: Path) -> list[dict[str, Any]]:
    """Read the records of a file; return an empty list if it is missing.

    Raises:
        RequestError: The file does not hold records of this schema.
    """
    if not path.exists():
        return []
    records = read_json(path)
    if not isinstance(records, list) or not all(
        isinstance(record, dict) and record.get("schema") == SCHEMA for record in records
    ):
        raise RequestError(f"{path} holds no records of schema {SCHEMA}; move it away to start a new one")
    return records


def read_json(path: Path) -> Any:
    """Read a JSON file.

    Raises:
        RequestError: The file is not JSON, or cannot be read.
    """
    return files.read_json(path, object, "move it away, or put back what it held")


def _key(record: dict[str, Any]) -> str:
    return json.dumps([record["name"], record["unit"], record["device"], record["config"]], sort_keys=True)


def _write(path: Path, records: list[dict[str, Any]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, json.dumps(records, indent=1, sort_keys=True) + "\n")


def write_json(path: Path, records: list[dict[str, Any]]) -> None:
    """Write the records of one run to a file."""
    _write(path, records)


def keep(path: Path, record: dict[str, Any]) -> dict[str, Any] | None:
    """Store a record in a file; return the record of the same configuration and device that it replaces; None without one."""
    record = json.loads(json.dumps(record))  # as it will be read back: tuples become lists
    records = load(path)
    previous = next((old for old in records if _key(old) == _key(record)), None)
    records = [old for old in records if _key(old) != _key(record)] + [record]
    _write(path, sorted(records, key=_key))
    return previous


def describe(record: dict[str, Any], previous: dict[str, Any] | None) -> str:
    """Describe a record in one line: quantity, configuration, value, and its change if the two are comparable.

    ``previous`` is the record that it replaces; None if there is none.
    """
    config = " ".join(f"{name}={value}" for name, value in record["config"].items())
    line = f"{record['name']:24} {config:72} {format_figure(record['value']):>12} {record['unit']}"
    if previous is None:
        return line + "  (first record)"
    before = f"{format_figure(previous['value'])} of {previous['revision']}, {previous['date'][:10]}"
    reason = comparison_fault(record["conditions"], previous.get("conditions"))
    if reason is not None:
        return line + f"  (not compared with {before}: {reason})"
    change = record["value"] / previous["value"] - 1 if previous["value"] else float("nan")
    spread = max(entry["details"].get("spread", 0.0) for entry in (record, previous))
    noise = f", no more than the spread of the repeats, {100 * spread:.1f} %" if abs(change) <= spread else ""
    return line + f"  ({100 * change:+.1f} % against {before}, the same machine at the same speed{noise})"


def format_figure(value: float) -> str:
    """Format a value with up to four significant digits, or as an integer with thousands separators from 1000 on."""
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"


def compare_and_keep(
    benchmark: str, measurement: Measurement, folder: Path | None = None, conditions: dict[str, Any] | None = None
) -> dict[str, Any]:
    """Store a measurement and print its line, with its details below; return the record.

    Args:
        benchmark: Name of the benchmark.
        measurement: Measurement to store.
        folder: Folder of records; None for `user_folder`.
        conditions: See `conditions.ConditionMonitor`.
    """
    record = to_record(measurement, conditions)
    print(describe(record, keep(results_path(benchmark, folder), record)), flush=True)
    if measurement.details:
        print("    " + ", ".join(f"{name} {value}" for name, value in measurement.details.items()), flush=True)
    return record
