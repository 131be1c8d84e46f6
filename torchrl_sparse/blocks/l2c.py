"""Learning-to-Cache (L2C, arXiv:2406.01733) for denoising transformers: a learned schedule, the same for every observation.

One logit for each block of each denoising step, learned through the frozen policy, then cut at one half: the
baseline that tells what a learned mask is worth without the observation. As released, L2C may cache only every
other step and weighs sparsity with an L1 term; here every step but the first may be pruned and the sparsity term
is SAG's, so that both methods can be compared at the same cost. Pruned blocks reuse their own latest output.

:mod:`torchrl_sparse.training.pruner.trainer` trains it; its mask is kept as a
:class:`~torchrl_sparse.blocks.schedule.CacheSchedule`.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

__all__ = ["StaticGates"]


class StaticGates(nn.Module):
    """A logit for each block of each denoising step, positive where it is better pruned; all zero at first.

    Args:
        num_steps: denoising steps K.
        num_blocks: blocks 3L.

    Examples:
        >>> gates = StaticGates(4, 6)
        >>> gates.prune_logits(torch.zeros(7, 2, 5)).shape
        torch.Size([7, 4, 6])
    """

    rate_input = False
    is_static = True

    def __init__(self, num_steps: int, num_blocks: int) -> None:
        super().__init__()
        self.logits = nn.Parameter(torch.zeros(num_steps, num_blocks))

    def prune_logits(self, cond: Tensor, rate: None = None) -> Tensor:
        """Return f32 [B, K, 3L], the same for every observation of ``cond`` [B, To, D]."""
        return self.logits.expand(len(cond), -1, -1)
