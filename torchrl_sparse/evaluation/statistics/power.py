"""Before episodes are run: how many a verdict of non-inferiority will need.

Fixed numbers are exact: every outcome that n episodes can have is judged by the test that will judge it, Tango's of pairs or
Miettinen and Nurminen's of episodes that share no seed, and weighed by its probability. Sequential designs are simulated with
the same tests at the analyses of a `Design`, whose random numbers are fixed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln, ndtri, xlogy

from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.statistics.intervals import DEFAULT_MARGIN, tango_z
from torchrl_sparse.evaluation.statistics.overlap import miettinen_nurminen_z
from torchrl_sparse.evaluation.statistics.sequential import Design

__all__ = [
    "DEFAULT_ANALYSES",
    "DEFAULT_POWER",
    "Plan",
    "Truth",
    "fixed_plan",
    "fixed_power",
    "sequential_plan",
]

DEFAULT_POWER = 0.9
DEFAULT_ANALYSES = 30
_CRITICAL = float(ndtri(0.975))
_PATHS = 10_000
_CAP_TO_FIXED = 1.15  # about what a cap is of the fixed number with the same power
_REACH = 7.0  # standard deviations around the mean within which outcomes are counted
_MOST = 100_000  # episodes, beyond which no plan goes


@dataclass(frozen=True)
class Truth:
    """What is assumed of two methods.

    Attributes:
        success: rate of the one that is compared with.
        correlation: Pearson's, of both successes on a seed; 0 where seeds tell nothing.
        difference: rate of the method minus that rate.

    Raises:
        InputError: if no two methods are so.

    >>> [round(share, 3) for share in Truth(0.8, 0.5).cells]
    [0.72, 0.08, 0.08, 0.12]
    """

    success: float
    correlation: float = 0.0
    difference: float = 0.0

    def __post_init__(self) -> None:
        if not 0 < self.success < 1:
            raise InputError(
                f"success: expected a rate strictly between 0 and 1, got {self.success}; of a pilot take (k + 1) / (n + 2)"
            )
        if not 0 < self.rate < 1:
            raise InputError(
                f"difference: expected {-self.success:g} to {1 - self.success:g}, exclusive, got {self.difference}"
            )
        if min(self.cells) < -1e-12:
            raise InputError(
                f"correlation: expected one that rates of {self.rate:g} and {self.success:g} allow, got {self.correlation}"
            )

    @property
    def rate(self) -> float:
        """Success rate of the method."""
        return self.success + self.difference

    @property
    def cells(self) -> tuple[float, float, float, float]:
        """Shares of seeds that both solve, the method alone, the other alone, and none."""
        p, q = self.rate, self.success
        both = p * q + self.correlation * math.sqrt(p * (1 - p) * q * (1 - q))
        cells = (both, p - both, q - both, 1 - p - q + both)
        return tuple(0.0 if abs(share) < 1e-12 else share for share in cells)


@dataclass(frozen=True)
class Plan:
    """How many episodes of each method suffice.

    Attributes:
        episodes: of each method; of a sequential design the cap.
        expected: mean number of each until the verdict, where the assumptions hold.
        power: how likely the verdict then is non-inferior.
    """

    episodes: int
    expected: float
    power: float


def fixed_plan(
    truth: Truth, margin: float = DEFAULT_MARGIN, power: float = DEFAULT_POWER, *, paired: bool = True
) -> Plan:
    """Return the fewest episodes, fixed before they are run, that show non-inferiority with this power.

    Args:
        truth: see `Truth`.
        margin: of the verdict, a difference of rates.
        power: how likely the verdict is to be.
        paired: whether both methods run the same seeds.

    Raises:
        InputError: if a number is out of range, or the difference lies so near the margin that none suffice.

    >>> fixed_plan(Truth(0.9, 0.5), margin=0.1).episodes
    118
    """
    _check(truth, margin, power)
    p, q = truth.rate, truth.success
    spread = sum(truth.cells[1:3]) - truth.difference**2 if paired else p * (1 - p) + q * (1 - q)
    far = (_CRITICAL + float(ndtri(power))) / (margin + truth.difference)
    if (guess := math.ceil(spread * far**2) + 1) > _MOST:
        raise InputError(
            f"margin: expected one that {_MOST} episodes show, got {margin}, which takes about {guess}"
        )
    found = _fewest(lambda n: fixed_power(truth, n, margin, paired=paired) >= power, guess)
    return Plan(found, found, fixed_power(truth, found, margin, paired=paired))


def fixed_power(truth: Truth, episodes: int, margin: float = DEFAULT_MARGIN, *, paired: bool = True) -> float:
    """Return how likely this number of episodes of each method shows non-inferiority, by enumeration of what they can be.

    >>> round(fixed_power(Truth(0.8), 100, 0.1, paired=False), 2)
    0.42
    """
    n = episodes
    if paired:
        _, won, lost, _ = truth.cells
        first, second = _near(n, won)[:, None], _near(n, lost)[None, :]
        rest = n - first - second
        log = gammaln(n + 1) - gammaln(first + 1) - gammaln(second + 1) - gammaln(np.maximum(rest, 0) + 1)
        log = log + xlogy(first, won) + xlogy(second, lost) + xlogy(rest, 1 - won - lost)
        share = np.where(rest >= 0, np.exp(np.where(rest >= 0, log, 0.0)), 0.0)
        z = tango_z(np.minimum(first, n - second), second, n, -margin)
        return float(share[z > _CRITICAL].sum())
    first, second = _near(n, truth.rate), _near(n, truth.success)
    share = _binomial(n, first, truth.rate)[:, None] * _binomial(n, second, truth.success)
    z = miettinen_nurminen_z(first[:, None], n, second[None, :], n, -margin)
    return float(share[z > _CRITICAL].sum())


def sequential_plan(
    truth: Truth,
    margin: float = DEFAULT_MARGIN,
    power: float = DEFAULT_POWER,
    analyses: int = DEFAULT_ANALYSES,
    *,
    paired: bool = True,
) -> Plan:
    """Return the smallest cap of a `Design` that shows non-inferiority with this power, and the mean number until it stops.

    Args:
        truth, margin, power, paired: see `fixed_plan`.
        analyses: of the design; the cap is a multiple of them.

    Raises:
        InputError: as `fixed_plan`.
    """
    fixed = fixed_plan(truth, margin, power, paired=paired).episodes

    @cache
    def shown(rounds: int) -> Plan:
        return _simulate(truth, margin, Design(rounds * analyses, analyses), paired)

    guess = math.ceil(_CAP_TO_FIXED * fixed / analyses)
    return shown(_fewest(lambda rounds: shown(rounds).power >= power, guess))


def _simulate(truth: Truth, margin: float, design: Design, paired: bool) -> Plan:
    """Run a design many times with fixed random numbers."""
    generator = np.random.default_rng(0)
    each = np.diff([0, *design.ends])
    if paired:
        drawn = generator.multinomial(each, truth.cells, size=(_PATHS, len(each))).cumsum(axis=1)
        won, lost = drawn[..., 1], drawn[..., 2]
    else:
        won, lost = (
            generator.binomial(each, rate, size=(_PATHS, len(each))).cumsum(axis=1)
            for rate in (truth.rate, truth.success)
        )
    left, shown, episodes = np.ones(_PATHS, dtype=bool), 0, 0
    for analysis, end in enumerate(design.ends):
        ours, theirs = won[left, analysis], lost[left, analysis]
        z = (
            tango_z(ours, theirs, end, -margin)
            if paired
            else miettinen_nurminen_z(ours, end, theirs, end, -margin)
        )
        critical, last = design.critical(end), analysis == len(design.ends) - 1
        stopped = (np.abs(z) > critical) | last
        shown += int((z > critical).sum())
        episodes += end * int(stopped.sum())
        left[np.flatnonzero(left)[stopped]] = False
    return Plan(design.max_episodes, episodes / _PATHS, shown / _PATHS)


def _check(truth: Truth, margin: float, power: float) -> None:
    for name, value in (("margin", margin), ("power", power)):
        if not 0 < value < 1:
            raise InputError(f"{name}: expected a number strictly between 0 and 1, got {value}")
    if truth.difference <= -margin:
        raise InputError(
            f"difference: expected above minus the margin of {margin:g}, where no number of episodes shows it, "
            f"got {truth.difference}"
        )


def _fewest(enough: Callable[[int], bool], guess: int) -> int:
    """Return a number that is enough and whose predecessor is not; more are taken to be enough too."""
    low, high = 0, guess
    while not enough(high):
        low, high = high, high + max(1, high // 8)
    step = max(1, high // 8)
    while low < high - step and enough(high - step):
        high -= step
    low = max(low, high - step)
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if enough(middle) else (middle, high)
    return high


def _near(n: int, share: float) -> NDArray[np.int64]:
    """Return the counts within reach of a binomial's mean."""
    reach = _REACH * math.sqrt(n * share * (1 - share)) + _REACH
    return np.arange(max(0, math.floor(n * share - reach)), min(n, math.ceil(n * share + reach)) + 1)


def _binomial(n: int, k: NDArray[np.int64], share: float) -> NDArray[np.float64]:
    log = gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1) + xlogy(k, share) + xlogy(n - k, 1 - share)
    return np.exp(log)
