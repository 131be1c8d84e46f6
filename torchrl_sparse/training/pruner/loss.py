"""The sparsity loss of SAG (arXiv:2601.12894, Section 3.3), and what blocks weigh in it."""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_sparse.blocks.mask import BLOCK_TYPES
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.training.pruner.config import Cost

__all__ = ["block_weights", "rate_metrics", "sparsity_loss", "weighted_rate"]


def sparsity_loss(gate: Tensor, rate: Tensor, weight: Tensor, *, per_block: bool = False) -> Tensor:
    """Return ``mean |sum w M / sum w - rho|`` over the batch, a scalar (SAG's global sparsity loss for equal weights).

    Args:
        gate: f32 [B, K, 3L], 1 = pruned.
        rate: target rho, f32 [B, 1].
        weight: cost of each block, f32 [3L].
        per_block: hold every block to the rate by itself; weights then do not matter.

    >>> gate = torch.tensor([[[0.0, 0.0], [1.0, 0.0]]])
    >>> sparsity_loss(gate, torch.tensor([[0.5]]), torch.tensor([3.0, 1.0])).item()
    0.125
    """
    if per_block:
        return (gate.mean(dim=1) - rate).abs().mean()
    return (weighted_rate(gate, weight) - rate).abs().mean()


def weighted_rate(gate: Tensor, weight: Tensor) -> Tensor:
    """Return the share of the cost that is pruned, f32 [B, 1]; see `sparsity_loss`."""
    return (gate.mean(dim=1) @ (weight / weight.sum()))[:, None]


def block_weights(policy: DiffusionPolicy, cost: Cost) -> Tensor:
    """Return the cost of each block, f32 [3L], as ``cost`` counts it."""
    if cost == "blocks":
        return torch.ones(policy.num_blocks)
    costs = policy.block_costs()
    return (
        torch.tensor([getattr(costs[kind], cost) for kind in BLOCK_TYPES])
        .float()
        .repeat(policy.network.n_layer)
    )


def rate_metrics(gate: Tensor, weight: Tensor) -> dict[str, Tensor]:
    """Return prune rates, scalars: of all blocks, of the cost, and of each type of block; see `sparsity_loss`."""
    by_type = gate.mean(dim=(0, 1)).view(-1, len(BLOCK_TYPES)).mean(dim=0)
    shares = {f"rate_{kind}": value for kind, value in zip(BLOCK_TYPES, by_type, strict=True)}
    return {"rate": gate.mean(), "rate_cost": weighted_rate(gate, weight).mean(), **shares}
