"""metrics.jsonl and its contents. Uses plain Python only, no JAX.

One line per seed and evaluation: seed, iteration, updates, env_steps (cumulative counts per seed), eval/*, the means of train/*
since the last evaluation and a ratio of two of them (`with_precision`), resume/replay_lost_at (the last iteration at which the
run resumed from a light checkpoint, without its replay), run_id (as in config.json), and time/wall_s (total, with evaluation,
compilation and earlier processes), time/compile_s (compilation, included in the former), time/env_steps_per_s (all seeds
together, since the last evaluation), and time/goodput (`goodput`).
"""

import dataclasses
import json
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.files import is_count, sync_folder, write_atomically
from jaxrl_vis_envs.documents import parse_json

PerSeed = dict[str, list[float]]
"""One number per seed, by name."""

Row = Mapping[str, Any]
"""A line of the file."""

RUN_ID = "run_id"
"""Key of the run's id in a row, a checkpoint's manifest or a config.json."""


class RowKeys(NamedTuple):
    """Keys that every row has, which identify it in a training run.

    Attributes:
        seed: Seed.
        iteration: Iterations completed.
        updates: Gradient steps taken.
        env_steps: Environment steps taken.
    """

    seed: int
    iteration: int
    updates: int
    env_steps: int


_NOT_METRICS = {*RowKeys._fields, RUN_ID} - {"updates"}
_MAX_VALUE = 2**63  # of a number in a row: the range of integer arrays
_SHOWN = 8  # line numbers in a message


def average_metrics(history: Sequence[Mapping[str, Sequence[float]]]) -> PerSeed:
    """Average metrics over the iterations in ``history``, seed by seed, with nine significant digits.

    The order of summation is fixed, so that a resumed run writes the same digits as an uninterrupted one.
    """
    if not history:
        return {}
    return {
        name: [
            _round_digits(math.fsum(values) / len(history)) for values in zip(*(entry[name] for entry in history), strict=True)
        ]
        for name in history[0]
    }


def with_precision(metrics: PerSeed) -> PerSeed:
    """Return ``metrics`` with the precision of the filter: the fraction of dropped negatives that were false; NaN if none.

    Without statistics of a filter, ``metrics`` are returned unchanged.

    This is a ratio of means, not a mean of ratios: the fraction among all dropped samples.
    """
    if "train/filtered_false_share" not in metrics:
        return metrics
    pairs = zip(metrics["train/filtered_false_share"], metrics["train/filtered_share"], strict=True)
    precision = [_round_digits(false / dropped) if dropped > 0.0 else math.nan for false, dropped in pairs]
    return {**metrics, "train/filter_precision": precision}


def _round_digits(value: float) -> float:
    # The precision of a float32, so that the file stays readable.
    return float(f"{value:.9g}")


def make_rows(seeds: Iterable[int], counts: Mapping[str, int], values: Mapping[str, Sequence[float]]) -> list[dict[str, Any]]:
    """Make one row per seed: seed, ``counts`` and its entry of ``values``. Non-finite numbers become None."""
    return [
        {"seed": seed, **counts, **{name: row[i] if math.isfinite(row[i]) else None for name, row in values.items()}}
        for i, seed in enumerate(seeds)
    ]


def scalars(row: Row) -> dict[str, float]:
    """Return the metrics of a row and its ``updates`` by name, without those that were not finite."""
    return {name: float(value) for name, value in row.items() if name not in _NOT_METRICS and value is not None}


@dataclasses.dataclass(frozen=True)
class Contents:
    """Contents of a metrics file.

    Attributes:
        rows: The rows, in the order of their iterations.
        damaged: Line number, from 1, and bytes of every line that is not a valid row, or repeats an earlier row.
        torn: Incomplete last line without a line break. After a kill, that row was never complete.
    """

    rows: list[dict[str, Any]]
    damaged: list[tuple[int, bytes]]
    torn: bytes = b""


