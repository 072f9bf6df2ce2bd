"""Stored records of benchmarks/results."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from jaxrl_vis.bench.record import SCHEMA, read_json
from jaxrl_vis.errors import RequestError

CHECKOUT = Path(__file__).resolve().parents[2]
RESULTS = CHECKOUT / "benchmarks" / "results"
"""Folder of the records that README and docs quote; its git history has older ones."""


def read_all(folder: Path) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Yield every record in ``folder`` and below with its file, sorted by file. Other JSON files are skipped.

    Raises:
        RequestError: There is no such folder, or a file is not JSON, or cannot be read.
    """
    if not folder.is_dir():
        raise RequestError(f"there is no folder of records {folder}: name one with --results")
    for path in sorted(folder.rglob("*.json")):
        contents = read_json(path)
        for record in contents if isinstance(contents, list) else [contents]:
            # The configuration of a run also has a schema, but neither name nor value.
            if isinstance(record, dict) and record.get("schema") == SCHEMA and "name" in record:
                yield path, record


def is_cpu_record(record: dict[str, Any]) -> bool:
    """Return True for a record of a CPU; its device is a name (`provenance.device_name`) or, for a run, a dictionary."""
    device = record["device"]
    return device["platform"] == "cpu" if isinstance(device, dict) else device.endswith(" cores")
