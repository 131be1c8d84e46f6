"""Pairwise comparisons of the methods in a ``realtime.json``, each at its own delay."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from torchrl_sparse.envs.seeds import evaluation_seeds
from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.results.build import Terms, compare_pair
from torchrl_sparse.evaluation.results.realtime import Realtime, RealtimePoint, load_realtime
from torchrl_sparse.evaluation.results.report import comparison_rows
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult, read_episodes
from torchrl_sparse.evaluation.statistics.sequential import Design

__all__ = ["late_pair_rows"]


def late_pair_rows(path: Path, pairs: Sequence[tuple[str, str]]) -> list[dict[str, str]]:
    """Compare points of a ``realtime.json`` by success and time, from the logs in its folder or below it.

    Args:
        path: of the file.
        pairs: of points, the first against the second. ``"ddim10 +1"`` is the method ddim10 one step late; one that is not
            late at all has an ordinary log, and is compared in a ``results.json``.

    Returns:
        For each pair a row, column -> text.

    Raises:
        FileNotFoundError: if the file or a log is not there.
        InputError: if the file has no such late point.

    >>> (row,) = late_pair_rows(Path("assets/lift/realtime.json"), [("ddim10 +1", "dense_noise +3")])
    >>> row["success"], row["difference, points"]
    ('100 : 89', '+11.0 [+6.3, +18.6]')
    """
    results = load_realtime(path)
    points = dict(_late(results))
    if unknown := [point for pair in pairs for point in pair if point not in points]:
        raise InputError(f"pairs: expected two of {', '.join(points)}, got {', '.join(unknown)}")
    played = {name: _episodes(path.parent, name, results, points) for pair in pairs for name in pair}
    first = points[pairs[0][0]]
    terms = Terms(
        Design(first.success.n),
        results.episode_horizon,
        margin=first.paired_vs_dense.margin,
        time_margin=first.time_vs_dense.margin,
    )
    return comparison_rows(
        [compare_pair(ours, played[ours], other, played[other], terms) for ours, other in pairs]
    )


def _late(results: Realtime) -> Iterable[tuple[str, RealtimePoint]]:
    for name, method in results.methods.items():
        yield from ((f"{name} +{point.delay_steps}", point) for point in method.points if point.delay_steps)


def _episodes(
    folder: Path, name: str, results: Realtime, points: Mapping[str, RealtimePoint]
) -> list[EpisodeResult]:
    stem = name.replace(" +", "_delay")
    log = min(folder.rglob(f"{stem}.jsonl*"), default=folder / f"{stem}.jsonl")
    seeds = evaluation_seeds(results.split, results.seed, points[name].success.n)
    return [episode for episode in read_episodes(log) if episode.seed in seeds]
