"""Statistics over seeds: comparison with values counted by hand, and with the coverage that they claim."""

import numpy as np
import pytest
import scipy.stats

from benchmarks.claims.permutation import permutation_p_value
from jaxrl_vis.studies.seed_statistics import bootstrap_interval, interquartile_mean


def test_the_interquartile_mean_leaves_out_the_outer_quarters_of_all_scores():
    assert interquartile_mean([np.array([0.0, 4.0, 5.0, 100.0])]) == 4.5
    assert interquartile_mean([np.array([-50.0, 1.0]), np.array([2.0, 90.0])]) == 1.5


def test_the_permutation_test_counts_assignments():
    # Of the 252 ways to divide ten seeds into two fives, two are as extreme as complete separation.
    separated = permutation_p_value(np.arange(5.0), np.arange(5.0) + 10.0)
    assert separated == pytest.approx(2 / 252)
    assert permutation_p_value(np.arange(5.0), np.arange(5.0)) == 1.0
    random = np.random.default_rng(0)
    for sizes in ((3, 6), (5, 5), (6, 3)):
        first, second = (np.round(random.normal(size=size), 1) for size in sizes)  # some scores are equal
        expected = scipy.stats.permutation_test((first, second), lambda a, b: np.mean(a) - np.mean(b), n_resamples=np.inf)
        assert permutation_p_value(first, second) == pytest.approx(expected.pvalue)
    with pytest.raises(ValueError, match="at most ten"):
        permutation_p_value(np.zeros(11), np.zeros(11))


def test_intervals_cover_the_mean_about_as_often_as_they_say():
    random = np.random.default_rng(1)
    trials = [bootstrap_interval([random.normal(size=10), random.normal(size=10)], seed=trial) for trial in range(80)]
    assert 0.85 <= np.mean([low <= 0.0 <= high for low, high in trials]) <= 1.0
    assert bootstrap_interval([np.ones(5)]) == (1.0, 1.0)
