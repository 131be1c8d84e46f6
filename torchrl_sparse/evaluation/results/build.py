"""Assembly of a ``results.json`` from a benchmark's measurements."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.latency.measure import Latency, Machine
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
from torchrl_sparse.evaluation.results.schema import DENSE, SCHEMA, MethodEntry, Results, Stopping
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult, tokens_kept, totals
from torchrl_sparse.evaluation.rollouts.pairs import EpisodePairs, pair_by_design, pair_episodes
from torchrl_sparse.evaluation.statistics.bootstrap import median_ratio_interval
from torchrl_sparse.evaluation.statistics.differences import Difference, Interval, TimeDifference
from torchrl_sparse.evaluation.statistics.durations import (
    DEFAULT_TIME_MARGIN,
    allowed_steps,
    correlation,
    success_within,
)
from torchrl_sparse.evaluation.statistics.intervals import DEFAULT_MARGIN, verdict
from torchrl_sparse.evaluation.statistics.scores import mean_interval
from torchrl_sparse.evaluation.statistics.sequential import Design

__all__ = ["MethodRun", "Terms", "build_results", "compare_episodes", "compare_pair"]


@dataclass(frozen=True)
class MethodRun:
    """All measurements of one method.

    Attributes:
        episodes: its episodes, the same seeds as every other method's, in any order; where benchmarks stop when they are
            decided, some of dense's.
        latency: of one policy call, measured interleaved with the other methods.
        action_error: (mean, maximum) absolute difference of its chunks to the dense policy's, on the same
            observations and the same noise; (0, 0) for the dense policy.
        planning: of the planner alone, within a call; where it reads the observation.
        every: environment steps from one call to the next, of a method that says so itself.
        executed_flops: of a call, that the engine really does; None where that is not counted.
    """

    episodes: Sequence[EpisodeResult]
    latency: Latency
    action_error: tuple[float, float]
    planning: Latency | None = None
    every: int | None = None
    executed_flops: float | None = None


@dataclass(frozen=True)
class Terms:
    """Terms of a comparison, fixed before its episodes ran.

    Attributes:
        design: when the episodes are looked at.
        episode_horizon: steps after which an episode is truncated.
        early_cut: of the task, see `torchrl_sparse.envs.tasks`; None for a task without one.
        margin: of success: a difference of rates; of a task that is graded, of mean scores.
        time_margin: of the restricted mean time: a share of dense's.
        graded: whether scores decide instead of success and time, see `torchrl_sparse.envs.task.Task`.
    """

    design: Design
    episode_horizon: int
    early_cut: int | None = None
    margin: float = DEFAULT_MARGIN
    time_margin: float = DEFAULT_TIME_MARGIN
    graded: bool = False

    def statistics(self, pairs: EpisodePairs) -> tuple[float, float]:
        """Return by how many standard errors success and time beat their margins."""
        return pairs.statistics(self.episode_horizon, self.margin, self.time_margin)

    def score_statistic(self, pairs: EpisodePairs) -> float:
        """Return by how many standard errors the mean score beats its margin."""
        return pairs.score_statistic(self.margin)

    def decided(self, pairs: EpisodePairs) -> bool:
        """Tell whether a method's verdict is reached on these episodes, at an analysis of the design."""
        deciding = (self.score_statistic(pairs),) if self.graded else self.statistics(pairs)
        return self.design.decides(len(pairs.method), *deciding)


