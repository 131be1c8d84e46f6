"""Simulated benchmarks: how often a `Design` makes a false claim, and how many episodes it saves."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchrl_sparse.evaluation.statistics.durations import DEFAULT_TIME_MARGIN, time_z
from torchrl_sparse.evaluation.statistics.intervals import (
    DEFAULT_MARGIN,
    discordant_pairs,
    tango_interval,
    tango_z,
)
from torchrl_sparse.evaluation.statistics.sequential import Design

__all__ = ["Population", "Savings", "claim_rates", "pair_errors", "savings"]

_SHAPE = 12.0  # of the gamma distribution of the steps to success: a spread of 29 %, dense's own on Can
_Analysis = tuple[
    int, tuple[float, float]
]  # episodes; standard errors above the margins of success and of time


@dataclass(frozen=True)
class Population:
    """Episodes of dense and of a method, drawn independently seed by seed, like those of two samplers of different steps.

    Attributes:
        success: dense's success rate.
        difference: the method's success rate minus that.
        steps: mean steps of dense's solved episodes.
        slower: the method's over that.
        horizon: steps of an episode that is not solved.
    """

    success: float
    difference: float
    steps: float
    slower: float = 1.0
    horizon: int = 400

    @property
    def ratio(self) -> float:
        """Restricted mean time of the method divided by dense's."""
        return self._mean(self.success + self.difference, self.slower) / self._mean(self.success, 1.0)

    def _mean(self, success: float, slower: float) -> float:
        return success * self.steps * slower + (1 - success) * self.horizon

    def at_time_margin(self, margin: float = DEFAULT_TIME_MARGIN) -> Population:
        """Return the population whose method is slower by exactly the margin, in its solved episodes alone."""
        wanted = (1 + margin) * self._mean(self.success, 1.0) - (1 - self.success) * self.horizon
        return Population(self.success, 0.0, self.steps, wanted / self.success / self.steps, self.horizon)

    def failing_at_time_margin(self, margin: float = DEFAULT_TIME_MARGIN) -> Population:
        """Return the population whose method is slower by exactly the margin, because it fails more often."""
        lost = margin * self._mean(self.success, 1.0) / (self.horizon - self.steps)
        return Population(self.success, -lost, self.steps, 1.0, self.horizon)

    def draw(self, n: int, generator: np.random.Generator) -> tuple[NDArray, NDArray]:
        """Return restricted times of the method and of dense, [n] each; a time at the horizon means failure."""
        pairs = []
        for success, slower in ((self.success + self.difference, self.slower), (self.success, 1.0)):
            steps = generator.gamma(_SHAPE, self.steps * slower / _SHAPE, n)
            solved = generator.random(n) < success
            pairs.append(np.where(solved, np.minimum(steps, self.horizon - 1), self.horizon))
        return pairs[0], pairs[1]


@dataclass(frozen=True)
class Savings:
    """Averages over trials with early stopping.

    Attributes:
        saved: share of the cap's episodes that need not run.
        non_inferior: share of trials that end non-inferior in success and in time.
        inferior: share that end inferior in one.
        fixed_non_inferior: share that a fixed number of episodes, the cap's, calls non-inferior.
    """

    saved: float
    non_inferior: float
    inferior: float
    fixed_non_inferior: float


def claim_rates(population: Population, design: Design, trials: int, seed: int = 0) -> tuple[float, float]:
    """Return how often non-inferiority is claimed at any interim analysis: in success, and in time.

    At a margin these are type-I errors.

    Args:
        population: of the episodes.
        design: when to analyse.
        trials: simulated benchmarks.
        seed: of their episodes.
    """
    claims = np.zeros(2)
    for analyses in _trials(population, design, trials, seed):
        beyond = [[z > design.critical(n) for z in statistics] for n, statistics in analyses]
        claims += np.any(beyond, axis=0)
    return float(claims[0]) / trials, float(claims[1]) / trials


def savings(population: Population, design: Design, trials: int, seed: int = 0) -> Savings:
    """Simulate benchmarks that stop as soon as `Design.decides` says so.

    Args:
        population, design, trials, seed: see `claim_rates`.
    """
    fixed, totals = Design(design.max_episodes), np.zeros(4)
    for analyses in _trials(population, design, trials, seed):
        analyses = list(analyses)
        n, worst = _stop(analyses, design)
        at_cap = min(analyses[-1][1]) > fixed.critical(design.max_episodes)
        totals += 1 - n / design.max_episodes, worst > 0, worst < 0, at_cap
    return Savings(*(float(total) / trials for total in totals))


def pair_errors(population: Population, design: Design, trials: int, seed: int = 0) -> tuple[float, float]:
    """Return how often two equal methods, each stopped by its own comparison with dense, seem to differ: in success, in time.

    Their ordinary 95 % intervals, of the episodes that both played, know nothing of what stopped either.

    Args:
        population: of the episodes of both.
        design, trials, seed: see `claim_rates`.
    """
    generator, errors = np.random.default_rng(seed), np.zeros(2)
    for _ in range(trials):
        first, dense = population.draw(design.max_episodes, generator)
        second, _ = population.draw(design.max_episodes, generator)
        n = min(_stop(_looks(method, dense, design, population), design)[0] for method in (first, second))
        first, second, horizon = first[:n], second[:n], population.horizon
        low, high = tango_interval(*discordant_pairs(first < horizon, second < horizon))
        errors += not low <= 0 <= high, Design(n).decides(n, time_z(first, second, horizon, 1.0))
    return float(errors[0]) / trials, float(errors[1]) / trials


def _stop(analyses: Iterable[_Analysis], design: Design) -> tuple[int, float]:
    """Return the episodes after which a verdict is reached and the lesser of the statistics that reach it, 0 at an open end."""
    return next(((n, min(z)) for n, z in analyses if design.decides(n, *z)), (design.max_episodes, 0.0))


def _trials(population: Population, design: Design, trials: int, seed: int) -> Iterator[Iterator[_Analysis]]:
    """Yield the analyses of each benchmark."""
    generator = np.random.default_rng(seed)
    for _ in range(trials):
        yield _looks(*population.draw(design.max_episodes, generator), design, population)


def _looks(method: NDArray, dense: NDArray, design: Design, population: Population) -> Iterator[_Analysis]:
    """Yield the number of episodes and both statistics at each analysis."""
    return ((n, _statistics(method[:n], dense[:n], population.horizon)) for n in design.ends)


def _statistics(method: NDArray, dense: NDArray, horizon: int) -> tuple[float, float]:
    return (
        tango_z(*discordant_pairs(method < horizon, dense < horizon), -DEFAULT_MARGIN),
        time_z(method, dense, horizon, 1 + DEFAULT_TIME_MARGIN),
    )
