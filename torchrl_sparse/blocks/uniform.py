"""Uniform caching: every block is recomputed at each ``interval``-th denoising step and reused in between.

The fixed-interval baseline of BAC (arXiv:2506.13456, Table 1) and, at block level, of EfficientVLA
(arXiv:2506.10100). As in BAC's release the last step is not forced: the computed steps are exactly the
multiples of the interval.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_sparse.blocks.planner import PlanSpec, StaticPlanner

__all__ = ["Uniform", "uniform_mask"]


def uniform_mask(num_steps: int, num_blocks: int, interval: int) -> Tensor:
    """Return bool [num_steps, num_blocks], True = pruned; steps 0, interval, 2 · interval, … compute everything.

    >>> uniform_mask(5, 1, interval=2).flatten().int().tolist()
    [0, 1, 0, 1, 0]
    """
    computed = torch.arange(num_steps) % interval == 0
    return (~computed)[:, None].repeat(1, num_blocks)


class Uniform(StaticPlanner):
    """Writes the same uniform mask for every observation.

    Args:
        interval: denoising steps from one update to the next, >= 1 (1 is dense).

    Raises:
        ValueError: if ``interval`` is not a whole number of at least 1.

    Examples:
        >>> spec = PlanSpec(num_inference_steps=100, num_layers=8, policy="any")
        >>> Uniform(10).mask(spec).sum().item() / (100 * 24)
        0.9
    """

    def __init__(self, interval: int) -> None:
        if not isinstance(interval, int) or interval < 1:
            raise ValueError(f"interval: expected a whole number >= 1, got {interval!r}")
        super().__init__()
        self.interval = interval

    def mask(self, spec: PlanSpec) -> Tensor:
        """Return the uniform mask [K, 3L]."""
        return uniform_mask(spec.num_inference_steps, spec.num_blocks, self.interval)
