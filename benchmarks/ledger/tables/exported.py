"""Table of docs/export.md: the package's policies in JAX and as ONNX files, from the record of `benchmarks.exported`."""

import json
from pathlib import Path
from typing import Any


def exported_table(results: Path) -> str | None:
    """Return a table of success, difference, size and latency of each policy as Markdown; None without a record."""
    paths = sorted(results.glob("exported-*.json"))
    return "\n\n".join(_device_table(json.loads(path.read_text())) for path in paths) if paths else None


def _device_table(record: dict[str, Any]) -> str:
    head = [
        "policy",
        "episodes",
        "success, JAX",
        "ONNX",
        "distance, JAX",
        "ONNX",
        "difference of actions",
        "ONNX file",
        "latency, JAX",
        "ONNX",
    ]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for row in record["rows"]:
        cells = [
            f"`{row['name']}`",
            str(row["episodes"]),
            f"{row['jax_success']:.3f}",
            f"{row['onnx_success']:.3f}",
            f"{1e3 * row['jax_goal_distance']:.1f} mm",
            f"{1e3 * row['onnx_goal_distance']:.1f} mm",
            f"{row['golden_difference']:.0e}",
            f"{row['onnx_bytes'] / 1e6:.1f} MB",
            f"{1e3 * row['jax_latency_s']:.2f} ms",
            f"{1e3 * row['onnx_latency_s']:.2f} ms",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    versions = record["versions"]
    revisions = ", ".join(sorted({row["revision"][:7] for row in record["rows"]}))
    return "\n".join([*lines, "", f"{record['device']}, JAX {versions['jax']}; {revisions}."])
