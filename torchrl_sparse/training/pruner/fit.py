"""Initialisation of gates before training: fitted to given masks, or different for every observation."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits

from torchrl_sparse import keys
from torchrl_sparse.blocks.mask import prune_rate
from torchrl_sparse.blocks.sag.network import PrunerNetwork
from torchrl_sparse.errors import InputError
from torchrl_sparse.training.pruner.gates import Gates

__all__ = ["fit_to_masks", "spread_logits"]

_BATCH = 4  # the coordinates' tokens, which no observation changes, cost the most
_SMALLEST_DEVIATION = 1e-3  # of an observed number; what varies less is taken for constant


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
    """Fit untrained gates to observation-independent masks, as a start for their training.

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
        InputError: if there is no mask, one is not of the gates' shape, or gates that do not read the rate get several.
    """
    if not masks or (len(masks) > 1 and not gates.rate_input):
        expected = "at least one" if gates.rate_input else "one for gates that do not read the rate"
        raise InputError(f"masks: expected {expected}, got {len(masks)}")
    torch.manual_seed(seed)
    optimizer = torch.optim.Adam(gates.parameters(), lr)
    total = updates * len(masks)
    for update in range(total):
        mask = masks[update % len(masks)]
        cond = targets[keys.COND][torch.randint(len(targets), (_BATCH,))]
        given = torch.full((len(cond), 1), prune_rate(mask).item(), device=cond.device)
        rate = given if gates.rate_input else None
        logits = gates.prune_logits(cond, rate)
        if (shape := logits.shape[1:]) != mask.shape:
            raise InputError(f"mask: expected [K, 3L] = {[*shape]} as the gates have, got {[*mask.shape]}")
        target = (0.25 + 0.5 * mask.to(logits)).expand_as(logits)
        loss = binary_cross_entropy_with_logits(logits[:, 1:], target[:, 1:])  # step 0 is never pruned
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        on_progress(update + 1, total)


@torch.no_grad()
def spread_logits(gates: PrunerNetwork, targets: TensorDict, spread: float, *, samples: int = 256) -> None:
    """Change untrained gates in place so that their masks differ between observations.

    Initialised as usual, gates are next to blind. Published normalisers scale a whole state by one number, so that most of
    what tells two observations apart is far smaller than 1, and every layer makes it smaller. Once the logits of the cells have
    grown apart, as when gates are fitted to a mask, no observation changes a sign, and what changes nothing is never learned.
    Here the first layers are scaled so that observation and coordinates have an equal say, with mean 0 and deviation 1 in
    each unit of the first hidden layer, and the last so that logits have mean 0 and deviation ``spread``. All of them stay
    the layers that they were.

    Args:
        gates: those that read the observation.
        targets: see `make_targets`; only its observations are read.
        spread: deviation of a cell's logit over observations, mean over the cells, > 0.
        samples: observations to measure it with, the first.
    """
    cond = targets[keys.COND][:samples]
    rate = torch.full((len(cond), 1), 0.5, device=cond.device) if gates.rate_input else None
    seen, weight = cond[..., gates.unseen :], gates.obs.weight
    deviation = seen.flatten(1).std(dim=0)
    varies = deviation > _SMALLEST_DEVIATION
    weight[:, : len(varies)] *= torch.where(varies, 1 / deviation, 0.0)  # a rate may follow
    _standardise(gates.fuse_obs, gates.fuse_obs(gates.obs(gates.features(seen, rate))))
    _standardise(gates.fuse_z, gates.cells(), gates.fuse_obs.bias)
    last = gates.mlp[-1]
    last.weight *= spread / gates.prune_logits(cond, rate)[:, 1:].std(dim=0).mean()
    last.bias[1] -= gates.prune_logits(cond, rate)[:, 1:].mean()
    gates.train(gates.training)  # forget what followed from the weights


def _standardise(layer: nn.Linear, outputs: Tensor, bias: Tensor | None = None) -> None:
    """Scale and shift a layer so that each of its ``outputs`` [N, n] has mean 0 and deviation 1."""
    bias, deviation, mean = layer.bias if bias is None else bias, outputs.std(dim=0), outputs.mean(dim=0)
    if layer.bias is not None:
        layer.bias /= deviation
    layer.weight /= deviation[:, None]
    bias -= mean / deviation
