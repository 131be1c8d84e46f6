"""Means of scores, and of their differences, with Student's intervals: for tasks that succeed by degrees."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtri, stdtr, stdtrit

from torchrl_sparse.evaluation.statistics.overlap import Means

__all__ = ["difference_interval", "difference_z", "mean_interval"]


def mean_interval(values: ArrayLike, confidence: float = 0.95) -> tuple[float, tuple[float, float]]:
    """Return the mean of ``values``, at least two, and Student's interval of it.

    Raises:
        ValueError: if there are fewer than two values, or they are no list of numbers.

    >>> mean, (low, high) = mean_interval([0.5, 0.7, 0.9])
    >>> round(mean, 3), round(low, 3), round(high, 3)
    (0.7, 0.203, 1.197)
    """
    values = np.asarray(values, np.float64)
    if values.ndim != 1 or len(values) < 2:
        raise ValueError(f"values: expected at least two numbers, got shape {values.shape}")
    half = _half_width(float(values.var(ddof=1)) / len(values), len(values), confidence)
    mean = float(values.mean())
    return mean, (mean - half, mean + half)


def difference_interval(
    method: ArrayLike, other: ArrayLike, more: ArrayLike = (), confidence: float = 0.95
) -> tuple[float, tuple[float, float]]:
    """Return the mean score of a method minus that of another, and its interval: that of the paired t-test without ``more``.

    Args:
        method, other: scores on the same seeds, [n], n at least 2.
        more: of the other on further seeds, see `torchrl_sparse.evaluation.statistics.overlap`.
        confidence: two-sided level.

    Raises:
        ValueError: if they are no pairs, or there are fewer than two.

    >>> difference, (low, high) = difference_interval([0.5, 0.7, 0.9], [0.0, 0.0, 0.0])
    >>> round(difference, 3), round(low, 3), round(high, 3)
    (0.7, 0.203, 1.197)
    """
    means = Means.of(method, other, more)
    if means.n < 2:
        raise ValueError(f"pairs: expected at least two, got {means.n}")
    half, difference = _half_width(means.variance(1), means.n, confidence), means.method - means.other
    return difference, (difference - half, difference + half)


def _half_width(variance: float, n: int, confidence: float) -> float:
    return float(stdtrit(n - 1, (1 + confidence) / 2)) * math.sqrt(variance)


def difference_z(method: ArrayLike, other: ArrayLike, bound: float, more: ArrayLike = ()) -> float:
    """Return by how many standard errors the difference of scores lies above ``bound``; 0 of a single pair, which says nothing.

    Student's statistic as the normal one that is as unlikely, so that `difference_interval` excludes ``bound`` where this is
    beyond the normal quantile.

    >>> round(difference_z([0.5, 0.7, 0.9], [0, 0, 0], 0.5), 3), difference_z([0.5, 0.5], [0, 0], 0.6)
    (1.212, -inf)
    """
    means = Means.of(method, other, more)
    if means.n < 2:
        return 0.0
    above, error = means.method - means.other - bound, math.sqrt(means.variance(1))
    tail = stdtr(means.n - 1, -abs(above) / error) if error > 0 else 0.0
    return math.copysign(-float(ndtri(tail)), above)
