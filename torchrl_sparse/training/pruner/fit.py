"""Gates fitted to given masks, the start of a training."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDict
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from torchrl_sparse import keys
from torchrl_sparse.blocks.mask import prune_rate
from torchrl_sparse.training.pruner.gates import Gates

__all__ = ["fit_to_masks"]

_BATCH = 4  # the coordinates' tokens, which no observation changes, cost the most


def fit_to_masks(
    gates: Gates,
    masks: Sequence[Tensor],
    targets: TensorDict,
    *,
    updates: int = 600,
    lr: float = 3e-3,
    seed: int = 0,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Fit untrained gates to a mask, the same for all observations, as the start of their training.

    Gates that read the rate can be fitted to several masks, each at its own prune rate; with a single one, they know nothing
    of other rates.

    From random gates over a long chain, a training first has to find back to any mask that works, and each step with
    a mask that prunes little costs most. The cross-entropy is taken against probabilities of 1/4 and 3/4,
    since logits far from zero would get next to no gradient through the straight-through estimator.

    Args:
        gates: fitted in place.
        masks: bool [K, 3L] each, True = pruned.
        targets: see `make_targets`; only its observations are read.
        updates: optimiser steps for each mask.
        lr: of Adam.
        seed: of the observations drawn.
        on_progress: called with (steps taken, all).

    Raises:
        ValueError: if there is no mask, one is not of the gates' shape, or gates that do not read the rate get several.
    """
    if not masks or (len(masks) > 1 and not gates.rate_input):
        expected = "at least one" if gates.rate_input else "one for gates that do not read the rate"
        raise ValueError(f"masks: expected {expected}, got {len(masks)}")
    torch.manual_seed(seed)
    optimizer = torch.optim.Adam(gates.parameters(), lr)
    total = updates * len(masks)
    for update in range(total):
        mask = masks[update % len(masks)]
        cond = targets[keys.COND][torch.randint(len(targets), (_BATCH,))]
        rate = torch.full((len(cond), 1), prune_rate(mask).item()) if gates.rate_input else None
        logits = gates.prune_logits(cond, rate)
        if (shape := logits.shape[1:]) != mask.shape:
            raise ValueError(f"mask: expected [K, 3L] = {[*shape]} as the gates have, got {[*mask.shape]}")
        target = (0.25 + 0.5 * mask.to(logits)).expand_as(logits)
        loss = binary_cross_entropy_with_logits(logits[:, 1:], target[:, 1:])  # step 0 is never pruned
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        on_progress(update + 1, total)
