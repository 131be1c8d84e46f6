"""Calibrated token budgets: a pruner's number, chosen for a stated tolerance, stored as a JSON file.

SpecPrune's paper (arXiv:2509.05614) sets alpha by hand for each task suite, from 0.6 to 1, and a baseline that is not tuned as
well says nothing. `torchrl_sparse.training.vla.token_budget` measures what each number loses; here the choice is made, kept and
turned into a pruner.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from torchrl_sparse.errors import InputError
from torchrl_sparse.methods.vla import TOKEN_METHODS, make_pruner
from torchrl_sparse.storage.json import read_json, write_json
from torchrl_sparse.tokens.base import TokenPruner

__all__ = ["BudgetPoint", "TokenBudget", "fewest_tokens", "numbered_pruner"]


@dataclass(frozen=True)
class BudgetPoint:
    """Loss and savings at one number.

    Attributes:
        number: SpecPrune's alpha, which multiplies its budget, a baseline's share of the tokens, and so on.
        kept: visual tokens in a decoder layer, mean over layers and all policy calls but the first of an episode, which may
            keep all of them whatever the number is.
        loss: mean absolute difference to the dense policy's normalised actions, or the share of episodes that were lost.
    """

    number: float
    kept: float
    loss: float


@dataclass(frozen=True)
class TokenBudget:
    """A calibrated number and the measurements behind it.

    Attributes:
        method: key of `TOKEN_METHODS`.
        number: the choice.
        measure: of the losses, ``"action_error"`` or ``"success"``.
        tolerance: the largest loss that was accepted.
        points: all that was tried.
        settings: further arguments of the method, for SpecPrune the fields of `SpecPruneOptions` that differ from the paper's.

    Raises:
        InputError: if there is no such method, it has no number, or its pruner refuses the number or a setting.

    Examples:
        >>> points = (BudgetPoint(0.5, 90.0, 0.03), BudgetPoint(1.0, 150.0, 0.01))
        >>> budget = TokenBudget("specprune", fewest_tokens(points, 0.02), "action_error", 0.02, points)
        >>> budget.pruner().options.alpha
        1.0
    """

    method: str
    number: float
    measure: Literal["action_error", "success"]
    tolerance: float
    points: tuple[BudgetPoint, ...]
    settings: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.pruner()

    def pruner(self) -> TokenPruner:
        """Return the pruner at this number."""
        return numbered_pruner(self.method, self.number, self.settings)

    def save_pretrained(self, path: str | Path) -> None:
        """Write a JSON file for `from_pretrained`, completely or not at all."""
        write_json(path, self)

    @classmethod
    def from_pretrained(cls, path: str | Path) -> TokenBudget:
        """Load a budget written by `save_pretrained`.

        Raises:
            FileNotFoundError, InputError: naming the file, what was expected in it and what was found.

        Examples:
            >>> TokenBudget.from_pretrained("assets/vla/specprune.json").number
            0.17
        """
        return read_json(path, cls)


def numbered_pruner(method: str, number: float, settings: dict[str, Any]) -> TokenPruner:
    """Return the pruner of a method in the table with its number set.

    Args:
        method: key of `TOKEN_METHODS`.
        number: of its argument ``TOKEN_METHODS[method].number``.
        settings: its further arguments; empty for methods that have none.

    Raises:
        InputError: see `TokenBudget`.

    >>> numbered_pruner("fastv", 0.3, {}).share
    0.3
    """
    tuned = [name for name, entry in TOKEN_METHODS.items() if entry.number is not None]
    if method not in tuned:
        raise InputError(f"method: expected one of {', '.join(tuned)}, got {method!r}")
    section = TOKEN_METHODS[method].settings
    if settings and section is None:
        raise InputError(f"settings: expected none for {method}, got {settings}")
    try:
        pruner = make_pruner(method, number=number, settings={section: settings} if section else None)
    except TypeError as error:
        raise InputError(f"settings: expected arguments of {method}, got {error}") from error
    assert pruner is not None  # no number tunes the dense policy
    return pruner


def fewest_tokens(points: Sequence[BudgetPoint], tolerance: float) -> float:
    """Return the number that keeps fewest tokens such that it and all larger budgets lose at most ``tolerance``.

    Numbers that keep as many tokens, as all of VLA-Cache do, go from the smallest to the largest.

    Raises:
        InputError: if even the one that keeps most does; the message lists all.
    """
    chosen = None
    for point in sorted(points, key=lambda point: (-point.kept, point.number)):
        if point.loss > tolerance:
            break
        chosen = point.number
    if chosen is None:
        found = ", ".join(f"{point.number:g}: {point.loss:.3g}" for point in points)
        raise InputError(
            f"tolerance: expected a loss of at most {tolerance:g} where most tokens are kept, got {found}"
        )
    return chosen
