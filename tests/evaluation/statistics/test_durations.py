"""Times to success: their ratio's interval covers, also where failures are rare, and agrees with its statistic."""

import numpy as np
import pytest
from scipy.stats import norm

from recipes.studies.simulate_stopping.simulation import Population
from tests.refusals import refused
from torchrl_sparse.evaluation.statistics.durations import (
    allowed_steps,
    correlation,
    restricted_times,
    success_within,
    time_ratio,
    time_verdict,
    time_z,
)

CAN, LIFT = Population(0.87, 0.0, 104), Population(0.9975, 0.0, 29)
POPULATIONS = {
    "equal": CAN,
    "slower": CAN.at_time_margin(),
    "failing more": Population(0.87, -0.1, 104),
    "rare failures": LIFT,
    "rare failures, slower": LIFT.failing_at_time_margin(),
}


@pytest.mark.parametrize("n", [100, 400])
@pytest.mark.parametrize("name", POPULATIONS)
def test_the_interval_covers_the_true_ratio(name, n):
    population, generator, trials = POPULATIONS[name], np.random.default_rng(n), 1000
    covered = 0
    for _ in range(trials):
        low, high = time_ratio(*population.draw(n, generator), population.horizon).ci95
        covered += low <= population.ratio <= high
    assert covered / trials > 0.95 - 3 * np.sqrt(0.05 * 0.95 / trials)


def test_pairs_that_share_their_difficulty_have_a_shorter_interval():
    generator = np.random.default_rng(0)
    dense = generator.gamma(12, 10, 300).round()
    near, far = dense + generator.integers(-3, 4, 300), generator.permutation(dense)
    widths = [np.diff(time_ratio(other, dense, 400).ci95)[0] for other in (near, far)]
    assert correlation(near, dense) > 0.9 > 0.2 > abs(correlation(far, dense))
    assert widths[0] < 0.8 * widths[1]


@pytest.mark.parametrize("confidence", [0.8, 0.95, 0.9999])
@pytest.mark.parametrize("seed", range(5))
def test_interval_and_statistic_agree(seed, confidence):
    ours, theirs = CAN.draw(60, np.random.default_rng(seed))
    z = norm.ppf((1 + confidence) / 2)
    low, high = time_ratio(ours, theirs, 400, confidence=confidence).ci95
    assert time_z(ours, theirs, 400, high) == pytest.approx(z, rel=1e-6)
    assert time_z(ours, theirs, 400, low) == pytest.approx(-z, rel=1e-6)


def test_what_cannot_be_told_is_not_claimed():
    same = time_ratio([30] * 20, [30] * 20, 400)
    assert same.ratio == 1
    assert same.verdict == "inconclusive"  # a failure in twenty would cost more than a tenth
    assert time_ratio([30], [400], 400).verdict == "inconclusive"
    assert time_ratio([400] * 50, [400] * 50, 400).verdict == "non-inferior"


def test_verdicts_lie_on_either_side_of_the_margin():
    assert time_verdict((0.9, 1.09)) == "non-inferior"
    assert time_verdict((1.11, 1.4)) == "inferior"
    assert time_verdict((1.05, 1.3), margin=0.5) == "non-inferior"
    with refused("margin"):
        time_verdict((1, 1), 0)


def test_an_unsolved_episode_counts_the_horizon():
    assert restricted_times([True, False, True], [400, 400, 12], 400).tolist() == [400, 400, 12]
    with refused("horizon"):
        restricted_times([True], [401], 400)
    with refused("horizon"):
        restricted_times([False], [399], 400)


def test_success_counts_what_was_solved_in_time():
    shares = success_within([True, True, False], [31, 400, 400], [31, 399, 400])
    assert [*shares.values()] == [1 / 3, 1 / 3, 2 / 3]
    steps = allowed_steps(400, 44)
    assert 44 in steps
    assert steps == sorted(set(steps))
    assert allowed_steps(16)[-1] == 16


def test_unequal_numbers_of_episodes_are_refused():
    with refused("pairs"):
        time_ratio([1, 2], [1], 400)
    with refused("pairs"):
        time_z([], [], 400, 1.1)
