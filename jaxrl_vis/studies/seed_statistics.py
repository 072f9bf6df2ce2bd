"""Statistics over seeds: interquartile means with bootstrap intervals.

The definitions are those of Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical Precipice" (2021,
section 4): the interquartile mean is taken over all scores of all tasks, and seeds are resampled within their task.
"""

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


def bootstrap_interval(scores: Sequence[np.ndarray], seed: int = 0) -> tuple[float, float]:
    """Compute a 95 % percentile interval of the interquartile mean; seeds are resampled within their task.

    Args:
        scores: One array of scores per task, [S].
        seed: Seed of the resampling.

    Returns:
        Lower and upper end of the interval.
    """
    random = np.random.default_rng(seed)
    samples = [values[random.integers(len(values), size=(RESAMPLES, len(values)))] for values in map(np.asarray, scores)]
    means = scipy.stats.trim_mean(np.concatenate(samples, axis=1), 0.25, axis=1)
    low, high = np.quantile(means, [0.025, 0.975])
    return float(low), float(high)
