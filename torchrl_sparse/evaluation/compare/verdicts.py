"""Methods against one of them, by the design that their episodes have."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

from scipy.special import ndtr

from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.compare.outcomes import MethodOutcomes, Outcome, Start
from torchrl_sparse.evaluation.statistics.differences import Difference, TimeDifference
from torchrl_sparse.evaluation.statistics.durations import (
    DEFAULT_TIME_MARGIN,
    restricted_times,
    time_ratio,
    time_z,
)
from torchrl_sparse.evaluation.statistics.intervals import DEFAULT_MARGIN, verdict
from torchrl_sparse.evaluation.statistics.multiplicity import holm
from torchrl_sparse.evaluation.statistics.overlap import OverlapCounts

__all__ = ["Comparison", "Verdicts", "compare_methods"]

_ERROR = 0.05  # of the family of all pairs, both sides


@dataclass(frozen=True)
class Comparison:
    """A method against the reference.

    Attributes:
        method: its name.
        counts: what both solved, in pairs and alone.
        success: the difference of rates and its verdict.
        p_equal: two-sided, of no difference.
        p_value: one-sided, of the verdict.
        time: ratio of restricted mean times on the seeds that both ran; None where the files do not tell it.
        time_p: one-sided, of its verdict.
    """

    method: str
    counts: OverlapCounts
    success: Difference
    p_equal: float
    p_value: float
    time: TimeDifference | None = None
    time_p: float | None = None

    @property
    def design(self) -> Literal["paired", "partly paired", "unpaired"]:
        """What the episodes of both have in common."""
        if self.counts.paired:
            return "paired"
        return "partly paired" if self.counts.pairs else "unpaired"


@dataclass(frozen=True)
class Verdicts:
    """All methods against the reference, and against each other.

    Attributes:
        reference: that all others are compared with.
        methods: all of them, the reference included.
        comparisons: of the others.
        lasting: verdicts that survive Holm's correction, as ``"NAME success"`` and ``"NAME time"``.
        best: methods that none of the others beats, see `compare_methods`; empty of two.
    """

    reference: MethodOutcomes
    methods: Sequence[MethodOutcomes]
    comparisons: Sequence[Comparison]
    lasting: frozenset[str]
    best: Sequence[str] = ()

    @property
    def num_verdicts(self) -> int:
        """Verdicts that Holm's correction was made for."""
        return sum(1 + (one.time is not None) for one in self.comparisons)


def compare_methods(
    methods: Sequence[MethodOutcomes],
    reference: str | None = None,
    margin: float = DEFAULT_MARGIN,
    time_margin: float = DEFAULT_TIME_MARGIN,
    horizon: int | None = None,
) -> Verdicts:
    """Compare all methods with one of them.

    Episodes that began at the same are pairs. Where all are, the interval is Tango's; where none is, Miettinen and Nurminen's;
    in between both parts count, see `OverlapCounts`. Of three methods and more, Holm's correction of the two-sided p-values of
    all pairs leaves those that none beats: the best is among them with 95 %.

    Args:
        methods: at least two.
        reference: name of the one that others are compared with; None is the first.
        margin, time_margin: of the verdicts.
        horizon: steps after which an episode is truncated; None is what the files tell.

    Raises:
        InputError: if there are fewer than two methods, none of that name, or methods of different tasks.
    """
    if len(methods) < 2:
        raise InputError(
            f"files: expected at least two methods, got {', '.join(one.name for one in methods)}"
        )
    known = {method.name: method for method in methods}
    if reference is not None and reference not in known:
        raise InputError(f"reference: expected one of {', '.join(known)}, got {reference!r}")
    base = known[reference or methods[0].name]
    comparisons = [
        _compare(method, base, margin, time_margin, horizon) for method in methods if method is not base
    ]
    p_values = {f"{one.method} success": one.p_value for one in comparisons}
    p_values |= {f"{one.method} time": one.time_p for one in comparisons if one.time_p is not None}
    best = _best(methods) if len(methods) > 2 else ()
    return Verdicts(base, methods, comparisons, frozenset(holm(p_values)), best)


