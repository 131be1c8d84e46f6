"""The bootstrap interval covers."""

import numpy as np

from tests.refusals import refused
from torchrl_sparse.evaluation.statistics.bootstrap import median_ratio_interval


def test_a_ratio_of_medians_is_covered_although_rounds_are_slow_together():
    generator, covered = np.random.default_rng(0), 0
    for _ in range(200):
        machine = generator.gamma(20, 1 / 20, 100)
        fast, dense = (
            machine * generator.gamma(400, 1 / 400, 100),
            machine * generator.gamma(400, 5 / 400, 100),
        )
        low, high = median_ratio_interval(dense, fast)
        covered += low <= 5 <= high
    assert covered / 200 > 0.88
    apart = median_ratio_interval(dense, generator.permutation(fast))
    assert np.diff(median_ratio_interval(dense, fast)) <= np.diff(apart) * 1.2


def test_rounds_that_do_not_fit_are_refused():
    with refused("rounds"):
        median_ratio_interval([1, 2], [1])
