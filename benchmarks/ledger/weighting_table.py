"""Tables of docs/weighting.md: our weightings beside TorchJD's, from the records of `benchmarks.peers.torchjd`."""

import json
from pathlib import Path
from typing import Any

_RECORD = "weighting_parity.json"


def torchjd_table(results: Path) -> str | None:
    """Write differences and residuals of all methods as Markdown; None without a record."""
    if not (results / _RECORD).exists():
        return None
    record = json.loads((results / _RECORD).read_text())
    lines = ["| method | cases | difference, greatest | median | residual, ours | TorchJD's |", "|---|---|---|---|---|---|"]
    for row in record["rows"]:
        residuals = [f"{row[name]:.0e}" if name in row else "" for name in ("residual_max_ours", "residual_max_theirs")]
        cells = [f"`{row['method']}`", str(row["cases"]), f"{row['difference_max']:.0e}", f"{row['difference_median']:.0e}"]
        lines.append("| " + " | ".join([*cells, *residuals]) + " |")
    versions = record["versions"]
    lines += ["", f"TorchJD {versions['torchjd']}, PyTorch {versions['torch']}, JAX {versions['jax']}."]
    return "\n".join(lines)


def cost_table(results: Path) -> str | None:
    """Write the time of a step of both libraries, and of the weighting alone, as Markdown; None without a record of a GPU."""
    paths = sorted(results.glob("weighting_cost-nvidia-*.json"))
    if not paths:
        return None
    return "\n\n".join(_of_device(json.loads(path.read_text())) for path in paths)


def _of_device(record: dict[str, Any]) -> str:
    counts = record["size"]["losses"]
    ours, theirs = (
        {(row["method"], row["losses"], row["what"]): row["seconds"] for row in record[side]} for side in ("ours", "torchjd")
    )
    head = ["method", *(f"step, K = {count}" for count in counts), f"alone, K = {counts[-1]}"]
    lines = [
        f"{record['device']}, microseconds, ours / TorchJD's:",
        "",
        "| " + " | ".join(head) + " |",
        "|" + "---|" * len(head),
    ]
    for method in dict.fromkeys(row["method"] for row in record["ours"]):
        cells = [f"`{method}`"]
        for count in counts:
            ways = (ours.get((method, count, f"step, {way}")) for way in ("per_loss", "latents"))
            fastest = min(seconds for seconds in ways if seconds is not None)
            cells.append(_pair(fastest, theirs.get((method, count, "step"))))
        cells.append(_pair(ours[method, counts[-1], "alone"], theirs.get((method, counts[-1], "alone"))))
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _pair(seconds: float, peer: float | None) -> str:
    return f"{1e6 * seconds:,.0f}" + ("" if peer is None else f" / {1e6 * peer:,.0f}")
