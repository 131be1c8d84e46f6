"""Partly paired success rates: each part agrees with its own test, and the whole keeps its level."""

import numpy as np
import pytest

from tests.refusals import refused
from torchrl_sparse.evaluation.statistics.intervals import mcnemar_p, tango_interval, tango_z
from torchrl_sparse.evaluation.statistics.overlap import OverlapCounts, miettinen_nurminen_z

DELTAS = (-0.3, -0.05, 0.07, 0.4)


def likelihood(k, n, rate):
    return sum(count * np.log(share) for count, share in ((k, rate), (n - k, 1 - rate)) if count)


@pytest.mark.parametrize("ours", [(56, 70), (0, 20), (9, 9), (1, 40)])
@pytest.mark.parametrize("theirs", [(48, 80), (30, 30), (0, 7)])
def test_unpaired_is_the_score_at_the_likeliest_rates(ours, theirs):
    (a, m), (b, n) = ours, theirs
    for delta in (*DELTAS, 0.0):
        rates = np.linspace(max(0, -delta), min(1, 1 - delta), 20003)[1:-1]
        rate = rates[np.argmax(likelihood(a, m, rates + delta) + likelihood(b, n, rates))]
        first = rate + delta
        variance = (first * (1 - first) / m + rate * (1 - rate) / n) * (m + n) / (m + n - 1)
        expected = (a / m - b / n - delta) / np.sqrt(variance)
        if abs(expected) < 30:  # where the likeliest rate is a limit the grid does not reach it
            assert miettinen_nurminen_z(a, m, b, n, delta) == pytest.approx(expected, rel=5e-3, abs=5e-3)


def test_arrays_are_judged_as_one_by_one():
    first, second = np.arange(6)[:, None], np.arange(9)
    z = miettinen_nurminen_z(first, 5, second, 8, -0.1)
    assert z[3, 4] == miettinen_nurminen_z(3, 5, 4, 8, -0.1)
    assert np.isfinite(z).all()
    assert (np.diff(z, axis=0) > 0).all()


@pytest.mark.parametrize("cells", [(30, 2, 7, 4), (0, 5, 2, 9), (12, 0, 3, 0), (7, 0, 0, 1), (3, 4, 0, 0)])
def test_the_score_of_pairs_alone_is_tangos(cells):
    counts = OverlapCounts(*cells)
    for delta in DELTAS:
        assert counts._score(delta) == pytest.approx(tango_z(cells[1], cells[2], sum(cells), delta), rel=1e-6)
    assert counts.interval() == tango_interval(cells[1], cells[2], sum(cells))
    assert counts.p_equal() == mcnemar_p(cells[1], cells[2])


def test_a_pair_beside_many_single_episodes_hardly_counts():
    alone = OverlapCounts(0, 0, 0, 0, ours=(560, 700), theirs=(480, 800))
    nearly = OverlapCounts(1, 0, 0, 0, ours=(559, 699), theirs=(479, 799))
    assert nearly.difference == pytest.approx(alone.difference, abs=2e-3)
    assert nearly.interval() == pytest.approx(alone.interval(), abs=2e-3)


def test_both_parts_make_the_interval_closer_than_either():
    pairs, whole = OverlapCounts(30, 4, 7, 9), OverlapCounts(30, 4, 7, 9, ours=(34, 50), theirs=(37, 50))
    alone = OverlapCounts(0, 0, 0, 0, ours=(34, 50), theirs=(37, 50))
    width = [high - low for low, high in (pairs.interval(), whole.interval(), alone.interval())]
    assert width[1] < min(width[0], width[2])
    low, high = whole.interval()
    assert whole.z(low) == pytest.approx(1.96, abs=1e-3)
    assert whole.z(high) == pytest.approx(-1.96, abs=1e-3)


def test_episodes_of_one_method_alone_tell_of_its_rate():
    pairs = OverlapCounts(60, 5, 8, 27)
    more = OverlapCounts(60, 5, 8, 27, theirs=(140, 200))
    assert more.interval()[1] - more.interval()[0] < pairs.interval()[1] - pairs.interval()[0]
    assert more.difference < pairs.difference  # the other is better than the pairs showed


def test_methods_that_solve_everything_are_not_told_apart():
    counts = OverlapCounts(20, 0, 0, 0, ours=(30, 30), theirs=(10, 10))
    low, high = counts.interval()
    assert counts.difference == pytest.approx(0, abs=1e-6)
    assert low < 0 < high
    assert counts.p_equal() == 1


def test_impossible_counts_are_refused():
    with refused("counts"):
        OverlapCounts(0, 0, 0, 0, ours=(3, 4))
    with refused("counts"):
        OverlapCounts(1, 0, -1, 0)
    with refused("counts"):
        OverlapCounts(1, 0, 0, 0, ours=(5, 4))


def covered(cells, counts, delta, trials, seed=0):
    """How often the score test keeps the truth at 95 %."""
    generator, kept = np.random.default_rng(seed), 0
    rates = cells[0] + cells[1], cells[0] + cells[2]
    for _ in range(trials):
        drawn = generator.multinomial(counts[0], cells)
        alone = [(int(generator.binomial(n, rate)), n) for n, rate in zip(counts[1:], rates, strict=True)]
        kept += abs(OverlapCounts(*map(int, drawn), *alone).z(delta)) <= 1.96
    return kept / trials


def test_coverage_partly_paired():
    assert covered((0.6, 0.1, 0.15, 0.15), (40, 40, 20), -0.05, 150) >= 0.9


@pytest.mark.full
@pytest.mark.parametrize("counts", [(40, 40, 20), (60, 0, 60), (15, 80, 80), (100, 10, 0)])
@pytest.mark.parametrize("cells", [(0.6, 0.1, 0.15, 0.15), (0.9, 0.02, 0.05, 0.03)])
def test_coverage_of_many_designs(counts, cells):
    assert 0.93 <= covered(cells, counts, cells[1] - cells[2], 1000) <= 0.985
