"""Stored runs of benchmarks/results: all evaluations of one configuration, from one or several folders with different seeds."""

import dataclasses
import functools
import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.ledger.ablations import read_curves
from benchmarks.ledger.records import RESULTS
from jaxrl_vis.report.learning import curve, steps_to
from jaxrl_vis.run.storage.folder import read_record
from jaxrl_vis.studies.engine.study import Family

SUCCESS, DISTANCE = "eval/success", "eval/goal_distance"
FIRST_FRESH_SEED = 100  # seeds below are used for tuning


@dataclasses.dataclass(frozen=True, eq=False)
class Record:
    """All seeds of one configuration.

    Attributes:
        name: Path below benchmarks/results, without file suffixes.
        rows: Evaluations of all seeds.
        origins: Revision and device of each run, as text; empty if neither is known.
    """

    name: str
    rows: tuple[dict[str, Any], ...]
    origins: frozenset[str] = frozenset()

    @functools.cached_property
    def seeds(self) -> list[int]:
        """The seeds, ascending."""
        return sorted({row["seed"] for row in self.rows})

    @functools.cached_property
    def end(self) -> int:
        """Environment steps of the last evaluation."""
        return max(row["env_steps"] for row in self.rows)

    @functools.cached_property
    def points(self) -> list[tuple[int, float]]:
        """Pairs of (environment steps, median success over seeds)."""
        return curve(self.rows, SUCCESS)

    def steps_to(self, level: float) -> int | None:
        """Return the environment steps of the first of 3 consecutive evaluations whose medians reach ``level``, or None."""
        return steps_to(self.points, level)

    def at(self, steps: int, metric: str = SUCCESS) -> np.ndarray | None:
        """Return the metric at one evaluation, [S] by ascending seed; None if not all seeds were evaluated then."""
        values = {row["seed"]: row.get(metric) for row in self.rows if row["env_steps"] == steps}
        if set(values) != set(self.seeds) or None in values.values():
            return None
        return np.array([values[seed] for seed in self.seeds])

    def median(self, steps: int | None = None, metric: str = SUCCESS) -> float:
        """Return the median over seeds at one evaluation, by default the last.

        Raises:
            ValueError: Not all seeds were evaluated then.
        """
        values = self.at(self.end if steps is None else steps, metric)
        if values is None:
            raise ValueError(f"{self.name} has no evaluation of all seeds at {steps} steps")
        return float(np.median(values))

    def means(self, budget: int | None = None, metric: str = SUCCESS) -> np.ndarray:
        """Return the mean of a metric over the evaluations up to ``budget`` environment steps, [S].

        Raises:
            ValueError: The run ended before ``budget``.
        """
        if (budget or 0) > self.end:
            raise ValueError(f"{self.name} ends at {self.end} steps, before {budget}")
        rows = [row for row in self.rows if row.get(metric) is not None and row["env_steps"] <= (budget or self.end)]
        return np.array([np.mean([row[metric] for row in rows if row["seed"] == seed]) for seed in self.seeds])


def _merge_records(name: str, records: Iterable[Record]) -> Record:
    records = list(records)
    return Record(
        name, tuple(row for part in records for row in part.rows), frozenset().union(*(part.origins for part in records))
    )


def _evaluations(file: Path) -> tuple[dict[str, Any], ...]:
    rows = (json.loads(line) for line in file.read_text(encoding="utf-8").splitlines())
    return tuple(row for row in rows if SUCCESS in row)


_curves = functools.cache(read_curves)


@functools.cache
def ablation(name: str) -> Record:
    """Return a curve of benchmarks/results/ablations, with revision and device as far as they are known.

    Raises:
        KeyError: No curve has this name.
    """
    curve = _curves()[name]
    origins = frozenset({f"{curve.revision} on {curve.device}"} if curve.revision and curve.device else ())
    return Record(f"ablations/{name}", tuple(row for row in curve.rows if SUCCESS in row), origins)


