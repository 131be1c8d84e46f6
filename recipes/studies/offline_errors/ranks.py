"""Rank correlation of two numbers over several groups whose members must not be compared across groups."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import rankdata

__all__ = ["difference_ci95", "mean_rank_correlation", "rank_correlation"]

Numbers = Sequence[float]


def rank_correlation(xs: Numbers, ys: Numbers) -> float:
    """Return Spearman's rank correlation, with mean ranks for ties; 0 if either input is constant.

    >>> rank_correlation([1, 2, 3], [10, 30, 20]), rank_correlation([1, 2, 3], [5, 5, 5])
    (0.5, 0.0)
    """
    return float(_correlations(np.asarray(xs), np.asarray(ys)))


def mean_rank_correlation(
    groups: Sequence[tuple[Numbers, Numbers]], *, trials: int = 10_000, seed: int = 0
) -> tuple[float, float]:
    """Return the size-weighted mean rank correlation of groups, and how often chance makes one as large.

    Args:
        groups: pairs of equally many x and y.
        trials: how often the y of each group are put in random order.
        seed: of the orders.

    Returns:
        The mean, and the two-sided p-value of the permutation test, at least ``1 / (trials + 1)``.

    >>> mean_rank_correlation([([1, 2, 3, 4, 5, 6], [1, 2, 3, 4, 5, 6]), ([1, 2, 3], [3, 2, 1])])[0]
    0.3333333333333333
    """
    rng, sizes = np.random.default_rng(seed), [len(xs) for xs, _ in groups]
    found = np.average([rank_correlation(*group) for group in groups], weights=sizes)
    shuffled = (rng.permuted(np.tile(ys, (trials, 1)), axis=1) for _, ys in groups)
    drawn = [_correlations(np.asarray(xs), orders) for (xs, _), orders in zip(groups, shuffled, strict=True)]
    by_chance = np.average(drawn, axis=0, weights=sizes)
    as_large = int((np.abs(by_chance) >= abs(found) - 1e-12).sum())
    return float(found), (1 + as_large) / (1 + trials)


def difference_ci95(
    groups: Sequence[tuple[Numbers, Numbers, Numbers]], *, draws: int = 10_000, seed: int = 0
) -> tuple[float, float]:
    """Return the 95 % interval of how much better x correlates with y than another number does.

    Args:
        groups: equally many of x, of the other number and of y; see `mean_rank_correlation`.
        draws: of the bootstrap, which draws the members of each group again.
        seed: of the draws.

    >>> x = [*range(20)]
    >>> difference_ci95([(x, x, x)]), difference_ci95([(x, x[::-1], x)])
    ((0.0, 0.0), (2.0, 2.0))
    """
    rng, sizes, more = np.random.default_rng(seed), [len(xs) for xs, _, _ in groups], []
    for group in groups:
        members = rng.integers(len(group[0]), size=(draws, len(group[0])))
        ours, theirs, ys = (np.asarray(numbers)[members] for numbers in group)
        more.append(_correlations(ours, ys) - _correlations(theirs, ys))
    low, high = np.percentile(np.average(more, axis=0, weights=sizes), [2.5, 97.5])
    return round(float(low), 12), round(float(high), 12)


def _correlations(xs: np.ndarray, ys: np.ndarray) -> np.ndarray:
    """Return the rank correlations of the last dimension."""
    a, b = _centred(xs), _centred(ys)
    size = np.sqrt((a * a).sum(-1) * (b * b).sum(-1))
    return np.where(size > 0, (a * b).sum(-1) / np.where(size > 0, size, 1), 0.0)


def _centred(values: np.ndarray) -> np.ndarray:
    ranks = rankdata(values, axis=-1)
    return ranks - ranks.mean(-1, keepdims=True)
