"""Score of an evaluation, by which a run keeps its best checkpoint and stops early. Imports no JAX.

A score is the mean over seeds of one metric (`RunOptions.best_by`; success if none is named): one program trains all seeds, so
they share one checkpoint and end together.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from jaxrl_vis.config import Config

_LOWER_IS_BETTER = ("goal_distance", "goal_distance_median")


def metric_name(config: Config) -> str:
    """Return the name of the metric that the score averages, without ``eval/``."""
    return config.run.best_by or "success"


def is_lower_better(config: Config) -> bool:
    """Return True if smaller scores are better, as for distances."""
    return metric_name(config) in _LOWER_IS_BETTER


def score(config: Config, values: Mapping[str, Sequence[float]]) -> float:
    """Return the score of an evaluation.

    Args:
        config: Configuration of the run.
        values: ``eval/*``, one number per seed.
    """
    per_seed = values[f"eval/{metric_name(config)}"]
    return math.fsum(per_seed) / len(per_seed)


def is_better(config: Config, new: float, old: float | None) -> bool:
    """Return True if ``new`` is strictly better than ``old``; any score is better than None."""
    if old is None:
        return True
    return new < old if is_lower_better(config) else new > old


def is_enough(config: Config, value: float) -> bool:
    """Return True if a score has reached the level at which the run stops (`RunOptions.stop_at`)."""
    level = config.run.stop_at
    if level is None:
        return False
    return value <= level if is_lower_better(config) else value >= level


def enough_at(config: Config, rows: Sequence[Mapping[str, Any]], seeds: Collection[int]) -> list[int]:
    """Return the iterations, ascending, after whose evaluations the run could have stopped.

    Args:
        config: Configuration of the run.
        rows: Rows of metrics.jsonl.
        seeds: Seeds of the run; evaluations without rows of all of them are ignored.
    """
    name = f"eval/{metric_name(config)}"
    by_iteration: dict[int, dict[int, float]] = {}
    for row in rows:
        if isinstance(row.get(name), int | float) and row["seed"] in seeds:
            by_iteration.setdefault(row["iteration"], {})[row["seed"]] = row[name]
    complete = {number: values for number, values in sorted(by_iteration.items()) if len(values) == len(seeds)}
    return [number for number, values in complete.items() if is_enough(config, score(config, {name: list(values.values())}))]
