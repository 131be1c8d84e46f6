"""Simulated error rates of verdicts and coverage of intervals, on a grid of success rates and correlations with dense."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchrl_sparse.evaluation.statistics.aggregate import TaskPairs, aggregate_tasks
from torchrl_sparse.evaluation.statistics.intervals import DEFAULT_MARGIN, tango_z
from torchrl_sparse.evaluation.statistics.sequential import Design

__all__ = ["CORRELATIONS", "RATES", "PairRates", "aggregate_coverage", "pair_rates", "verdict_errors"]

RATES = (0.5, 0.6, 0.7, 0.8, 0.87, 0.9, 0.95, 0.98, 0.99, 1.0)
"""Of dense."""
CORRELATIONS = (-0.05, 0.0, 0.3, 0.6, 0.9)
"""Of successes, pair by pair."""

_STEPS, _SHAPE, _HORIZON = 100, 12.0, 400  # of solved episodes: mean and gamma shape; of those that are not


@dataclass(frozen=True)
class PairRates:
    """Probabilities of each outcome of a pair: solved by the method alone, by dense alone, or by both."""

    won: float
    lost: float
    both: float

    @property
    def shares(self) -> tuple[float, float, float, float]:
        """Probabilities that a pair is won, lost, solved by both, and solved by neither."""
        return self.won, self.lost, self.both, max(1 - self.won - self.lost - self.both, 0.0)

    def draw(self, n: int, generator: np.random.Generator) -> tuple[NDArray, NDArray]:
        """Return the successes of the method and of dense, bool [n] each."""
        kind = generator.choice(4, size=n, p=self.shares)
        return (kind == 0) | (kind == 2), (kind == 1) | (kind == 2)


def pair_rates(method: float, dense: float, correlation: float) -> PairRates | None:
    """Return the pair probabilities for two success rates and a correlation; None if no pairs have that correlation.

    >>> pair_rates(0.5, 0.5, 0.0)
    PairRates(won=0.25, lost=0.25, both=0.25)
    """
    both = method * dense + correlation * math.sqrt(method * (1 - method) * dense * (1 - dense))
    shares = method - both, dense - both, both, 1 - method - dense + both
    return None if min(shares) < -1e-12 else PairRates(*(max(share, 0.0) for share in shares[:3]))


def verdict_errors(
    pairs: PairRates, design: Design, trials: int, generator: np.random.Generator
) -> tuple[float, float]:
    """Return how often a method worse by exactly the margin is called non-inferior at some analysis, and how often inferior.

    Args:
        pairs: of the method and dense, with rates that differ by the margin.
        design: when to analyse.
        trials: simulated benchmarks.
        generator: of their episodes.
    """
    counts = np.zeros((2, trials), dtype=np.int64)
    wrong, before = np.zeros((2, trials), dtype=bool), 0
    shares = [pairs.won, pairs.lost, max(1 - pairs.won - pairs.lost, 0.0)]
    for n in design.ends:
        counts += generator.multinomial(n - before, shares, trials)[:, :2].T
        z = tango_z(*counts, n, -DEFAULT_MARGIN)
        wrong |= np.stack([z, -z]) > design.critical(n)
        before = n
    return float(wrong[0].mean()), float(wrong[1].mean())


def aggregate_coverage(
    pairs: Sequence[PairRates],
    slower: float,
    designs: Sequence[Design],
    trials: int,
    generator: np.random.Generator,
) -> tuple[float, float]:
    """Return the coverage of the intervals over several tasks: of the difference, and of the ratio of times.

    Args:
        pairs: of each task.
        slower: times of solved episodes of the method, over dense's.
        designs: of each task; one with several analyses stops the task where it is decided on success.
        trials, generator: as `verdict_errors`.
    """
    truth = np.mean([one.won - one.lost for one in pairs])
    ratio = math.exp(float(np.mean([math.log(_mean_ratio(one, slower)) for one in pairs])))
    covered = np.zeros(2)
    for _ in range(trials):
        tasks = {
            str(i): _task(*one, slower, generator) for i, one in enumerate(zip(pairs, designs, strict=True))
        }
        found = aggregate_tasks(tasks)
        cis = zip((truth, ratio), (found.success.ci, found.time.ci), strict=True)
        covered += [low - 1e-12 <= value <= high + 1e-12 for value, (low, high) in cis]
    return float(covered[0]) / trials, float(covered[1]) / trials


def _mean_ratio(pairs: PairRates, slower: float) -> float:
    method, dense = pairs.won + pairs.both, pairs.lost + pairs.both
    return (method * slower * _STEPS + (1 - method) * _HORIZON) / (dense * _STEPS + (1 - dense) * _HORIZON)


def _task(pairs: PairRates, design: Design, slower: float, generator: np.random.Generator) -> TaskPairs:
    solved = pairs.draw(design.max_episodes, generator)
    n = next(_stops(solved, design))
    times = [
        np.where(ours[:n], np.minimum(generator.gamma(_SHAPE, mean / _SHAPE, n), _HORIZON), _HORIZON)
        for ours, mean in zip(solved, (slower * _STEPS, _STEPS), strict=True)
    ]
    return TaskPairs((solved[0][:n], solved[1][:n]), (times[0], times[1]), _HORIZON, design)


def _stops(solved: tuple[NDArray, NDArray], design: Design) -> Iterator[int]:
    won, lost = np.cumsum(solved[0] > solved[1]), np.cumsum(solved[1] > solved[0])
    for n in design.ends[:-1]:
        if design.decides(n, tango_z(int(won[n - 1]), int(lost[n - 1]), n, -DEFAULT_MARGIN)):
            yield n
    yield design.max_episodes
