"""Benchmark records: one JSON file for each benchmark and device, and the change against what it held before.

A file holds the newest record of every configuration; older ones are in its git history.
"""

import dataclasses
import datetime
import functools
import importlib.metadata
import json
import os
import platform
import re
import subprocess
from pathlib import Path
from typing import Any

SCHEMA = 1
LIBRARIES = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "flax", "optax")
_CHECKOUT = Path(__file__).resolve().parents[2]


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


@functools.cache
def device_name() -> str:
    """The machine that computes: the accelerator's name and count, or the processor's name and usable cores."""
    import jax

    if jax.default_backend() != "cpu":
        return f"{jax.devices()[0].device_kind} x{jax.device_count()}"
    name = platform.processor() or platform.machine()
    if os.path.exists("/proc/cpuinfo"):
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            name = next((line.split(":", 1)[1].strip() for line in file if line.startswith("model name")), name)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"{name}, {cores} cores"


def library_versions() -> dict[str, str]:
    """Versions of what decides speed."""
    return {"python": platform.python_version(), **{name: importlib.metadata.version(name) for name in LIBRARIES}}


def git_revision(folder: Path = _CHECKOUT) -> str:
    """The checkout's revision, with ``-dirty`` where code differs from it (kept records do not count); or ``unknown``.

    JAXRL_VIS_REVISION, where it is set, goes first: for a copy that travelled without its history.
    """
    if os.environ.get("JAXRL_VIS_REVISION"):
        return os.environ["JAXRL_VIS_REVISION"]

    def git(*arguments: str) -> str:
        return subprocess.run(["git", "-C", folder, *arguments], capture_output=True, text=True, check=True).stdout.strip()

    try:
        if Path(git("rev-parse", "--show-toplevel")).resolve() != folder.resolve():
            return "unknown"
        dirty = git("status", "--porcelain", "--", ".", ":!benchmarks/results")
        return git("rev-parse", "--short=12", "HEAD") + ("-dirty" if dirty else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def to_record(measurement: Measurement) -> dict[str, Any]:
    """The measurement with everything that says where it comes from."""
    return {
        "schema": SCHEMA,
        **dataclasses.asdict(measurement),
        "device": device_name(),
        "versions": library_versions(),
        "revision": git_revision(),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }


def results_folder() -> Path:
    """benchmarks/results of the checkout that this code lies in, or else of the current folder."""
    home = _CHECKOUT if (_CHECKOUT / "pyproject.toml").exists() else Path.cwd()
    return home / "benchmarks" / "results"


def results_path(benchmark: str, folder: Path | None = None) -> Path:
    """The file of one benchmark on this device."""
    slug = re.sub(r"[^a-z0-9]+", "-", device_name().lower().replace("(r)", "").replace("(tm)", "")).strip("-")
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


def _key(record: dict[str, Any]) -> str:
    return json.dumps([record["name"], record["unit"], record["device"], record["config"]], sort_keys=True)


def _write(path: Path, records: list[dict[str, Any]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    scratch = path.with_suffix(".json.part")
    scratch.write_text(json.dumps(records, indent=1, sort_keys=True) + "\n")
    scratch.replace(path)


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
