"""Metrics of a reward function relative to the ground truth, on NumPy arrays. Rewards lie between 0 and 1."""

import numpy as np

BINS = 10
"""Number of bins of the calibration error."""


def ranks(values: np.ndarray) -> np.ndarray:
    """Return the ranks [N] float64 of [N] numbers, from 0; ties get their mean rank."""
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    ends = np.cumsum(counts)
    return (ends - (counts + 1) / 2.0)[inverse]


def rank_correlation(first: np.ndarray, second: np.ndarray) -> float:
    """Compute Spearman's rank correlation of two arrays [N]; 0 if all values of one are equal."""
    first_ranks, second_ranks = (ranks(values) - (len(values) - 1) / 2.0 for values in (first, second))
    size = np.sqrt(np.sum(first_ranks**2) * np.sum(second_ranks**2))
    return 0.0 if size == 0.0 else float(np.sum(first_ranks * second_ranks) / size)


def error_shares(reward: np.ndarray, is_reached: np.ndarray) -> tuple[float, float]:
    """Compute the fraction of false positives among unreached pairs, and that of false negatives among reached pairs.

    Args:
        reward: [N] float; at least 0.5 counts as positive.
        is_reached: [N] bool, ground truth.

    Returns:
        Both fractions; NaN if there is no such pair.
    """
    positive = reward >= 0.5
    errors = positive[~is_reached], ~positive[is_reached]
    false_positive, false_negative = (float(np.mean(flags)) if flags.size else float("nan") for flags in errors)
    return false_positive, false_negative


def calibration(reward: np.ndarray, is_reached: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compare rewards, interpreted as probabilities, with the fraction of reached pairs, in uniform bins of the reward.

    Args:
        reward: [N] float.
        is_reached: [N] bool, ground truth.

    Returns:
        Mean reward, fraction reached (both NaN in empty bins), and number of pairs: [BINS] each.
    """
    place = np.minimum((np.clip(reward, 0.0, 1.0) * BINS).astype(int), BINS - 1)
    count = np.bincount(place, minlength=BINS)
    some = np.where(count, count, np.nan)
    mean = np.bincount(place, weights=reward, minlength=BINS) / some
    return mean, np.bincount(place, weights=is_reached.astype(float), minlength=BINS) / some, count


def calibration_error(reward: np.ndarray, is_reached: np.ndarray) -> float:
    """Compute the expected calibration error: the mean over pairs of |mean reward - fraction reached| of their bin.

    Arguments as for `calibration`.
    """
    mean, frequency, count = calibration(reward, is_reached)
    return float(np.nansum(count * np.abs(mean - frequency)) / np.sum(count))
