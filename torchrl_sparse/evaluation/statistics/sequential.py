"""Sequential designs: episodes continue until the verdict is reached, with the error rate controlled over interim analyses.

A `Design` analyses the episodes after equal numbers of them, up to a cap. An analysis uses the ordinary intervals at a higher
level, ``2 Φ(c) - 1`` with the critical value ``c = C t^(1/4 - 1/2)`` of Wang and Tsiatis' family (Biometrics 43, 1987), t being
the share of the cap. C makes a Brownian motion cross one of the limits with 5 % at any of the analyses (Armitage, McPherson and
Rowe, JRSS A 132, 1969), so that the intervals of *all* analyses hold together with 95 %: they are repeated confidence intervals
(Jennison and Turnbull, JRSS B 51, 1989), valid whatever rule stops. A verdict at the margin is wrong with at most 2.5 %, as
that of a fixed number of episodes.

STEP (arXiv:2503.10966), the anchor of sequential comparisons of policies, spends its error over a known cap too, for unpaired
successes and the null of no difference; here episodes are paired, the null is a margin, and times are judged beside successes.
N-SCORE (arXiv:2603.13616) bets on bounded scores and holds without a cap and without the normal approximation; a cap that is
known makes the limits here closer. How the approximation holds with 30 analyses is simulated (the study `simulate_stopping`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import ndtr

from torchrl_sparse.errors import InputError

__all__ = ["Design"]

_SHAPE = 0.25  # between Pocock's limits (0.5), which stop early, and O'Brien and Fleming's (0), which lose no power
_ERROR = 0.05  # of both sides together
_NODES = 128  # of the integral over where a motion is that has not crossed
_LARGEST_Z = 8.0  # beyond, a p-value is below 1e-15, and the nodes of the integral lie too far apart


@dataclass(frozen=True)
class Design:
    """Sequential design: the numbers of episodes at the analyses, and the level of each.

    Attributes:
        max_episodes: the cap.
        analyses: at most so many, the last at the cap. One analysis is the ordinary fixed number of episodes.

    Raises:
        InputError: if a number is below 1 or there are more analyses than episodes.

    >>> design = Design(1300, analyses=30)
    >>> design.ends[:3], design.ends[-1]
    ((43, 86, 130), 1300)
    >>> round(design.confidence(1300), 4), Design(400).confidence(400)
    (0.9769, 0.95)
    """

    max_episodes: int
    analyses: int = 1

    def __post_init__(self) -> None:
        if not 1 <= self.analyses <= self.max_episodes:
            raise InputError(
                f"analyses: expected 1 to max_episodes = {self.max_episodes}, got {self.analyses}"
            )

    @cached_property
    def ends(self) -> tuple[int, ...]:
        """Number of episodes at each analysis."""
        return tuple(
            self.max_episodes * analysis // self.analyses for analysis in range(1, self.analyses + 1)
        )

    def critical(self, episodes: int) -> float:
        """Return the number of standard errors beyond which an analysis is significant.

        Raises:
            InputError: if there is no analysis after so many episodes.
        """
        if episodes not in self.ends:
            raise InputError(f"episodes: expected an analysis of the design ({self.ends}), got {episodes}")
        return _constant(self._times) * self._time(episodes) ** (_SHAPE - 0.5)

    def confidence(self, episodes: int) -> float:
        """Return the two-sided level of an analysis' intervals; over all analyses they hold together with 95 %."""
        if self.analyses == 1:
            return 1 - _ERROR
        return 1 - 2 * float(ndtr(-self.critical(episodes)))

    def decides(self, episodes: int, *statistics: float) -> bool:
        """Tell whether a method's verdict is reached at an analysis: non-inferior in every statistic, or inferior in any.

        Args:
            episodes: at the analysis.
            statistics: standard errors above the margin: `tango_z` of successes, `time_z` of times.
        """
        critical = self.critical(episodes)
        return min(statistics) > critical or min(statistics) < -critical

    def p_value(self, z: float, episodes: int) -> float:
        """Return the one-sided p-value of a statistic at an analysis: the error level whose limit it just reaches.

        >>> round(Design(400).p_value(1.96, 400), 4), round(Design(400, 20).p_value(1.96, 400), 3)
        (0.025, 0.052)
        """
        if z <= 0:
            return 0.5
        z = min(z, _LARGEST_Z)
        if self.analyses == 1:
            return float(ndtr(-z))
        constant = z * self._time(episodes) ** (0.5 - _SHAPE)
        return max(_crossing(constant, self._times) / 2, float(ndtr(-z)))

    @cached_property
    def _times(self) -> tuple[float, ...]:
        return tuple(self._time(episodes) for episodes in self.ends)

    def _time(self, episodes: int) -> float:
        return episodes / self.max_episodes


@cache
def _constant(times: tuple[float, ...]) -> float:
    return float(brentq(lambda constant: _crossing(constant, times) - _ERROR, 1.9, 4.0, xtol=1e-6))


@cache
def _quadrature() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return np.polynomial.legendre.leggauss(_NODES)


def _crossing(constant: float, times: tuple[float, ...]) -> float:
    """Return how likely a Brownian motion is beyond ``±constant * t^shape`` at any of these times."""
    nodes, weights = _quadrature()
    before, mass, earlier = np.zeros(1), np.ones(1), 0.0
    for time in times:
        limit = constant * time**_SHAPE
        here = limit * nodes
        spread = math.sqrt(time - earlier)
        step = np.exp(-(((here[:, None] - before) / spread) ** 2) / 2) / (spread * math.sqrt(2 * math.pi))
        before, mass, earlier = here, limit * weights * (step @ mass), time
    return max(1 - float(mass.sum()), 0.0)