def build_results(
    runs: Mapping[str, MethodRun],
    *,
    task: str,
    split: str,
    seed: int,
    terms: Terms,
    machine: Machine,
    policy: PolicyShape,
    pairs: Sequence[Sequence[str]] = (),
    settings: Mapping[str, Any] | None = None,
) -> Results:
    """Build the content of ``results.json`` from the measurements.

    Args:
        runs: method name -> its run; ``"dense"``, which all are compared with, must be there.
        task: name of the task.
        split: of the seeds, see `torchrl_sparse.envs.seeds`.
        seed: of the whole benchmark.
        terms: of the comparisons.
        machine: see `describe_machine`.
        policy: the dense policy.
        pairs: of methods that are compared with each other.
        settings: what else the methods depend on, as JSON values.

    Raises:
        InputError: if dense is missing, a pair is not two of the methods, methods ran on different seeds, or a value is out of
            range.
    """
    if DENSE not in runs:
        raise InputError(f"runs: expected the method {DENSE!r} among them, got {sorted(runs)}")
    design, uneven = terms.design, any(run.every for run in runs.values())
    return Results(
        SCHEMA,
        task,
        split,
        seed,
        terms.episode_horizon,
        machine,
        policy,
        {name: _entry(name, run, runs[DENSE], terms, uneven=uneven) for name, run in runs.items()},
        early_cut=terms.early_cut,
        until_conclusive=Stopping(design.max_episodes, design.analyses) if design.analyses > 1 else None,
        pairs=tuple(_pair(pair, runs, terms) for pair in pairs) or None,
        settings=None if settings is None else dict(settings),
    )


def _entry(name: str, run: MethodRun, dense: MethodRun, terms: Terms, *, uneven: bool) -> MethodEntry:
    cost, tokens = totals(run.episodes), tokens_kept(run.episodes)
    whole = uneven or tokens is not None  # a policy call does not say what an episode costs
    return MethodEntry(
        success=Success.of([episode.success for episode in run.episodes]),
        **compare_episodes(name, run.episodes, dense.episodes, terms),
        prune_rate=cost.prune_rate,
        flops=Flops(
            cost.flops_per_query,
            cost.flops_per_query / totals(dense.episodes).flops_per_query,
            run.executed_flops,
        ),
        latency_s=Percentiles.of(run.latency),
        speedup_vs_dense=dense.latency.p50 / run.latency.p50,
        speedup_ci95=_speedup_interval(run.latency, dense.latency),
        action_error_vs_dense=ActionError(*map(float, run.action_error)),
        episode_length=cost.episode_length,
        planning_s=None if run.planning is None else Percentiles.of(run.planning),
        tokens=tokens,
        per_episode=_episode_cost(run, dense) if whole else None,
    )


def _episode_cost(run: MethodRun, dense: MethodRun) -> EpisodeCost:
    """Compare an episode's cost with that of dense's episodes on the same seeds."""
    seeds = {episode.seed for episode in run.episodes}
    paired = replace(dense, episodes=[episode for episode in dense.episodes if episode.seed in seeds])
    ours, theirs = _spent(run), _spent(paired)
    ratios = {
        f"{name}_to_dense": ours[name] / theirs[name] for name in ("flops", "flops_per_step", "seconds")
    }
    return EpisodeCost(**ours, **ratios)


def _spent(run: MethodRun) -> dict[str, float]:
    cost, latency = totals(run.episodes), run.latency
    queries = cost.queries / len(run.episodes)
    flops = queries * cost.flops_per_query
    second = sum(latency.samples) / len(latency.samples) if latency.samples else latency.p50
    return {
        "queries": queries,
        "flops": flops,
        "flops_per_step": flops / cost.episode_length,
        "seconds": queries * second,
    }


def _pair(names: Sequence[str], runs: Mapping[str, MethodRun], terms: Terms) -> PairedEntry:
    if len(names) != 2 or not set(names) <= set(runs):
        raise InputError(f"pairs: expected two of {', '.join(runs)}, got {list(names)}")
    first, second = (runs[name].episodes for name in names)
    if terms.design.analyses > 1:  # methods may have stopped after different numbers of episodes
        shared = {episode.seed for episode in first} & {episode.seed for episode in second}
        first, second = ([e for e in episodes if e.seed in shared] for episodes in (first, second))
    return compare_pair(names[0], first, names[1], second, terms)


