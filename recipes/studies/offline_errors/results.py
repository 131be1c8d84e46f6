"""``offline_errors_TASK.json``: how methods change a policy's actions, and whether that predicts its episodes."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Literal

from recipes.studies.offline_errors.errors import OfflineErrors
from recipes.studies.offline_errors.ranks import rank_correlation
from torchrl_sparse.evaluation.results.schema import DENSE, MethodEntry, Results
from torchrl_sparse.storage.json import read_json, write_json

__all__ = [
    "MEASURES",
    "OfflineResults",
    "Outcome",
    "agreement_rows",
    "error_rows",
    "load_offline",
    "outcomes",
    "rank_agreement",
    "save_offline",
]

_SELF = (DENSE, "dense_noise")  # what the others are compared with
MEASURES = tuple(field.name for field in fields(OfflineErrors))


@dataclass(frozen=True)
class Outcome:
    """Episode results of a method relative to dense in the same table.

    Attributes:
        success: difference of success rates.
        time: ratio of mean steps, the horizon where an episode was not solved.
    """

    success: float
    time: float


@dataclass(frozen=True)
class OfflineResults:
    """The content of an ``offline_errors_TASK.json``.

    Attributes:
        policy: its fingerprint.
        policy calls, draws: how many were answered, and how often each.
        seed: of the calls and the noise.
        errors: method -> what was measured of its answers.
        played: table of results -> method -> what its episodes came to.
    """

    offline_errors: Literal[1]
    task: str
    policy: str
    queries: int
    draws: int
    seed: int
    errors: dict[str, OfflineErrors]
    played: dict[str, dict[str, Outcome]]


def load_offline(path: str | os.PathLike) -> OfflineResults:
    """Read an ``offline_errors_TASK.json``.

    Raises:
        FileNotFoundError: if there is none.
        InputError: naming file and key, if it is of another kind.
    """
    return read_json(path, OfflineResults)


def save_offline(results: OfflineResults, path: str | os.PathLike) -> Path:
    """Write an ``offline_errors_TASK.json`` in one piece or not at all; return the path."""
    return write_json(path, results)


def outcomes(results: Results) -> dict[str, Outcome]:
    """Return the episode results of a table's methods except dense; scores where the task is graded."""
    dense = results.dense
    return {
        name: Outcome(_reached(entry) - _reached(dense), entry.episode_length / dense.episode_length)
        for name, entry in results.methods.items()
        if name not in _SELF
    }


def _reached(entry: MethodEntry) -> float:
    return entry.score.mean if entry.score else entry.success.rate


def error_rows(results: OfflineResults) -> list[dict[str, str]]:
    """Return one row per method."""
    return [
        {"method": name, **{_words(measure): f"{value:.3f}" for measure, value in asdict(errors).items()}}
        for name, errors in results.errors.items()
    ]


def rank_agreement(results: OfflineResults, table: str, measure: str) -> Outcome:
    """Return how well the order of a table's methods by a measure agrees with their order by episode results.

    Spearman's rank correlation: 1 where a smaller error always went with a higher success, and with a shorter time.
    """
    played = results.played[table]
    errors = [getattr(results.errors[name], measure) for name in played]
    costs = [-one.success for one in played.values()], [one.time for one in played.values()]
    return Outcome(*(rank_correlation(errors, cost) for cost in costs))


def agreement_rows(results: OfflineResults) -> list[dict[str, str]]:
    """Return one row per measure: its rank correlations with success and with time, for each table."""
    rows = []
    for measure in MEASURES:
        row = {"measure": _words(measure)}
        for table, played in results.played.items():
            found = rank_agreement(results, table, measure)
            row[f"{table}, {len(played)} methods: success"] = f"{found.success:+.2f}"
            row[f"{table}: time"] = f"{found.time:+.2f}"
        rows.append(row)
    return rows


def _words(measure: str) -> str:
    return measure.replace("_", " ")
