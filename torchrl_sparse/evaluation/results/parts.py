"""Parts of results files: rates, differences, percentiles, each checked on reading."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

from torchrl_sparse.evaluation.latency.measure import Latency
from torchrl_sparse.evaluation.statistics.differences import (
    Difference,
    Interval,
    TimeDifference,
    check_interval,
    require,
)
from torchrl_sparse.evaluation.statistics.intervals import wilson_interval

__all__ = [
    "ActionError",
    "EpisodeCost",
    "Flops",
    "PValues",
    "Score",
    "PairedEntry",
    "Percentiles",
    "PolicyShape",
    "Success",
]


@dataclass(frozen=True)
class PolicyShape:
    """Shape of the dense policy: parameters, denoising steps, chunk length, observation and executed steps, and
    cameras if any.
    """

    params: int
    num_inference_steps: int
    horizon: int
    n_obs_steps: int
    n_action_steps: int
    cameras: tuple[str, ...] = ()


@dataclass(frozen=True)
class Success:
    """Number of solved episodes, with Wilson's 95 % interval of the rate.

    >>> Success.of([True, False]).rate
    0.5
    """

    k: int
    n: int
    rate: float
    ci95: Interval

    def __post_init__(self) -> None:
        require(self.n >= 1, "n", "at least 1", self.n)
        require(0 <= self.k <= self.n, "k", f"0 to {self.n}", self.k)
        rate = self.k / self.n
        require(math.isclose(self.rate, rate, abs_tol=1e-9), "rate", f"k / n = {rate}", self.rate)
        check_interval(self.ci95)
        require(self.ci95[0] >= 0 and self.ci95[1] <= 1, "ci95", "limits in [0, 1]", self.ci95)

    @classmethod
    def of(cls, outcomes: Sequence[bool]) -> Success:
        """Count the successful episodes."""
        k, n = sum(outcomes), len(outcomes)
        return cls(k, n, k / n, wilson_interval(k, n))


@dataclass(frozen=True)
class Score:
    """Mean score of a graded task's episodes, with Student's 95 % interval, and the difference to dense.

    Attributes:
        vs_dense: mean paired difference; see `Difference`.
        p_value: of its verdict, see `PValues`; None of dense.
    """

    mean: float
    ci95: Interval
    vs_dense: Difference
    p_value: float | None

    def __post_init__(self) -> None:
        require(0 <= self.mean <= 1, "mean", "0 to 1", self.mean)
        check_interval(self.ci95)
        _check_p("p_value", self.p_value)


@dataclass(frozen=True)
class PValues:
    """One-sided p-values of both verdicts, for Holm's correction: of non-inferiority or inferiority, whichever is nearer."""

    success: float
    time: float

    def __post_init__(self) -> None:
        for name in ("success", "time"):
            _check_p(name, getattr(self, name))


def _check_p(name: str, value: float | None) -> None:
    require(value is None or 0 <= value <= 0.5, name, "0 to 0.5", value)


@dataclass(frozen=True)
class Percentiles:
    """Median and 95th percentile of ``n`` timed calls, seconds."""

    p50: float
    p95: float
    n: int

    def __post_init__(self) -> None:
        require(0 < self.p50 <= self.p95, "p50", "0 < p50 <= p95", (self.p50, self.p95))
        require(self.n >= 1, "n", "at least 1", self.n)

    @classmethod
    def of(cls, latency: Latency) -> Percentiles:
        """Build it from a latency measurement."""
        return cls(latency.p50, latency.p95, latency.n)


@dataclass(frozen=True)
class Flops:
    """FLOPs of a policy call, by the published count.

    Attributes:
        per_query: see `torchrl_sparse.blocks.mask`; with the planner's.
        ratio_to_dense: those over dense's.
        executed: that the engine really does, mean over calls of dense episodes; None in older files and of VLAs.
    """

    per_query: float
    ratio_to_dense: float
    executed: float | None = None

    def __post_init__(self) -> None:
        require(self.per_query >= 0, "per_query", "at least 0", self.per_query)
        require(self.ratio_to_dense >= 0, "ratio_to_dense", "at least 0", self.ratio_to_dense)
        require(self.executed is None or self.executed >= 0, "executed", "at least 0 or null", self.executed)


@dataclass(frozen=True)
class EpisodeCost:
    """Mean cost of an episode. A method that saves per policy call may lose the savings in longer episodes.

    Attributes:
        queries: calls of the policy.
        flops: of all of them.
        flops_to_dense: those over dense's.
        flops_per_step: of an environment step, mean; times the control frequency, those of a second of motion.
        flops_per_step_to_dense: those over dense's.
        seconds: of all calls, each as long as the mean of those that were timed.
        seconds_to_dense: those over dense's.
    """

    queries: float
    flops: float
    flops_to_dense: float
    flops_per_step: float
    flops_per_step_to_dense: float
    seconds: float
    seconds_to_dense: float

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            require(0 <= value < math.inf, field.name, "a finite number >= 0", value)


@dataclass(frozen=True)
class PairedEntry:
    """One method against another, neither of them dense, on the same seeds.

    Attributes:
        method, against: their names.
        solved: episodes that each of them solved.
        n: episodes of each.
        success: of the first minus that of the second.
        time: restricted mean time of the first over that of the second.
        score: mean score of the first minus that of the second, where a task is graded.
    """

    method: str
    against: str
    solved: tuple[int, int]
    n: int
    success: Difference
    time: TimeDifference
    score: Difference | None = None

    @property
    def judged(self) -> Difference:
        """The comparison that is judged: the score of a graded task, else success."""
        return self.score or self.success

    def __post_init__(self) -> None:
        require(all(0 <= k <= self.n for k in self.solved), "solved", f"0 to {self.n}", self.solved)


@dataclass(frozen=True)
class ActionError:
    """Absolute difference of action entries to the dense policy's, for the same observations and noise."""

    mean: float
    max: float

    def __post_init__(self) -> None:
        for name in ("mean", "max"):
            value = getattr(self, name)
            require(0 <= value < math.inf, name, "a finite number >= 0", value)
