"""Mean scores by method on graded tasks: Push-T's overlap, or subtasks done."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from torchrl_sparse.evaluation.results.text import difference_text, mean_text, verdict_text
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult
from torchrl_sparse.evaluation.statistics.differences import Difference
from torchrl_sparse.evaluation.statistics.intervals import verdict
from torchrl_sparse.evaluation.statistics.scores import mean_interval

__all__ = ["score_rows", "told_scores"]


def told_scores(episodes: Mapping[str, Sequence[EpisodeResult]]) -> dict[str, dict[int, float]]:
    """Return the scores of each method's episodes by seed; methods whose task has no scores are left out."""
    scores = {
        name: {e.seed: e.score for e in played if e.score is not None} for name, played in episodes.items()
    }
    return {name: told for name, told in scores.items() if told}


def score_rows(scores: Mapping[str, Mapping[int, float]], margin: float) -> list[dict[str, str]]:
    """Return one row per method: its mean score, and the paired difference to dense on the shared seeds.

    Args:
        scores: method -> seed -> score in [0, 1]; at least two seeds that each method shares with ``dense``.
        margin: of non-inferiority, a difference of scores.

    >>> dense, fast = {0: 0.9, 1: 0.8, 2: 0.7}, {0: 0.9, 1: 0.7, 2: 0.7}
    >>> score_rows({"dense": dense, "ddim10": fast}, 0.05)[1]["vs dense, points"]
    '-3.3 [-17.7, +11.0]'
    """
    return [_row(name, told, scores["dense"], margin) for name, told in scores.items()]


def _row(name: str, told: Mapping[int, float], dense: Mapping[int, float], margin: float) -> dict[str, str]:
    row = {
        "method": name,
        "episodes": str(len(told)),
        "mean score": mean_text(*mean_interval([*told.values()])),
    }
    if name == "dense":
        return row | {"vs dense, points": "", "verdict": "baseline"}
    diff, ci = mean_interval([told[seed] - dense[seed] for seed in told.keys() & dense.keys()])
    difference = Difference(diff, ci, margin, verdict(ci, margin))
    return row | {"vs dense, points": difference_text(difference), "verdict": verdict_text(difference)}
