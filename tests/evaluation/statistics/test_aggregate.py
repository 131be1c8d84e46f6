"""Several tasks together: coverage by enumeration where pairs are few, weights, and what is refused."""

import itertools
import math

import numpy as np
import pytest
from scipy.stats import multinomial

from recipes.studies.simulate_stopping.coverage import pair_rates
from tests.refusals import refused
from torchrl_sparse.evaluation.statistics.aggregate import TaskPairs, aggregate_tasks
from torchrl_sparse.evaluation.statistics.intervals import mcnemar_p
from torchrl_sparse.evaluation.statistics.sequential import Design

N = 5
OUTCOMES = [(won, lost) for won in range(N + 1) for lost in range(N + 1 - won)]


def pairs(won, lost, n, horizon=400):
    """A task in which the others were solved by both."""
    ours, dense = [True] * n, [True] * n
    ours[:lost], dense[lost : lost + won] = [False] * lost, [False] * won
    times = tuple(np.where(solved, 100.0, horizon) for solved in (ours, dense))
    return TaskPairs((ours, dense), times, horizon)


def test_of_two_tasks_of_five_pairs_all_outcomes_together_hold_the_claimed_error():
    """Exact: every outcome of both tasks with its probability, for rates alike and unlike and correlations of 0 to .9."""
    limits = np.empty((len(OUTCOMES), len(OUTCOMES), 2))
    for (i, one), (j, other) in itertools.product(enumerate(OUTCOMES), repeat=2):
        found = aggregate_tasks({"a": pairs(*one, N), "b": pairs(*other, N)})
        limits[i, j] = found.success.ci
    cases = [
        (method - dense, rates)
        for dense, method in itertools.product((0.5, 0.7, 0.9, 0.99), (0.5, 0.65, 0.85, 0.94, 0.99))
        for correlation in (0.0, 0.3, 0.6, 0.9)
        if (rates := pair_rates(method, dense, correlation))
    ]
    chances = [
        multinomial.pmf(
            [(won, lost, N - won - lost) for won, lost in OUTCOMES],
            N,
            [rates.won, rates.lost, 1 - rates.won - rates.lost],
        )
        for _, rates in cases
    ]
    least = 1.0
    for (one, first), (other, second) in itertools.product(
        zip((case[0] for case in cases), chances, strict=True), repeat=2
    ):
        truth = (one + other) / 2
        held = (limits[..., 0] <= truth + 1e-12) & (truth - 1e-12 <= limits[..., 1])
        least = min(least, first @ held @ second)
    assert least >= 0.95


def test_every_task_weighs_the_same_whatever_its_episodes():
    result = aggregate_tasks({"a": pairs(0, 0, 400), "b": pairs(0, 10, 10)})
    assert (result.success.value, result.episodes) == (-0.5, 410)
    assert result.time.value == pytest.approx(2.0)
    assert result.mcnemar_p == mcnemar_p(0, 10)


def test_where_failures_are_common_it_is_the_ordinary_interval():
    generator = np.random.default_rng(0)
    solved = [(generator.random(1300) < 0.6, generator.random(1300) < 0.6) for _ in range(3)]
    tasks = {
        str(i): TaskPairs(both, tuple(np.where(one, 100.0, 400.0) for one in both), 400)
        for i, both in enumerate(solved)
    }
    low, high = aggregate_tasks(tasks).success.ci
    spread = math.sqrt(sum(np.subtract(*map(np.float64, both)).var(ddof=1) / 1300 for both in solved)) / 3
    assert (high - low) / 2 == pytest.approx(1.96 * spread, rel=0.06)


@pytest.mark.parametrize("lost", [0, 3, 40])
def test_interval_and_p_value_agree(lost):
    found = aggregate_tasks({"a": pairs(1, lost, 150), "b": pairs(2, lost, 150)})
    for mean, bound in ((found.success, -0.05), (found.time, 1.1)):
        assert (mean.p_value < 0.025) == (not mean.ci[0] <= bound <= mean.ci[1])


def test_a_task_that_stopped_early_is_as_wide_as_its_look():
    fixed, looked = pairs(2, 3, 130), pairs(2, 3, 130)
    looked = TaskPairs(looked.solved, looked.times, 400, Design(1300, 30))
    widths = [np.diff(aggregate_tasks({"a": task, "b": task}).success.ci) for task in (fixed, looked)]
    assert widths[1] > 1.8 * widths[0]


def test_what_says_nothing_is_refused():
    with refused("tasks"):
        aggregate_tasks({})
    with refused("tasks"):
        aggregate_tasks({"a": pairs(0, 0, 5), "b": pairs(0, 0, 1)})
