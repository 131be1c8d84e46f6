"""``results.json``: the single source of every table and figure.

The dataclasses are the schema, and `load_results` refuses everything else. Seconds are those of a policy call; FLOPs are 2 *
MAC of a call, of the denoiser alone or of a whole vision-language-action model.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from torchrl_sparse.envs.seeds import Split, evaluation_seeds
from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.latency.measure import Machine
from torchrl_sparse.evaluation.results.parts import (
    ActionError,
    EpisodeCost,
    Flops,
    PairedEntry,
    Percentiles,
    PolicyShape,
    PValues,
    Score,
    Success,
)
from torchrl_sparse.evaluation.rollouts.episodes import TokensKept
from torchrl_sparse.evaluation.statistics.differences import (
    Difference,
    Interval,
    TimeDifference,
    check_interval,
    require,
)
from torchrl_sparse.storage.json import read_json, write_json

__all__ = [
    "DENSE",
    "SCHEMA",
    "MethodEntry",
    "Results",
    "Stopping",
    "load_results",
    "save_results",
]

SCHEMA = 2
DENSE = "dense"
"""The method that all others are compared with."""


@dataclass(frozen=True, kw_only=True)
class MethodEntry:
    """All results of one method.

    Attributes:
        success: of its episodes.
        paired_vs_dense: their difference to the dense policy's.
        prune_rate: pruned share of the blocks, or of the visual tokens.
        flops: of a policy call.
        latency_s: of a call, measured interleaved with the other methods.
        speedup_vs_dense: ratio of the medians.
        action_error_vs_dense: of its actions.
        episode_length: mean, environment steps.
        planning_s: part of a call in which the planner decides; where it reads the observation.
        tokens: that it keeps; of policies with visual tokens.
        restricted_mean_time: steps to success, mean; an episode that is not solved counts the horizon.
        time_vs_dense: its ratio to the dense policy's.
        success_within: share of episodes solved within so many steps; see `allowed_steps`.
        correlation_with_dense: Pearson's, of times over the seeds; None where times never differ.
        p_values: of the two verdicts; None of dense.
        speedup_ci95: interval of ``speedup_vs_dense``, from the rounds of the measurement; None in older files.
        score: of a task that is graded; its verdict is the one that counts there.
        per_episode: what an episode costs; of policies with visual tokens, whose calls differ, or where methods are asked
            unequally often.
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
    restricted_mean_time: float
    time_vs_dense: TimeDifference
    success_within: dict[str, float]
    correlation_with_dense: float | None = None
    p_values: PValues | None = None
    speedup_ci95: Interval | None = None
    score: Score | None = None
    per_episode: EpisodeCost | None = None

    @property
    def judged(self) -> Difference:
        """The comparison that is judged: the score's difference to dense's on graded tasks, else success's."""
        return self.score.vs_dense if self.score else self.paired_vs_dense

    def __post_init__(self) -> None:
        require(0 <= self.prune_rate <= 1, "prune_rate", "0 to 1", self.prune_rate)
        for steps, share in self.success_within.items():
            require(
                steps.isdecimal() and 0 <= share <= 1, "success_within", "steps and shares", {steps: share}
            )
        if self.speedup_ci95 is not None:
            check_interval(self.speedup_ci95)


@dataclass(frozen=True)
class Stopping:
    """Interim analyses of a benchmark with early stopping: see `torchrl_sparse.evaluation.statistics.sequential.Design`."""

    max_episodes: int
    analyses: int


@dataclass(frozen=True)
class Results:
    """The content of a ``results.json``: machine, policy, and all methods including dense.

    Attributes:
        task: name of the task.
        split: of the seeds.
        seed: of the first episode, in the split's range.
        episode_horizon: steps after which an episode is truncated.
        machine: of the latencies.
        policy: the dense one.
        methods: name -> entry.
        early_cut: steps of the task's pre-registered early cut; None for a task without one.
        until_conclusive: where methods have as many episodes as their verdicts took; None where all have the same.
        pairs: methods against each other; None where none were asked for.
        settings: what else the methods depend on, such as the options of pruners and controllers, and the shares at which
            methods match another's tokens; None in older files.
    """

    schema: Literal[2]
    task: str
    split: Split
    seed: int
    episode_horizon: int
    machine: Machine
    policy: PolicyShape
    methods: dict[str, MethodEntry]
    early_cut: int | None = None
    until_conclusive: Stopping | None = None
    pairs: tuple[PairedEntry, ...] | None = None
    settings: dict[str, Any] | None = None

    def __post_init__(self) -> None:
        same_episodes = self.until_conclusive is None
        require(DENSE in self.methods, "methods", f"the key {DENSE!r}", sorted(self.methods))
        n = self.dense.success.n
        expected = f"{n}, as every method" if same_episodes else f"at most {n}, as dense"
        for name, method in self.methods.items():
            got = method.success.n
            fits = got == n if same_episodes else got <= n
            require(fits, f"methods.{name}.success.n", expected, got)
        for pair in self.pairs or ():
            known = {pair.method, pair.against} <= self.methods.keys()
            require(known, "pairs", f"two of {', '.join(self.methods)}", [pair.method, pair.against])

    @property
    def graded(self) -> bool:
        """Whether the task is graded, so that scores are judged."""
        return self.dense.score is not None

    @property
    def dense_did_nothing(self) -> bool:
        """Whether dense solved no episode, or scored nothing in any, so that no verdict is meaningful."""
        return not (self.dense.score.mean if self.dense.score else self.dense.success.k)

    @property
    def dense(self) -> MethodEntry:
        """The dense policy's entry."""
        return self.methods[DENSE]

    @property
    def first_seed(self) -> int:
        """Seed of the first episode."""
        return evaluation_seeds(self.split, self.seed, 1)[0]


def load_results(path: str | os.PathLike) -> Results:
    """Read a ``results.json``.

    Raises:
        FileNotFoundError: if there is none.
        InputError: naming file and key, if it is of another version or does not agree with itself.
    """
    found = read_json(path, dict[str, Any]).get("schema")
    if type(found) is not int or found != SCHEMA:  # true is 1
        older = "; schema 1 had no times to success: run its benchmark again" if found == 1 else ""
        raise InputError(f"{path}: schema: expected {SCHEMA}, got {found!r}{older}")
    return read_json(path, Results)


def save_results(results: Results, path: str | os.PathLike) -> Path:
    """Write a ``results.json`` atomically and return its path."""
    return write_json(path, results)
