"""A calibrated token budget: SpecPrune's alpha, chosen by a stated tolerance instead of by hand, as a JSON file.

The paper (arXiv:2509.05614) sets alpha by hand for each task suite, from 0.6 to 1. `torchrl_sparse.training.vla.token_budget`
measures what each alpha loses; here the choice is made, kept and turned into a pruner.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from torchrl_sparse.storage.json import read_json, write_json
from torchrl_sparse.tokens.specprune import SpecPrune

__all__ = ["BudgetPoint", "TokenBudget", "smallest_alpha"]


@dataclass(frozen=True)
class BudgetPoint:
    """The loss and the saving of one alpha.

    Attributes:
        alpha: multiplies SpecPrune's budget.
        kept: visual tokens in a decoder layer, mean over layers and all queries but the first of an episode, which keeps most
            of them whatever alpha is.
        loss: mean absolute difference to the dense policy's normalised actions, or the share of episodes that were lost.
    """

    alpha: float
    kept: float
    loss: float


@dataclass(frozen=True)
class TokenBudget:
    """A calibrated alpha, and the measurements that it was chosen from.

    Attributes:
        preset: of `SpecPrune`.
        alpha: the choice.
        measure: of the losses, ``"action_error"`` or ``"success"``.
        tolerance: the largest loss that was accepted.
        points: all that was tried.
        options: of `SpecPrune`, that differ from the preset's.

    Raises:
        ValueError: if `SpecPrune` refuses the preset or an option.

    Examples:
        >>> points = (BudgetPoint(0.5, 90.0, 0.03), BudgetPoint(1.0, 150.0, 0.01))
        >>> budget = TokenBudget("paper", smallest_alpha(points, 0.02), "action_error", 0.02, points)
        >>> budget.pruner().options.alpha
        1.0
    """

    preset: Literal["paper", "release"]
    alpha: float
    measure: Literal["action_error", "success"]
    tolerance: float
    points: tuple[BudgetPoint, ...]
    options: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        try:
            self.pruner()
        except TypeError as error:
            raise ValueError(f"options: expected fields of SpecPruneOptions, got {error}") from error

    def pruner(self) -> SpecPrune:
        """Return `SpecPrune` at this alpha."""
        return SpecPrune(self.preset, alpha=self.alpha, **self.options)

    def save_pretrained(self, path: str | Path) -> None:
        """Write a JSON file that `from_pretrained` reads, in one piece or not at all."""
        write_json(path, self)

    @classmethod
    def from_pretrained(cls, path: str | Path) -> TokenBudget:
        """Load what `save_pretrained` wrote.

        Raises:
            FileNotFoundError, ValueError: naming the file, what was expected in it and what was found.

        Examples:
            >>> TokenBudget.from_pretrained("assets/vla/specprune.json").alpha
            0.17
        """
        return read_json(path, cls)


def smallest_alpha(points: Sequence[BudgetPoint], tolerance: float) -> float:
    """Return the smallest alpha from which on no tried alpha loses more than ``tolerance``.

    Raises:
        ValueError: if even the largest does; the message lists all.
    """
    chosen = None
    for point in sorted(points, key=lambda point: -point.alpha):
        if point.loss > tolerance:
            break
        chosen = point.alpha
    if chosen is None:
        found = ", ".join(f"{point.alpha:g}: {point.loss:.3g}" for point in points)
        raise ValueError(
            f"tolerance: expected a loss of at most {tolerance:g} at the largest alpha, got {found}"
        )
    return chosen
