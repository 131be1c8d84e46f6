"""Time to success: the cost of a slower method even if it solves as many episodes.

An episode that is not solved took the whole horizon: the *restricted mean time* is the mean of these times, and two methods
that ran on the same seeds are compared by the ratio of theirs. Its interval inverts a paired test, as Fieller's does (E. C.
Fieller, JRSS B 16, 1954): a ratio r is in it unless the sum of ``method - r * other`` over the seeds is too many standard
errors from zero. No resampling, since a sequential design asks for levels of 99.99 %, whose tails no bootstrap of a few dozen
seeds reaches, and since its verdicts then are those of one statistic, `time_z`.

What the observed spread cannot show is the failure that has not been seen yet: on Lift one episode in a hundred at the horizon
costs more than a tenth of the mean, and a hundred seeds without one have almost no spread. So the variance gains ``z² L²``, L
being what one seed costs that one method solves and the other does not. It is what Tango's variance under the hypothesised
difference does for success: without any spread the interval is as wide as ``±z²/n`` such seeds, and it vanishes against the
observed variance where failures are common. `tests/evaluation/statistics/test_durations.py` simulates the coverage.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtri

from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.statistics.differences import TimeDifference, Verdict
from torchrl_sparse.evaluation.statistics.intervals import check_level, checked_pairs

__all__ = [
    "DEFAULT_TIME_MARGIN",
    "allowed_steps",
    "correlation",
    "one_seed",
    "restricted_times",
    "success_within",
    "time_ratio",
    "time_verdict",
    "time_z",
]

DEFAULT_TIME_MARGIN = 0.10
_PER_OCTAVE, _OCTAVES = 6, 5  # of the allowed times that a curve shows


def restricted_times(success: Sequence[bool], length: Sequence[int], horizon: int) -> NDArray[np.float64]:
    """Return the steps to success of each episode, or the horizon for failures.

    Args:
        success: whether each episode was solved.
        length: steps of each episode, which ends when it is solved.
        horizon: steps until truncation.

    Raises:
        InputError: if an episode is longer than the horizon, or ended before it unsolved.

    >>> restricted_times([True, False], [31, 400], 400).tolist()
    [31.0, 400.0]
    """
    for solved, steps in zip(success, length, strict=True):
        if steps > horizon or not (solved or steps == horizon):
            raise InputError(
                f"horizon: expected at most {horizon} steps of an episode, fewer only of solved ones, got {steps}"
            )
    return np.asarray(length, dtype=np.float64)


def time_ratio(
    method: ArrayLike,
    other: ArrayLike,
    horizon: int,
    margin: float = DEFAULT_TIME_MARGIN,
    confidence: float = 0.95,
) -> TimeDifference:
    """Compare the restricted mean times of two methods on the same seeds.

    Args:
        method: its `restricted_times`, [n].
        other: those of the other, on the same seeds in the same order, [n].
        horizon: the largest that a time can be.
        margin: of the verdict, a share of the other's time.
        confidence: two-sided level, strictly between 0 and 1.

    Raises:
        InputError: if the lengths differ or are zero, or a number is out of range.

    >>> result = time_ratio([30.0] * 500, [30.0] * 500, 400)
    >>> result.ratio, result.verdict, [round(limit, 2) for limit in result.ci95]
    (1.0, 'non-inferior', [0.91, 1.09])
    """
    check_level(confidence)
    z2 = float(ndtri((1 + confidence) / 2)) ** 2
    (y, x), variances = _moments(method, other)
    of_method, of_other, shared = (z2 * variance for variance in variances)
    own = of_method + (z2 * one_seed(method, other, horizon)) ** 2
    ci = _fieller(x * x - of_other, x * y - shared, y * y - own)
    low, high = (min(max(limit, 1 / horizon), float(horizon)) for limit in ci)
    return TimeDifference(y / x, (low, high), margin, time_verdict((low, high), margin))


def _moments(method: ArrayLike, other: ArrayLike) -> tuple[tuple[float, float], tuple[float, float, float]]:
    """Return both means, and their variances and covariance, [n] pairs each."""
    method, other = checked_pairs(method, other)
    y, x = float(method.mean()), float(other.mean())
    a, b, scale = method - y, other - x, max(len(method) - 1, 1) * len(method)
    return (y, x), (float(a @ a) / scale, float(b @ b) / scale, float(a @ b) / scale)


def _fieller(a: float, b: float, c: float) -> tuple[float, float]:
    """Return where ``a r² - 2 b r + c`` is negative; all positive ratios where the other's mean could be zero."""
    if a <= 0:
        return 0.0, math.inf
    root = math.sqrt(max(b * b - a * c, 0.0))
    return (b - root) / a, (b + root) / a


