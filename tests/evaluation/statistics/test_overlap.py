"""Further episodes of dense: the estimate, its variance and coverage by simulation; without them, the pairs alone."""

import numpy as np
import pytest
from scipy.stats import norm

from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult
from torchrl_sparse.evaluation.rollouts.pairs import pair_by_design, pair_episodes
from torchrl_sparse.evaluation.statistics.durations import time_ratio, time_z
from torchrl_sparse.evaluation.statistics.intervals import (
    discordant_pairs,
    paired_difference,
    tango_interval,
    tango_z,
)
from torchrl_sparse.evaluation.statistics.overlap import Further, Means
from torchrl_sparse.evaluation.statistics.sequential import Design

HORIZON, STEPS = 400, 150


def draw(generator, n, total, rate, difference, shared):
    """Times of a method [n] and of dense [total], whose successes share as much luck as `shared` says."""
    luck = generator.normal(size=total)
    own = shared * luck[:n] + (1 - shared**2) ** 0.5 * generator.normal(size=n)
    return tuple(
        np.where(lucky < norm.ppf(p), np.minimum(generator.gamma(12, STEPS / 12, len(lucky)), HORIZON - 1), HORIZON)
        for lucky, p in ((own, rate + difference), (luck, rate))
    )  # fmt: skip


def true_ratio(rate, difference):
    return np.divide(*(p * STEPS + (1 - p) * HORIZON for p in (rate + difference, rate)))


@pytest.mark.parametrize("n", [43, 150])
@pytest.mark.parametrize("shared", [0.0, 0.7])
@pytest.mark.parametrize(("rate", "difference"), [(0.7, 0.0), (0.87, -0.05), (0.9975, -0.05)])
def test_intervals_cover_what_is_true_and_are_shorter(rate, difference, shared, n):
    generator, trials = np.random.default_rng(n), 600
    covered, widths = np.zeros(2), np.zeros((2, 2))
    truth = np.array([difference, true_ratio(rate, difference)])
    for _ in range(trials):
        ours, dense = draw(generator, n, 1300, rate, difference, shared)
        for column, more in enumerate((dense[n:], dense[:0])):
            solved = (times < HORIZON for times in (ours, dense[:n]))
            cis = (
                paired_difference(*solved, more=more < HORIZON).ci,
                time_ratio(ours, dense[:n], HORIZON, more=more).ci,
            )
            widths[column] += [high - low for low, high in cis]
            if column == 0:
                covered += [low <= value <= high for value, (low, high) in zip(truth, cis, strict=True)]
    assert (covered / trials > 0.95 - 3 * (0.05 * 0.95 / trials) ** 0.5).all()
    gained = widths[0] / widths[1]
    assert (gained < 1).all()
    if shared == 0 and rate < 0.9:
        assert (gained < 0.8).all()


@pytest.mark.parametrize("slope", [0.0, 0.5, 1.0])
def test_the_variance_is_that_of_the_estimate(slope):
    generator, n, total, trials = np.random.default_rng(0), 60, 600, 4000
    dense = generator.normal(3, 2, (trials, total))
    method = slope * dense[:, :n] + generator.normal(1, 1, (trials, n))
    found = [Means.of(ours, theirs[:n], theirs[n:]) for ours, theirs in zip(method, dense, strict=True)]
    for ratio in (1.0, 1.1):
        gains = [means.method - ratio * means.other for means in found]
        assert np.mean(gains) == pytest.approx(1 + 3 * slope - 3 * ratio, abs=0.02)
        assert np.mean([means.variance(ratio) for means in found]) == pytest.approx(np.var(gains), rel=0.08)


def test_without_further_episodes_it_is_the_pairs():
    generator = np.random.default_rng(0)
    ours, dense = draw(generator, 80, 80, 0.8, -0.1, 0.5)
    means = Means.of(ours, dense)
    assert (means.method, means.other) == (pytest.approx(ours.mean()), pytest.approx(dense.mean()))
    for ratio in (0.5, 1.0, 1.1):
        assert means.variance(ratio) == pytest.approx((ours - ratio * dense).var(ddof=1) / 80)
        assert means.known(ratio) == pytest.approx(0.0, abs=1e-9)
    assert Further.of(ours < HORIZON, dense < HORIZON) == Further()


