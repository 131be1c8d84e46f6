"""Two success rates of which some episodes are pairs and some are not: Rao's score test of all of them together.

A pair is one seed that both methods ran. The statistic at a hypothesised difference weighs pairs and single episodes by their
variances where that difference is true, the other parameters at their likeliest (C. R. Rao, Proc. Cambridge Phil. Soc. 44,
1948). Of pairs alone it is Tango's (see `intervals`); of single episodes alone it is that of Miettinen and Nurminen (Statistics
in Medicine 4, 1985, 213-226), with their factor ``N / (N - 1)`` on the variance of single episodes. In between, pairs count by
their correlation, and episodes of one method alone still tell of its rate.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq
from scipy.special import ndtr, ndtri

from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.statistics.intervals import (
    check_level,
    mcnemar_p,
    tango_interval,
    tango_z,
)

__all__ = ["OverlapCounts", "miettinen_nurminen_z"]

_LIMIT = 1 - 1e-9  # of a difference at which the statistic is computed
_HALVINGS = 60


@dataclass(frozen=True)
class OverlapCounts:
    """What two methods solved, in pairs and alone.

    Attributes:
        both, won, lost, neither: pairs that both solved, the first alone, the second alone, and none.
        ours: episodes of the first method alone: solved, all.
        theirs: the same of the second.

    Raises:
        InputError: if a count is negative, or a method has no episode.

    >>> counts = OverlapCounts(0, 0, 0, 0, ours=(56, 70), theirs=(48, 80))
    >>> round(counts.difference, 3), [round(limit, 3) for limit in counts.interval()]
    (0.2, [0.053, 0.338])
    """

    both: int
    won: int
    lost: int
    neither: int
    ours: tuple[int, int] = (0, 0)
    theirs: tuple[int, int] = (0, 0)

    def __post_init__(self) -> None:
        cells = (self.both, self.won, self.lost, self.neither)
        alone = (self.ours, self.theirs)
        if min(cells) < 0 or any(not 0 <= k <= n for k, n in alone):
            raise InputError(f"counts: expected none below 0 and solved <= all, got {cells}, {alone}")
        if not all(self.pairs + n for _, n in alone):
            raise InputError(f"counts: expected an episode of both methods, got {cells}, {alone}")

    @property
    def pairs(self) -> int:
        """Episodes that both methods ran."""
        return self.both + self.won + self.lost + self.neither

    @property
    def paired(self) -> bool:
        """Whether there are pairs alone."""
        return not self.ours[1] + self.theirs[1]

    @property
    def rates(self) -> tuple[float, float]:
        """Success rates of both, each of all its episodes."""
        ours = (self.both + self.won + self.ours[0]) / (self.pairs + self.ours[1])
        return ours, (self.both + self.lost + self.theirs[0]) / (self.pairs + self.theirs[1])

    @cached_property
    def difference(self) -> float:
        """The likeliest difference of the rates; where some are pairs and some not, it is not that of `rates`."""
        if self.paired or not self.pairs:
            return self.rates[0] - self.rates[1]
        return _crossing(self.z, 0.0)

    def z(self, delta: float) -> float:
        """Return by how many standard errors the difference lies above ``delta``, strictly between -1 and 1."""
        if self.paired and delta:
            return float(tango_z(self.won, self.lost, self.pairs, delta))
        if self.paired:
            discordant = self.won + self.lost
            return (self.won - self.lost) / math.sqrt(discordant) if discordant else 0.0
        if not self.pairs:
            return float(miettinen_nurminen_z(*self.ours, *self.theirs, delta))
        return self._score(delta)

    def interval(self, confidence: float = 0.95) -> tuple[float, float]:
        """Return the differences that the statistic does not exclude."""
        if self.paired:
            return tango_interval(self.won, self.lost, self.pairs, confidence)
        check_level(confidence)
        critical = float(ndtri((1 + confidence) / 2))
        return _crossing(self.z, critical), _crossing(self.z, -critical)

    def p_equal(self) -> float:
        """Return the two-sided p-value of no difference: McNemar's exact one of pairs alone, else that of the statistic."""
        if self.paired:
            return mcnemar_p(self.won, self.lost)
        return min(1.0, 2 * float(ndtr(-abs(self.z(0.0)))))

    def _score(self, delta: float) -> float:
        """Return the statistic of pairs and single episodes: generalised least squares at the likeliest parameters."""
        lost, rate = _likeliest(self, delta)
        rates = (min(rate + delta, 1.0), rate)
        spread = [max(p * (1 - p), 0.0) for p in rates]
        shared = max(rate - lost, 0.0) - rates[0] * rates[1]
        n = self.pairs
        mean = np.array([self.both + self.won, self.both + self.lost]) / n
        covariance = np.array([[spread[0], shared], [shared, spread[1]]]) / n
        total = 2 * n + self.ours[1] + self.theirs[1]
        for index, (solved, count) in enumerate((self.ours, self.theirs)):
            if not count:
                continue
            noise = spread[index] / count * total / (total - 1)
            if (seen := covariance[index, index] + noise) <= 0:
                continue
            gain = covariance[:, index] / seen
            mean = mean + gain * (solved / count - mean[index])
            covariance = covariance - np.outer(gain, covariance[index])
        variance = covariance[0, 0] + covariance[1, 1] - 2 * covariance[0, 1]
        far = mean[0] - mean[1] - delta
        if variance <= 1e-300:
            return 0.0 if abs(far) < 1e-12 else math.copysign(math.inf, far)
        return float(far / math.sqrt(variance))


