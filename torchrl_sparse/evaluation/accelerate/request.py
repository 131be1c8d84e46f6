"""The options of an acceleration."""

from __future__ import annotations

from dataclasses import dataclass

from torchrl_sparse.evaluation.statistics.durations import DEFAULT_TIME_MARGIN
from torchrl_sparse.evaluation.statistics.intervals import DEFAULT_MARGIN

__all__ = ["Request"]


@dataclass(frozen=True)
class Request:
    """Options of an acceleration.

    Attributes:
        task: a name or alias.
        budget_ms: milliseconds that 95 % of the policy calls may take; None asks for the fastest method that is still right.
        episodes: at most so many of each method, until its verdict is reached; 0 ranks offline and needs no simulator.
        finalists: methods that are played.
        margin: of non-inferiority in success, a difference of rates.
        time_margin: of the mean time to success, a share of dense's.
        n_action_steps: actions executed of a chunk.
        windows: of demonstrations, that errors are measured on.
        seed: of the windows, and of the first episode, see `evaluation_seeds`.
        repeats: timed calls of each candidate.
        threads: of the timing.
        workers: processes that play episodes.
    """

    task: str
    budget_ms: float | None = None
    episodes: int = 0
    finalists: int = 3
    margin: float = DEFAULT_MARGIN
    time_margin: float = DEFAULT_TIME_MARGIN
    n_action_steps: int = 8
    windows: int = 200
    seed: int = 0
    repeats: int = 30
    threads: int = 1
    workers: int = 1
