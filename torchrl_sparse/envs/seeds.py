"""Ranges of episode seeds by purpose, so that nothing is tested on episodes that it was trained or tuned on.

Demonstrations begin at seed 0. Whatever is tuned (calibrations, sweeps, searches, evaluations during training, benchmarks while
a method is being made) looks at development seeds; a table is made on test seeds, once. Until November 2026 evaluations during
training and sweeps began at 200 000, so benchmarks begin beyond what those saw. Schedules and pruners that were calibrated on
the seeds of that time, from 1 000 000 and 2 000 000 on, are not remade: no table reaches those either.
"""

from __future__ import annotations

import operator
from typing import Any, Literal, get_args

from torchrl_sparse.errors import InputError

__all__ = [
    "CALIBRATION_SEED",
    "CLOSED_LOOP_SEED",
    "DEVELOPMENT_SEED",
    "FIRST_TEST_SEED",
    "Split",
    "evaluation_seeds",
    "tuning_seeds",
    "whole_seed",
]

Split = Literal["test", "development"]

FIRST_TEST_SEED = 200_000
_SPLITS: dict[str, range] = {
    "development": range(100_000, FIRST_TEST_SEED),
    "test": range(210_000, 1_000_000),
}

# All within the development range, and as far apart as anybody's number of episodes.
DEVELOPMENT_SEED = 150_000  # of evaluations during training, and of sweeps
CLOSED_LOOP_SEED = 160_000  # of the episodes that a pruner is trained on
CALIBRATION_SEED = 180_000  # of the observations that cache schedules are computed from


def evaluation_seeds(split: str, offset: int, episodes: int) -> range:
    """Return the seeds of a benchmark's episodes; a second benchmark can extend the first by another ``offset``.

    Args:
        split: "test" or "development".
        offset: of the first episode in the split's range.
        episodes: how many.

    Raises:
        InputError: for another split, or seeds that would leave its range.

    >>> evaluation_seeds("development", 200, 3), evaluation_seeds("test", 0, 2)
    (range(100200, 100203), range(210000, 210002))
    """
    if split not in get_args(Split):
        raise InputError(f"split: expected {' or '.join(get_args(Split))}, got {split!r}")
    of_split = _SPLITS[split]
    if offset < 0 or offset + episodes > len(of_split):
        raise InputError(
            f"seed: expected {episodes} episodes from 0 to {len(of_split)} of the {split} seeds, got {offset}"
        )
    return of_split[offset : offset + episodes]


def tuning_seeds(first: int, episodes: int) -> range:
    """Return the seeds of episodes for tuning.

    Args:
        first: seed.
        episodes: how many.

    Raises:
        InputError: if one of them is for tests.

    >>> tuning_seeds(CALIBRATION_SEED, 2)
    range(180000, 180002)
    """
    if first + episodes > FIRST_TEST_SEED:
        last = first + episodes - 1
        raise InputError(f"seed: expected seeds below {FIRST_TEST_SEED} for tuning, got the test seed {last}")
    return range(first, first + episodes)


def whole_seed(seed: Any) -> int:
    """Convert a seed of any integer-like type to an int.

    Raises:
        InputError: if it is a fraction, which would silently be another episode, negative, or of more than 63 bits.

    >>> whole_seed(1.7)
    Traceback (most recent call last):
    ...
    torchrl_sparse.errors.InputError: seed: expected a whole number from 0 to 2**63 - 1, got 1.7
    """
    try:
        value = operator.index(seed)
    except TypeError:
        value = -1
    if not 0 <= value < 1 << 63:
        raise InputError(f"seed: expected a whole number from 0 to 2**63 - 1, got {seed!r}")
    return value
