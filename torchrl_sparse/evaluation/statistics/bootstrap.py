"""Bootstrap interval of a ratio of medians, resampled over measurement rounds."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchrl_sparse.errors import InputError

__all__ = ["median_ratio_interval"]

_DRAWS = 4000
_LIMITS = (2.5, 97.5)


def median_ratio_interval(numerator: ArrayLike, denominator: ArrayLike) -> tuple[float, float]:
    """Return the 95 % percentile interval of the ratio of two medians, by resampling rounds with replacement.

    A round timed both, one right after the other: drawn together, what slowed the machine in it slows both.

    Args:
        numerator, denominator: seconds of each round, [rounds], in the order of the rounds.

    Raises:
        InputError: if they are not as many, or none.

    >>> median_ratio_interval([2.0, 2.0, 2.0], [1.0, 1.0, 1.0])
    (2.0, 2.0)
    """
    top, bottom = np.asarray(numerator, dtype=np.float64), np.asarray(denominator, dtype=np.float64)
    if top.shape != bottom.shape or not top.size:
        raise InputError(
            f"rounds: expected as many of both, and at least one, got {top.size} and {bottom.size}"
        )
    rounds = _draw(np.random.default_rng(0), len(top))
    return _limits(np.median(top[rounds], axis=1) / np.median(bottom[rounds], axis=1))


def _draw(generator: np.random.Generator, n: int) -> NDArray[np.int64]:
    """Return indices [draws, n], with a fixed seed so that a table is the same whenever it is made."""
    return generator.integers(n, size=(_DRAWS, n))


def _limits(values: NDArray) -> tuple[float, float]:
    low, high = np.percentile(values, _LIMITS)
    return float(low), float(high)
