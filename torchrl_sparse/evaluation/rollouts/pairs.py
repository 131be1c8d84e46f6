"""Episodes of two methods, seed by seed: what they solved, and how long they took."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult
from torchrl_sparse.evaluation.statistics.durations import restricted_times, time_z
from torchrl_sparse.evaluation.statistics.intervals import tango_z

__all__ = ["EpisodePairs", "pair_episodes"]


@dataclass(frozen=True)
class EpisodePairs:
    """Two methods on the same seeds, in the same order.

    Attributes:
        method: episodes of the first.
        other: episodes of the second.
    """

    method: Sequence[EpisodeResult]
    other: Sequence[EpisodeResult]

    @property
    def solved(self) -> tuple[list[bool], list[bool]]:
        """Successes of both."""
        return [episode.success for episode in self.method], [episode.success for episode in self.other]

    @property
    def score_gains(self) -> NDArray[np.float64]:
        """How much higher the first one's scores are, pair by pair."""
        ours, theirs = (
            np.array([episode.score for episode in episodes]) for episodes in (self.method, self.other)
        )
        return ours - theirs

    def times(self, horizon: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the restricted times of both; see `restricted_times`."""
        lengths = ([episode.length for episode in episodes] for episodes in (self.method, self.other))
        ours, theirs = (restricted_times(*both, horizon) for both in zip(self.solved, lengths, strict=True))
        return ours, theirs

    def statistics(self, horizon: int, margin: float, time_margin: float) -> tuple[float, float]:
        """Return by how many standard errors successes and times are better than their margins."""
        ours, theirs = self.solved
        won = sum(a and not b for a, b in zip(ours, theirs, strict=True))
        lost = sum(b and not a for a, b in zip(ours, theirs, strict=True))
        times = time_z(*self.times(horizon), horizon, 1 + time_margin)
        return tango_z(won, lost, len(ours), -margin), times


def pair_episodes(
    name: str, episodes: Sequence[EpisodeResult], other: str, others: Sequence[EpisodeResult]
) -> EpisodePairs:
    """Put the episodes of two methods beside each other.

    Args:
        name, other: of the methods, for errors.
        episodes: of the first, in any order.
        others: of the second, on the same seeds.

    Raises:
        ValueError: if they ran on different seeds, or a seed ran twice.
    """
    ours, theirs = _by_seed(episodes), _by_seed(others)
    if ours.keys() != theirs.keys():
        odd = sorted(ours.keys() ^ theirs.keys())
        raise ValueError(f"{name}: expected the seeds of {other!r}, got others: {odd[:10]} are in one only")
    return EpisodePairs([*ours.values()], [theirs[seed] for seed in ours])


def _by_seed(episodes: Sequence[EpisodeResult]) -> dict[int, EpisodeResult]:
    by_seed = {episode.seed: episode for episode in episodes}
    if len(by_seed) != len(episodes):
        raise ValueError(f"expected one episode per seed, got {len(episodes)} for {len(by_seed)} seeds")
    return by_seed
