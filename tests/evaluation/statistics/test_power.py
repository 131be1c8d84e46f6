"""Plans hold in simulation, with the tests and the designs that will judge."""

import numpy as np
import pytest

from tests.refusals import refused
from torchrl_sparse.evaluation.statistics.intervals import episodes_needed, paired_difference, tango_z
from torchrl_sparse.evaluation.statistics.overlap import OverlapCounts
from torchrl_sparse.evaluation.statistics.power import Truth, fixed_plan, fixed_power, sequential_plan
from torchrl_sparse.evaluation.statistics.sequential import Design


def shown_pairs(truth, n, margin, trials, seed):
    """Share of simulated pairs of episodes whose verdict is non-inferior."""
    generator, shown = np.random.default_rng(seed), 0
    outcomes = np.array([(1, 1), (1, 0), (0, 1), (0, 0)])
    for _ in range(trials):
        ours, theirs = outcomes[generator.choice(4, size=n, p=truth.cells)].T
        shown += paired_difference(ours, theirs, margin).verdict == "non-inferior"
    return shown / trials


def shown_alone(truth, n, margin, trials, seed):
    generator, shown = np.random.default_rng(seed), 0
    for _ in range(trials):
        ours, theirs = (int(generator.binomial(n, rate)) for rate in (truth.rate, truth.success))
        shown += OverlapCounts(0, 0, 0, 0, (ours, n), (theirs, n)).interval()[0] > -margin
    return shown / trials


def stopped(truth, plan, analyses, margin, trials, seed):
    """Mean number of episodes until a design decides, and how often it shows non-inferiority, episode by episode."""
    generator, design, ends, shown = np.random.default_rng(seed), Design(plan.episodes, analyses), [], 0
    for _ in range(trials):
        drawn = generator.choice(4, size=plan.episodes, p=truth.cells)
        for end in design.ends:
            won, lost = (drawn[:end] == 1).sum(), (drawn[:end] == 2).sum()
            z = float(tango_z(won, lost, end, -margin))
            if design.decides(end, z):
                shown += z > 0
                break
        ends.append(end)
    return np.mean(ends), shown / trials


TRUTHS = (Truth(0.8, 0.5), Truth(0.95, 0.2, -0.01), Truth(0.98))


@pytest.mark.parametrize("truth", TRUTHS)
def test_fixed_power_is_that_of_simulated_verdicts(truth):
    for paired, simulate in ((True, shown_pairs), (False, shown_alone)):
        expected = fixed_power(truth, 150, 0.08, paired=paired)
        assert simulate(truth, 150, 0.08, 200, 1) == pytest.approx(expected, abs=0.1)


def test_the_plan_is_the_fewest():
    for paired in (True, False):
        plan = fixed_plan(Truth(0.9, 0.5), 0.1, 0.8, paired=paired)
        assert plan.power >= 0.8 > fixed_power(Truth(0.9, 0.5), plan.episodes - 1, 0.1, paired=paired)


def test_methods_that_always_agree_need_the_fewest_pairs_that_can_show_it():
    assert fixed_plan(Truth(0.8, 1.0)).episodes == episodes_needed(0.05)


def test_correlation_saves_pairs_and_nothing_else():
    loose, close = (fixed_plan(Truth(0.8, rho)).episodes for rho in (0.0, 0.6))
    assert close < loose / 2
    assert fixed_plan(Truth(0.8, 0.6), paired=False) == fixed_plan(Truth(0.8), paired=False)


def test_a_sequential_plan_holds_in_simulation():
    truth = Truth(0.9, 0.4)
    plan = sequential_plan(truth, 0.1, analyses=10)
    expected, power = stopped(truth, plan, 10, 0.1, 300, 2)
    assert plan.episodes % 10 == 0
    assert plan.expected == pytest.approx(expected, rel=0.1)
    assert plan.power == pytest.approx(power, abs=0.06)
    assert plan.expected < fixed_plan(truth, 0.1).episodes < plan.episodes


@pytest.mark.full
@pytest.mark.parametrize("truth", TRUTHS)
def test_plans_hold_in_long_simulations(truth):
    for paired, simulate in ((True, shown_pairs), (False, shown_alone)):
        plan = fixed_plan(truth, 0.08, paired=paired)
        assert simulate(truth, plan.episodes, 0.08, 1500, 3) == pytest.approx(plan.power, abs=0.03)
    plan = sequential_plan(truth, 0.08)
    expected, power = stopped(truth, plan, 30, 0.08, 1000, 4)
    assert plan.expected == pytest.approx(expected, rel=0.05)
    assert plan.power == pytest.approx(power, abs=0.04)


def test_what_cannot_be_is_refused():
    with refused("success"):
        Truth(1.0)
    with refused("difference"):
        Truth(0.9, difference=0.2)
    with refused("correlation"):
        Truth(0.9, 0.95, difference=-0.2)
    with refused("difference"):
        fixed_plan(Truth(0.9, difference=-0.05), 0.05)
    with refused("margin"):
        fixed_plan(Truth(0.5), 0.0001)
    with refused("power"):
        fixed_plan(Truth(0.5), power=1.0)
