"""Pairs of episodes and further ones of dense alone: a mean that many episodes know helps a mean that few know.

All methods run on dense's seeds, and dense may have run on more. The pairs tell how far a method follows dense, the slope β of
its regression on it, and so what dense's better known mean says of the method's (a control variate; W. G. Cochran, Sampling
Techniques, 3rd ed., 1977, ch. 7)::

    μ_method = mean of the method's n + β (mean of dense's N - mean of dense's on the n seeds)
    Var(μ_method - r μ_dense) = (1 - ρ²) σ_method² (1 + u) / n + (β - r)² σ_dense² / N,    u = (1 - n / N) / (n - 2)

where u is for not knowing the slope. Without further episodes, N = n, this is the paired comparison. A method that follows
dense exactly (β = r) gains nothing, one of the same spread that has nothing in common with it (β = 0) up to half the variance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["Further", "Means", "checked_pairs"]


@dataclass(frozen=True)
class Means:
    """Two means that are estimated together.

    Attributes:
        method: mean of the method.
        other: mean of the one that it is compared with, over all of its episodes.
        slope: of the method on the other, from the pairs.
        residual: variance of the method's numbers that the other's do not explain.
        spread: variance of the other's.
        n: pairs.
        total: episodes of the other.

    Examples:
        >>> Means.of([2.0, 4.0, 6.0], [1.0, 2.0, 3.0], more=[6.0])
        Means(method=6.0, other=3.0, slope=2.0, residual=0.0, spread=4.666666666666667, n=3, total=4)
    """

    method: float
    other: float
    slope: float
    residual: float
    spread: float
    n: int
    total: int

    @classmethod
    def of(cls, method: ArrayLike, other: ArrayLike, more: ArrayLike = ()) -> Means:
        """Estimate from one number an episode.

        Args:
            method: [n].
            other: of the other on the same seeds in the same order, [n].
            more: of the other on further seeds, [N - n].

        Raises:
            ValueError: if the lengths of the pairs differ or are zero.
        """
        method, other = checked_pairs(method, other)
        ours, theirs, degrees = float(method.mean()), float(other.mean()), max(len(method) - 1, 1)
        varies = other.min() < other.max()  # else what is left of it would be rounding
        a, b = method - ours, other - theirs
        explained = float(b @ b) / degrees if varies else 0.0
        slope = float(a @ b) / degrees / explained if explained else 0.0
        more = np.asarray(more, dtype=np.float64)
        mean, spread = theirs, explained
        if len(more):
            everything = np.concatenate([other, more])
            mean, spread = float(everything.mean()), float(everything.var(ddof=1))
        return cls(
            method=ours + slope * (mean - theirs),
            other=mean,
            slope=slope,
            residual=max(float(a @ a) / degrees - slope**2 * explained, 0.0),
            spread=spread,
            n=len(method),
            total=len(method) + len(more),
        )

    @property
    def unpaired(self) -> float:
        """Share of the other's episodes that are in no pair."""
        return 1 - self.n / self.total

    @property
    def own_variance(self) -> float:
        """Variance of ``method`` that the other does not explain."""
        return self.residual / self.n * (1 + self.unpaired / max(self.n - 2, 1))

    @property
    def other_variance(self) -> float:
        """Variance of ``other``."""
        return self.spread / self.total

    def variance(self, ratio: float) -> float:
        """Return the variance of ``method - ratio * other``."""
        return self.own_variance + (self.slope - ratio) ** 2 * self.other_variance

    def known(self, ratio: float) -> float:
        """Return by how much the variance of one of n pairs was larger if there were no further episodes."""
        alone = self.residual + (self.slope - ratio) ** 2 * self.spread
        return max(alone - self.n * self.variance(ratio), 0.0)


@dataclass(frozen=True)
class Further:
    """What further episodes of the other say of a difference of success rates, beside its pairs.

    Attributes:
        shift: what they add to the difference of the pairs.
        known: the variance of a pair that they spare.
        share: of whatever variance a hypothesis gives a pair, the largest that may count as spared: a method without a failure
            so far looks surer than it is.
    """

    shift: float = 0.0
    known: float = 0.0
    share: float = 0.0

    @classmethod
    def of(cls, method: ArrayLike, other: ArrayLike, more: ArrayLike = ()) -> Further:
        """Estimate it from successes. Pairs in which the other always or never succeeds tell no slope; then they stand alone.

        Args:
            method, other, more: see `Means.of`, which raises.

        >>> Further.of([True, False, True], [True, True, False])
        Further(shift=0.0, known=0.0, share=0.0)
        >>> Further.of([True, False] * 20, [True, True, False, False] * 10, more=[True] * 40).shift
        -0.25
        """
        ours, theirs = checked_pairs(method, other)
        if not len(np.asarray(more)) or theirs.min() == theirs.max():
            return cls()
        means = Means.of(method, other, more)
        alone = float(ours.mean() - theirs.mean())
        return cls(means.method - means.other - alone, means.known(1), means.unpaired / 2)

    def left(self, variance: float) -> float:
        """Return what is left of the variance of a pair."""
        return variance - min(self.known, self.share * variance)


def checked_pairs(method: ArrayLike, other: ArrayLike) -> tuple[NDArray, NDArray]:
    """Return both as f64 [n], or raise ValueError if they are no pairs."""
    method, other = np.asarray(method, dtype=np.float64), np.asarray(other, dtype=np.float64)
    if method.shape != other.shape or method.ndim != 1 or not len(method):
        raise ValueError(
            f"pairs need as many episodes of both, and at least one, got {method.size} and {other.size}"
        )
    return method, other
