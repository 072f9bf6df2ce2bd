"""Statistics over seeds: interquartile means with bootstrap intervals, and exact permutation tests.

The definitions are those of Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical Precipice" (2021,
section 4): the interquartile mean is taken over all scores of all tasks, and seeds are resampled within their task.
"""

import functools
import itertools
from collections.abc import Sequence

import numpy as np
import scipy.stats

RESAMPLES = 20_000


def interquartile_mean(scores: Sequence[np.ndarray]) -> float:
    """Compute the mean of the middle half of all scores.

    Args:
        scores: One array of scores per task, [S].
    """
    return float(scipy.stats.trim_mean(np.concatenate(scores), 0.25))


def bootstrap_interval(scores: Sequence[np.ndarray], level: float = 0.95, seed: int = 0) -> tuple[float, float]:
    """Compute a percentile interval of the interquartile mean; seeds are resampled within their task.

    Args:
        scores: One array of scores per task, [S].
        level: Coverage of the interval.
        seed: Seed of the resampling.

    Returns:
        Lower and upper end of the interval.
    """
    random = np.random.default_rng(seed)
    samples = [values[random.integers(len(values), size=(RESAMPLES, len(values)))] for values in map(np.asarray, scores)]
    means = scipy.stats.trim_mean(np.concatenate(samples, axis=1), 0.25, axis=1)
    low, high = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)


def permutation_p_value(first: np.ndarray, second: np.ndarray) -> float:
    """Compute the two-sided p-value of the difference of two means, by all permutations of seeds between the groups.

    Args:
        first, second: Scores of the groups, [S] and [T]; at most 20 seeds in total, with up to 184,756 permutations.

    Raises:
        ValueError: There are too many permutations for an exact test.
    """
    first, second = np.asarray(first, float), np.asarray(second, float)
    if min(len(first), len(second)) > 10 or len(first) + len(second) > 20:
        raise ValueError(f"an exact test takes at most ten seeds in each group, not {len(first)} and {len(second)}")
    pooled = np.concatenate([first, second])
    sums = pooled[_choices(len(pooled), len(first))].sum(axis=1)
    # Sums of equal scores may differ by rounding errors.
    margin = 1e-12 * np.abs(pooled).sum()
    rarer = min(np.mean(sums <= first.sum() + margin), np.mean(sums >= first.sum() - margin))
    return min(1.0, 2.0 * float(rarer))


@functools.cache
def _choices(count: int, size: int) -> np.ndarray:
    """Return all combinations of ``size`` out of ``count`` indices, [combinations, size] uint8.

    `scipy.stats.permutation_test` enumerates them in each call, one by one, which takes 0.3 s for two groups of ten.
    """
    return np.array(list(itertools.combinations(range(count), size)), np.uint8)
