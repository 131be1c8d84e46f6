import math

import pytest
from scipy.stats import binomtest

from tests.refusals import refused
from torchrl_sparse.evaluation.statistics.intervals import (
    episodes_needed,
    mcnemar_p,
    paired_difference,
    tango_interval,
    verdict,
    wilson_interval,
)


# Newcombe, Statistics in Medicine 17 (1998) 857-872, table I: Wilson's score method without continuity
# correction.
@pytest.mark.parametrize(
    ("k", "n", "low", "high"),
    [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611), (1, 29, 0.0061, 0.1718)],
)
def test_wilson_published_examples(k, n, low, high):
    assert wilson_interval(k, n) == pytest.approx((low, high), abs=6e-5)


@pytest.mark.parametrize("n", [1, 7, 1300])
def test_wilson_is_that_of_scipy(n):
    for k in {0, 1, n // 3, n}:
        expected = binomtest(k, n).proportion_ci(confidence_level=0.9, method="wilson")
        assert wilson_interval(k, n, 0.9) == pytest.approx((expected.low, expected.high), abs=1e-12)


def test_wilson_is_never_empty_and_mirrors():
    assert wilson_interval(100, 100)[0] < 0.97
    low, high = wilson_interval(98, 100)
    assert wilson_interval(2, 100) == pytest.approx((1 - high, 1 - low))


# Tango, Statistics in Medicine 17 (1998) 891-908, §6.1 (90 %) and §6.2; Fagerland, Lydersen and Laake,
# Statistics in Medicine 33 (2014) 2850-2875, the airway hyper-responsiveness example.
@pytest.mark.parametrize(
    ("won", "lost", "n", "confidence", "low", "high"),
    [(0, 1, 44, 0.90, -0.096, None), (9, 3, 32, 0.95, -0.027, 0.390), (1, 7, 21, 0.95, -0.517, -0.026)],
)
def test_tango_published_examples(won, lost, n, confidence, low, high):
    interval = tango_interval(won, lost, n, confidence)
    assert interval[0] == pytest.approx(low, abs=6e-4)
    if high is not None:
        assert interval[1] == pytest.approx(high, abs=6e-4)


def test_tango_limits_solve_the_score_equation():
    won, lost, n, z = 3, 11, 60, 1.959963984540054
    for limit, sign in zip(tango_interval(won, lost, n), (1, -1), strict=True):
        # The constrained maximum of the likelihood, by brute force instead of the closed form.
        grid = [i / 200000 for i in range(1, 200000)]
        feasible = [q for q in grid if q + limit > 0 and 2 * q + limit < 1]
        q = max(
            feasible,
            key=lambda q: (
                won * math.log(q + limit)
                + lost * math.log(q)
                + (n - won - lost) * math.log(1 - 2 * q - limit)
            ),
        )
        score = (won - lost - n * limit) / math.sqrt(n * (2 * q + limit * (1 - limit)))
        assert score == pytest.approx(sign * z, abs=2e-3)


@pytest.mark.parametrize("n", [1, 5, 50, 1000])
def test_tango_without_discordant_pairs_has_width(n):
    low, high = tango_interval(0, 0, n)
    assert low == -high
    assert low == pytest.approx(-3.8414588 / (n + 3.8414588))


def test_tango_degenerate_ends_stay_in_range():
    assert tango_interval(10, 0, 10)[1] == 1.0
    assert tango_interval(0, 10, 10)[0] == -1.0
    assert -1 < tango_interval(10, 0, 10)[0] < 1


def test_tango_mirrors_and_contains_the_estimate():
    for n in (7, 30):
        for won in range(n + 1):
            for lost in range(n + 1 - won):
                low, high = tango_interval(won, lost, n)
                assert -1 <= low < high <= 1
                assert low - 1e-9 <= (won - lost) / n <= high + 1e-9
                assert tango_interval(lost, won, n) == pytest.approx((-high, -low), abs=1e-9)


@pytest.mark.parametrize("n", [10, 25])
def test_tango_coverage_by_enumeration(n):
    """Exact coverage: near 95 % on average, and nowhere far below it."""
    intervals = {(b, c): tango_interval(b, c, n) for b in range(n + 1) for c in range(n + 1 - b)}
    levels = [0.01, 0.03, 0.06, 0.1, 0.2, 0.3, 0.45]
    coverages = [_coverage(intervals, n, p, q) for p in levels for q in levels]
    assert min(coverages) > 0.93
    assert 0.94 < sum(coverages) / len(coverages) < 0.985


def _coverage(intervals, n, p_won, p_lost):
    total = 0.0
    for (won, lost), (low, high) in intervals.items():
        if low <= p_won - p_lost <= high:
            ways = math.comb(n, won) * math.comb(n - won, lost)
            total += ways * p_won**won * p_lost**lost * (1 - p_won - p_lost) ** (n - won - lost)
    return total


def test_verdicts():
    assert verdict((-0.049, 0.2)) == "non-inferior"
    assert verdict((-0.3, -0.051)) == "inferior"
    assert verdict((-0.051, 0.2)) == "inconclusive"
    assert verdict((-0.08, 0.0), margin=0.1) == "non-inferior"


def test_identical_outcomes_need_enough_episodes():
    needed = episodes_needed(0.05)
    for n, expected in ((needed - 1, "inconclusive"), (needed, "non-inferior")):
        assert paired_difference([True] * n, [True] * n).verdict == expected


def test_paired_difference_counts_pairs_not_rates():
    # Equal rates, but every pair differs: nothing is known, and the interval says so.
    method, reference = [True, False] * 20, [False, True] * 20
    apart = paired_difference(method, reference)
    assert (apart.diff, apart.mcnemar_p) == (0.0, 1.0)
    together = paired_difference(reference, reference)
    assert apart.ci95[1] - apart.ci95[0] > 2 * (together.ci95[1] - together.ci95[0])


def test_far_worse_is_inferior():
    result = paired_difference([False] * 40 + [True] * 60, [True] * 100)
    assert result.verdict == "inferior"
    assert result.diff == pytest.approx(-0.4)


@pytest.mark.parametrize(
    ("call", "entry"),
    [
        (lambda: wilson_interval(5, 4), "k"),
        (lambda: wilson_interval(0, 0), "k"),
        (lambda: tango_interval(3, 3, 5), "pairs"),
        (lambda: tango_interval(1, 1, 5, confidence=95), "confidence"),
        (lambda: paired_difference([True], [True, False]), "pairs"),
        (lambda: paired_difference([], []), "pairs"),
        (lambda: verdict((0, 1), margin=0), "margin"),
        (lambda: episodes_needed(5), "margin"),
    ],
)
def test_faults_name_what_came(call, entry):
    with refused(entry):
        call()


@pytest.mark.parametrize(("won", "lost"), [(8, 1), (4, 0), (3, 3), (0, 0), (40, 21)])
def test_the_p_of_few_differences_is_exact(won, lost):
    """SciPy's signed-rank test halves it, or has none (findings/scipy_signed_rank_of_successes.sh)."""
    expected = binomtest(won, won + lost).pvalue if won + lost else 1.0
    assert mcnemar_p(won, lost) == mcnemar_p(lost, won) == pytest.approx(expected, rel=1e-12)
