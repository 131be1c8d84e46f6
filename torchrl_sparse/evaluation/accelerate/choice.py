"""Ranking of candidates before episodes are played, and the choice among those that were played."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import chain, zip_longest

from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.results.acceleration import FAMILIES, Candidate, Played
from torchrl_sparse.evaluation.results.schema import DENSE

__all__ = ["choose", "rank", "within_budget"]


def within_budget(candidates: Mapping[str, Candidate], budget_ms: float | None) -> list[str]:
    """Return the methods within the time budget, without dense.

    Args:
        candidates: dense among them.
        budget_ms: of the 95th percentile, since a late answer is late however fast the median is; None for methods whose
            median is below dense's.

    Raises:
        InputError: if there is none.
    """
    others = {name: candidate for name, candidate in candidates.items() if name != DENSE}
    if budget_ms is None:
        limit = candidates[DENSE].latency_s.p50
        fast = [name for name, candidate in others.items() if candidate.latency_s.p50 < limit]
        if not fast:
            raise InputError("budget_ms: expected a candidate that is faster than dense, got none")
        return fast
    fast = [name for name, candidate in others.items() if 1e3 * candidate.latency_s.p95 <= budget_ms]
    if not fast:
        name = min(others, key=lambda name: others[name].latency_s.p95)
        needed = 1e3 * others[name].latency_s.p95
        raise InputError(
            f"budget_ms: expected at least {needed:.3g}, what the fastest candidate, {name}, takes here, got {budget_ms:g}"
        )
    return fast


def rank(names: Sequence[str], candidates: Mapping[str, Candidate], budget_ms: float | None) -> list[str]:
    """Order methods by promise: first the best of every family, then the second best of every family, and so on.

    With a budget, which all of them keep, the one of least error is the most promising. Without one it is the fastest of those
    that are no farther from demonstrations than dense, before the others by error.

    The error compares chains of one family only: a chain without noise averages several good actions, which is close to
        demonstrations in the mean but may still cost success.

    Examples:
        >>> from torchrl_sparse.evaluation.results.parts import Percentiles
        >>> tried = [("a", "stochastic", 0.3), ("b", "deterministic", 0.1), ("c", "stochastic", 0.2)]
        >>> candidates = {name: Candidate(kind, error, Percentiles(0.01, 0.02, 1)) for name, kind, error in tried}
        >>> rank(["a", "b", "c"], candidates, budget_ms=50)
        ['c', 'b', 'a']
    """
    by_error = budget_ms is not None

    def promise(name: str) -> tuple[bool, float]:
        candidate = candidates[name]
        if by_error or candidate.error > candidates[DENSE].error:
            return True, candidate.error
        return False, candidate.latency_s.p50

    families = [[n for n in names if candidates[n].family == family] for family in FAMILIES]
    ordered = [sorted(members, key=promise) for members in families]
    return [name for name in chain.from_iterable(zip_longest(*ordered)) if name is not None]


def choose(
    ranking: Sequence[str],
    candidates: Mapping[str, Candidate],
    played: Mapping[str, Played],
    budget_ms: float | None,
) -> str:
    """Return the chosen method.

    Of the methods that are non-inferior to dense in success and in time, or in the score of a graded task: with a
    budget, which all of them keep, the one that is surest; else the fastest. Where none is shown to be, the one whose interval
    reaches least below dense. Where none was played, the first of the ranking.
    """
    tried = [name for name in ranking if name in played]
    if not tried:
        return ranking[0]
    right = [name for name in tried if played[name].is_right]
    if right and budget_ms is None:
        return min(right, key=lambda name: candidates[name].latency_s.p50)
    return max(right or tried, key=lambda name: played[name].judged.ci95[0])
