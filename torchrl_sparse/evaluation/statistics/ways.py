"""Outcomes of episodes beside success: the mode taken on a multimodal task, and the number of subtasks done."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from math import log2

from torchrl_sparse.errors import InputError

__all__ = ["count_levels", "way_entropy"]


def way_entropy(ways: Iterable[int]) -> float:
    """Return the entropy, in bits, of the modes that episodes took; 0 for a single mode, 2 for four equally frequent ones.

    It is the entropy of observed frequencies, so it underestimates the policy's: with four equal modes and 20 episodes it is
    1.9 in the mean.

    Args:
        ways: one number an episode. Negative ones, which showed no way or went between them, count as no episode.

    Raises:
        InputError: if no episode showed a way.

    >>> way_entropy([0, 3, 0, 3, -1])
    1.0
    """
    counts = Counter(way for way in ways if way >= 0)
    if not (total := counts.total()):
        raise InputError("ways: expected at least one episode that showed its way, got none")
    return sum(count / total * log2(total / count) for count in counts.values())


def count_levels(told: Sequence[int], most: int = 0) -> dict[str, int]:
    """Count the episodes with at least one subtask done, two, … up to ``most`` or the maximum of any episode.

    >>> count_levels([2, 2, 1, 0])
    {'p1': 3, 'p2': 2}
    """
    levels = range(1, max(1, most, *told) + 1)
    return {f"p{level}": sum(count >= level for count in told) for level in levels}
