"""Intervals by resampling: of a ratio of medians over the rounds of a measurement, of a mean over tasks by their seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["Aggregate", "aggregate_tasks", "median_ratio_interval"]

_DRAWS = 4000
_LIMITS = (2.5, 97.5)


def median_ratio_interval(numerator: ArrayLike, denominator: ArrayLike) -> tuple[float, float]:
    """Return the 95 % percentile interval of the ratio of two medians, rounds being drawn with replacement.

    A round timed both, one right after the other: drawn together, what slowed the machine in it slows both.

    Args:
        numerator, denominator: seconds of each round, [rounds], in the order of the rounds.

    Raises:
        ValueError: if they are not as many, or none.

    >>> median_ratio_interval([2.0, 2.0, 2.0], [1.0, 1.0, 1.0])
    (2.0, 2.0)
    """
    top, bottom = np.asarray(numerator, dtype=np.float64), np.asarray(denominator, dtype=np.float64)
    if top.shape != bottom.shape or not top.size:
        raise ValueError(
            f"rounds: expected as many of both, and at least one, got {top.size} and {bottom.size}"
        )
    rounds = _draw(np.random.default_rng(0), len(top))
    return _limits(np.median(top[rounds], axis=1) / np.median(bottom[rounds], axis=1))


@dataclass(frozen=True)
class Aggregate:
    """A method against dense over several tasks, each of the same weight, with 95 % intervals.

    Attributes:
        success: mean over the tasks of the difference of success rates.
        success_ci: its interval.
        time: geometric mean over the tasks of the ratio of restricted mean times.
        time_ci: its interval.
        episodes: pairs, of all tasks together.
    """

    success: float
    success_ci: tuple[float, float]
    time: float
    time_ci: tuple[float, float]
    episodes: int


def aggregate_tasks(
    successes: Mapping[str, Sequence[tuple[bool, bool]]], times: Mapping[str, Sequence[tuple[float, float]]]
) -> Aggregate:
    """Put the tasks of a method together: seeds are drawn with replacement within each task, and never across.

    Args:
        successes: task -> (method's, dense's) of each seed.
        times: task -> the same of restricted times, in steps.

    Raises:
        ValueError: if there is no task, or a task has no seed.

    >>> result = aggregate_tasks({"a": [(True, True)], "b": [(False, True)]}, {"a": [(10, 10)], "b": [(40, 10)]})
    >>> result.success, result.time
    (-0.5, 2.0)
    """
    if not successes or not all(successes.values()) or successes.keys() != times.keys():
        raise ValueError(f"tasks: expected seeds of at least one, got {sorted(successes)}")
    generator = np.random.default_rng(0)
    differences, logs = [], []
    for task, pairs in successes.items():
        solved, steps = np.asarray(pairs, dtype=np.float64), np.asarray(times[task], dtype=np.float64)
        drawn = np.vstack([np.arange(len(solved)), _draw(generator, len(solved))])
        differences.append((solved[drawn, 0] - solved[drawn, 1]).mean(axis=1))
        logs.append(np.log(steps[drawn, 0].mean(axis=1) / steps[drawn, 1].mean(axis=1)))
    success, time = np.mean(differences, axis=0), np.exp(np.mean(logs, axis=0))
    episodes = sum(len(pairs) for pairs in successes.values())
    return Aggregate(float(success[0]), _limits(success[1:]), float(time[0]), _limits(time[1:]), episodes)


def _draw(generator: np.random.Generator, n: int) -> NDArray[np.int64]:
    """Return indices [draws, n], with a fixed seed so that a table is the same whenever it is made."""
    return generator.integers(n, size=(_DRAWS, n))


def _limits(values: NDArray) -> tuple[float, float]:
    low, high = np.percentile(values, _LIMITS)
    return float(low), float(high)