def append_rows(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """Append rows to the file and sync them to the disk.

    Raises:
        OSError: The file cannot be written.
    """
    _append(path, "".join(json.dumps(row) + "\n" for row in rows).encode())


def _append(path: Path, contents: bytes) -> None:
    is_new = not path.exists()
    with path.open("ab") as file:
        file.write(contents)
        file.flush()
        os.fsync(file.fileno())
    if is_new:
        sync_folder(path.parent)


def read_contents(path: Path) -> Contents:
    """Read a metrics file, which may be damaged; empty if there is no file.

    Raises:
        RequestError: The file cannot be read.
    """
    try:
        *lines, last = path.read_bytes().removeprefix(b"\xef\xbb\xbf").split(b"\n")
    except FileNotFoundError:
        return Contents([], [])
    except OSError as error:
        raise RequestError(f"cannot read {path} ({error.strerror or type(error).__name__})") from error
    rows: dict[tuple[int, int, str | None], dict[str, Any]] = {}
    damaged, torn = [], b""
    for number, line in enumerate([*lines, last], 1):
        is_last = number > len(lines)  # not terminated by a line break
        row = _read_row(line)
        key = None if row is None else (row["iteration"], row["seed"], row.get(RUN_ID))
        if row is not None and key is not None and key not in rows:
            rows[key] = row
        elif is_last and row is None:
            torn = line.strip()
        elif line.strip():
            damaged.append((number, line))
    return Contents(sorted(rows.values(), key=lambda row: row["iteration"]), damaged, torn)


def _read_row(line: bytes) -> dict[str, Any] | None:
    """Parse a row; None if it is not one that a run can have written."""
    try:
        row = parse_json(line.decode("utf-8"))
    except ValueError:
        return None
    if not isinstance(row, dict) or not all(is_count(row.get(name)) for name in RowKeys._fields):
        return None
    if not isinstance(row.get(RUN_ID), str | None):
        return None
    return row if all(name == RUN_ID or _is_metric(value) for name, value in row.items()) else None


def _is_metric(value: Any) -> bool:
    if isinstance(value, int) and not isinstance(value, bool):
        return abs(value) < _MAX_VALUE
    return value is None or (isinstance(value, float) and math.isfinite(value))


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Read the rows of a metrics file, in order of iteration, without damaged lines; empty if there is no file.

    Raises:
        RequestError: The file cannot be read.
    """
    return read_contents(path).rows


def truncate(
    path: Path, iteration: int, run_id: str, aside: Path, others: Path, keeps_later: bool, evaluated: int = 0
) -> str | None:
    """Remove the rows after ``iteration``, which a resumed run writes again, and the rows of other runs.

    Args:
        path: The file.
        iteration: Last iteration to keep.
        run_id: Id of the run.
        aside: File to which damaged lines are moved; nothing is discarded.
        others: File to which other runs' rows are moved.
        keeps_later: Whether to move rows after ``iteration`` to ``aside``, instead of discarding them.
        evaluated: Last iteration known to have had a row of each seed, or 0: if one is missing, a torn line is that row.

    Returns:
        A line about damaged or foreign rows; None if there are none.

    Raises:
        OSError: A file cannot be written.
        RequestError: The file cannot be read.
    """
    if not path.exists():
        return None
    contents = read_contents(path)
    foreign = [row for row in contents.rows if row.get(RUN_ID) != run_id]
    rows = [row for row in contents.rows if row.get(RUN_ID) == run_id]
    later = [row for row in rows if keeps_later and row["iteration"] > iteration]
    damaged = list(contents.damaged)
    evaluated_seeds = {row["seed"] for row in rows if row["iteration"] == evaluated}
    if contents.torn and evaluated and (not evaluated_seeds or evaluated_seeds < {row["seed"] for row in rows}):
        damaged.append((path.read_bytes().count(b"\n") + 1, contents.torn))
    _append_lines(aside, [line for _, line in damaged] + [json.dumps(row).encode() for row in later])
    _append_lines(others, [json.dumps(row).encode() for row in foreign])
    text = "".join(json.dumps(row) + "\n" for row in rows if row["iteration"] <= iteration)
    if text.encode() != path.read_bytes():
        write_atomically(path, text)
    findings = [f"{_describe(damaged)}: kept in {aside}"] if damaged else []
    findings += [f"{len(foreign)} row{'s' * (len(foreign) > 1)} of another run: kept in {others}"] if foreign else []
    return f"{path.name} held {', and '.join(findings)}; left out here" if findings else None


def _append_lines(path: Path, lines: Sequence[bytes]) -> None:
    if lines:
        path.parent.mkdir(parents=True, exist_ok=True)
        _append(path, b"".join(line + b"\n" for line in lines))


def _describe(damaged: Sequence[tuple[int, bytes]]) -> str:
    numbers = ", ".join(str(number) for number, _ in damaged[:_SHOWN]) + (", ..." if len(damaged) > _SHOWN else "")
    return f"{len(damaged)} damaged line{'s' * (len(damaged) > 1)} (line {numbers})"
