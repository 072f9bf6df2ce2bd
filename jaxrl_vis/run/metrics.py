"""metrics.jsonl, and the numbers that go into it. No JAX here: everything is plain Python by now.

One line per seed and evaluation: seed, iteration, updates, env_steps (counts per seed, since the beginning), eval/*, the means
of train/* since the last evaluation and a quotient of two of them (`with_precision`), resume/replay_lost_at (where a run went
on from a light checkpoint: the last iteration at which its replay was lost), run_id (as in config.json), and time/wall_s (the
run so far, with evaluation, compilation and what came before a resumption), time/compile_s (of that, compilation),
time/env_steps_per_s (all seeds together, since the last evaluation), and time/goodput (`goodput`).
"""

import dataclasses
import json
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxrl_vis.errors import RequestError
from jaxrl_vis.files import sync_folder, write_atomically
from jaxrl_vis_envs.documents import parse_json

PerSeed = dict[str, list[float]]
"""Name -> one number per seed."""

Row = Mapping[str, Any]
"""A line of the file."""

RUN_ID = "run_id"
"""Key of the run that a row, a checkpoint's manifest or a config.json is of; not there in those of earlier versions."""

_PLACE = ("seed", "iteration", "env_steps", RUN_ID)  # of a row: where it belongs, not what it says
_COUNTS = ("seed", "iteration", "updates", "env_steps")  # what no row is without
_LARGEST = 2**63  # of a number in a row: beyond, arrays of whole numbers end
_SHOWN = 8  # numbers of lines in a message


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


def make_rows(
    seeds: Iterable[int], counts: Mapping[str, int], values: Mapping[str, Sequence[float]], run_id: str | None = None
) -> list[dict[str, Any]]:
    """One row per seed: its number, ``counts``, its share of ``values``, and whose it is. A NaN or an infinity becomes None."""
    whose = {} if run_id is None else {RUN_ID: run_id}
    return [
        {"seed": seed, **counts, **{name: row[i] if math.isfinite(row[i]) else None for name, row in values.items()}, **whose}
        for i, seed in enumerate(seeds)
    ]


def scalars(row: Row) -> dict[str, float]:
    """The figures of a row by name; those that were not finite are left out."""
    return {name: float(value) for name, value in row.items() if name not in _PLACE and value is not None}


@dataclasses.dataclass(frozen=True)
class Contents:
    """Contents of a metrics file.

    Attributes:
        rows: The rows, in the order of their iterations.
        damaged: Number and bytes of every line that is no row, or a row that is there already.
        torn: What is left of a last line that no line break ends. After a kill, that row was never whole.
    """

    rows: list[dict[str, Any]]
    damaged: list[tuple[int, bytes]]
    torn: bytes = b""


def append_rows(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """Writes rows at the end of the file and sees to it that they are on the disk."""
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
    """All that a metrics file holds, whatever somebody or a disk has made of it; nothing where there is no file.

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
        is_last = number > len(lines)  # what no line break ends
        row = _read_row(line)
        place = None if row is None else (row["iteration"], row["seed"], row.get(RUN_ID))
        if row is not None and place is not None and place not in rows:
            rows[place] = row
        elif is_last and row is None:
            torn = line.strip()
        elif line.strip():
            damaged.append((number, line))
    return Contents(sorted(rows.values(), key=lambda row: row["iteration"]), damaged, torn)


def _read_row(line: bytes) -> dict[str, Any] | None:
    """The row of a line; None where it is none that a run can have written."""
    try:
        row = parse_json(line.decode("utf-8"))
    except ValueError:
        return None
    if not isinstance(row, dict) or not all(_is_count(row.get(name)) for name in _COUNTS):
        return None
    if not isinstance(row.get(RUN_ID), str | None):
        return None
    return row if all(name == RUN_ID or _is_figure(value) for name, value in row.items()) else None


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < _LARGEST


def _is_figure(value: Any) -> bool:
    if isinstance(value, int) and not isinstance(value, bool):
        return abs(value) < _LARGEST
    return value is None or (isinstance(value, float) and math.isfinite(value))


def read_rows(path: Path) -> list[dict[str, Any]]:
    """All rows of a metrics file, in the order of their iterations, or none where there is no file. Damaged lines are left out.

    Raises:
        RequestError: The file cannot be read.
    """
    return read_contents(path).rows


def cut_back(
    path: Path, iteration: int, run_id: str | None, aside: Path, others: Path, keeps_later: bool, evaluated: int = 0
) -> str | None:
    """Takes out every row after ``iteration``, which a resumed run writes again, and all that is not this run's.

    Args:
        path: The file.
        iteration: The last one to keep.
        run_id: Of the run; None for one of an earlier version, which has none.
        aside: To this file goes what is damaged; nothing is ever dropped.
        others: To this one goes what is of another run.
        keeps_later: Rows after ``iteration``, too.
        evaluated: The last iteration that is known to have had a row of each seed, or 0: where one is missing, a torn line was
            that.

    Returns:
        A line on what is damaged or of another run; None where nothing is.

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
    evaluated_there = {row["seed"] for row in rows if row["iteration"] == evaluated}
    if contents.torn and evaluated and (not evaluated_there or evaluated_there < {row["seed"] for row in rows}):
        damaged.append((path.read_bytes().count(b"\n") + 1, contents.torn))
    _keep(aside, [line for _, line in damaged] + [json.dumps(row).encode() for row in later])
    _keep(others, [json.dumps(row).encode() for row in foreign])
    text = "".join(json.dumps(row) + "\n" for row in rows if row["iteration"] <= iteration)
    if text.encode() != path.read_bytes():
        write_atomically(path, text)
    what = [f"{_describe(damaged)}: kept in {aside}"] if damaged else []
    what += [f"{len(foreign)} row{'s' * (len(foreign) > 1)} of another run: kept in {others}"] if foreign else []
    return f"{path.name} held {', and '.join(what)}; left out here" if what else None


def _keep(path: Path, lines: Sequence[bytes]) -> None:
    if lines:
        path.parent.mkdir(parents=True, exist_ok=True)
        _append(path, b"".join(line + b"\n" for line in lines))


def _describe(damaged: Sequence[tuple[int, bytes]]) -> str:
    numbers = ", ".join(str(number) for number, _ in damaged[:_SHOWN]) + (", ..." if len(damaged) > _SHOWN else "")
    return f"{len(damaged)} damaged line{'s' * (len(damaged) > 1)} (line {numbers})"
