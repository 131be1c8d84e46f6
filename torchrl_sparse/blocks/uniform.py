"""Uniform caching: every block is recomputed at each ``interval``-th denoising step and reused in between.

The fixed-interval baseline of BAC (arXiv:2506.13456, Table 1) and, at block level, of EfficientVLA
(arXiv:2506.10100). As in BAC's release the last step is not forced: the computed steps are exactly the
multiples of the interval. BAC's own schedules always compute it, though, and it matters most: with ``last`` the
baseline does too, and an interval of 7 of 100 steps then costs what BAC does with ten updates.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_sparse.blocks.planner import PlanSpec, StaticPlanner
from torchrl_sparse.errors import InputError

__all__ = ["Uniform", "uniform_mask"]


def uniform_mask(num_steps: int, num_blocks: int, interval: int, *, last: bool = False) -> Tensor:
    """Return bool [num_steps, num_blocks], True = pruned; steps 0, interval, 2 · interval, … compute everything.

    With ``last``, so does the last step.

    >>> uniform_mask(6, 1, interval=2).flatten().int().tolist()
    [0, 1, 0, 1, 0, 1]
    >>> uniform_mask(6, 1, interval=2, last=True).flatten().int().tolist()
    [0, 1, 0, 1, 0, 0]
    """
    computed = torch.arange(num_steps) % interval == 0
    computed[-1] |= last
    return (~computed)[:, None].repeat(1, num_blocks)


class Uniform(StaticPlanner):
    """Planner that writes the same uniform mask for every observation.

    Args:
        interval: denoising steps from one update to the next, >= 1 (1 is dense).
        last: also compute the last denoising step.

    Raises:
        InputError: if ``interval`` is not a whole number of at least 1.

    Examples:
        >>> spec = PlanSpec(num_inference_steps=100, num_layers=8, policy="any")
        >>> Uniform(10).mask(spec).sum().item() / (100 * 24)
        0.9
        >>> Uniform(7, last=True).mask(spec).sum().item() / (100 * 24)
        0.84
    """

    def __init__(self, interval: int, *, last: bool = False) -> None:
        if type(interval) is not int or interval < 1:
            raise InputError(f"interval: expected a whole number >= 1, got {interval!r}")
        super().__init__()
        self.interval, self.last = interval, last

    def mask(self, spec: PlanSpec) -> Tensor:
        """Return the uniform mask [K, 3L]."""
        return uniform_mask(spec.num_inference_steps, spec.num_blocks, self.interval, last=self.last)
