"""Table of subtasks completed by each method: the published p1 and p2 of block pushing, p1 to p4 of kitchen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from torchrl_sparse.evaluation.results.text import percent_range
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult
from torchrl_sparse.evaluation.statistics.intervals import wilson_interval
from torchrl_sparse.evaluation.statistics.ways import count_levels

__all__ = ["completed_rows", "told_completed"]


def told_completed(episodes: Mapping[str, Sequence[EpisodeResult]]) -> dict[str, list[int]]:
    """Return the number of subtasks in each method's episodes; methods whose task counts none are left out."""
    counts = {
        name: [e.completed for e in played if e.completed is not None] for name, played in episodes.items()
    }
    return {name: told for name, told in counts.items() if told}


def completed_rows(completed: Mapping[str, Sequence[int]]) -> list[dict[str, str]]:
    """Return one row per method: the share of episodes with at least n subtasks done, with Wilson's 95 % interval.

    Args:
        completed: method -> the parts that its episodes did, see `EpisodeResult.completed`.

    >>> completed_rows({"dense": [2, 2, 1, 2], "ddim3": [0, 1, 0, 0]})[1]["p1"]
    '1/4 [5, 70] %'
    """
    most = max(count for told in completed.values() for count in told)
    return [
        {"method": name, **{level: _share(k, len(told)) for level, k in count_levels(told, most).items()}}
        for name, told in completed.items()
    ]


def _share(k: int, n: int) -> str:
    return f"{k}/{n} {percent_range(wilson_interval(k, n))} %"
