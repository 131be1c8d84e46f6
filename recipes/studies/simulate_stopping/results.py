"""``stopping.json``: simulated savings and errors of early stopping on tasks like those of this repository."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from recipes.studies.simulate_stopping.simulated import (
    Covered,
    VerdictErrors,
    simulate_aggregates,
    simulate_errors,
)
from recipes.studies.simulate_stopping.simulation import (
    Population,
    Savings,
    claim_rates,
    pair_errors,
    savings,
)
from torchrl_sparse.evaluation.statistics.intervals import DEFAULT_MARGIN
from torchrl_sparse.evaluation.statistics.sequential import Design
from torchrl_sparse.storage.json import read_json, write_json

__all__ = [
    "EqualPair",
    "SavedEpisodes",
    "StoppingResults",
    "TypeOne",
    "load_stopping",
    "save_stopping",
    "simulate_stopping",
    "stopping_rows",
]

# Success and mean steps of solved episodes of the dense policies here, rounded.
_TASKS = {
    "Lift": Population(0.9975, 0.0, 29),
    "Can": Population(0.87, 0.0, 104),
    "Square": Population(0.68, 0.0, 165),
}
_DIFFERENCES = (-0.2, -0.1, -0.05, -0.02, 0.0, 0.02)
_PAIR_DIFFERENCES = (-0.2, -0.1, 0.0)  # of both from dense: stopped soon, later, late


@dataclass(frozen=True)
class TypeOne:
    """Rate of false non-inferiority claims, at any analysis, for a method that is worse by exactly the margin."""

    task: str
    margin: Literal["success", "time, slower", "time, failing more"]
    rate: float


@dataclass(frozen=True)
class SavedEpisodes:
    """Episodes saved at a true difference of success rates, which also makes the method slower by ``ratio``."""

    task: str
    difference: float
    ratio: float
    savings: Savings


@dataclass(frozen=True)
class EqualPair:
    """Rate at which the intervals of two equal methods exclude equality, at a true difference of both from dense.

    Attributes:
        success, time: of the difference in success, and of the ratio of times.
    """

    task: str
    difference: float
    success: float
    time: float


@dataclass(frozen=True)
class StoppingResults:
    """The content of a ``stopping.json``."""

    stopping: Literal[1]
    max_episodes: int
    analyses: int
    trials: int
    seed: int
    type_one: tuple[TypeOne, ...]
    savings: tuple[SavedEpisodes, ...]
    pairs: tuple[EqualPair, ...] = ()
    errors: tuple[VerdictErrors, ...] = ()
    aggregates: tuple[Covered, ...] = ()


def simulate_stopping(max_episodes: int, analyses: int, trials: int, seed: int = 0) -> StoppingResults:
    """Run every simulated case.

    Args:
        max_episodes, analyses: of the `Design`.
        trials: benchmarks of each case.
        seed: of all.

    Raises:
        InputError: for a design that is none.
    """
    design = Design(max_episodes, analyses)
    type_one, saved, pairs = (tuple(cases(design, trials, seed)) for cases in (_type_one, _savings, _pairs))
    errors, aggregates = simulate_errors(trials, seed), simulate_aggregates(trials, seed)
    return StoppingResults(
        1, max_episodes, analyses, trials, seed, type_one, saved, pairs, errors, aggregates
    )


def _type_one(design: Design, trials: int, seed: int) -> Iterator[TypeOne]:
    for task, equal in _TASKS.items():
        worse = replace(equal, difference=-DEFAULT_MARGIN)
        yield TypeOne(task, "success", claim_rates(worse, design, trials, seed)[0])
        yield TypeOne(task, "time, slower", claim_rates(equal.at_time_margin(), design, trials, seed)[1])
        failing = equal.failing_at_time_margin()
        yield TypeOne(task, "time, failing more", claim_rates(failing, design, trials, seed)[1])


def _savings(design: Design, trials: int, seed: int) -> Iterator[SavedEpisodes]:
    for task, equal in _TASKS.items():
        for difference in _DIFFERENCES:
            if equal.success + difference <= 1:
                method = replace(equal, difference=difference)
                yield SavedEpisodes(task, difference, method.ratio, savings(method, design, trials, seed))


def _pairs(design: Design, trials: int, seed: int) -> Iterator[EqualPair]:
    for task, equal in _TASKS.items():
        for difference in _PAIR_DIFFERENCES:
            both = replace(equal, difference=difference)
            yield EqualPair(task, difference, *pair_errors(both, design, trials, seed))


def load_stopping(path: str | os.PathLike) -> StoppingResults:
    """Read a ``stopping.json``.

    Raises:
        FileNotFoundError: if there is none.
        InputError: naming file and key, if it is of another kind.
    """
    return read_json(path, StoppingResults)


def save_stopping(results: StoppingResults, path: str | os.PathLike) -> Path:
    """Write a ``stopping.json`` in one piece or not at all; return the path."""
    return write_json(path, results)


def stopping_rows(results: StoppingResults) -> dict[str, list[dict[str, str]]]:
    """Return the tables: false claims, episodes saved, equal methods called different, largest errors, and least coverage."""
    claims = [
        {"like": one.task, "margin": one.margin, "non-inferior all the same": f"{one.rate:.1%}"}
        for one in results.type_one
    ]
    saved = [
        {
            "like": one.task,
            "true difference, points": f"{100 * one.difference:+.0f}",
            "time vs dense": f"{one.ratio:.2f}",
            "episodes saved": f"{one.savings.saved:.0%}",
            "non-inferior": f"{one.savings.non_inferior:.0%}",
            "inferior": f"{one.savings.inferior:.0%}",
        }
        for one in results.savings
    ]
    pairs = [
        {
            "like": one.task,
            "both to dense, points": f"{100 * one.difference:+.0f}",
            "success seems to differ": f"{one.success:.1%}",
            "time seems to differ": f"{one.time:.1%}",
        }
        for one in results.pairs
    ]
    errors = [
        {
            "episodes, at most": str(one.max_episodes),
            "analyses": str(one.analyses),
            "non-inferior all the same": f"{one.non_inferior:.1%}",
            "dense's rate there": f"{one.rate:g}",
            "correlation there": f"{one.correlation:g}",
            "inferior": f"{one.inferior:.1%}",
        }
        for one in results.errors
    ]
    covered = [
        {
            "tasks, pairs of each": one.tasks,
            "success covered": f"{one.success:.1%}",
            "time covered": f"{one.time:.1%}",
        }
        for one in results.aggregates
    ]
    tables = {"claims": claims, "saved": saved, "pairs": pairs, "errors": errors, "aggregates": covered}
    return {name: rows for name, rows in tables.items() if rows}
