"""Largest verdict errors and least coverage over several tasks, on a grid: parts of a ``stopping.json``."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recipes.studies.simulate_stopping.coverage import (
    CORRELATIONS,
    RATES,
    aggregate_coverage,
    pair_rates,
    verdict_errors,
)
from torchrl_sparse.evaluation.statistics.intervals import DEFAULT_MARGIN
from torchrl_sparse.evaluation.statistics.sequential import Design

__all__ = ["Covered", "VerdictErrors", "simulate_aggregates", "simulate_errors"]

_DESIGNS = (
    (50, 1),
    (150, 1),
    (300, 1),
    (60, 6),
    (100, 10),
    (300, 30),
    (600, 30),
    (1300, 30),
)  # caps and analyses
_ERROR_TRIALS = 10  # times as many of verdicts: they are cheap
_AGGREGATES = {
    "2 of 5": [(5, 1)] * 2,
    "5 of 5": [(5, 1)] * 5,
    "10 of 20": [(20, 1)] * 10,
    "3 of 30": [(30, 1)] * 3,
    "5 and 300": [(5, 1), (300, 1)],
    "3 of 1300": [(1300, 1)] * 3,
    "3 until conclusive or 300": [(300, 30)] * 3,
}
_AGGREGATED = ((0.5, 0.5), (0.95, 0.9), (0.99, 0.94), (0.8, 0.5))  # rates of dense and of the method
_AGGREGATE_CORRELATIONS = (0.0, 0.6)
_SLOWER = (1.0, 1.5)
_FEWER_TRIALS = 5  # times fewer of these, which are dear


@dataclass(frozen=True)
class VerdictErrors:
    """Largest errors over `RATES` and `CORRELATIONS` for a method that is worse by exactly the margin of success.

    Attributes:
        max_episodes, analyses: of the design.
        non_inferior, inferior: how often this is claimed at some analysis.
        rate, correlation: of dense, where ``non_inferior`` is largest.
    """

    max_episodes: int
    analyses: int
    non_inferior: float
    inferior: float
    rate: float
    correlation: float


@dataclass(frozen=True)
class Covered:
    """Least coverage of intervals over several tasks, over rates, correlations and times.

    Attributes:
        tasks: how many, and of how many pairs.
        success, time: of the difference in success, and of the ratio of times.
    """

    tasks: str
    success: float
    time: float


def simulate_errors(trials: int, seed: int = 0) -> tuple[VerdictErrors, ...]:
    """Return the largest verdict errors on success, with a fixed number of episodes and with interim analyses.

    Args:
        trials: a tenth of the benchmarks of each rate, correlation and design.
        seed: of all.
    """
    return tuple(_errors(Design(*design), _ERROR_TRIALS * trials, seed) for design in _DESIGNS)


def _errors(design: Design, trials: int, seed: int) -> VerdictErrors:
    generator, found = np.random.default_rng(seed), []
    for rate in RATES:
        for correlation in CORRELATIONS:
            if pairs := pair_rates(rate - DEFAULT_MARGIN, rate, correlation):
                found.append((*verdict_errors(pairs, design, trials, generator), rate, correlation))
    most = max(found)
    return VerdictErrors(
        design.max_episodes, design.analyses, most[0], max(one[1] for one in found), *most[2:]
    )


def simulate_aggregates(trials: int, seed: int = 0) -> tuple[Covered, ...]:
    """Return the least coverage of intervals over several tasks.

    Args:
        trials: five times the aggregates of each case.
        seed: of all.
    """
    return tuple(
        _covered(name, [Design(*of_task) for of_task in designs], max(trials // _FEWER_TRIALS, 1), seed)
        for name, designs in _AGGREGATES.items()
    )


def _covered(name: str, designs: list[Design], trials: int, seed: int) -> Covered:
    generator, found = np.random.default_rng(seed), []
    for dense, method in _AGGREGATED:
        for correlation in _AGGREGATE_CORRELATIONS:
            pairs = pair_rates(method, dense, correlation)
            for slower in _SLOWER if pairs else ():
                found.append(aggregate_coverage([pairs] * len(designs), slower, designs, trials, generator))
    return Covered(name, *map(min, zip(*found, strict=True)))
