"""``offline_agreement.json``: over several tasks, which number of a method's answers says how its episodes go."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from torchrl_sparse.evaluation.results.offline import MEASURES, OfflineResults, Outcome
from torchrl_sparse.evaluation.statistics.ranks import mean_rank_correlation, rank_correlation
from torchrl_sparse.storage.json import read_json, write_json

__all__ = [
    "Agreement",
    "OfflineAgreement",
    "agreement_of",
    "load_agreement",
    "save_agreement",
    "together_rows",
]

_COSTS: dict[str, Callable[[Outcome], float]] = {
    "success": lambda outcome: -outcome.success,
    "time": lambda outcome: outcome.time,
}


@dataclass(frozen=True)
class Agreement:
    """How the order of methods by a measure agrees with their order by what episodes came to.

    Attributes:
        tasks: task -> Spearman's rank correlation of its methods; 1 where less always went with better.
        together: mean over tasks, each weighed by its methods.
        p: how often methods in random order within each task would come to a mean as far from 0.
    """

    tasks: dict[str, float]
    together: float
    p: float


@dataclass(frozen=True)
class OfflineAgreement:
    """The content of an ``offline_agreement.json``.

    Attributes:
        methods: task -> how many, without dense.
        success, time: measure -> how it agrees with that.
    """

    offline_agreement: Literal[1]
    methods: dict[str, int]
    success: dict[str, Agreement]
    time: dict[str, Agreement]


def load_agreement(path: str | os.PathLike) -> OfflineAgreement:
    """Read an ``offline_agreement.json``.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: naming file and key, if it is of another kind.
    """
    return read_json(path, OfflineAgreement)


def save_agreement(agreement: OfflineAgreement, path: str | os.PathLike) -> Path:
    """Write an ``offline_agreement.json`` in one piece or not at all; return the path."""
    return write_json(path, agreement)


def agreement_of(results: Sequence[OfflineResults]) -> OfflineAgreement:
    """Put several tasks together, of each its first table.

    Raises:
        ValueError: for two of the same task.
    """
    tasks = {one.task: one for one in results}
    if len(tasks) < len(results):
        raise ValueError(f"aggregate: expected one file of each task, got {[one.task for one in results]}")
    played = {task: next(iter(one.played.values())) for task, one in tasks.items()}

    def agree(measure: str, outcome: str) -> Agreement:
        groups = {
            task: (
                [getattr(tasks[task].errors[name], measure) for name in table],
                [_COSTS[outcome](one) for one in table.values()],
            )
            for task, table in played.items()
        }
        alone = {task: rank_correlation(*group) for task, group in groups.items()}
        return Agreement(alone, *mean_rank_correlation([*groups.values()]))

    found = ({measure: agree(measure, outcome) for measure in MEASURES} for outcome in _COSTS)
    return OfflineAgreement(1, {task: len(table) for task, table in played.items()}, *found)


def together_rows(agreement: OfflineAgreement) -> dict[str, list[dict[str, str]]]:
    """Return two tables, ``"success"`` and ``"time"``, with a row for each measure."""

    def row(measure: str, found: Agreement) -> dict[str, str]:
        cells = {f"{task}, {agreement.methods[task]}": f"{value:+.2f}" for task, value in found.tasks.items()}
        total = sum(agreement.methods.values())
        more = {f"together, {total}": f"{found.together:+.2f}", "p": f"{found.p:.4f}"}
        return {"measure": measure.replace("_", " "), **cells, **more}

    tables = {"success": agreement.success, "time": agreement.time}
    return {name: [row(*entry) for entry in found.items()] for name, found in tables.items()}
