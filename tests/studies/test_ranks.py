"""Rank correlations within groups."""

import numpy as np
import pytest
from scipy.stats import spearmanr

from recipes.studies.offline_errors.ranks import (
    difference_ci95,
    mean_rank_correlation,
    rank_correlation,
)


def test_it_is_spearmans():
    rng = np.random.default_rng(0)
    for _ in range(5):
        xs, ys = rng.integers(4, size=9), rng.normal(size=9)
        assert rank_correlation(xs, ys) == pytest.approx(spearmanr(xs, ys).statistic)


def test_groups_are_not_mixed():
    """Within each group less goes with less, though the second group lies the other way round above the first."""
    groups = [([1, 2, 3, 4], [11, 12, 13, 14]), ([5, 6], [1, 2])]
    assert mean_rank_correlation(groups)[0] == pytest.approx(1.0)


def test_chance_is_called_chance():
    rng = np.random.default_rng(1)
    ps = [
        mean_rank_correlation([(rng.normal(size=6), rng.normal(size=6)) for _ in range(2)], trials=200)[1]
        for _ in range(200)
    ]
    assert 0.4 < np.mean(ps) < 0.6
    assert np.mean(np.array(ps) <= 0.1) == pytest.approx(0.1, abs=0.06)


def test_a_better_number_is_told_from_an_equal_one():
    rng = np.random.default_rng(2)
    y = rng.normal(size=40)
    near, as_near, far = (y + noise * rng.normal(size=40) for noise in (0.1, 0.1, 2.0))
    low, high = difference_ci95([(near, far, y)], draws=500)
    assert 0.2 < low < high < 1.2
    low, high = difference_ci95([(near, as_near, y)], draws=500)
    assert -0.05 < low < 0 < high < 0.05


def test_a_group_that_tells_nothing_apart_counts_as_nothing():
    told = ([1, 2, 3], [1, 2, 3])
    assert mean_rank_correlation([told, ([1, 2, 3], [0, 0, 0])])[0] == pytest.approx(0.5)
