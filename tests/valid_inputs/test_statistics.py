"""Episodes that gave wrong numbers: few pairs, pairs that all agree, dense that does nothing, many analyses."""

import numpy as np
import pytest

from recipes.studies.pages.choices import headline
from recipes.studies.simulate_stopping.coverage import pair_rates, verdict_errors
from tests.evaluation.results.test_report import ABOUT, run
from tests.refusals import refused
from torchrl_sparse.evaluation.results.build import Terms, build_results
from torchrl_sparse.evaluation.results.report import format_table, results_rows
from torchrl_sparse.evaluation.statistics.aggregate import TaskPairs, aggregate_tasks
from torchrl_sparse.evaluation.statistics.intervals import mcnemar_p
from torchrl_sparse.evaluation.statistics.multiplicity import holm
from torchrl_sparse.evaluation.statistics.scores import difference_interval, difference_z, mean_interval
from torchrl_sparse.evaluation.statistics.sequential import Design


def test_six_concordant_pairs_show_no_non_inferiority():
    """Three of each task, all solved by both: a score interval's width, as Tango's of one task, never [0, 0]."""
    agreeing = TaskPairs(([True] * 3, [True] * 3), ([30.0] * 3, [30.0] * 3), 400)
    found = aggregate_tasks({"a": agreeing, "b": agreeing})
    assert found.success.ci[0] < -0.05
    assert found.time.ci[1] > 1.1
    assert min(found.success.p_value, found.time.p_value) > 0.025


def test_three_hundred_episodes_and_thirty_looks_err_no_more_than_is_claimed():
    """At the margin with dense at .9, which erred in 4.0 to 4.9 % while dense's further episodes counted; 2.5 % is meant."""
    rates = pair_rates(0.85, 0.9, 0.0)
    found, _ = verdict_errors(rates, Design(300, 30), 10_000, np.random.default_rng(0))
    assert found < 0.03
    one_look, _ = verdict_errors(rates, Design(50), 10_000, np.random.default_rng(0))
    assert one_look < 0.035


def test_mcnemar_is_exact_two_sided_and_one_where_no_pair_differs():
    """Binomial(won + lost, 1/2), twice the smaller tail: 2 (1 + 8) / 2^8 of one and seven."""
    assert mcnemar_p(1, 7) == mcnemar_p(7, 1) == pytest.approx(18 / 256)
    assert mcnemar_p(0, 0) == mcnemar_p(4, 4) == 1.0
    dense, fast = run([1] * 8 + [0]), run([1] + [0] * 7 + [1])
    results = build_results({"dense": dense, "fast": fast}, terms=Terms(Design(9), 60), **ABOUT)
    assert results.methods["fast"].paired_vs_dense.mcnemar_p == pytest.approx(18 / 256)
    assert results_rows(results)[1]["McNemar's p"] == "0.070"
    assert "exact, two-sided" in format_table(results)


def test_dense_that_solves_nothing_says_so_instead_of_verdicts():
    """A checkpoint that observes nothing useful: a method that also solves nothing is not non-inferior to it."""
    nothing = run([0] * 400)
    results = build_results({"dense": nothing, "fast": nothing}, terms=Terms(Design(400), 60), **ABOUT)
    entry = results.methods["fast"]
    assert (entry.paired_vs_dense.verdict, entry.time_vs_dense.verdict) == ("inconclusive", "inconclusive")
    row = results_rows(results)[1]
    assert (row["verdict"], row["time verdict"]) == ("dense solved none", "dense solved none")
    assert "non-inferior" not in format_table(results).split("\n\n")[0]
    assert headline(results)[0] is None


def test_scores_that_are_all_alike_are_not_known_exactly():
    """Student's interval of a spread of zero had no width, of two episodes; Tango's of pairs that agree has."""
    _, (low, high) = difference_interval([0.5, 0.5], [0.5, 0.5])
    assert low < -0.5
    assert high > 0.5
    assert abs(difference_z([0.5, 0.5], [0.5, 0.5], -0.05)) < 1.96
    assert mean_interval([1.0, 1.0])[1][0] < 0.6
    z = difference_z([0.5] * 73, [0.5] * 73, -0.05)
    assert (z > 1.96) == (difference_interval([0.5] * 73, [0.5] * 73)[1][0] > -0.05)


def test_holm_of_one_comparison_and_of_a_number_that_is_none():
    """One comparison is its own family; NaN is no p-value and survives nothing, wherever it stands among others."""
    assert holm({"a": 0.0249}) == {"a"}
    assert holm({}) == set()
    for order in (("a", "b"), ("b", "a")):
        with refused("b"):
            holm({name: {"a": 0.001, "b": float("nan")}[name] for name in order})
