"""Bootstrap intervals cover, and tasks keep their weight."""

import numpy as np
import pytest

from torchrl_sparse.evaluation.statistics.bootstrap import aggregate_tasks, median_ratio_interval


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


def test_every_task_weighs_the_same_whatever_its_episodes():
    successes = {"a": [(True, True)] * 400, "b": [(False, True)] * 10}
    times = {"a": [(30.0, 30.0)] * 400, "b": [(400.0, 100.0)] * 10}
    result = aggregate_tasks(successes, times)
    assert (result.success, result.time, result.episodes) == (-0.5, 2.0, 410)
    assert result.success_ci == (-0.5, -0.5)


def test_seeds_are_drawn_within_their_task():
    generator, covered = np.random.default_rng(0), 0
    for _ in range(100):
        drawn = {
            task: generator.random((100, 2)) < [rate - 0.1, rate]
            for task, rate in {"a": 0.9, "b": 0.6}.items()
        }
        times = {task: np.where(solved, 100.0, 400.0) for task, solved in drawn.items()}
        result = aggregate_tasks({task: [*map(tuple, solved)] for task, solved in drawn.items()}, times)
        covered += result.success_ci[0] <= -0.1 <= result.success_ci[1]
    assert covered >= 88


def test_nothing_cannot_be_put_together():
    with pytest.raises(ValueError, match="tasks: expected seeds of at least one, got"):
        aggregate_tasks({}, {})
    with pytest.raises(ValueError, match="rounds: expected as many of both, and at least one, got 2 and 1"):
        median_ratio_interval([1, 2], [1])
