"""``aggregate.json``: methods over several equally weighted tasks, and its table."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from torchrl_sparse.envs.seeds import Split
from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.results.comparisons import surviving
from torchrl_sparse.evaluation.results.parts import PValues
from torchrl_sparse.evaluation.results.schema import DENSE, Results, load_results
from torchrl_sparse.evaluation.results.text import NONE_SOLVED, p_text, points_text, ratio_text, verdict_text
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult, read_episodes
from torchrl_sparse.evaluation.rollouts.pairs import pair_episodes
from torchrl_sparse.evaluation.statistics.aggregate import TaskPairs, aggregate_tasks
from torchrl_sparse.evaluation.statistics.differences import Difference, TimeDifference
from torchrl_sparse.evaluation.statistics.durations import time_verdict
from torchrl_sparse.evaluation.statistics.intervals import verdict
from torchrl_sparse.evaluation.statistics.sequential import Design
from torchrl_sparse.storage.json import read_json

__all__ = [
    "AggregateResults",
    "aggregate_results",
    "aggregate_rows",
    "counted_episodes",
    "load_aggregate",
    "num_verdicts",
]


@dataclass(frozen=True)
class AggregateEntry:
    """One method over all tasks: mean success difference, geometric mean time ratio, pairs, and both verdicts' p-values."""

    paired_vs_dense: Difference
    time_vs_dense: TimeDifference
    episodes: int
    p_values: PValues


@dataclass(frozen=True)
class AggregateResults:
    """The content of an ``aggregate.json``: the tasks, their seed split, and the methods common to all tasks."""

    aggregate: Literal[2]
    tasks: tuple[str, ...]
    split: Split
    methods: dict[str, AggregateEntry]


def aggregate_results(paths: Sequence[str | os.PathLike]) -> AggregateResults:
    """Combine the results of several tasks; see `torchrl_sparse.evaluation.statistics.aggregate`.

    Args:
        paths: of a ``results.json`` of each task, with ``episodes/`` beside it.

    Raises:
        FileNotFoundError: if a file or a log is not there.
        InputError: naming the file, if one is of a task that is graded, dense solved nothing in it, or
            its log lacks episodes; if a task is there twice, splits or margins differ, or no method is in all of them.
    """
    found = {Path(path): load_results(path) for path in paths}
    for path, results in found.items():
        if results.graded:
            raise InputError(
                f"{path}: expected a task that success and time decide, got {results.task}, graded"
            )
        if results.dense_did_nothing:
            raise InputError(f"{path}: {NONE_SOLVED}")
    tasks, splits = (
        [results.task for results in found.values()],
        {results.split for results in found.values()},
    )
    if len(set(tasks)) != len(tasks) or len(splits) != 1:
        raise InputError(f"aggregate: expected different tasks of one split, got {tasks} of {sorted(splits)}")
    if len(margins := {_margins(results) for results in found.values()}) != 1:
        raise InputError(f"aggregate: expected the same margins in all files, got {sorted(margins)}")
    shared = [
        name
        for name in next(iter(found.values())).methods
        if name != DENSE and all(name in results.methods for results in found.values())
    ]
    if not shared:
        raise InputError(f"aggregate: expected a method that all of {tasks} have, got none")
    return AggregateResults(2, tuple(tasks), splits.pop(), {name: _entry(name, found) for name in shared})


def _entry(name: str, found: Mapping[Path, Results]) -> AggregateEntry:
    tasks = {results.task: _pairs(name, path, results) for path, results in found.items()}
    margin, time_margin = _margins(next(iter(found.values())))
    whole = aggregate_tasks(tasks, margin, time_margin)
    success, time = whole.success, whole.time
    return AggregateEntry(
        Difference(success.value, success.ci, margin, verdict(success.ci, margin), whole.mcnemar_p),
        TimeDifference(time.value, time.ci, time_margin, time_verdict(time.ci, time_margin)),
        whole.episodes,
        PValues(success.p_value, time.p_value),
    )


def _pairs(name: str, path: Path, results: Results) -> TaskPairs:
    n, stopping = results.methods[name].success.n, results.until_conclusive
    ours, theirs = (counted_episodes(path, results, method, n) for method in (name, DENSE))
    pairs = pair_episodes(name, ours, DENSE, theirs)
    design = Design(stopping.max_episodes, stopping.analyses) if stopping else None
    return TaskPairs(pairs.solved, pairs.times(results.episode_horizon), results.episode_horizon, design)


def _margins(results: Results) -> tuple[float, float]:
    return results.dense.paired_vs_dense.margin, results.dense.time_vs_dense.margin


def counted_episodes(path: Path, results: Results, name: str, n: int) -> list[EpisodeResult]:
    """Return the first ``n`` episodes that a ``results.json`` counts of a method, from the log beside it.

    Raises:
        FileNotFoundError: if there is no log.
        InputError: if the log lacks some of them.
    """
    first, log = results.first_seed, path.parent / "episodes" / f"{name}.jsonl"
    found = [episode for episode in read_episodes(log) if first <= episode.seed < first + n]
    if len(found) != n:
        raise InputError(
            f"{log}: expected the {n} episodes from seed {first} that {path.name} counts, got {len(found)}"
        )
    return found


def aggregate_rows(results: AggregateResults) -> list[dict[str, str]]:
    """Return the table, one row per method: column -> text; † marks verdicts that fail Holm's correction."""
    p_values = {name: entry.p_values for name, entry in results.methods.items()}
    lasting = surviving(p_values, num_verdicts(results))
    return [
        {
            "method": name,
            "pairs": str(entry.episodes),
            "vs dense, points": points_text(entry.paired_vs_dense.diff, entry.paired_vs_dense.ci95),
            "verdict": verdict_text(entry.paired_vs_dense, f"{name} success" in lasting),
            "McNemar's p": p_text(entry.paired_vs_dense.mcnemar_p),
            "time vs dense": ratio_text(entry.time_vs_dense),
            "time verdict": verdict_text(entry.time_vs_dense, f"{name} time" in lasting),
        }
        for name, entry in results.methods.items()
    ]


def num_verdicts(results: AggregateResults) -> int:
    """Return the number of verdicts in the table: success and time for every method."""
    return 2 * len(results.methods)


def load_aggregate(path: str | os.PathLike) -> AggregateResults:
    """Read an ``aggregate.json``.

    Raises:
        FileNotFoundError: if there is none.
        InputError: naming file and key, if it is of another kind.
    """
    return read_json(path, AggregateResults)
