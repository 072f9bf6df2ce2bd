"""Train a fixed set of short runs and compare all their metrics, bit for bit, with those of another revision.

    python benchmarks/same_numbers.py --write before.json      # at the reference revision
    python benchmarks/same_numbers.py --compare before.json    # after a change; exit status 1 and a table if a number differs
    python benchmarks/same_numbers.py --compare before.json --only cosine resumed

Runs are started only through the command line, so that this script works for revisions with different modules. Times and run
ids are excluded. Both files must come from the same machine and JAX version.
"""

import argparse
import concurrent.futures
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

AUX_TASKS = ("forward_dynamics", "inverse_dynamics", "egomotion", "autoencoder", "optical_flow")
_DEBUG = ("--preset", "debug", "--image-size", "32", "--updates-per-iteration", "10", "--pixels", "rgbd")
_ALL_LOSSES = ("VisualReacher", *_DEBUG, "--aux-tasks", *AUX_TASKS)

RUNS: dict[str, tuple[tuple[str, ...], ...]] = {
    "reacher_states": (("Reacher", "--preset", "debug"),),
    "fetch_cpu": (("VisualFetchReach", "--preset", "cpu", "--env-steps", "4800", "--eval-episodes", "32"),),
    "fetch_fast": (
        ("VisualFetchReach", "--preset", "fast", "--env-steps", "2500", "--batch-size", "32", "--eval-episodes", "16"),
    ),
    "finger": (("VisualFingerTurn", *_DEBUG, "--frame-stack", "3"),),
    "hand": (("VisualHandReach", "--preset", "debug", "--env-steps", "400"),),
    "sawyer": (("VisualSawyerReach", "--preset", "debug"),),
    "two_seeds": (("VisualReacher", "--preset", "debug", "--seeds", "2"),),
    **{
        f"method_{name}": (("VisualReacher", *_DEBUG, "--method", name),)
        for name in ("autoencoder", "indicator", "indicator_balance_filter")
    },
    **{f"weighting_{name}": ((*_ALL_LOSSES, "--weighting", name),) for name in ("sum", "fixed", "balance", "cosine")},
    "weighting_none_log": (("VisualReacher", *_DEBUG, "--weighting", "none_log"),),
    "weighting_ol_aux": ((*_ALL_LOSSES, "--weighting", "ol_aux"),),
    "weighting_ol_aux_ablation": ((*_ALL_LOSSES, "--weighting", "ol_aux_ablation"),),
    "resumed": (
        ("VisualReacher", *_DEBUG, "--env-steps", "400"),
        ("VisualReacher", *_DEBUG, "--env-steps", "800", "--resume"),
    ),
    "make_train": (("VisualFetchReach", "--preset", "cpu"),),
}
"""Options of successive commands in one run folder, by name."""


def train(name: str, folder: Path) -> list[dict[str, Any]]:
    """Train one of `RUNS`; return its rows without times and ids.

    Raises:
        RuntimeError: A command failed.
    """
    run = folder / name
    for options in RUNS[name]:
        command = [sys.executable, "-m", "jaxrl_vis", "train", *options, "--run-dir", str(run)]
        ended = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "JAX_PLATFORMS": "cpu"})
        if ended.returncode != 0:
            raise RuntimeError(f"{name}: {ended.stdout}\n{ended.stderr}")
    rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    return [{key: value for key, value in row.items() if not key.startswith("time/") and key != "run_id"} for row in rows]


def differences(before: list[dict[str, Any]], after: list[dict[str, Any]]) -> list[str]:
    """List the columns that differ, with the first differing iteration and both values."""
    if [row["iteration"] for row in before] != [row["iteration"] for row in after]:
        return ["rows of other iterations"]
    lines = []
    for column in sorted({key for row in (*before, *after) for key in row}):
        pair = next(((a, b) for a, b in zip(before, after, strict=True) if a.get(column) != b.get(column)), None)
        if pair is not None:
            lines.append(f"{column} at iteration {pair[0]['iteration']}: {pair[0].get(column)} -> {pair[1].get(column)}")
    return lines


def main() -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", type=Path, help="file for the numbers of this revision")
    parser.add_argument("--compare", type=Path, help="file of another revision's numbers")
    parser.add_argument("--only", nargs="+", default=list(RUNS), help="runs whose name contains one of these words")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    names = [name for name in RUNS if any(word in name for word in options.only)]
    before = {} if options.compare is None else json.loads(options.compare.read_text())
    missing = [name for name in names if name not in before]
    if options.compare is not None and missing:
        print(f"{options.compare} has no numbers of {', '.join(missing)}: write it with the same --only", file=sys.stderr)
        return 2
    with tempfile.TemporaryDirectory() as folder, concurrent.futures.ThreadPoolExecutor(options.workers) as pool:
        numbers = dict(zip(names, pool.map(lambda name: train(name, Path(folder)), names), strict=True))
    if options.write is not None:
        options.write.write_text(json.dumps(numbers))
    if options.compare is None:
        return 0
    unequal = {name: lines for name in names if (lines := differences(before[name], numbers[name]))}
    for name in names:
        print(f"{name:28} {'DIFFERS' if name in unequal else 'equal'} ({len(numbers[name])} rows)")
        print("\n".join(f"    {line}" for line in unequal.get(name, [])[:5]), end="\n" if name in unequal else "")
    return int(bool(unequal))


if __name__ == "__main__":
    sys.exit(main())
