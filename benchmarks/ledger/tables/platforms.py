"""Table of docs/where_it_ran.md, written from the records of `jaxrl-vis doctor --report` and of the benchmarks."""

import json
from pathlib import Path
from typing import Any

from benchmarks.ledger.records import read_all
from jaxrl_vis.host.platform_report import SCHEMA

FOLDER = "platforms"
_BENCHMARKS = ("render", "physics", "env", "update", "train")
EXPECTED = (
    (
        "ARM (aarch64, Linux)",
        "Everything: MuJoCo and jaxlib provide wheels, and this project contains no processor-specific binaries.",
    ),
    (
        "Apple (arm64, macOS)",
        "Everything on the CPU, with the wheels of MuJoCo and jaxlib. Its GPU is unsupported, as jax-metal lags behind JAX.",
    ),
    ("TPU", "Training, MJX and the pure JAX renderer; the kernels for NVIDIA GPUs are disabled automatically."),
    ("AMD GPU (ROCm)", "As on a TPU, with AMD's jaxlib."),
)
"""Untested platforms, and what is expected to work."""


def platforms_table(results: Path) -> str | None:
    """Return a table with a row for each machine, Python and JAX, newest first, as Markdown; None without records."""
    rows = [_row(record) for record in _records(results)] + _benchmark_rows(results)
    if not rows:
        return None
    rows.sort(key=lambda row: row[0], reverse=True)
    lines = ["| date | machine | driver | Python | JAX | checks and benchmarks |", "|---|---|---|---|---|---|"]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def not_run_table(_: Path) -> str:
    """Return a table of the untested platforms as Markdown; the folder of records is ignored."""
    return "\n".join(
        ["| untested platform | expected to work |", "|---|---|", *(f"| {name} | {text} |" for name, text in EXPECTED)]
    )


def _records(results: Path) -> list[dict[str, Any]]:
    files = sorted((results / FOLDER).glob("*.json"))
    records = [json.loads(file.read_text(encoding="utf-8")) for file in files]
    return [record for record in records if record.get("platform_schema") == SCHEMA]


def _row(record: dict[str, Any]) -> tuple[str, ...]:
    machine = record["accelerator"] or f"{record['processor']}, {record['cores']} cores"
    checks, training = record["checks"], record["training"]
    failed = [name for name, passed in checks.items() if not passed]
    ran = f"doctor: {len(checks) - len(failed)} of {len(checks)} checks" + (f" (failed: {', '.join(failed)})" if failed else "")
    if training is not None:
        ran += f"; {training['task']}, debug: {training['env_steps_per_s']:,.0f} steps/s"
    versions = record["versions"]
    place = f"{machine} ({record['machine']}, {record['system']})"
    return record["date"], place, record["driver"] or "", versions["python"], versions["jax"], ran


def _benchmark_rows(results: Path) -> list[tuple[str, ...]]:
    """Return a row for each device, Python and JAX that benchmarks were run on, with the newest date."""
    rows: dict[tuple[str, str, str], tuple[str, set[str]]] = {}
    for path, record in read_all(results):
        name = record["name"].partition("/")[0]
        if path.parent != results or name not in _BENCHMARKS or not isinstance(record["device"], str):
            continue
        place = (record["device"], record["versions"]["python"], record["versions"]["jax"])
        date, names = rows.get(place, ("", set()))
        rows[place] = (max(date, record["date"][:10]), names | {name})
    return [
        (date, device, "", python, jax, f"benchmarks: {', '.join(name for name in _BENCHMARKS if name in names)}")
        for (device, python, jax), (date, names) in rows.items()
    ]
