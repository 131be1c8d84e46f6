"""Paired episodes of two methods: successes and times, seed by seed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult
from torchrl_sparse.evaluation.statistics.differences import Difference, TimeDifference
from torchrl_sparse.evaluation.statistics.durations import restricted_times, time_ratio, time_z
from torchrl_sparse.evaluation.statistics.intervals import (
    discordant_pairs,
    paired_difference,
    tango_z,
)
from torchrl_sparse.evaluation.statistics.scores import difference_interval, difference_z
from torchrl_sparse.evaluation.statistics.sequential import Design

__all__ = ["EpisodePairs", "pair_by_design", "pair_episodes"]


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
        """Successes of both methods."""
        return [episode.success for episode in self.method], [episode.success for episode in self.other]

    def times(self, horizon: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the restricted times of both methods; see `restricted_times`."""
        return _times(self.method, horizon), _times(self.other, horizon)

    def success_difference(self, margin: float, confidence: float = 0.95) -> Difference:
        """Compare the successes of both methods; see `paired_difference`."""
        return paired_difference(*self.solved, margin, confidence)

    def time_ratio(self, horizon: int, margin: float, confidence: float = 0.95) -> TimeDifference:
        """Compare the times of both methods; see `torchrl_sparse.evaluation.statistics.durations.time_ratio`."""
        return time_ratio(*self.times(horizon), horizon, margin, confidence)

    def score_difference(self, confidence: float = 0.95) -> tuple[float, tuple[float, float]]:
        """Compare the scores of both methods; see `difference_interval`."""
        return difference_interval(_scores(self.method), _scores(self.other), confidence)

    def statistics(self, horizon: int, margin: float, time_margin: float) -> tuple[float, float]:
        """Return by how many standard errors success and time beat their margins."""
        times = time_z(*self.times(horizon), horizon, 1 + time_margin)
        return tango_z(*discordant_pairs(*self.solved), -margin), times

    def score_statistic(self, margin: float) -> float:
        """Return by how many standard errors the score beats its margin."""
        return difference_z(_scores(self.method), _scores(self.other), -margin)


def pair_episodes(
    name: str,
    episodes: Sequence[EpisodeResult],
    other: str,
    others: Sequence[EpisodeResult],
) -> EpisodePairs:
    """Pair the episodes of two methods by seed.

    Args:
        name, other: of the methods, for errors.
        episodes: of the first, in any order.
        others: of the second, on the same seeds.

    Raises:
        InputError: if they ran on different seeds, or a seed ran twice.
    """
    ours, theirs = _by_seed(episodes), _by_seed(others)
    if ours.keys() != theirs.keys():
        odd = sorted(ours.keys() ^ theirs.keys())
        raise InputError(f"{name}: expected the seeds of {other!r}, got others: {odd[:10]} are in one only")
    return EpisodePairs([*ours.values()], [theirs[seed] for seed in ours])


def pair_by_design(
    name: str,
    episodes: Sequence[EpisodeResult],
    other: str,
    others: Sequence[EpisodeResult],
    design: Design,
) -> EpisodePairs:
    """Pair a method's episodes with another's on the same seeds.

    Args:
        name, other: of the methods, for errors.
        episodes: of the first.
        others: of the second; more of them only where the design has several analyses, after which methods stop.
        design: of the benchmark.

    Raises:
        InputError: if the seeds do not fit.
    """
    if design.analyses > 1:
        seeds = {episode.seed for episode in episodes}
        others = [episode for episode in others if episode.seed in seeds]
    return pair_episodes(name, episodes, other, others)


def _times(episodes: Sequence[EpisodeResult], horizon: int) -> NDArray[np.float64]:
    solved, lengths = [e.success for e in episodes], [e.length for e in episodes]
    return restricted_times(solved, lengths, horizon)


def _scores(episodes: Sequence[EpisodeResult]) -> NDArray[np.float64]:
    return np.array([episode.score for episode in episodes], dtype=np.float64)


def _by_seed(episodes: Sequence[EpisodeResult]) -> dict[int, EpisodeResult]:
    by_seed = {episode.seed: episode for episode in episodes}
    if len(by_seed) != len(episodes):
        raise InputError(f"episodes: expected one per seed, got {len(episodes)} for {len(by_seed)} seeds")
    return by_seed
