"""Analysis of learning curves. "X by N steps": the evaluation at N and the next two all reach X, in the median over seeds."""

import statistics
from collections.abc import Mapping, Sequence
from typing import Any

CONFIRMATIONS = 2  # further evaluations that must reach a value


def curve(rows: Sequence[Mapping[str, Any]], metric: str) -> list[tuple[int, float]]:
    """Compute the median over seeds of a metric against environment steps, at the steps where every seed was evaluated.

    Args:
        rows: Rows of metrics.jsonl, from one run or several. No seed may appear twice at the same step.
        metric: A column, such as ``eval/success``.

    Raises:
        ValueError: A seed appears twice.
    """
    seeds = {row["seed"] for row in rows}
    values: dict[int, dict[int, float]] = {}
    for row in rows:
        if row["seed"] in values.setdefault(row["env_steps"], {}):
            raise ValueError(f"seed {row['seed']} appears twice at {row['env_steps']} steps: are these different runs?")
        values[row["env_steps"]][row["seed"]] = row[metric]
    return [(steps, statistics.median(by_seed.values())) for steps, by_seed in sorted(values.items()) if set(by_seed) == seeds]


def steps_to(points: Sequence[tuple[int, float]], target: float, lower_is_better: bool = False) -> int | None:
    """Return the first step whose evaluation and the next `CONFIRMATIONS` all reach ``target``; None if there is none.

    Args:
        points: From `curve`.
        target: Value to be reached.
        lower_is_better: Whether a value reaches the target from above, as distances do.
    """
    for index in range(len(points) - CONFIRMATIONS):
        window = [value for _, value in points[index : index + 1 + CONFIRMATIONS]]
        if all(value <= target if lower_is_better else value >= target for value in window):
            return points[index][0]
    return None
