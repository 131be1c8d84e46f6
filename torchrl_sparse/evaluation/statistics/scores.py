"""Mean scores and their differences, with Student's intervals, for graded tasks.

Numbers that are all the same show no spread, which does not say that there is none. Scores lie in [0, 1]; the interval then is
Tango's of as many pairs of which none differs, ``±z²/(n + z²)``.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtri, stdtr, stdtrit

from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.statistics.intervals import checked_pairs

__all__ = ["difference_interval", "difference_z", "mean_interval"]


def mean_interval(values: ArrayLike, confidence: float = 0.95) -> tuple[float, tuple[float, float]]:
    """Return the mean of ``values``, at least two, and its Student interval.

    Raises:
        InputError: if there are fewer than two values, or they are no list of numbers.

    >>> mean, (low, high) = mean_interval([0.5, 0.7, 0.9])
    >>> round(mean, 3), round(low, 3), round(high, 3)
    (0.7, 0.203, 1.197)
    """
    values = np.asarray(values, np.float64)
    if values.ndim != 1 or len(values) < 2:
        raise InputError(f"values: expected at least two numbers, got shape {values.shape}")
    half, mean = _half_width(values, confidence), float(values.mean())
    if not np.ptp(values):
        return mean, (max(mean - half, 0.0), min(mean + half, 1.0))
    return mean, (mean - half, mean + half)


def difference_interval(
    method: ArrayLike, other: ArrayLike, confidence: float = 0.95
) -> tuple[float, tuple[float, float]]:
    """Return the mean score difference of two methods and its interval, as in the paired t-test.

    Args:
        method, other: scores on the same seeds, [n], n at least 2.
        confidence: two-sided level.

    Raises:
        InputError: if they are no pairs, or there are fewer than two.

    >>> difference, (low, high) = difference_interval([0.5, 0.7, 0.9], [0.0, 0.0, 0.0])
    >>> round(difference, 3), round(low, 3), round(high, 3)
    (0.7, 0.203, 1.197)
    """
    gained = np.subtract(*checked_pairs(method, other))
    if len(gained) < 2:
        raise InputError(f"pairs: expected at least two, got {len(gained)}")
    difference, half = float(gained.mean()), _half_width(gained, confidence)
    return difference, (difference - half, difference + half)


def _half_width(values: NDArray, confidence: float) -> float:
    n, level = len(values), (1 + confidence) / 2
    if not np.ptp(values):
        z2 = float(ndtri(level)) ** 2
        return z2 / (n + z2)
    return float(stdtrit(n - 1, level)) * _standard_error(values)


def _standard_error(values: NDArray) -> float:
    return math.sqrt(float(values.var(ddof=1)) / len(values))


def difference_z(method: ArrayLike, other: ArrayLike, bound: float) -> float:
    """Return by how many standard errors the score difference lies above ``bound``; 0 for a single pair.

    Student's statistic as the normal one that is as unlikely, so that `difference_interval` excludes ``bound`` where this is
    beyond the normal quantile.

    >>> round(difference_z([0.5, 0.7, 0.9], [0, 0, 0], 0.5), 3), round(difference_z([0.5, 0.5], [0, 0], 0.6), 3)
    (1.212, -0.471)
    """
    gained = np.subtract(*checked_pairs(method, other))
    n, above = len(gained), float(gained.mean()) - bound
    if n < 2:
        return 0.0
    if not np.ptp(gained):
        far = abs(above)
        return math.copysign(math.sqrt(n * far / (1 - far)) if far < 1 else math.inf, above)
    return math.copysign(-float(ndtri(stdtr(n - 1, -abs(above) / _standard_error(gained)))), above)