def compare_pair(
    method: str,
    episodes: Sequence[EpisodeResult],
    against: str,
    others: Sequence[EpisodeResult],
    terms: Terms,
) -> PairedEntry:
    """Compare two methods, of which neither need be dense, with the protocol of all comparisons with dense.

    Args:
        method, against: their names.
        episodes, others: theirs, on the same seeds.
        terms: of the comparison.

    Raises:
        InputError: if the seeds differ.
    """
    pairs, horizon = pair_episodes(method, episodes, against, others), terms.episode_horizon
    solved, times = pairs.success_difference(terms.margin), pairs.time_ratio(horizon, terms.time_margin)
    return PairedEntry(
        method,
        against,
        solved=tuple(map(sum, pairs.solved)),
        n=len(pairs.method),
        success=solved,
        time=times,
        score=_gain(pairs, terms.margin) if terms.graded else None,
    )


def compare_episodes(
    name: str, episodes: Sequence[EpisodeResult], dense: Sequence[EpisodeResult], terms: Terms
) -> dict[str, Any]:
    """Return the `MethodEntry` fields that follow from the episodes of a method and of dense alone.

    Args:
        name: of the method.
        episodes: its own.
        dense: the dense policy's; perhaps more of them, see `pair_by_design`.
        terms: of the comparison.

    Raises:
        InputError: if the seeds do not fit.
    """
    pairs = pair_by_design(name, episodes, DENSE, dense, terms.design)
    ours, theirs = pairs.times(terms.episode_horizon)
    steps = allowed_steps(terms.episode_horizon, terms.early_cut)
    shares = success_within(pairs.solved[0], ours, steps)
    return {
        **(_to_itself(terms) if name == DENSE else _to_dense(pairs, terms)),
        "restricted_mean_time": float(ours.mean()),
        "success_within": {str(step): share for step, share in shares.items()},
        "correlation_with_dense": correlation(ours, theirs),
        "score": _score(name, pairs, terms) if terms.graded else None,
    }


def _score(name: str, pairs: EpisodePairs, terms: Terms) -> Score:
    mean, ci = mean_interval([episode.score for episode in pairs.method])
    if name == DENSE:
        return Score(mean, ci, Difference(0.0, (0.0, 0.0), terms.margin, "non-inferior"), None)
    n, design = len(pairs.method), terms.design
    gained = _gain(pairs, terms.margin, design.confidence(n))
    return Score(mean, ci, gained, design.p_value(abs(terms.score_statistic(pairs)), n))


def _gain(pairs: EpisodePairs, margin: float, confidence: float = 0.95) -> Difference:
    diff, ci = pairs.score_difference(confidence)
    return Difference(diff, ci, margin, verdict(ci, margin))


def _to_dense(pairs: EpisodePairs, terms: Terms) -> dict[str, Any]:
    n, design, horizon = len(pairs.method), terms.design, terms.episode_horizon
    confidence = design.confidence(n)
    solved = pairs.success_difference(terms.margin, confidence)
    times = pairs.time_ratio(horizon, terms.time_margin, confidence)
    p_values = [design.p_value(abs(z), n) for z in terms.statistics(pairs)]
    if not any(map(any, pairs.solved)):  # as alike as two policies that do nothing
        solved, times = (replace(one, verdict="inconclusive") for one in (solved, times))
        p_values = [0.5, 0.5]
    return {
        "paired_vs_dense": solved,
        "time_vs_dense": times,
        "p_values": PValues(*p_values),
    }


def _to_itself(terms: Terms) -> dict[str, Any]:
    """Dense equals itself by definition: nothing is estimated, and nothing is tested."""
    solved = Difference(0.0, (0.0, 0.0), terms.margin, "non-inferior")
    times = TimeDifference(1.0, (1.0, 1.0), terms.time_margin, "non-inferior")
    return {"paired_vs_dense": solved, "time_vs_dense": times}


def _speedup_interval(latency: Latency, dense: Latency) -> Interval | None:
    return median_ratio_interval(dense.samples, latency.samples) if latency.samples else None
