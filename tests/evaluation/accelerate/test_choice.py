"""What is worth episodes, and what is taken, on made-up measurements."""

from tests.refusals import refused
from torchrl_sparse.evaluation.accelerate.choice import choose, rank, within_budget
from torchrl_sparse.evaluation.results.acceleration import Candidate, Played
from torchrl_sparse.evaluation.results.parts import Percentiles, Success
from torchrl_sparse.evaluation.statistics.differences import Difference, TimeDifference


def candidate(family, error, p50, p95=None):
    return Candidate(family, error, Percentiles(p50 / 1e3, (p95 or p50) / 1e3, 30))


CANDIDATES = {
    "dense": candidate("stochastic", 0.5, 100),
    "good": candidate("stochastic", 0.4, 9, 12),
    "better": candidate("stochastic", 0.3, 20),
    "bad": candidate("stochastic", 0.9, 4),
    "cache": candidate("cached", 0.2, 30),
    "even": candidate("deterministic", 0.1, 5),
    "slow": candidate("cached", 0.1, 120),
}


def played(low, verdict="non-inferior", time="non-inferior"):
    return Played(
        Success.of([True] * 9 + [False]),
        Difference(low, (low, low), 0.05, verdict),
        TimeDifference(1.0, (0.9, 1.1), 0.1, time),
    )


def test_the_budget_is_kept_by_95_percent_of_the_queries():
    assert within_budget(CANDIDATES, 10) == ["bad", "even"]
    assert within_budget(CANDIDATES, 12) == ["good", "bad", "even"]


def test_without_a_budget_all_that_is_faster_than_dense_is_kept():
    assert within_budget(CANDIDATES, None) == ["good", "better", "bad", "cache", "even"]


def test_a_budget_that_nothing_keeps_is_refused_with_what_it_takes():
    with refused("budget_ms"):
        within_budget(CANDIDATES, 1)
    with refused("budget_ms"):
        within_budget({name: CANDIDATES[name] for name in ("dense", "slow")}, None)


def test_families_take_turns_by_error_within_a_budget():
    names = within_budget(CANDIDATES, 40)
    assert rank(names, CANDIDATES, 40) == ["better", "cache", "even", "good", "bad"]


def test_without_a_budget_those_as_close_as_dense_go_by_speed():
    names = within_budget(CANDIDATES, None)
    assert rank(names, CANDIDATES, None) == ["good", "cache", "even", "better", "bad"]


def test_of_the_right_ones_the_fastest_is_taken_or_within_a_budget_the_surest():
    ranking = ["better", "cache", "even"]
    outcomes = {
        "dense": played(0.0),
        "better": played(-0.01),
        "cache": played(-0.04),
        "even": played(0.2, time="inconclusive"),
    }
    assert choose(ranking, CANDIDATES, outcomes, 50) == "better"
    outcomes["good"] = played(-0.03)
    assert choose([*ranking, "good"], CANDIDATES, outcomes, None) == "good"


def test_where_none_is_right_the_nearest_is_taken_and_without_episodes_the_first():
    outcomes = {"cache": played(-0.4, "inconclusive"), "even": played(-0.2, "inconclusive")}
    assert choose(["better", "cache", "even"], CANDIDATES, outcomes, None) == "even"
    assert choose(["better", "cache"], CANDIDATES, {}, None) == "better"
