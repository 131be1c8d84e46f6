"""Means of scores, and of their paired differences, with Student's intervals: for tasks that succeed by degrees."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import norm, t

__all__ = ["mean_interval", "mean_z"]


def mean_interval(values: ArrayLike, confidence: float = 0.95) -> tuple[float, tuple[float, float]]:
    """Return the mean of ``values``, at least two, and Student's interval of it.

    Of the differences of paired episodes it is the interval of the paired t-test.

    Raises:
        ValueError: if there are fewer than two values, or they are no list of numbers.

    >>> mean, (low, high) = mean_interval([0.5, 0.7, 0.9])
    >>> round(mean, 3), round(low, 3), round(high, 3)
    (0.7, 0.203, 1.197)
    """
    values = np.asarray(values, np.float64)
    if values.ndim != 1 or len(values) < 2:
        raise ValueError(f"values: expected at least two numbers, got shape {values.shape}")
    half = float(t.ppf((1 + confidence) / 2, len(values) - 1) * values.std(ddof=1) / len(values) ** 0.5)
    mean = float(values.mean())
    return mean, (mean - half, mean + half)


def mean_z(values: ArrayLike, bound: float) -> float:
    """Return by how many standard errors the mean of ``values`` lies above ``bound``; 0 of fewer than two, which say nothing.

    Student's statistic as the normal one that is as unlikely, so that `mean_interval` excludes ``bound`` where this is beyond
    the normal quantile.

    >>> round(mean_z([0.5, 0.7, 0.9], 0.5), 3), mean_z([0.5, 0.5], 0.6)
    (1.212, -inf)
    """
    values = np.asarray(values, np.float64)
    if len(values) < 2:
        return 0.0
    above, error = float(values.mean()) - bound, float(values.std(ddof=1)) / len(values) ** 0.5
    tail = t.sf(abs(above) / error, len(values) - 1) if error > 0 else 0.0
    return math.copysign(float(norm.isf(tail)), above)
