"""Table of docs/weighting.md: our weightings beside TorchJD's, from the record of `benchmarks.peers.torchjd equality`."""

import json
from pathlib import Path

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
