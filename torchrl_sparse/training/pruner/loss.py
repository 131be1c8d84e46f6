"""SAG's sparsity loss (arXiv:2601.12894, Section 3.3), and the block weights in it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchrl_sparse.blocks.mask import BLOCK_TYPES
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.training.pruner.config import Cost

__all__ = [
    "block_weights",
    "mutual_information",
    "rate_metrics",
    "sparsity_loss",
    "variety_reward",
    "varying_share",
    "weighted_rate",
]


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


def mutual_information(logits: Tensor) -> Tensor:
    """Return the mutual information between gates and observations in a batch: bits per cell, 0 to 1, a scalar.

    ``H(mean_i p_i) - mean_i H(p_i)``, the mean over all cells after the first step, with ``p_i`` the probability that
    observation i prunes the cell: 0 if every observation prunes alike, 1 if each cell is pruned for half of them, surely.
    Gates that start from one mask stay there, since reward and gradient of looking are both 0; this has a gradient.

    Args:
        logits: f32 [B, K, 3L], positive where pruning is preferred.

    >>> certain = torch.tensor([[[0.0], [20.0]], [[0.0], [-20.0]]])
    >>> round(mutual_information(certain).item(), 3), mutual_information(certain[:1]).item()
    (1.0, 0.0)
    """
    probability = logits[:, 1:].sigmoid().clamp(1e-6, 1 - 1e-6)  # an entropy's slope is infinite at its ends
    return (_entropy(probability.mean(dim=0)) - _entropy(probability).mean(dim=0)).mean()


def variety_reward(information: Tensor, asked: float | None) -> Tensor:
    """Return the reward, a scalar, for masks with ``information`` bits about their observations.

    Information itself, if none is asked for. Its slope goes to 0 as gates come to prune alike, and then nothing holds them
    apart; with bits that are ``asked`` it is ``log2(information / asked)``, whose slope does not, and 0 from there on.

    >>> variety_reward(torch.tensor(0.01), 0.04).item(), variety_reward(torch.tensor(0.5), 0.04).item()
    (-2.0, 0.0)
    """
    if asked is None:
        return information
    return (information.clamp(min=1e-8) / asked).log2().clamp(max=0)


def _entropy(probability: Tensor) -> Tensor:
    """Return the entropy of coins, in bits."""
    certain = torch.special.entr(probability) + torch.special.entr(1 - probability)
    return certain / math.log(2)


def varying_share(masks: Tensor) -> Tensor:
    """Return the share of the K x 3L cells in which the masks bool [N, K, 3L] are not all equal.

    >>> varying_share(torch.tensor([[[False, False], [True, True]], [[False, False], [True, False]]])).item()
    0.25
    """
    return (masks != masks[:1]).any(dim=0).float().mean()


def weighted_rate(gate: Tensor, weight: Tensor) -> Tensor:
    """Return the pruned share of the cost, f32 [B, 1]; see `sparsity_loss`."""
    return (gate.mean(dim=1) @ (weight / weight.sum()))[:, None]


def block_weights(policy: DiffusionPolicy, cost: Cost) -> Tensor:
    """Return the cost of each block, f32 [3L], in the measure ``cost``."""
    if cost == "blocks":
        return torch.ones(policy.num_blocks)
    costs = policy.block_costs()
    return (
        torch.tensor([getattr(costs[kind], cost) for kind in policy.network.block_types])
        .float()
        .repeat(policy.network.n_layer)
    )


def rate_metrics(gate: Tensor, weight: Tensor, types: Sequence[str] = BLOCK_TYPES) -> dict[str, Tensor]:
    """Return prune rates, scalars: of all blocks, of the cost, and of each type of block; see `sparsity_loss`."""
    by_type = gate.mean(dim=(0, 1)).view(-1, len(types)).mean(dim=0)
    shares = {f"rate_{kind}": value for kind, value in zip(types, by_type, strict=True)}
    return {"rate": gate.mean(), "rate_cost": weighted_rate(gate, weight).mean(), **shares}
