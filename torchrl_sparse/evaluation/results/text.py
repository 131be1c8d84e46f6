"""Formatting of numbers for tables."""

from __future__ import annotations

from torchrl_sparse.evaluation.results.parts import Success
from torchrl_sparse.evaluation.statistics.differences import Difference, Interval, TimeDifference

__all__ = [
    "NONE_SOLVED",
    "NO_VERDICT",
    "count_text",
    "difference_text",
    "mean_text",
    "milliseconds_text",
    "p_text",
    "points_text",
    "ratio_text",
    "threads_text",
    "verdict_text",
]

NONE_SOLVED = (
    "Dense solved none: whatever a method loses, no verdict here can show it. Is the policy observed, and are its chunks "
    "executed, as it was trained?"
)
"""What is said of episodes that tell methods apart by nothing."""

NO_VERDICT = "dense solved none"
"""What stands in place of each verdict then."""


def count_text(success: Success) -> str:
    """Format solved episodes with the interval of their rate.

    >>> count_text(Success(3, 4, 0.75, (0.3006, 0.9544)))
    '3/4 [30, 95] %'
    """
    return f"{success.k}/{success.n} {percent_range(success.ci95)} %"


def difference_text(difference: Difference) -> str:
    """Format a difference of success rates with its interval, in points."""
    return points_text(difference.diff, difference.ci95)


def mean_text(mean: float, interval: Interval) -> str:
    """Format a mean score with its interval.

    >>> mean_text(0.7049, (0.6502, 0.7606))
    '0.705 [0.650, 0.761]'
    """
    return f"{mean:.3f} [{interval[0]:.3f}, {interval[1]:.3f}]"


def points_text(diff: float, interval: Interval) -> str:
    """Format a difference of rates with its interval, in points.

    >>> points_text(-0.03, (-0.053, 0.014))
    '-3.0 [-5.3, +1.4]'
    """
    low, high = (f"{100 * limit:+.1f}" for limit in interval)
    return f"{100 * diff:+.1f} [{low}, {high}]"


def p_text(p: float | None) -> str:
    """Format a p-value with two digits; empty for None.

    >>> p_text(0.0703125), p_text(1.0), p_text(3e-7), p_text(None)
    ('0.070', '1.00', '<0.001', '')
    """
    if p is None:
        return ""
    return "<0.001" if p < 1e-3 else f"{p:.3f}" if p < 0.1 else f"{p:.2f}"


def ratio_text(difference: TimeDifference) -> str:
    """Format a ratio of times with its interval.

    >>> ratio_text(TimeDifference(1.06, (0.951, 1.182), 0.1, "inconclusive"))
    '1.06 [0.95, 1.18]'
    """
    low, high = (f"{limit:.2f}" for limit in difference.ci95)
    return f"{difference.ratio:.2f} [{low}, {high}]"


def verdict_text(difference: Difference | TimeDifference, survives: bool = True) -> str:
    """Format a verdict: also whether the method is worse whatever the margin, and † unless it survives Holm's correction.

    >>> verdict_text(Difference(-0.03, (-0.045, -0.015), 0.05, "non-inferior"), survives=False)
    'non-inferior†, worse'
    """
    decided = difference.verdict != "inconclusive"
    mark = "†" if decided and not survives else ""
    worse = ", worse" if difference.worse and difference.verdict != "inferior" else ""
    return f"{difference.verdict}{mark}{worse}"


def milliseconds_text(seconds: float) -> str:
    """Format a duration with three digits, in milliseconds.

    >>> milliseconds_text(0.00838), milliseconds_text(1.2345)
    ('8.38', '1234')
    """
    value = 1e3 * seconds
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def threads_text(threads: int) -> str:
    """Format a number of threads as words.

    >>> threads_text(1), threads_text(2)
    ('1 thread', '2 threads')
    """
    return f"{threads} thread{'' if threads == 1 else 's'}"


def percent_range(interval: Interval) -> str:
    return f"[{100 * interval[0]:.0f}, {100 * interval[1]:.0f}]"