@functools.cache
def learning(*names: str) -> Record:
    """Return runs of benchmarks/results/learning, combined as seeds of one record."""
    folder, parts = RESULTS / "learning", []
    for name in names:
        record = json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))
        origins = frozenset({_format_origin(record["revision"], record["device"])})
        parts.append(Record(f"learning/{name}", _evaluations(folder / f"{name}.metrics.jsonl"), origins))
    return _merge_records(", ".join(part.name for part in parts), parts)


@functools.cache
def study(family: str, stem: str, is_fresh: bool = False, budget: int = 0) -> Record:
    """Return the runs of a study that differ only in seeds.

    Args:
        family: Folder below benchmarks/results/studies.
        stem: Prefix of the folders' names, before the seeds: ``VisualFetchReach-none-paper``.
        is_fresh: True for runs with seeds from 100 on instead of seeds 0 to 4, if there are any.
        budget: Environment steps that fresh runs must have reached.

    Raises:
        LookupError: No such run is stored.
    """
    folders = _folders(family, stem)
    if is_fresh:
        # The study of target networks includes the release's decay with fresh seeds, which is the same configuration.
        candidates = {**_folders("target_decay", f"{stem}-decay0.98"), **folders}
        long_enough = {first: folder for first, folder in candidates.items() if _read_run(folder).end >= budget}
        fresh_folders = {first: folder for first, folder in long_enough.items() if first >= FIRST_FRESH_SEED}
        if fresh_folders:
            return _merge_records(
                f"studies/{family}/{stem}", (_read_run(folder) for _, folder in sorted(fresh_folders.items()))
            )
    folders = {first: folder for first, folder in folders.items() if first < FIRST_FRESH_SEED}
    if not folders:
        raise LookupError(f"no run {stem} with seeds is kept in {RESULTS / 'studies' / family}")
    return _merge_records(f"studies/{family}/{stem}", (_read_run(folder) for _, folder in sorted(folders.items())))


def variants(family: Family, task: str) -> dict[str, Record]:
    """Return the runs of a family on a task by variant, in the family's order, with fresh seeds if there are any."""
    records = {}
    for variant in family.variants:
        try:
            records[variant] = study(family.name, f"{task}-{variant}-{family.preset}", is_fresh=True)
        except LookupError:
            continue
    return records


def runs(folder: str) -> dict[str, Record]:
    """Return the runs in a folder of benchmarks/results by name; {} if there are none."""
    return {path.name: _read_run(path) for path in (RESULTS / folder).glob("*") if path.is_dir()}


def fresh_variants(task: str) -> list[str]:
    """Return the variants of the study of auxiliary losses that were run with fresh seeds and the release's decay."""
    names = [folder.name for family in ("ol_aux", "target_decay") for folder in (RESULTS / "studies" / family).iterdir()]
    pattern = rf"{re.escape(task)}-([\w.]+)-paper(?:-decay0\.98)?-seeds(\d+)to\d+(?:-.*)?"
    matches = [match for name in names if (match := re.fullmatch(pattern, name))]
    return sorted({match[1] for match in matches if int(match[2]) >= FIRST_FRESH_SEED})


def _folders(family: str, stem: str) -> dict[int, Path]:
    """Return the folder of the longest run of a study by first seed; {} if there are none."""
    longest: dict[int, tuple[int, Path]] = {}
    for folder in (RESULTS / "studies" / family).glob(f"{stem}-seeds*"):
        match = re.fullmatch(rf"{re.escape(stem)}-seeds(\d+)to\d+(?:-.*)?", folder.name)
        if match:
            longest[int(match[1])] = max(longest.get(int(match[1]), (0, folder)), (_read_run(folder).end, folder))
    return {first: folder for first, (_, folder) in longest.items()}


@functools.cache
def _read_run(folder: Path) -> Record:
    record = read_record(folder)
    origins = frozenset({_format_origin(record["git_revision"], record["device"])})
    return Record(folder.relative_to(RESULTS).as_posix(), _evaluations(folder / "metrics.jsonl"), origins)


def _format_origin(revision: str, device: dict[str, Any]) -> str:
    kind = device.get("kind") or f"{device.get('cpu_count')} CPU cores"
    return f"{revision[:7]} on {kind if device['platform'] != 'cpu' else str(device['cpu_count']) + ' CPU cores'}"