def miettinen_nurminen_z(
    ours: ArrayLike, our_n: int, theirs: ArrayLike, their_n: int, delta: float
) -> NDArray | float:
    """Return by how many standard errors the difference of two independent rates lies above ``delta``.

    Args:
        ours, theirs: solved episodes, of one comparison or of many as arrays.
        our_n, their_n: all episodes, at least 1 each.
        delta: the hypothesis, strictly between -1 and 1.

    >>> round(miettinen_nurminen_z(56, 70, 48, 80, 0.0), 3)
    2.641
    """
    ours, theirs = np.asarray(ours, np.float64), np.asarray(theirs, np.float64)
    n, left = our_n + their_n, ours - our_n * delta
    # With x the second rate and x + delta the first, the likelihood's slope has the sign of a cubic; its middle root is meant.
    b = -(left + our_n + theirs + their_n * (1 - 2 * delta)) / (3 * n)
    c = (left + theirs * (1 - 2 * delta) - their_n * delta * (1 - delta)) / n
    d = theirs * delta * (1 - delta) / n
    q, p = b**3 - b * c / 2 + d / 2, np.maximum(b**2 - c / 3, 0.0)
    u = np.where(q < 0, -1.0, 1.0) * np.sqrt(p)
    cosine = np.divide(q, u**3, out=np.zeros_like(q * u), where=u != 0)
    x = 2 * u * np.cos((np.pi + np.arccos(np.clip(cosine, -1, 1))) / 3) - b
    x = np.clip(x, max(0.0, -delta), min(1.0, 1 - delta))
    y = x + delta
    variance = (x * (1 - x) / their_n + y * (1 - y) / our_n) * n / (n - 1)
    far = ours / our_n - theirs / their_n - delta
    sure = np.abs(far) / 1e-12  # without variance, anything but the difference itself is excluded
    return np.where(variance > 1e-15, far / np.sqrt(np.maximum(variance, 1e-15)), np.copysign(sure, far))[()]


def _likeliest(counts: OverlapCounts, delta: float) -> tuple[float, float]:
    """Return the likeliest share of pairs that only the second solves, and its rate, where ``delta`` is the difference."""

    def best_lost(rate: float) -> tuple[float, int]:
        """Return the likeliest share for a rate, and by which of its limits it is held: 1 of pairs solved, -1 of none."""
        solved, none = rate, 1 - delta - rate
        low, high = max(0.0, -delta), min(solved, none)

        def slope(lost: float) -> float:
            return (
                _term(counts.won, lost + delta)
                + _term(counts.lost, lost)
                - _term(counts.both, solved - lost)
                - _term(counts.neither, none - lost)
            )

        at, falls = _top(slope, low, high)
        return at, 0 if falls else (1 if solved <= none else -1)

    def slope(rate: float) -> float:
        lost, held = best_lost(rate)
        both, neither = _term(counts.both, rate - lost), _term(counts.neither, 1 - delta - rate - lost)
        paired = both - neither
        if held:  # the limit moves with the rate, and the share with it
            paired = _term(counts.won, lost + delta) + _term(counts.lost, lost)
            paired = paired - 2 * neither if held > 0 else 2 * both - paired
        (ours, our_n), (theirs, their_n) = counts.ours, counts.theirs
        alone = _term(ours, rate + delta) - _term(our_n - ours, 1 - rate - delta)
        return paired + alone + _term(theirs, rate) - _term(their_n - theirs, 1 - rate)

    rate, _ = _top(slope, max(0.0, -delta), min(1.0, 1 - delta))
    return best_lost(rate)[0], rate


def _term(count: int, share: float) -> float:
    """Return the slope of ``count * log(share)``."""
    return count / max(share, 1e-300) if count else 0.0


def _top(slope: Callable[[float], float], low: float, high: float) -> tuple[float, bool]:
    """Return where a falling slope changes sign, and whether it falls below zero before ``high``."""
    falls = False
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        if slope(middle) > 0:
            low = middle
        else:
            high, falls = middle, True
    return (low + high) / 2, falls


def _crossing(z: Callable[[float], float], level: float) -> float:
    """Return the difference at which a falling statistic is ``level``; the end of the range where it never is."""
    low, high = -_LIMIT, _LIMIT
    if z(low) <= level:
        return -1.0
    if z(high) >= level:
        return 1.0
    return float(brentq(lambda delta: min(max(z(delta), -1e6), 1e6) - level, low, high, xtol=1e-10))
