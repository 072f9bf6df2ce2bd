"""Table of docs/indicator_rewards.md: learning on the host, from the records of `benchmarks.tasks.host_learning`."""

import itertools
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.tasks import host_learning
from jaxrl_vis_envs.documents import read_json

_TITLES = {
    "exact": "indicator_balance_filter",
    "tolerance": "indicator_tolerance",
    "oracle": "oracle",
    "contrastive": "contrastive",
    "cloning": "behaviour cloning",
}


def host_table(results: Path) -> str | None:
    """Return the table as Markdown; None without records."""
    folder = results / host_learning.RESULTS.relative_to(Path("benchmarks") / "results")
    return rows(folder) if any(folder.glob("*.json")) else None


def rows(folder: Path) -> str:
    """Return a table of all records in ``folder`` as Markdown, with a row for the seeds of each mode, method and noise."""
    cells = [cell for cell in host_learning.cells() if (folder / f"{cell.name}.json").exists()]
    records = sorted((read_json(folder / f"{cell.name}.json") for cell in cells), key=_sort_key)
    lines = [
        "| data | reward | camera noise | seeds | steps to 0.9 | final success | false positive rate | false negative rate |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for _, group in itertools.groupby(records, key=_sort_key):
        lines.append(_row(list(group)))
    revisions = ", ".join(sorted({record["revision"][:7] for record in records}))
    versions = records[0]["versions"]
    lines += [
        "",
        f"Success of the noisy behaviour policy: {_behaviour(records)}. Made by {revisions} on {records[0]['device']}, "
        f"MuJoCo {versions['mujoco']}, JAX {versions['jax']}.",
    ]
    return "\n".join(lines)


def _sort_key(record: dict[str, Any]) -> tuple[str, int, int]:
    return record["mode"], record["noise"], list(_TITLES).index(record["method"])


def _behaviour(records: list[dict[str, Any]]) -> str:
    shares = {record["behaviour_success"] for record in records if record["mode"] == "recorded"}
    return ", ".join(f"{share:.3f}" for share in sorted(shares)) or "not recorded"


def _row(records: list[dict[str, Any]]) -> str:
    first = records[0]
    steps = [_steps(record) for record in records] if first["mode"] == "live" else []
    shares = [record["shares"] for record in records if "false_positive_share" in record["shares"]]
    errors = [f"{np.mean([share[name] for share in shares]):.3f}" if shares else "" for name in _ERRORS]
    cells = (
        first["mode"],
        f"`{_TITLES[first['method']]}`" if first["method"] not in ("cloning",) else _TITLES[first["method"]],
        f"{first['noise']}",
        ", ".join(str(record["seed"]) for record in records),
        ", ".join("never" if reached is None else f"{reached:,}" for reached in steps),
        ", ".join(f"{record['success']:.2f}" for record in records),
        *errors,
    )
    return "| " + " | ".join(cells) + " |"


_ERRORS = ("false_positive_share", "false_negative_share")


def _steps(record: dict[str, Any]) -> int | None:
    """Return the environment steps of the first of three evaluations in a row with a success of 0.9 or more, or None."""
    success = [row["success"] for row in record["rows"]]
    for start in range(len(success) - host_learning.IN_A_ROW + 1):
        if min(success[start : start + host_learning.IN_A_ROW]) >= host_learning.TARGET_SUCCESS:
            return record["rows"][start]["env_steps"]
    return None
