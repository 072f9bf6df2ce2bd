"""metrics.jsonl, and the numbers that go into it. No JAX here: everything is plain Python by now.

One line per seed and evaluation: seed, iteration, updates, env_steps (counts per seed, since the beginning), eval/*, the means
of train/* since the last evaluation and a quotient of two of them (`with_precision`), resume/replay_lost_at (where a run went
on from a light checkpoint: the last iteration at which its replay was lost), and time/wall_s (the run so far, with evaluation,
compilation and what came before a resumption), time/compile_s (of that, compilation), time/env_steps_per_s (all seeds together,
since the last evaluation), and time/goodput (`goodput`).
"""

import json
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxrl_vis.run.folder import write_atomically

PerSeed = dict[str, list[float]]
"""Name -> one number per seed."""

Row = Mapping[str, Any]
"""A line of the file."""

_PLACE = ("seed", "iteration", "env_steps")  # of a row: where it belongs, not what it says


def mean_of(history: Sequence[Mapping[str, Sequence[float]]]) -> PerSeed:
    """The mean of each metric over the iterations in ``history``, seed by seed.

    The order of additions is fixed, so a resumed run writes the same digits as a straight one.
    """
    if not history:
        return {}
    return {
        name: [
            _nine_digits(math.fsum(values) / len(history)) for values in zip(*(entry[name] for entry in history), strict=True)
        ]
        for name in history[0]
    }


def with_precision(means: PerSeed) -> PerSeed:
    """``means`` with the precision of the filter: the share of what it has dropped that truly was false; NaN for nothing.

    The quotient is taken of means, not the mean of quotients: so it is the share among all that was dropped.
    """
    if "train/filtered_false_share" not in means:
        return means
    pairs = zip(means["train/filtered_false_share"], means["train/filtered_share"], strict=True)
    precision = [_nine_digits(false / dropped) if dropped > 0.0 else math.nan for false, dropped in pairs]
    return {**means, "train/filter_precision": precision}


def _nine_digits(value: float) -> float:
    # As many as a float32 has, so that the file stays readable.
    return float(f"{value:.9g}")


def make_rows(seeds: Iterable[int], counts: Mapping[str, int], values: Mapping[str, Sequence[float]]) -> list[dict[str, Any]]:
    """One row per seed: its number, then ``counts``, then its share of ``values``. A NaN or an infinity becomes None."""
    return [
        {"seed": seed, **counts, **{name: row[i] if math.isfinite(row[i]) else None for name, row in values.items()}}
        for i, seed in enumerate(seeds)
    ]


def scalars(row: Row) -> dict[str, float]:
    """The figures of a row by name; those that were not finite are left out."""
    return {name: float(value) for name, value in row.items() if name not in _PLACE and value is not None}


def append_rows(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """Writes rows at the end of the file and sees to it that they are on the disk."""
    with path.open("a", encoding="utf-8") as file:
        file.writelines(json.dumps(row) + "\n" for row in rows)
        file.flush()
        os.fsync(file.fileno())


def read_rows(path: Path) -> list[dict[str, Any]]:
    """All rows of a metrics file, or none where there is no file. A line that was cut off in the middle is left out."""
    if not path.exists():
        return []
    rows = []
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            row = json.loads(line)
        except ValueError:
            continue
        if isinstance(row, dict) and "iteration" in row and "seed" in row:
            rows.append(row)
    return rows


def cut_back(path: Path, iteration: int, cut_to: Path | None = None) -> None:
    """Takes out every row after ``iteration``: a resumed run writes those again.

    Args:
        path: The file.
        iteration: The last one to keep.
        cut_to: Append what is taken out to this file; None: it is dropped.
    """
    if not path.exists():
        return
    rows = read_rows(path)
    later = [row for row in rows if row["iteration"] > iteration]
    if cut_to is not None and later:
        append_rows(cut_to, later)
    write_atomically(path, "".join(json.dumps(row) + "\n" for row in rows if row["iteration"] <= iteration))
