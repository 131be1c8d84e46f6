"""Paired comparison of two methods, as a difference or a ratio of times, validated on construction and on reading."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from torchrl_sparse.errors import InputError

__all__ = ["Difference", "Interval", "TimeDifference", "Verdict", "check_interval", "require"]

Interval = tuple[float, float]
Verdict = Literal["non-inferior", "inferior", "inconclusive"]


@dataclass(frozen=True)
class Difference:
    """Difference in success or score between two methods on the same seeds, with its interval and verdict.

    ``ci95`` has the confidence that was asked for where it was made; in files it is 95 %.
    The dense policy's own is 0 without width and "non-inferior": a policy equals itself by definition, nothing is estimated.
    ``mcnemar_p`` is the exact two-sided p-value of no difference at all, see `torchrl_sparse.evaluation.statistics.intervals`;
    None of dense, of scores and in older files.
    """

    diff: float
    ci95: Interval
    margin: float
    verdict: Verdict
    mcnemar_p: float | None = None

    def __post_init__(self) -> None:
        require(-1 <= self.diff <= 1, "diff", "-1 to 1", self.diff)
        check_interval(self.ci95)
        require(self.mcnemar_p is None or 0 <= self.mcnemar_p <= 1, "mcnemar_p", "0 to 1", self.mcnemar_p)
        require(0 < self.margin < 1, "margin", "between 0 and 1", self.margin)

    @property
    def worse(self) -> bool:
        """Whether the whole interval lies below zero, regardless of the margin."""
        return self.ci95[1] < 0


@dataclass(frozen=True)
class TimeDifference:
    """Ratio of two methods' restricted mean times on the same seeds, with its interval and verdict.

    The dense policy's own is 1 without width and "non-inferior", as of `Difference`.
    """

    ratio: float
    ci95: Interval
    margin: float
    verdict: Verdict

    def __post_init__(self) -> None:
        require(self.ratio > 0, "ratio", "a number above 0", self.ratio)
        check_interval(self.ci95)
        require(0 < self.margin < 1, "margin", "between 0 and 1", self.margin)

    @property
    def worse(self) -> bool:
        """Whether the whole interval lies above one, regardless of the margin."""
        return self.ci95[0] > 1


def check_interval(interval: Interval) -> None:
    low, high = interval
    require(low <= high, "ci95", "low <= high", list(interval))


def require(condition: bool, key: str, expected: str, got: Any) -> None:
    """Raise InputError naming the key unless the condition holds."""
    if not condition:
        raise InputError(f"{key}: expected {expected}, got {got!r}")
