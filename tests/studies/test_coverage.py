"""What assets/statistics/README.md claims of verdicts and of several tasks together, simulated again."""

import numpy as np
import pytest

from recipes.studies.simulate_stopping.coverage import pair_rates, verdict_errors
from recipes.studies.simulate_stopping.results import load_stopping
from recipes.studies.simulate_stopping.simulated import simulate_aggregates, simulate_errors
from torchrl_sparse.evaluation.statistics.intervals import DEFAULT_MARGIN, tango_z
from torchrl_sparse.evaluation.statistics.sequential import Design

PUBLISHED = load_stopping("assets/statistics/stopping.json")


def test_what_is_published_holds_what_is_claimed():
    assert all(case.non_inferior <= 0.03 for case in PUBLISHED.errors)
    assert all(min(case.success, case.time) >= 0.94 for case in PUBLISHED.aggregates)


@pytest.mark.parametrize("correlation", [-0.05, 0.0, 0.6])
def test_pairs_have_the_rates_and_the_correlation_that_are_asked_for(correlation):
    rates = pair_rates(0.75, 0.8, correlation)
    ours, dense = rates.draw(40_000, np.random.default_rng(0))
    assert (ours.mean(), dense.mean()) == (pytest.approx(0.75, abs=0.01), pytest.approx(0.8, abs=0.01))
    assert np.corrcoef(ours, dense)[0, 1] == pytest.approx(correlation, abs=0.02)
    assert pair_rates(0.5, 0.99, 0.9) is None


def test_errors_are_those_of_single_trials():
    """The slow reference: one benchmark at a time, from drawn episodes."""
    design, rates = Design(60, 6), pair_rates(0.85, 0.9, 0.3)
    generator, wrong = np.random.default_rng(0), 0
    for _ in range(2000):
        ours, dense = rates.draw(60, generator)
        won, lost = np.cumsum(ours > dense), np.cumsum(dense > ours)
        wrong += any(
            tango_z(won[n - 1], lost[n - 1], n, -DEFAULT_MARGIN) > design.critical(n) for n in design.ends
        )
    found, _ = verdict_errors(rates, design, 20_000, np.random.default_rng(1))
    assert found == pytest.approx(wrong / 2000, abs=0.012)


@pytest.mark.slow
def test_verdicts_err_no_more_than_is_published():
    for found, published in zip(simulate_errors(1000, seed=1), PUBLISHED.errors, strict=True):
        assert found.non_inferior <= 0.03 + 0.003
        assert found.non_inferior == pytest.approx(published.non_inferior, abs=0.006)


@pytest.mark.slow
def test_intervals_over_tasks_cover_as_often_as_is_published():
    for found in simulate_aggregates(1000, seed=1):
        assert min(found.success, found.time) >= 0.92  # the least of many cases of 500 trials
