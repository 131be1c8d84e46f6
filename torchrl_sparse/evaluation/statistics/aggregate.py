"""Comparison of a method with dense over several equally weighted tasks.

The mean over tasks of a paired number has the variance ``V = Σ w² s² / n``, of each task's sample variance s² and pairs n, with
the weight w, one over the number of tasks. As of single tasks, what was seen does not show the failure that has not been seen
yet, and the interval inverts a test whose variance grows with the distance from the estimate, as Tango's and Wilson's do::

    h² = t² (V + a h)

where a is the most that one seed of any task moves the mean: of successes ``w / n``, of logarithms of ratios of times that over
the mean time, times what a failure costs (see `durations`). h is the half width and t Student's quantile with ``Σ (n - 1)``
degrees of freedom. Pairs that all agree give ``±t² a``, never ±0; where failures are common, a h vanishes beside V. Nothing is
resampled: draws from a few concordant pairs are all alike.

Tasks that stopped when they were decided have wider quantiles, those of their analysis (`Design`), since their intervals hold
whatever stopped them. The study `simulate_stopping` simulates the coverage, and tests enumerate it where pairs are few.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtr, ndtri, stdtr, stdtrit

from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.statistics.durations import DEFAULT_TIME_MARGIN, one_seed
from torchrl_sparse.evaluation.statistics.intervals import (
    DEFAULT_MARGIN,
    checked_pairs,
    discordant_pairs,
    mcnemar_p,
)
from torchrl_sparse.evaluation.statistics.sequential import Design

__all__ = ["Aggregate", "Mean", "TaskPairs", "aggregate_tasks"]


@dataclass(frozen=True)
class TaskPairs:
    """A method and dense on the same seeds of one task, in the same order.

    Attributes:
        solved: whether the method solved each episode, and whether dense did; [n] each, n at least 2.
        times: their `restricted_times`, [n] each, steps.
        horizon: the largest that a time can be, steps.
        design: after which of whose analyses the task stopped; None for a number that was fixed.
    """

    solved: tuple[Sequence[bool], Sequence[bool]]
    times: tuple[ArrayLike, ArrayLike]
    horizon: int
    design: Design | None = None


@dataclass(frozen=True)
class Mean:
    """A mean over tasks.

    Attributes:
        value: of successes the difference of rates, of times the geometric mean of the ratios.
        ci: its 95 % interval.
        tasks: of each its design, its pairs, and how many standard errors lie between the value and the margin.
    """

    value: float
    ci: tuple[float, float]
    tasks: tuple[tuple[Design, int, float], ...]

    @property
    def p_value(self) -> float:
        """One-sided p-value of being on the other side of the margin: the largest over the tasks' designs."""
        return max(design.p_value(z, n) for design, n, z in self.tasks)


@dataclass(frozen=True)
class Aggregate:
    """Comparison of a method with dense over several tasks.

    Attributes:
        success: the difference of success rates.
        time: the ratio of restricted mean times.
        mcnemar_p: exact, of no difference in success in any task: of the discordant pairs of all, see `mcnemar_p`.
        episodes: pairs, of all tasks together.
    """

    success: Mean
    time: Mean
    mcnemar_p: float
    episodes: int


def aggregate_tasks(
    tasks: Mapping[str, TaskPairs], margin: float = DEFAULT_MARGIN, time_margin: float = DEFAULT_TIME_MARGIN
) -> Aggregate:
    """Combine a method's comparisons with dense over its tasks.

    Args:
        tasks: task -> its pairs.
        margin: of success, a difference of rates.
        time_margin: of times, a share of dense's.

    Raises:
        InputError: if there are fewer than two tasks, or a task has fewer than two pairs.

    >>> agreeing = TaskPairs(([True] * 5, [True] * 5), ([30] * 5, [30] * 5), 400)
    >>> result = aggregate_tasks({"a": agreeing, "b": agreeing})
    >>> result.success.value, [round(limit, 3) for limit in result.success.ci], result.mcnemar_p
    (0.0, [-0.532, 0.532], 1.0)
    """
    counts = {name: len(task.solved[0]) for name, task in tasks.items()}
    if len(counts) < 2 or min(counts.values()) < 2:
        raise InputError(f"tasks: expected at least two, of at least two pairs each, got {counts}")
    success, times = [], []
    for name, task in tasks.items():
        n, design = counts[name], task.design or Design(counts[name])
        success.append(_Part.of(np.subtract(*checked_pairs(*task.solved)), 1 / n, design))
        ours, theirs = checked_pairs(*task.times)
        each = ours / ours.mean() - theirs / theirs.mean()
        lost = one_seed(ours, theirs, task.horizon) / min(ours.mean(), theirs.mean())
        times.append(_Part.of(each, lost, design, math.log(ours.mean() / theirs.mean())))
    value, half, tested = _combine(success, -margin)
    low, high = max(value - half, -1.0), min(value + half, 1.0)
    log, spread, time_tested = _combine(times, math.log(1 + time_margin))
    won, lost, _ = map(sum, zip(*(discordant_pairs(*task.solved) for task in tasks.values()), strict=True))
    return Aggregate(
        Mean(value, (low, high), tested),
        Mean(math.exp(log), (math.exp(log - spread), math.exp(log + spread)), time_tested),
        mcnemar_p(won, lost),
        sum(counts.values()),
    )


@dataclass(frozen=True)
class _Part:
    """A task's mean, the variance of it, what one seed may move it, and the design that its n pairs are of."""

    mean: float
    variance: float
    one_seed: float
    n: int
    design: Design

    @classmethod
    def of(cls, each: ArrayLike, one_seed: float, design: Design, mean: float | None = None) -> _Part:
        each = np.asarray(each)
        variance = float(each.var(ddof=1)) / len(each)
        return cls(float(each.mean()) if mean is None else mean, variance, one_seed, len(each), design)


def _combine(
    parts: Sequence[_Part], bound: float
) -> tuple[float, float, tuple[tuple[Design, int, float], ...]]:
    """Return the mean of the parts' means, half the width of its interval, and how far ``bound`` is, as `Mean.tasks`."""
    weight, degrees = 1 / len(parts), sum(part.n - 1 for part in parts)
    quantiles = [float(stdtrit(degrees, ndtr(part.design.critical(part.n)))) for part in parts]
    mean = math.fsum(part.mean for part in parts) * weight
    variance = sum((t * weight) ** 2 * part.variance for t, part in zip(quantiles, parts, strict=True))
    seed = max(t**2 * weight * part.one_seed for t, part in zip(quantiles, parts, strict=True))
    half = (seed + math.sqrt(seed**2 + 4 * variance)) / 2
    far = abs(mean - bound)
    beyond = far / math.sqrt(variance + seed * far) if far else 0.0
    z = (-float(ndtri(stdtr(degrees, -beyond * t))) for t in quantiles)
    return mean, half, tuple((part.design, part.n, one) for part, one in zip(parts, z, strict=True))
