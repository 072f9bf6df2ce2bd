"""Exact permutation tests of two groups of seeds."""

import functools
import itertools

import numpy as np


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