def time_z(method: ArrayLike, other: ArrayLike, horizon: int, ratio: float) -> float:
    """Return by how many standard errors the method is faster than ``ratio`` times the other; negative if slower.

    The two-sided interval of `time_ratio` excludes ``ratio`` where this is beyond its normal quantile.

    Args:
        method, other, horizon: see `time_ratio`.
        ratio: the hypothesis, 1 + margin for non-inferiority.

    Raises:
        InputError: as `time_ratio`.

    >>> round(time_z([30.0] * 500, [30.0] * 500, 400, 1.1), 2)
    2.01
    """
    (y, x), (of_method, of_other, shared) = _moments(method, other)
    gain, spread = ratio * x - y, max(of_method - 2 * ratio * shared + ratio**2 * of_other, 0.0)
    floor = one_seed(method, other, horizon) ** 2
    # The variance holds z² itself: floor * z⁴ + spread * z² = gain².
    z2 = (math.sqrt(spread * spread + 4 * floor * gain * gain) - spread) / (2 * floor)
    return math.copysign(math.sqrt(z2), gain)


def one_seed(method: ArrayLike, other: ArrayLike, horizon: int) -> float:
    """Return the effect of one discordant seed on the mean time, in steps."""
    method, other = checked_pairs(method, other)
    solved = np.concatenate([method[method < horizon], other[other < horizon]])
    lost = horizon - float(solved.mean()) if len(solved) else float(horizon)
    return lost / len(method)


def time_verdict(ci: tuple[float, float], margin: float = DEFAULT_TIME_MARGIN) -> Verdict:
    """Judge a time-ratio interval: non-inferior if all below ``1 + margin``, inferior if all above, else inconclusive.

    >>> time_verdict((0.97, 1.06)), time_verdict((1.2, 1.4)), time_verdict((0.95, 1.15))
    ('non-inferior', 'inferior', 'inconclusive')
    """
    if not 0 < margin < 1:
        raise InputError(f"margin: expected a number strictly between 0 and 1, got {margin}")
    low, high = ci
    if high < 1 + margin:
        return "non-inferior"
    return "inferior" if low > 1 + margin else "inconclusive"


def allowed_steps(horizon: int, early_cut: int | None = None) -> list[int]:
    """Return the step limits for `success_within`: five octaves below the horizon, and the early cut.

    The limits follow from horizon and cut alone, so they cannot be chosen by the result.

    >>> allowed_steps(400, 36)[:5], allowed_steps(400)[-2:]
    ([12, 14, 16, 18, 20], [356, 400])
    """
    steps = {round(horizon * 2 ** (-index / _PER_OCTAVE)) for index in range(_PER_OCTAVE * _OCTAVES + 1)}
    return sorted({step for step in steps if step} | ({early_cut} if early_cut else set()))


def success_within(success: Sequence[bool], times: ArrayLike, steps: Sequence[int]) -> Mapping[int, float]:
    """Return the share of episodes solved within each number of steps.

    >>> success_within([True, True, False], [31, 80, 400], [30, 40, 400])
    {30: 0.0, 40: 0.3333333333333333, 400: 0.6666666666666666}
    """
    solved = np.asarray(times)[np.asarray(success, dtype=bool)]
    return {step: float((solved <= step).sum()) / len(success) for step in steps}


def correlation(method: ArrayLike, other: ArrayLike) -> float | None:
    """Return Pearson's correlation of two methods' times over the seeds; None if either is constant.

    Pairing shortens an interval only as far as this is above zero. Methods that draw the same noise at every denoising step
    share much of it with dense; those with other steps cannot.

    >>> correlation([1, 2, 3], [2, 4, 6]), correlation([1, 2, 3], [5, 5, 5])
    (1.0, None)
    """
    method, other = checked_pairs(method, other)
    if method.std() == 0 or other.std() == 0:
        return None
    return float(np.clip(np.corrcoef(method, other)[0, 1], -1, 1))
