"""``results.json``: the only source of every table and figure.

The dataclasses are the schema, version 1; `load_results` and `save_results` refuse everything else. Seconds are those of a
query; FLOPs are 2 * MAC of a query, of the denoiser alone or of a whole vision-language-action model.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from torchrl_sparse.evaluation.latency.measure import Latency, Machine
from torchrl_sparse.evaluation.statistics.intervals import PairedDifference, Verdict, wilson_interval
from torchrl_sparse.storage.json import read_json, write_json

__all__ = [
    "DENSE",
    "SCHEMA",
    "ActionError",
    "Difference",
    "Flops",
    "Interval",
    "MethodEntry",
    "Percentiles",
    "PolicyShape",
    "Results",
    "Success",
    "TokensKept",
    "load_results",
    "save_results",
]

SCHEMA = 1
DENSE = "dense"
"""The method that all others are compared with."""

Interval = tuple[float, float]


@dataclass(frozen=True)
class PolicyShape:
    """The dense policy: parameters, denoising steps, actions of a chunk, observations that it reads, actions executed."""

    params: int
    num_inference_steps: int
    horizon: int
    n_obs_steps: int
    n_action_steps: int


@dataclass(frozen=True)
class Success:
    """Episodes solved, with Wilson's 95 % interval of the rate.

    >>> Success.of([True, False]).rate
    0.5
    """

    k: int
    n: int
    rate: float
    ci95: Interval

    def __post_init__(self) -> None:
        _require(self.n >= 1, "n", "at least 1", self.n)
        _require(0 <= self.k <= self.n, "k", f"0 to {self.n}", self.k)
        rate = self.k / self.n
        _require(math.isclose(self.rate, rate, abs_tol=1e-9), "rate", f"k / n = {rate}", self.rate)
        _check_interval(self.ci95)
        _require(self.ci95[0] >= 0 and self.ci95[1] <= 1, "ci95", "limits in [0, 1]", self.ci95)

    @classmethod
    def of(cls, outcomes: Sequence[bool]) -> Success:
        """Count the successes of episodes."""
        k, n = sum(outcomes), len(outcomes)
        return cls(k, n, k / n, wilson_interval(k, n))


@dataclass(frozen=True)
class Difference:
    """Success minus dense success on the same seeds, with Tango's 95 % interval and the verdict against a margin.

    The dense policy's own is 0 without width and "non-inferior": a policy equals itself by definition, nothing is estimated.
    """

    diff: float
    ci95: Interval
    margin: float
    verdict: Verdict

    def __post_init__(self) -> None:
        _require(-1 <= self.diff <= 1, "diff", "-1 to 1", self.diff)
        _check_interval(self.ci95)
        _require(0 < self.margin < 1, "margin", "between 0 and 1", self.margin)

    @classmethod
    def of(cls, paired: PairedDifference) -> Difference:
        """Keep what a file holds of a comparison."""
        return cls(paired.diff, paired.ci, paired.margin, paired.verdict)


@dataclass(frozen=True)
class Percentiles:
    """Median and 95th percentile of ``n`` timed calls, seconds."""

    p50: float
    p95: float
    n: int

    def __post_init__(self) -> None:
        _require(0 < self.p50 <= self.p95, "p50", "0 < p50 <= p95", (self.p50, self.p95))
        _require(self.n >= 1, "n", "at least 1", self.n)

    @classmethod
    def of(cls, latency: Latency) -> Percentiles:
        """Keep what a file holds of a measurement."""
        return cls(latency.p50, latency.p95, latency.n)


@dataclass(frozen=True)
class Flops:
    """FLOPs of a query, and over those of a dense one."""

    per_query: float
    ratio_to_dense: float

    def __post_init__(self) -> None:
        _require(self.per_query >= 0, "per_query", "at least 0", self.per_query)
        _require(self.ratio_to_dense >= 0, "ratio_to_dense", "at least 0", self.ratio_to_dense)


@dataclass(frozen=True)
class ActionError:
    """Absolute difference of an action entry to the dense policy's, on the same observations and the same noise."""

    mean: float
    max: float

    def __post_init__(self) -> None:
        for name in ("mean", "max"):
            value = getattr(self, name)
            _require(0 <= value < math.inf, name, "a finite number >= 0", value)


@dataclass(frozen=True)
class TokensKept:
    """Visual tokens in a decoder layer, mean over layers and queries: of all queries, in fine and in coarse mode."""

    kept_mean: float
    kept_fine: float | None
    kept_coarse: float | None


@dataclass(frozen=True)
class MethodEntry:
    """Everything about one method.

    Attributes:
        success: of its episodes.
        paired_vs_dense: their difference to the dense policy's.
        prune_rate: pruned share of the blocks, or of the visual tokens.
        flops: of a query.
        latency_s: of a query, measured interleaved with the other methods.
        speedup_vs_dense: ratio of the medians.
        action_error_vs_dense: of its actions.
        episode_length: mean, environment steps.
        planning_s: part of a query in which the planner decides; where it looks at the observation.
        tokens: that it keeps; of policies with visual tokens.
    """

    success: Success
    paired_vs_dense: Difference
    prune_rate: float
    flops: Flops
    latency_s: Percentiles
    speedup_vs_dense: float
    action_error_vs_dense: ActionError
    episode_length: float
    planning_s: Percentiles | None = None
    tokens: TokensKept | None = None

    def __post_init__(self) -> None:
        _require(0 <= self.prune_rate <= 1, "prune_rate", "0 to 1", self.prune_rate)


@dataclass(frozen=True)
class Results:
    """The content of a ``results.json``: where it was measured, on what, and all methods, the dense policy among them."""

    schema: Literal[1]
    task: str
    seed: int
    machine: Machine
    policy: PolicyShape
    methods: dict[str, MethodEntry]

    def __post_init__(self) -> None:
        _require(DENSE in self.methods, "methods", f"the key {DENSE!r}", sorted(self.methods))
        n = self.dense.success.n
        for name, method in self.methods.items():
            got = method.success.n
            _require(got == n, f"methods.{name}.success.n", f"{n}, as every method", got)

    @property
    def dense(self) -> MethodEntry:
        """The dense policy's entry."""
        return self.methods[DENSE]


def load_results(path: str | os.PathLike) -> Results:
    """Read a ``results.json``.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: naming file and key, if it is not of this schema or does not agree with itself.
    """
    return read_json(path, Results)


def save_results(results: Results, path: str | os.PathLike) -> Path:
    """Write a ``results.json`` in one piece or not at all; return the path."""
    return write_json(path, results)


def _check_interval(interval: Interval) -> None:
    low, high = interval
    _require(low <= high, "ci95", "low <= high", list(interval))


def _require(condition: bool, key: str, expected: str, got: Any) -> None:
    if not condition:
        raise ValueError(f"{key}: expected {expected}, got {got!r}")
