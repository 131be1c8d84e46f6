"""Modes that each method's episodes take: a method that solves as many but takes only one mode has collapsed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from torchrl_sparse.envs.seeded import BETWEEN, NO_WAY
from torchrl_sparse.evaluation.results.text import percent_range
from torchrl_sparse.evaluation.statistics.intervals import wilson_interval
from torchrl_sparse.evaluation.statistics.ways import way_entropy

__all__ = ["way_rows"]


def way_rows(ways: Mapping[str, Sequence[int]]) -> list[dict[str, str]]:
    """Return one row per method: episodes in each mode, episodes between modes, and the entropy in bits.

    Args:
        ways: method -> the ways of its episodes, see `EpisodeResult.way`.

    >>> way_rows({"dense": [0, 1, 1, 0], "ddim3": [0, 0, -2, 0]})[1]["between"]
    '1 [5, 70] %'
    """
    known = sorted({way for told in ways.values() for way in told if way >= 0})
    return [_row(name, list(told), known) for name, told in ways.items()]


def _row(name: str, told: list[int], known: Sequence[int]) -> dict[str, str]:
    n, between = len(told), told.count(BETWEEN)
    return {
        "method": name,
        "episodes": str(n),
        **{f"way {way}": str(told.count(way)) for way in known},
        "between": f"{between} {percent_range(wilson_interval(between, n))} %",
        "none": str(told.count(NO_WAY)),
        "entropy, bits": f"{way_entropy(told):.2f}" if max(told) >= 0 else "",
    }
