"""Looking again and again costs no error: the design's level, and whole benchmarks simulated at the margins."""

import math

import numpy as np
import pytest

from recipes.studies.simulate_stopping.results import load_stopping, simulate_stopping
from recipes.studies.simulate_stopping.simulation import Population, claim_rates, pair_errors, savings
from tests.refusals import refused
from torchrl_sparse.evaluation.statistics import sequential
from torchrl_sparse.evaluation.statistics.durations import time_z
from torchrl_sparse.evaluation.statistics.intervals import tango_interval, tango_z
from torchrl_sparse.evaluation.statistics.sequential import Design

CAN, LIFT = Population(0.87, 0.0, 104), Population(0.9975, 0.0, 29)
DESIGN, TRIALS = Design(1300, analyses=30), 1000


@pytest.mark.parametrize(
    ("shape", "analyses", "constant"), [(0.5, 2, 2.178), (0.5, 5, 2.413), (0, 2, 1.977), (0, 5, 2.040)]
)
def test_the_ends_of_the_family_are_pococks_and_obrien_and_flemings(monkeypatch, shape, analyses, constant):
    monkeypatch.setattr(sequential, "_SHAPE", shape)
    times = tuple((analysis + 1) / analyses for analysis in range(analyses))
    assert sequential._crossing(constant, times) == pytest.approx(0.05, abs=1e-4)


def test_a_motion_crosses_as_often_as_the_design_says():
    steps = np.random.default_rng(0).standard_normal((20_000, 30)).cumsum(axis=1)
    limits = np.array([DESIGN.critical(n) for n in DESIGN.ends]) * np.sqrt(np.arange(1, 31))
    assert (np.abs(steps) > limits).any(axis=1).mean() == pytest.approx(0.05, abs=5e-3)


@pytest.mark.parametrize("margin", ["success", "slower", "failing more", "rarely failing"])
def test_whoever_looks_thirty_times_errs_no_more_than_once_in_twenty(margin):
    population, statistic = {
        "success": (Population(0.87, -0.05, 104), 0),
        "slower": (CAN.at_time_margin(), 1),
        "failing more": (CAN.failing_at_time_margin(), 1),
        "rarely failing": (LIFT.failing_at_time_margin(), 1),
    }[margin]
    assert claim_rates(population, DESIGN, TRIALS)[statistic] <= 0.05


def test_ordinary_intervals_would_err_far_more_often():
    statistics, generator = [], np.random.default_rng(0)
    for _ in range(300):
        ours, theirs = Population(0.87, -0.05, 104).draw(1300, generator)
        solved, dense = ours < 400, theirs < 400
        won, lost = (solved & ~dense).cumsum(), (dense & ~solved).cumsum()
        statistics.append([tango_z(int(won[n - 1]), int(lost[n - 1]), n, -0.05) for n in DESIGN.ends])
    assert (np.array(statistics) > 1.96).any(axis=1).mean() > 0.08


def test_plain_differences_are_decided_early_and_equal_methods_before_the_cap():
    bad, equal = savings(Population(0.87, -0.2, 104), DESIGN, 50), savings(CAN, DESIGN, 50)
    assert bad.saved > 0.7
    assert bad.inferior == 1
    assert equal.saved > 0.2
    assert equal.non_inferior > 0.7
    assert equal.inferior == 0


def test_interval_and_statistic_of_a_look_agree():
    level = DESIGN.confidence(433)
    low, high = tango_interval(30, 40, 433, level)
    assert tango_z(30, 40, 433, low) == pytest.approx(DESIGN.critical(433), abs=1e-6)
    assert tango_z(30, 40, 433, high) == pytest.approx(-DESIGN.critical(433), abs=1e-6)


def test_a_method_is_decided_by_both_measures_or_by_one_that_is_inferior():
    c = DESIGN.critical(650)
    assert DESIGN.decides(650, c + 0.1, c + 0.1)
    assert not DESIGN.decides(650, c + 0.1, c - 0.1)
    assert DESIGN.decides(650, c + 0.1, -c - 0.1)


def test_p_values_count_the_looks():
    design = Design(1000, analyses=10)
    for n in design.ends:
        assert design.p_value(design.critical(n), n) == pytest.approx(0.025, abs=1e-4)
    assert design.p_value(3.0, 1000) > Design(1000).p_value(3.0, 1000) == pytest.approx(0.00135, abs=1e-5)
    assert design.p_value(-1.0, 1000) == 0.5


def test_designs_that_are_none_are_refused():
    with refused("analyses"):
        Design(10, analyses=11)
    with refused("analyses"):
        Design(0)
    with refused("episodes"):
        DESIGN.critical(44)


def test_published_simulations_are_what_their_command_makes():
    published = load_stopping("assets/statistics/stopping.json")
    assert (published.max_episodes, published.analyses, published.trials) == (1300, 30, 2000)
    assert all(case.rate <= 0.05 for case in published.type_one)
    assert all(max(case.success, case.time) < 0.08 for case in published.pairs)
    few = simulate_stopping(130, 3, 2)
    for cases in ("savings", "pairs"):
        tasks = [[case.task for case in getattr(results, cases)] for results in (few, published)]
        assert tasks[0] == tasks[1] != []


def test_equal_methods_that_dense_stopped_seem_to_differ_about_as_often_as_intervals_say():
    """With one analysis nothing but the intervals is tested."""
    population = Population(0.8, -0.15, 100)
    for design in (Design(200), Design(300, analyses=15)):
        for rate in pair_errors(population, design, trials=1000):
            assert 0.022 < rate < 0.078  # 5 %, give or take four of its standard errors


def test_a_single_pair_decides_nothing():
    assert abs(time_z([30], [30], 400, 1.1)) < 1


@pytest.mark.parametrize("analyses", [1, 30])
def test_a_p_value_never_grows_with_the_evidence(analyses):
    p_values = [Design(300, analyses).p_value(z, 300) for z in (1, 2, 4, 8, 20, 60, math.inf)]
    assert p_values == sorted(p_values, reverse=True)
    assert p_values[-1] < 1e-12
