"""``aggregate.json``: methods over several tasks, each task of the same weight, and its table."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import NormalDist
from typing import Literal

from torchrl_sparse.envs.seeds import Split
from torchrl_sparse.evaluation.results.parts import Difference, TimeDifference
from torchrl_sparse.evaluation.results.schema import DENSE, Results, load_results
from torchrl_sparse.evaluation.results.text import points_text, ratio_text, verdict_text
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult, read_episodes
from torchrl_sparse.evaluation.rollouts.pairs import pair_episodes
from torchrl_sparse.evaluation.statistics.bootstrap import aggregate_tasks
from torchrl_sparse.evaluation.statistics.durations import time_verdict
from torchrl_sparse.evaluation.statistics.intervals import verdict
from torchrl_sparse.evaluation.statistics.multiplicity import holm
from torchrl_sparse.storage.json import read_json, write_json

__all__ = [
    "AggregateResults",
    "aggregate_results",
    "aggregate_rows",
    "load_aggregate",
    "num_verdicts",
    "save_aggregate",
]


@dataclass(frozen=True)
class AggregateEntry:
    """A method over all tasks: mean difference of success rates, geometric mean of the ratios of times, and its pairs."""

    paired_vs_dense: Difference
    time_vs_dense: TimeDifference
    episodes: int


@dataclass(frozen=True)
class AggregateResults:
    """The content of an ``aggregate.json``: the tasks, the split of their seeds, and the methods that all of them tried."""

    aggregate: Literal[1]
    tasks: tuple[str, ...]
    split: Split
    methods: dict[str, AggregateEntry]


def aggregate_results(paths: Sequence[str | os.PathLike]) -> AggregateResults:
    """Put the results of several tasks together, stratified: intervals draw seeds anew within each task.

    Args:
        paths: of a ``results.json`` of version 2 of each task, with ``episodes/`` beside it.

    Raises:
        FileNotFoundError: if a file or a log is not there.
        ValueError: if a file is of version 1, a task or a split is there twice, or no method is in all of them.
    """
    found = {Path(path): load_results(path) for path in paths}
    for path, results in found.items():
        if not isinstance(results, Results):
            raise ValueError(f"{path}: schema: expected 2 to aggregate, got {results.schema}")
    tasks, splits = (
        [results.task for results in found.values()],
        {results.split for results in found.values()},
    )
    if len(set(tasks)) != len(tasks) or len(splits) != 1:
        raise ValueError(f"aggregate: expected different tasks of one split, got {tasks} of {sorted(splits)}")
    shared = [
        name
        for name in next(iter(found.values())).methods
        if name != DENSE and all(_has_times(results, name) for results in found.values())
    ]
    if not shared:
        raise ValueError(f"aggregate: expected a method whose times all of {tasks} have, got none")
    return AggregateResults(1, tuple(tasks), splits.pop(), {name: _entry(name, found) for name in shared})


def _has_times(results: Results, name: str) -> bool:
    return name in results.methods and results.methods[name].time_vs_dense is not None


def _entry(name: str, found: Mapping[Path, Results]) -> AggregateEntry:
    successes, times = {}, {}
    for path, results in found.items():
        seeds = range(results.first_seed, results.first_seed + results.methods[name].success.n)
        ours, theirs = (_episodes(path, method, seeds) for method in (name, DENSE))
        pairs = pair_episodes(name, ours, DENSE, theirs)
        successes[results.task] = [*zip(*pairs.solved, strict=True)]
        times[results.task] = [*zip(*pairs.times(results.episode_horizon), strict=True)]
    whole = aggregate_tasks(successes, times)
    dense = next(iter(found.values())).dense
    margin, time_margin = dense.paired_vs_dense.margin, dense.time_vs_dense.margin
    return AggregateEntry(
        Difference(whole.success, whole.success_ci, margin, verdict(whole.success_ci, margin)),
        TimeDifference(whole.time, whole.time_ci, time_margin, time_verdict(whole.time_ci, time_margin)),
        whole.episodes,
    )


def _episodes(path: Path, name: str, seeds: range) -> list[EpisodeResult]:
    log = read_episodes(path.parent / "episodes" / f"{name}.jsonl")
    return [episode for episode in log if episode.seed in seeds]


def aggregate_rows(results: AggregateResults) -> list[dict[str, str]]:
    """Return the rows of the table, one per method: column -> text; † where a verdict does not survive Holm's correction."""
    lasting = holm(_p_values(results), num_verdicts(results))
    return [
        {
            "method": name,
            "pairs": str(entry.episodes),
            "vs dense, points": points_text(entry.paired_vs_dense.diff, entry.paired_vs_dense.ci95),
            "verdict": verdict_text(entry.paired_vs_dense, f"{name} success" in lasting),
            "time vs dense": ratio_text(entry.time_vs_dense),
            "time verdict": verdict_text(entry.time_vs_dense, f"{name} time" in lasting),
        }
        for name, entry in results.methods.items()
    ]


def num_verdicts(results: AggregateResults) -> int:
    """Return the verdicts of the table: on success and on time, of every method."""
    return 2 * len(results.methods)


def _p_values(results: AggregateResults) -> dict[str, float]:
    """Return by verdict how probable a value as far from its margin is at it, as normal as the bootstrap's interval is wide."""
    p_values = {}
    for name, entry in results.methods.items():
        success, time = entry.paired_vs_dense, entry.time_vs_dense
        p_values[f"{name} success"] = _tail(success.diff + success.margin, *success.ci95)
        limits = map(math.log, time.ci95)
        p_values[f"{name} time"] = _tail(math.log(time.ratio / (1 + time.margin)), *limits)
    return p_values


def _tail(distance: float, low: float, high: float) -> float:
    error = (high - low) / (2 * NormalDist().inv_cdf(0.975))
    if not error:
        return 0.0 if distance else 0.5
    return NormalDist().cdf(-abs(distance) / error)


def load_aggregate(path: str | os.PathLike) -> AggregateResults:
    """Read an ``aggregate.json``.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: naming file and key, if it is of another kind.
    """
    return read_json(path, AggregateResults)


def save_aggregate(results: AggregateResults, path: str | os.PathLike) -> Path:
    """Write an ``aggregate.json`` in one piece or not at all; return the path."""
    return write_json(path, results)
