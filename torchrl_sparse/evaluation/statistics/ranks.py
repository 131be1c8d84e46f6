"""Whether two numbers order the same things alike, over several groups that are not to be mixed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import rankdata

__all__ = ["mean_rank_correlation", "rank_correlation"]

Group = tuple[Sequence[float], Sequence[float]]


def rank_correlation(xs: Sequence[float], ys: Sequence[float]) -> float:
    """Return Spearman's rank correlation, ties at their mean rank; 0 where one of them tells nothing apart.

    >>> rank_correlation([1, 2, 3], [10, 30, 20]), rank_correlation([1, 2, 3], [5, 5, 5])
    (0.5, 0.0)
    """
    a, b = _centred(xs), _centred(ys)
    size = np.sqrt((a @ a) * (b @ b))
    return float(a @ b / size) if size else 0.0


def mean_rank_correlation(
    groups: Sequence[Group], *, trials: int = 10_000, seed: int = 0
) -> tuple[float, float]:
    """Return the mean rank correlation of groups, each weighed by its size, and how often chance makes one as large.

    Args:
        groups: pairs of equally many x and y.
        trials: how often the y of each group are drawn in random order.
        seed: of the orders.

    Returns:
        The mean, and the two-sided p-value of the permutation test, at least ``1 / (trials + 1)``.

    >>> mean_rank_correlation([([1, 2, 3, 4, 5, 6], [1, 2, 3, 4, 5, 6]), ([1, 2, 3], [3, 2, 1])])[0]
    0.3333333333333333
    """
    rng = np.random.default_rng(seed)
    total, found, drawn = sum(len(xs) for xs, _ in groups), 0.0, np.zeros(trials)
    for xs, ys in groups:
        a, b = _centred(xs), _centred(ys)
        if not (size := np.sqrt((a @ a) * (b @ b))):
            continue
        found += len(xs) / total * float(a @ b / size)
        drawn += len(xs) / total * (rng.permuted(np.tile(b, (trials, 1)), axis=1) @ a) / size
    as_large = int((np.abs(drawn) >= abs(found) - 1e-12).sum())
    return found, (1 + as_large) / (1 + trials)


def _centred(values: Sequence[float]) -> np.ndarray:
    ranks = rankdata(values)
    return ranks - ranks.mean()
