"""Weight-decay groups of the optimiser."""

from __future__ import annotations

from torch import nn

__all__ = ["optimizer_groups"]


def optimizer_groups(network: nn.Module, weight_decay: float) -> list[dict]:
    """Return AdamW parameter groups as published: only Linear and attention weights decay.

    Args:
        network: any module.
        weight_decay: decay of the first group, >= 0.

    Returns:
        two groups, with and without decay, each in a deterministic order.

    Examples:
        >>> [len(group["params"]) for group in optimizer_groups(nn.Linear(2, 2), 1e-3)]
        [1, 1]
    """
    decayed: set[int] = set()
    for module in network.modules():
        if isinstance(module, nn.Linear):
            decayed.add(id(module.weight))
        elif isinstance(module, nn.MultiheadAttention) and module.in_proj_weight is not None:
            decayed.add(id(module.in_proj_weight))
    parameters = [p for p in network.parameters() if p.requires_grad]
    return [
        {"params": [p for p in parameters if id(p) in decayed], "weight_decay": weight_decay},
        {"params": [p for p in parameters if id(p) not in decayed], "weight_decay": 0.0},
    ]