def _compare(
    method: MethodOutcomes, other: MethodOutcomes, margin: float, time_margin: float, horizon: int | None
) -> Comparison:
    counts = _overlap(method, other)
    ci, z = counts.interval(), counts.z(-margin)
    difference = Difference(counts.difference, ci, margin, verdict(ci, margin))
    p_value, compared = float(ndtr(-abs(z))), _compare_times(method, other, time_margin, horizon)
    if not method.solved + other.solved:  # as alike as two policies that do nothing
        difference, p_value, compared = replace(difference, verdict="inconclusive"), 0.5, (None, None)
    return Comparison(method.name, counts, difference, counts.p_equal(), p_value, *compared)


def _overlap(method: MethodOutcomes, other: MethodOutcomes) -> OverlapCounts:
    if method.tasks and other.tasks and not method.tasks & other.tasks:
        raise InputError(
            f"{method.source}: expected episodes of {_few(other.tasks)}, as {other.source}, got {_few(method.tasks)}"
        )
    pairs = _pairs(method, other)
    cells = [(ours.success, theirs.success) for ours, theirs in pairs.values()]
    alone = tuple(
        (
            one.solved - sum(pair[side] for pair in cells),
            len(one.outcomes) - len(cells),
        )
        for side, one in enumerate((method, other))
    )
    count = {(a, b): cells.count((a, b)) for a in (True, False) for b in (True, False)}
    return OverlapCounts(
        count[True, True], count[True, False], count[False, True], count[False, False], *alone
    )


def _pairs(method: MethodOutcomes, other: MethodOutcomes) -> dict[Start, tuple[Outcome, Outcome]]:
    ours, theirs = method.by_start, other.by_start
    return {start: (outcome, theirs[start]) for start, outcome in ours.items() if start in theirs}


def _compare_times(
    method: MethodOutcomes, other: MethodOutcomes, margin: float, horizon: int | None
) -> tuple[TimeDifference | None, float | None]:
    """Compare times to success where both files tell them, and whatever was not solved ran to the horizon."""
    pairs = [pair for pair in _pairs(method, other).values() if not (pair[0].error or pair[1].error)]
    steps = [outcome.steps for pair in pairs for outcome in pair]
    if len(pairs) < 2 or None in steps:
        return None, None
    limit = horizon or method.horizon or other.horizon
    unsolved = {outcome.steps for pair in pairs for outcome in pair if not outcome.success}
    if limit is None and len(unsolved) == 1:
        limit = unsolved.pop()
    early = [
        outcome.steps for pair in pairs for outcome in pair if outcome.success and outcome.steps != limit
    ]
    if limit is None or not early:
        return None, None
    times = []
    for side, one in enumerate((method, other)):
        told = [pair[side] for pair in pairs]
        try:
            times.append(restricted_times([o.success for o in told], [o.steps for o in told], limit))
        except InputError as error:
            if horizon is None:  # some episode was given up, which is no time
                return None, None
            raise InputError(f"{one.source}: {error}") from error
    return time_ratio(*times, limit, margin), float(ndtr(-abs(time_z(*times, limit, 1 + margin))))


def _best(methods: Sequence[MethodOutcomes]) -> list[str]:
    """Return the methods that none is shown to beat in success, all pairs being corrected together."""
    p_values, worse = {}, {}
    for index, (first, second) in enumerate(combinations(methods, 2)):
        counts, name = _overlap(first, second), str(index)
        p_values[name] = counts.p_equal()
        worse[name] = second.name if counts.difference > 0 else first.name
    beaten = {worse[name] for name in holm(p_values, error=_ERROR)}
    return [method.name for method in methods if method.name not in beaten]


def _few(tasks: set[str]) -> str:
    return ", ".join(sorted(tasks)[:3])
