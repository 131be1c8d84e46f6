"""Reuse across the queries of a rollout: what a block returned in the same denoising step of an earlier query.

TTS (Test-time Sparsity, arXiv:2605.13316, with its released code) lets a pruned block choose among three earlier outputs: the
latest of its type, its own latest of this query, and, across queries, the latest that was *computed* in this block and step
since the episode began. The third, here called recalled, is::

    out[k, b] = fresh                     where neither pruned nor recalled; also the next query's memory[k, b]
              = latest of the reuse rule  where pruned
              = memory[k, b]              where pruned and recalled; no buffer of the query changes

As released, the first step of a query always computes, and so does the first query of an episode, which has no memory.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_sparse.blocks.engine.base import check_input
from torchrl_sparse.blocks.mask import MaskError, check_form
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion

__all__ = ["Memory", "check_memory", "check_recall"]


def check_recall(recalled: Tensor, mask: Tensor) -> None:
    """Refuse anything but cells bool [B, K, 3L] that ``mask`` of the same shape prunes.

    Raises:
        MaskError: a ValueError.
    """
    check_form(recalled, mask.shape[-2], mask.shape[-1] // 3, batch=mask.shape[:-2])
    if (recalled & ~mask).any():
        raise MaskError(f"recall: expected pruned cells alone, got {int((recalled & ~mask).sum())} others")


def check_memory(memory: Tensor, mask: Tensor, network: TransformerForDiffusion) -> None:
    """Raise ValueError unless ``memory`` is [B, K, 3L, H, d] for a ``mask`` [B, K, 3L], of the network's type and device."""
    check_input("memory", memory, (*mask.shape, network.horizon, network.n_emb), network.pos_emb)


class Memory:
    """What the blocks of a batch of queries computed, for the queries after them; the ``replace`` of `denoise`.

    Args:
        mask: bool [B, K, 3L], True = pruned.
        recall: bool [B, K, 3L], the pruned cells that reuse ``outputs``.
        outputs: f32 [B, K, 3L, H, d] of the queries before; it is not written to.

    Attributes:
        outputs: the same with what this query computed, f32 [B, K, 3L, H, d].

    Raises:
        MaskError: a ValueError, if a cell is recalled that is not pruned.
    """

    def __init__(self, mask: Tensor, recall: Tensor, outputs: Tensor) -> None:
        check_recall(recall, mask)
        self._mask, self._recall, self._before = mask, recall, outputs
        self.outputs = outputs.clone()

    def __call__(self, step: int, block: int, output: Tensor) -> Tensor:
        """Return what ``block`` adds, [B, H, d], given what it returned or reuses by its rule."""
        pruned, recalled = (cells[:, step, block, None, None] for cells in (self._mask, self._recall))
        before = self._before[:, step, block]
        self.outputs[:, step, block] = torch.where(pruned, before, output)
        return torch.where(recalled, before, output)
