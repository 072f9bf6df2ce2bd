"""Tables of docs/scaling.md, written from the records of benchmarks/scaling.py on the machine with the most devices."""

from pathlib import Path
from typing import Any

from jaxrl_vis.bench.record import load

KINDS = {
    ("seeds", 512): "seeds, one each, with evaluations",
    ("weak", 2048): "one learner, 2,048 a device",
    ("weak", 512): "one learner, 512 a device",
    ("strong", 2048): "one learner, strong scaling",
    ("strong", 512): "",
}
"""Label of the first row by kind and batch size (per device for weak scaling)."""
_RECORD = "scaling-nvidia-h200-x4.json"
_GOOD = 0.95  # minimum efficiency of a speed-up set in bold


def _kind(record: dict[str, Any]) -> tuple[str, int]:
    config, kind = record["config"], record["name"].partition("/")[2]
    return kind, config["batch_size"] // (config["devices"] if kind == "weak" else 1)


def devices_table(results: Path) -> str:
    """Return a table that compares N devices with one, as Markdown; times are milliseconds per iteration."""
    records = [record for record in load(results / _RECORD) if record["details"].get("one_device_ms")]
    lines = [
        "| | devices | batch | environments | one device | all | speed-up | efficiency |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for kind, label in KINDS.items():
        rows = sorted((record for record in records if _kind(record) == kind), key=lambda record: record["config"]["devices"])
        for index, record in enumerate(rows):
            config, details = record["config"], record["details"]
            speedup = f"{record['value']:.2f}"
            cells = (
                "" if index else label,
                config["devices"],
                f"{config['batch_size']:,}",
                config["num_envs"],
                f"{details['one_device_ms']:.1f}",
                f"{details['ms']:.1f}",
                f"**{speedup}**" if details["efficiency"] >= _GOOD else speedup,
                f"{100 * details['efficiency']:.0f} %",
            )
            lines.append("| " + " | ".join(map(str, cells)).lstrip() + " |")
    return "\n".join(lines)


def processes_table(results: Path) -> str:
    """Return a table that compares two processes with one, as Markdown; times are milliseconds per iteration."""
    lines = ["| two processes of two devices each | one process of four | two processes | efficiency |", "|---|---|---|---|"]
    for record in load(results / _RECORD):
        kind, details = record["name"].removeprefix("scaling/processes_"), record["details"]
        if "one_process_ms" in details:
            label = KINDS[kind, 512 if kind == "seeds" else 2048]
            figures = f"{details['one_process_ms']:.1f} | {details['ms']:.1f} | {100 * details['efficiency']:.1f} %"
            lines.append(f"| {label} | {figures} |")
    return "\n".join(lines)