def test_pairs_in_which_dense_never_differs_tell_no_slope():
    ours = np.random.default_rng(0).random(7)
    means = Means.of(ours, np.full(7, 0.1), np.linspace(0, 1, 50))
    assert (means.slope, means.method) == (0.0, pytest.approx(ours.mean()))
    assert means.variance(1) < ours.var(ddof=1) / 7 * 1.3 + 0.1 / 57


def test_a_method_that_follows_dense_gains_nothing():
    dense = np.random.default_rng(0).normal(3, 1, 500)
    means = Means.of(dense[:50] - 0.2, dense[:50], dense[50:])
    assert means.method - means.other == pytest.approx(-0.2)
    assert means.variance(1) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("seed", range(40))
def test_intervals_and_statistics_agree(seed):
    generator = np.random.default_rng(seed)
    n, rate = int(generator.integers(10, 120)), generator.uniform(0.5, 0.999)
    ours, dense = draw(
        generator, n, 400, rate, -generator.uniform(0, 0.3) * rate, generator.choice([0.0, 0.5, 0.95])
    )
    solved, further = (ours < HORIZON, dense[:n] < HORIZON), dense[n:] < HORIZON
    help, counts = Further.of(*solved, further), discordant_pairs(*solved)
    for confidence in (0.9, 0.95, 0.9999):
        z = norm.ppf((1 + confidence) / 2)
        low, high = tango_interval(*counts, confidence, help)
        for margin in (-0.3, -0.1, -0.05, 0.05):
            beyond = tango_z(*counts, margin, help)
            assert (beyond > z) == (low > margin)
            assert (beyond < -z) == (high < margin)
        low, high = time_ratio(ours, dense[:n], HORIZON, confidence=confidence, more=dense[n:]).ci
        if low > 1 / HORIZON and high < HORIZON:
            assert time_z(ours, dense[:n], HORIZON, low, dense[n:]) == pytest.approx(-z, rel=1e-5)
            assert time_z(ours, dense[:n], HORIZON, high, dense[n:]) == pytest.approx(z, rel=1e-5)


def test_a_method_without_a_failure_so_far_is_not_surer_than_the_margin_allows():
    """Its own variance looks like none, so that all of a pair's would be dense's; at most half of it counts as known."""
    further = Further.of([True] * 20, [True] * 14 + [False] * 6, [True, True, False] * 400)
    assert further.known > 0.9 * 0.21
    assert further.left(0.22) == pytest.approx(0.22 * (1 - further.share))
    assert further.share < 0.5


def episode(seed, length):
    return EpisodeResult(seed, length < HORIZON, length, 4, 1e9, 0.0)


def test_the_design_says_which_episodes_count():
    dense = [episode(seed, 100 + seed) for seed in range(50)]
    ours = [episode(seed, 100) for seed in range(20)]
    for known, more in ((None, 0), (10, 0), (20, 0), (30, 10), (50, 30)):
        pairs = pair_by_design("fast", ours, "dense", dense, Design(50, 5, known))
        assert [e.seed for e in pairs.other] == list(range(20))
        assert [e.seed for e in pairs.more] == list(range(20, 20 + more))
    with pytest.raises(ValueError, match="fast: expected the seeds of 'dense'"):
        pair_by_design("fast", ours, "dense", dense, Design(50))
    with pytest.raises(
        ValueError, match=r"fast: expected further episodes of 'dense' on other seeds, got \[3\]"
    ):
        pair_episodes("fast", ours, "dense", dense[:20], dense[3:4])
    with pytest.raises(ValueError, match="dense_episodes: expected at least 1 or None, got 0"):
        Design(50, 5, 0)
