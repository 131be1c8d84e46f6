"""``offline_agreement.json``: which offline measure of a method's actions predicts its episodes, over several tasks."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from recipes.studies.offline_errors.ranks import (
    difference_ci95,
    mean_rank_correlation,
    rank_correlation,
)
from recipes.studies.offline_errors.results import MEASURES, OfflineResults, Outcome
from torchrl_sparse.errors import InputError
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
    """Agreement between the order of methods by an offline measure and their order by episode results.

    Attributes:
        tables: table -> Spearman's rank correlation of its methods; 1 where less always went with better.
        together: mean over tables, each weighed by its methods.
        p: how often methods in random order within each table would come to a mean as far from 0.
        over_error_ci95: of by how much ``together`` exceeds that of the error to demonstrations, methods drawn again.
    """

    tables: dict[str, float]
    together: float
    p: float
    over_error_ci95: tuple[float, float]


@dataclass(frozen=True)
class OfflineAgreement:
    """The content of an ``offline_agreement.json``.

    Attributes:
        methods: table -> how many, without dense.
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
        InputError: naming file and key, if it is of another kind.
    """
    return read_json(path, OfflineAgreement)


def save_agreement(agreement: OfflineAgreement, path: str | os.PathLike) -> Path:
    """Write an ``offline_agreement.json`` in one piece or not at all; return the path."""
    return write_json(path, agreement)


def agreement_of(results: Sequence[OfflineResults]) -> OfflineAgreement:
    """Combine all tables of several tasks, each with the errors of the file that lists it.

    Raises:
        InputError: for a table that is in two files.
    """
    groups = [(_short(path), one, table) for one in results for path, table in one.played.items()]
    methods = {name: len(table) for name, _, table in groups}
    if len(methods) < len(groups):
        raise InputError(f"aggregate: expected every table once, got {[name for name, _, _ in groups]}")

    def agree(measure: str, outcome: str) -> Agreement:
        ours, errors = ([_errors(one, table, key) for _, one, table in groups] for key in (measure, "error"))
        costs = [[_COSTS[outcome](played) for played in table.values()] for _, _, table in groups]
        pairs = [*zip(ours, costs, strict=True)]
        alone = {name: rank_correlation(*pair) for name, pair in zip(methods, pairs, strict=True)}
        over = difference_ci95([*zip(ours, errors, costs, strict=True)])
        return Agreement(alone, *mean_rank_correlation(pairs), over)

    found = ({measure: agree(measure, outcome) for measure in MEASURES} for outcome in _COSTS)
    return OfflineAgreement(1, methods, *found)


def _errors(results: OfflineResults, table: Mapping[str, Outcome], measure: str) -> list[float]:
    return [getattr(results.errors[method], measure) for method in table]


def _short(path: str) -> str:
    return path.removeprefix("assets/").removesuffix(".json").removesuffix("/results")


def together_rows(agreement: OfflineAgreement) -> dict[str, list[dict[str, str]]]:
    """Return two tables, ``"success"`` and ``"time"``, with one row per measure."""

    def row(measure: str, found: Agreement) -> dict[str, str]:
        cells = {
            f"{name}, {agreement.methods[name]}": f"{value:+.2f}" for name, value in found.tables.items()
        }
        total = sum(agreement.methods.values())
        low, high = found.over_error_ci95
        over = "" if measure == "error" else f"[{low:+.2f}, {high:+.2f}]"
        more = {f"together, {total}": f"{found.together:+.2f}", "p": f"{found.p:.4f}", "over the error": over}
        return {"measure": measure.replace("_", " "), **cells, **more}

    tables = {"success": agreement.success, "time": agreement.time}
    return {name: [row(*entry) for entry in found.items()] for name, found in tables.items()}
