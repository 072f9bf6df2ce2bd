"""Tables of docs/weighting.md: our weightings compared with TorchJD's, from the records of `benchmarks.peers.torchjd`, and all
of ours on supervised data, from the record of `benchmarks.weighted_digits`."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import scipy.stats

_RECORD = "weighting_parity.json"
_BASELINE = "sum"


def torchjd_table(results: Path) -> str | None:
    """Return a table of differences and residuals of all methods as Markdown; None without a record."""
    if not (results / _RECORD).exists():
        return None
    record = json.loads((results / _RECORD).read_text())
    lines = [
        "| method | cases | maximum difference | median difference | residual | residual of TorchJD |",
        "|---|---|---|---|---|---|",
    ]
    for row in record["rows"]:
        residuals = [f"{row[name]:.0e}" if name in row else "" for name in ("residual_max_ours", "residual_max_theirs")]
        cells = [f"`{row['method']}`", str(row["cases"]), f"{row['difference_max']:.0e}", f"{row['difference_median']:.0e}"]
        lines.append("| " + " | ".join([*cells, *residuals]) + " |")
    versions = record["versions"]
    lines += ["", f"TorchJD {versions['torchjd']}, PyTorch {versions['torch']}, JAX {versions['jax']}."]
    return "\n".join(lines)


def cost_table(results: Path) -> str | None:
    """Return a table of the time of a step and of the weighting alone for both libraries; None without a GPU record."""
    paths = sorted(results.glob("weighting_cost-nvidia-*.json"))
    if not paths:
        return None
    return "\n\n".join(_device_table(json.loads(path.read_text())) for path in paths)


def _device_table(record: dict[str, Any]) -> str:
    counts = record["size"]["losses"]
    ours, theirs = (
        {(row["method"], row["losses"], row["what"]): row["seconds"] for row in record[side]} for side in ("ours", "torchjd")
    )
    sources = record["revisions"]
    counts_of = {new: [count for count, old in sources.items() if old == new] for new in sources.values()}
    revisions = ", ".join(f"K = {', '.join(same)} on {revision[:7]}" for revision, same in counts_of.items())
    head = ["method", *(f"step, K = {count}" for count in counts), f"weighting only, K = {counts[-1]}"]
    lines = [
        f"{record['device']}, microseconds, ours / TorchJD's, {revisions}:",
        "",
        "| " + " | ".join(head) + " |",
        "|" + "---|" * len(head),
    ]
    for method in dict.fromkeys(row["method"] for row in record["ours"]):
        cells = [f"`{method}`"]
        for count in counts:
            times = (ours.get((method, count, f"step, {mode}")) for mode in ("per_loss", "latents"))
            fastest = min(seconds for seconds in times if seconds is not None)
            cells.append(_pair(fastest, theirs.get((method, count, "step"))))
        cells.append(_pair(ours[method, counts[-1], "alone"], theirs.get((method, counts[-1], "alone"))))
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _pair(seconds: float, peer: float | None) -> str:
    return f"{1e6 * seconds:,.0f}" + ("" if peer is None else f" / {1e6 * peer:,.0f}")


def digits_table(results: Path) -> str | None:
    """Return a table of the test accuracies of all weightings on supervised data, and their differences from the sum.

    Differences that are significant at 5 % by the exact paired permutation test over seeds, with Holm's correction for the
    number of methods in the column, are bold. None without a record.
    """
    path = results / "weighted_digits.json"
    if not path.exists():
        return None
    record = json.loads(path.read_text())
    columns = {title: _problem_cells(rows) for title, rows in record["problems"].items()}
    names = list(dict.fromkeys(row["method"] for rows in record["problems"].values() for row in rows))
    lines = ["| method | " + " | ".join(f"`{title}`" for title in columns) + " |", "|---|" + "---|" * len(columns)]
    lines += [f"| `{name}` | " + " | ".join(column.get(name, "") for column in columns.values()) + " |" for name in names]
    seeds = len(next(iter(record["problems"].values()))[0]["test"])
    versions = record["versions"]
    lines += [
        "",
        f"Test accuracy in %, mean of {seeds} seeds, and the difference from `{_BASELINE}` with its 95 % interval over seeds. "
        f"**Bold**: a difference by Holm's correction. {record['revision'][:7]} on {record['device']}, JAX {versions['jax']}.",
    ]
    return "\n".join(lines)


def _problem_cells(rows: list[dict[str, Any]]) -> dict[str, str]:
    """Return the cells of a problem by method: accuracy, and difference from the sum, in bold if significant."""
    scores = {row["method"]: np.asarray(row["test"]) for row in rows}
    baseline = scores[_BASELINE]
    others = {name: values - baseline for name, values in scores.items() if name != _BASELINE}
    p_values = {name: _p_value(differences) for name, differences in others.items()}
    cells, rejects = {_BASELINE: f"{100 * baseline.mean():.1f}"}, True
    for rank, name in enumerate(sorted(others, key=lambda name: p_values[name])):
        rejects = rejects and p_values[name] * (len(others) - rank) <= 0.05
        differences = 100 * others[name]
        half = scipy.stats.t.ppf(0.975, len(differences) - 1) * differences.std(ddof=1) / math.sqrt(len(differences))
        change = f"{differences.mean():+.1f} ± {half:.1f}"
        cells[name] = f"{100 * scores[name].mean():.1f} ({f'**{change}**' if rejects else change})"
    return cells


def _p_value(differences: np.ndarray) -> float:
    """Return the two-sided p-value of the mean of differences [S] under all 2^S sign flips."""
    signs = 1 - 2 * (np.arange(2 ** len(differences))[:, None] >> np.arange(len(differences)) & 1)
    means = np.abs(signs @ differences)
    return float(np.mean(means >= np.abs(differences.sum()) - 1e-9))
