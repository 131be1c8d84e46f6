"""A ``results.json`` of version 1 made anew in version 2: times come from the episodes beside it, all else is carried over."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path

from torchrl_sparse.envs.seeds import evaluation_seeds
from torchrl_sparse.envs.tasks import find_robosuite_task
from torchrl_sparse.evaluation.results.build import Terms, compare_episodes
from torchrl_sparse.evaluation.results.schema import (
    DENSE,
    SCHEMA,
    MethodEntry,
    MethodEntry1,
    Results,
    Results1,
    load_results,
)
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult, read_episodes
from torchrl_sparse.evaluation.statistics.durations import DEFAULT_TIME_MARGIN
from torchrl_sparse.evaluation.statistics.sequential import Design

__all__ = ["upgrade_results"]


def upgrade_results(path: str | os.PathLike) -> tuple[Results, dict[str, str]]:
    """Return what a file says in version 2, and why methods lack what that adds.

    Every benchmark of version 1 ran on what are development seeds now. A method's episodes count only if they are as many, and
    as many of them solved, as the file says.

    Args:
        path: of a ``results.json`` of version 1, with ``episodes/`` beside it.

    Returns:
        The results, and method -> why its entry has no times.

    Raises:
        FileNotFoundError: if there is no file, or no log of dense episodes beside it.
        ValueError: naming the file, if it is not of version 1 or dense's episodes are not those of the file.
    """
    path = Path(path)
    old = load_results(path)
    if not isinstance(old, Results1):
        raise ValueError(f"{path}: schema: expected 1 to upgrade, got {old.schema}")
    seeds = evaluation_seeds("development", old.seed, old.dense.success.n)
    task = find_robosuite_task(old.task)
    terms = Terms(
        Design(len(seeds)),
        task.horizon,
        task.early_cut,
        old.dense.paired_vs_dense.margin,
        DEFAULT_TIME_MARGIN,
    )
    episodes, lacking = _kept_episodes(path.parent / "episodes", old, seeds)
    if DENSE in lacking:
        raise ValueError(f"{path}: expected the episodes of {DENSE!r}, {lacking[DENSE]}")
    methods = {name: _entry(name, method, episodes, terms) for name, method in old.methods.items()}
    results = Results(
        SCHEMA, old.task, "development", old.seed, task.horizon, old.machine, old.policy, methods, task.early_cut
    )  # fmt: skip
    return results, lacking


def _kept_episodes(
    folder: Path, old: Results1, seeds: range
) -> tuple[dict[str, list[EpisodeResult]], dict[str, str]]:
    """Return the episodes of the methods that have them, and what is wrong with the others'."""
    kept, lacking = {}, {}
    for name, method in old.methods.items():
        log = folder / f"{name}.jsonl"
        try:
            found = [episode for episode in read_episodes(log) if episode.seed in seeds]
        except FileNotFoundError:
            lacking[name] = f"got no {log}"
            continue
        solved = sum(episode.success for episode in found)
        if (solved, len(found)) == (method.success.k, len(seeds)):
            kept[name] = found
        else:
            expected = f"{method.success.k} solved of {len(seeds)}"
            lacking[name] = f"expected {expected} in {log}, got {solved} of {len(found)}"
    return kept, lacking


def _entry(
    name: str, old: MethodEntry1, episodes: Mapping[str, Sequence[EpisodeResult]], terms: Terms
) -> MethodEntry:
    carried = {field.name: getattr(old, field.name) for field in fields(old)}
    if name in episodes:
        carried |= compare_episodes(name, episodes[name], episodes[DENSE], terms)
    return MethodEntry(**carried)
