"""Where statsmodels and robostats compute the same, they answer the same; where not, it is known why. Extra ``dev``."""

import itertools

import pytest

from torchrl_sparse.evaluation.statistics.intervals import mcnemar_p, wilson_interval
from torchrl_sparse.evaluation.statistics.multiplicity import holm
from torchrl_sparse.evaluation.statistics.overlap import OverlapCounts
from torchrl_sparse.evaluation.statistics.power import Truth, fixed_plan

CELLS = [(30, 2, 7, 4), (12, 0, 3, 0), (50, 1, 1, 8)]
NAMES = (
    *("n_both_success", "n_a_success_b_failure", "n_b_success_a_failure", "n_both_failure"),
    *("successes_only_a", "n_only_a", "successes_only_b", "n_only_b"),
)
ALONE = [((56, 70), (48, 80)), ((20, 100), (31, 100)), ((38, 40), (20, 21))]


def test_statsmodels_agrees():
    proportion = pytest.importorskip("statsmodels.stats.proportion")
    tables = pytest.importorskip("statsmodels.stats.contingency_tables")
    multiple = pytest.importorskip("statsmodels.stats.multitest")
    for both, won, lost, neither in CELLS:
        told = tables.mcnemar([[both, won], [lost, neither]], exact=True).pvalue
        assert mcnemar_p(won, lost) == pytest.approx(told)
    for (a, m), (b, n) in ALONE:
        told = proportion.proportion_confint(a, m, method="wilson")
        assert wilson_interval(a, m) == pytest.approx(told)
        equal = proportion.test_proportions_2indep(a, m, b, n, method="score", compare="diff")
        assert OverlapCounts(0, 0, 0, 0, (a, m), (b, n)).p_equal() == pytest.approx(equal.pvalue)
    p_values = {"a": 0.001, "b": 0.012, "c": 0.02, "d": 0.3}
    rejected = multiple.multipletests([*p_values.values()], alpha=0.025, method="holm")[0]
    assert holm(p_values) == {name for name, out in zip(p_values, rejected, strict=True) if out}


def test_statsmodels_differs_away_from_no_difference():
    """Its likeliest rate has a successes' count where Miettinen and Nurminen have episodes: ours is the likelier one."""
    proportion = pytest.importorskip("statsmodels.stats.proportion")
    (a, m), (b, n) = ALONE[0]
    told = proportion.confint_proportions_2indep(a, m, b, n, method="score", correction=True)
    ours = OverlapCounts(0, 0, 0, 0, (a, m), (b, n)).interval()
    assert ours == pytest.approx(told, abs=0.01)
    assert ours != pytest.approx(told, abs=1e-5)


def test_statsmodels_sizes_are_near_where_the_normal_approximation_holds():
    proportion = pytest.importorskip("statsmodels.stats.proportion")
    plan = fixed_plan(Truth(0.8), paired=False)
    power = proportion.power_proportions_2indep(
        0.05, 0.8, plan.episodes, alpha=0.025, alternative="larger"
    ).power
    assert power == pytest.approx(plan.power, abs=0.03)


def test_robostats_agrees():
    intervals, compare = pytest.importorskip("robostats.intervals"), pytest.importorskip("robostats.compare")
    for (a, m), (b, n) in ALONE:
        assert intervals.wilson(a, m).lower == pytest.approx(wilson_interval(a, m)[0])
        counts = OverlapCounts(0, 0, 0, 0, (a, m), (b, n))
        told = compare.unpaired_difference(a, m, b, n)
        assert counts.interval() == pytest.approx((told.lower, told.upper), abs=1e-6)


def test_robostats_partly_paired_is_a_likelihood_ratio_and_near():
    compare = pytest.importorskip("robostats.compare")
    for cells, (ours, theirs) in itertools.product(CELLS, ALONE):
        told = compare.combined_difference(**dict(zip(NAMES, (*cells, *ours, *theirs), strict=True)))
        counts = OverlapCounts(*cells, ours, theirs)
        assert counts.difference == pytest.approx(told.point, abs=0.01)
        assert counts.interval() == pytest.approx((told.lower, told.upper), abs=0.03)
