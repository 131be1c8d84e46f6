"""What the PyTorch engine knows before it sees an observation."""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_sparse.blocks.engine.folding import (
    ConditionEncoder,
    CrossAttentionFold,
    FoldedMemory,
    after_length,
    centred,
)
from torchrl_sparse.blocks.engine.program import slot_counts
from torchrl_sparse.blocks.engine.torch.blocks import CrossAttention, FeedForward, SelfAttention
from torchrl_sparse.blocks.engine.torch.linear import transposed
from torchrl_sparse.blocks.mask import num_buffers
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion

__all__ = ["Tables"]

_SHARED_BUFFERS = tuple(num_buffers(reuse, num_blocks=0) for reuse in ("type", "single"))


class Tables:
    """A snapshot of the network's weights, prepared, and of the sampler.

    Args:
        network: the denoiser.
        sampler: the sampler.

    Attributes:
        blocks: one callable for each column of a mask.
        time: the folded time token of each denoising step; None if the condition encoder must see all tokens at
            once.
        coefficients: [K, 5], those of :mod:`torchrl_sparse.networks.diffusion.coefficients` but the last, the first
            with a minus.
        weighs_eps: the last of them is not 0 throughout.
        spread: [K].
        counts: ``counts[slots][first][last]``, how often the blocks first .. last-1 read each of the buffers that
            blocks share.
    """

    def __init__(self, network: TransformerForDiffusion, sampler: Sampler) -> None:
        self.network = network
        self.device = network.pos_emb.device
        kinds = (SelfAttention, CrossAttention, FeedForward)
        self.blocks = [kinds[b % 3](network, b // 3) for b in range(network.num_blocks)]
        self.stem_weight = centred(network.input_emb.weight.T).contiguous()
        self.stem_bias = centred(network.input_emb.bias + network.pos_emb[0])
        head_weight, self.head_bias = after_length(network.ln_f, network.head.weight, network.head.bias)
        self.head_weight = transposed(head_weight)
        self.memory_mask = None if network.memory_mask is None else network.memory_mask.clone()
        self.fold = CrossAttentionFold(network)
        self.encoder = ConditionEncoder(network, sampler.timesteps)
        self.num_steps = sampler.num_inference_steps
        self.time = self._fold_time() if self.encoder.separable else None
        coefficients = sampler.coefficients
        self.clip, self.spread = coefficients.clip, coefficients.spread.to(self.stem_weight)
        columns = coefficients.table()[:, :-1].clone()
        columns[:, 0].neg_()
        self.coefficients = columns.to(self.stem_weight)
        self.weighs_eps = bool(coefficients.eps_weight.any())
        self.counts = {n: _count_table(network.num_blocks, n, self.stem_weight) for n in _SHARED_BUFFERS}

    def _fold_time(self) -> list[FoldedMemory]:
        """For each step, vectors [L, 2, 1, n_head, d] and bias [L, 1, 1, n_head]."""
        folded = self.fold(self.encoder.time_tokens(), self.fold.room(self.num_steps))
        vectors = folded.vectors.movedim(2, 0).contiguous().unsqueeze(3)
        bias = folded.bias.movedim(1, 0).contiguous()[:, :, None, None]
        return [FoldedMemory(*step) for step in zip(vectors, bias, strict=True)]


def _count_table(num_blocks: int, num_slots: int, like: Tensor) -> list[list[Tensor]]:
    """``table[first][last]``: how often the blocks ``first .. last-1`` read each shared buffer, [num_slots]."""
    edges = range(num_blocks + 1)
    counts = [[slot_counts(first, max(first, last), num_slots) for last in edges] for first in edges]
    return [list(row.unbind(0)) for row in torch.tensor(counts).to(like).unbind(0)]
