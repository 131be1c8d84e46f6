"""Intervals and verdicts for success rates, single or paired with the dense policy.

Episodes are Bernoulli trials. A rate gets Wilson's interval (E. B. Wilson, JASA 22, 1927). Two methods that
ran on the same
seeds are compared pair by pair: only the *discordant* pairs, in which one succeeds and the other fails, say
anything about the difference, and its interval is Tango's asymptotic score interval (T. Tango, Statistics
in Medicine 17, 1998, 891-908). It inverts a test whose variance is estimated under each hypothesised
difference, and so keeps a positive width where a
Wald interval collapses: with n pairs and no discordant one it is ``±z²/(n + z²)``, not ``±0``.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq
from scipy.special import bdtr, ndtri

from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.statistics.differences import Difference, Verdict

__all__ = [
    "DEFAULT_MARGIN",
    "check_level",
    "checked_pairs",
    "discordant_pairs",
    "episodes_needed",
    "mcnemar_p",
    "paired_difference",
    "tango_interval",
    "tango_z",
    "verdict",
    "wilson_interval",
]

DEFAULT_MARGIN = 0.05


def wilson_interval(k: int, n: int, confidence: float = 0.95) -> tuple[float, float]:
    """Return Wilson's score interval of a success rate.

    Args:
        k: successes, 0 <= k <= n.
        n: trials, at least 1.
        confidence: two-sided level, strictly between 0 and 1.

    Raises:
        InputError: if the counts or the level are out of range.

    >>> [round(limit, 4) for limit in wilson_interval(81, 263)]
    [0.2553, 0.3662]
    """
    check_level(confidence)
    if n < 1 or not 0 <= k <= n:
        raise InputError(f"k: expected 0 <= k <= n and n >= 1, got k={k}, n={n}")
    z = float(ndtri((1 + confidence) / 2))
    centre, half = k + z**2 / 2, z * math.sqrt(k * (n - k) / n + z**2 / 4)
    low, high = (centre - half) / (n + z**2), (centre + half) / (n + z**2)
    return low if k else 0.0, high if k < n else 1.0  # which rounding would miss


def tango_interval(won: int, lost: int, n: int, confidence: float = 0.95) -> tuple[float, float]:
    """Return Tango's score interval of ``(won - lost) / n``, the difference of two paired proportions.

    Args:
        won: pairs in which only the first member succeeds.
        lost: pairs in which only the second member succeeds.
        n: all pairs, concordant ones included, at least 1.
        confidence: two-sided level, strictly between 0 and 1.

    Raises:
        InputError: if the counts or the level are out of range.

    >>> [round(limit, 3) for limit in tango_interval(1, 7, 21)]
    [-0.517, -0.026]
    """
    check_level(confidence)
    if n < 1 or won < 0 or lost < 0 or won + lost > n:
        raise InputError(
            f"pairs: expected won, lost >= 0 and won + lost <= n, n >= 1, got won={won}, lost={lost}, n={n}"
        )
    z2 = float(ndtri((1 + confidence) / 2)) ** 2
    # Where the estimated variance is zero, the equation below also holds at the estimate itself, which is
    # no limit of the interval; its other roots have closed forms there.
    if won + lost == 0:
        return -z2 / (n + z2), z2 / (n + z2)
    if won == n:
        return (n - z2) / (n + z2), 1.0
    if lost == n:
        return -1.0, (z2 - n) / (n + z2)
    diff = (won - lost) / n

    def excess(delta: float) -> float:
        """Return the squared score statistic minus z², times its variance: negative inside the interval."""
        return n * (diff - delta) ** 2 - z2 * _pair_variance(won, lost, n, delta)

    return float(brentq(excess, -1.0, diff, xtol=1e-12)), float(brentq(excess, diff, 1.0, xtol=1e-12))


def tango_z(won: ArrayLike, lost: ArrayLike, n: int, delta: float) -> NDArray | float:
    """Return Tango's score statistic: by how many standard errors the difference lies above ``delta``.

    `tango_interval` excludes ``delta`` where this is beyond its normal quantile.

    Args:
        won, lost: see `tango_interval`; of one comparison, or of many as arrays.
        n: see `tango_interval`.
        delta: the hypothesis, strictly between -1 and 1 and not 0; minus the margin for non-inferiority.

    >>> round(tango_z(1, 7, 21, -0.026), 2), round(tango_z(0, 0, 73, -0.05), 2)
    (-1.96, 1.96)
    """
    won, lost = np.asarray(won), np.asarray(lost)
    return ((won - lost) / n - delta) / np.sqrt(_pair_variance(won, lost, n, delta) / n)


def _pair_variance(won: ArrayLike, lost: ArrayLike, n: int, delta: float) -> NDArray | float:
    """Return the variance of a pair's difference where ``delta`` is the true one, whose likeliest loss rate is Tango's."""
    a = 2 * n
    b = -won - lost + (2 * n - won + lost) * delta
    c = -lost * delta * (1 - delta)
    loss_rate = (np.sqrt(np.maximum(b * b - 4 * a * c, 0.0)) - b) / (2 * a)
    return 2 * loss_rate + delta * (1 - delta)


def mcnemar_p(won: int, lost: int) -> float:
    """Return the exact two-sided p-value of McNemar's test: the chance that a fair coin splits discordant pairs as unevenly.

    Given their number, the pairs that only one solved are Binomial(won + lost, 1/2) where both methods are as good (Q. McNemar,
    Psychometrika 12, 1947). Twice the smaller tail, at most 1; as the coin is fair, the sum over all splits that are as
    unlikely is the same. It is of a number of pairs that was fixed: a sequential design's analyses are not counted.

    >>> mcnemar_p(1, 7), mcnemar_p(0, 0), mcnemar_p(3, 3)
    (0.0703125, 1.0, 1.0)
    """
    if won < 0 or lost < 0:
        raise InputError(f"discordant pairs: expected won, lost >= 0, got won={won}, lost={lost}")
    return min(2 * float(bdtr(min(won, lost), won + lost, 0.5)), 1.0)


def verdict(ci: tuple[float, float], margin: float = DEFAULT_MARGIN) -> Verdict:
    """Judge the interval of a paired difference against a non-inferiority margin.

    ``"non-inferior"`` if the whole interval lies above ``-margin``, ``"inferior"`` if all of it lies below,
    else ``"inconclusive"``: the episodes do not suffice to tell.

    >>> verdict((-0.03, 0.01)), verdict((-0.30, -0.12)), verdict((-0.11, 0.02))
    ('non-inferior', 'inferior', 'inconclusive')
    """
    if not 0 < margin < 1:
        raise InputError(f"margin: expected a number strictly between 0 and 1, got {margin}")
    low, high = ci
    if low > -margin:
        return "non-inferior"
    return "inferior" if high < -margin else "inconclusive"


def paired_difference(
    method: Sequence[bool],
    other: Sequence[bool],
    margin: float = DEFAULT_MARGIN,
    confidence: float = 0.95,
) -> Difference:
    """Compare two methods on the same seeds; entry *i* of both sequences has the same seed.

    Args:
        method, other: whether each solved an episode.
        margin: of the verdict.
        confidence: two-sided level, strictly between 0 and 1.

    Raises:
        InputError: if the lengths differ or are zero.

    >>> result = paired_difference([True, True, False, True], [True, True, True, True])
    >>> result.diff, result.mcnemar_p, result.verdict
    (-0.25, 1.0, 'inconclusive')
    """
    won, lost, n = discordant_pairs(method, other)
    ci = tango_interval(won, lost, n, confidence)
    return Difference((won - lost) / n, ci, margin, verdict(ci, margin), mcnemar_p(won, lost))


def discordant_pairs(method: Sequence[bool], other: Sequence[bool]) -> tuple[int, int, int]:
    """Return the number of pairs that only the method solved, that only the other solved, and in all.

    Raises:
        InputError: if the lengths differ or are zero.

    >>> discordant_pairs([True, False, True], [True, True, False])
    (1, 1, 3)
    """
    ours, theirs = checked_pairs(method, other)
    return int((ours > theirs).sum()), int((theirs > ours).sum()), len(ours)


def checked_pairs(method: ArrayLike, other: ArrayLike) -> tuple[NDArray, NDArray]:
    """Return both inputs as f64 [n], or raise InputError if they are empty or differ in length."""
    method, other = np.asarray(method, dtype=np.float64), np.asarray(other, dtype=np.float64)
    if method.shape != other.shape or method.ndim != 1 or not len(method):
        raise InputError(
            f"pairs: expected as many episodes of both, and at least one, got {method.size} and {other.size}"
        )
    return method, other


def episodes_needed(margin: float = DEFAULT_MARGIN, confidence: float = 0.95) -> int:
    """Return the least number of pairs that can show non-inferiority: enough if no pair is discordant.

    >>> episodes_needed(0.05)
    73
    """
    check_level(confidence)
    if not 0 < margin < 1:
        raise InputError(f"margin: expected a number strictly between 0 and 1, got {margin}")
    z2 = float(ndtri((1 + confidence) / 2)) ** 2
    return math.floor(z2 * (1 - margin) / margin) + 1


def check_level(confidence: float) -> None:
    """Raise InputError unless a level is strictly between 0 and 1."""
    if not 0 < confidence < 1:
        raise InputError(f"confidence: expected a number strictly between 0 and 1, got {confidence}")
