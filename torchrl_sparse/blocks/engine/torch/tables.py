"""The PyTorch engine's tables: everything that depends only on network and sampler."""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_sparse.blocks.engine.folding import (
    Affine,
    FoldedLayer,
    FoldedMemory,
    MemoryEncoder,
    after_norm,
    fold_layers,
    fold_tokens,
)
from torchrl_sparse.blocks.engine.program import slot_counts
from torchrl_sparse.blocks.engine.torch.blocks import CrossAttention, FeedForward, SelfAttention
from torchrl_sparse.blocks.engine.torch.fold import TokenFold
from torchrl_sparse.blocks.engine.torch.linear import transposed
from torchrl_sparse.blocks.engine.torch.norms import after_length, centred, without_norms
from torchrl_sparse.blocks.mask import num_buffers
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion

__all__ = ["Tables"]

_SHARED_BUFFERS = tuple(num_buffers(reuse, num_blocks=0) for reuse in ("type", "single"))


class Tables:
    """A snapshot of the network's prepared weights and of the sampler.

    Args:
        network: the denoiser.
        sampler: the sampler.

    Attributes:
        blocks: one callable for each column of a mask.
        time: the folded time token of each denoising step; None if the condition encoder must see all tokens at
            once.
        coefficients: [K, 7], those of :mod:`torchrl_sparse.networks.diffusion.coefficients` but the last, the first
            with a minus.
        weighs_eps: the weight of the predicted noise is not 0 throughout.
        sample_share: see :mod:`torchrl_sparse.networks.diffusion.coefficients`.
        history: earlier clean predictions that the steps read.
        spread: [K].
        counts: ``counts[slots][first][last]``, how often the blocks first .. last-1 read each of the buffers that
            blocks share.
    """

    def __init__(self, network: TransformerForDiffusion, sampler: Sampler) -> None:
        self.network, like = network, network.pos_emb.detach()
        self.device = like.device
        layers = [without_norms(layer) for layer in fold_layers(network)]
        kinds = (SelfAttention, CrossAttention, FeedForward)  # in the order of BLOCK_TYPES
        self.blocks = [kind(network, layer) for layer in layers for kind in kinds]
        self.stem_weight = centred(network.input_emb.weight.T).contiguous()
        self.stem_bias = centred(network.input_emb.bias + network.pos_emb[0])
        head = after_length(after_norm(network.ln_f, Affine(network.head.weight, network.head.bias)))
        self.head_weight, self.head_bias = transposed(head.weight.to(like)), head.bias.to(like)
        self.memory_mask = None if network.memory_mask is None else network.memory_mask.clone()
        self.fold = TokenFold(layers, like)
        self.encoder = MemoryEncoder(network, sampler.timesteps)
        self.num_steps = sampler.num_inference_steps
        self.time = self._fold_time(layers) if self.encoder.separable else None
        coefficients = sampler.coefficients
        self.sample_share = coefficients.sample_share
        self.clip, self.spread = coefficients.clip, coefficients.spread.to(self.stem_weight)
        columns = coefficients.table()[:, :-1].clone()
        columns[:, 0].neg_()
        self.coefficients = columns.to(self.stem_weight)
        self.weighs_eps, self.history = bool(coefficients.eps_weight.any()), coefficients.history
        self.counts = {n: _count_table(network.num_blocks, n, self.stem_weight) for n in _SHARED_BUFFERS}

    def _fold_time(self, layers: list[FoldedLayer]) -> list[FoldedMemory]:
        """Fold the time token of each step: vectors [L, 2, 1, n_head, d] and bias [L, 1, 1, n_head]."""
        vectors, bias = fold_tokens(layers, self.encoder.time_tokens().double())
        vectors = vectors.to(self.stem_weight).movedim(2, 0).contiguous().unsqueeze(3)
        bias = bias.to(self.stem_weight).movedim(1, 0).contiguous()[:, :, None, None]
        return [FoldedMemory(*step) for step in zip(vectors, bias, strict=True)]


def _count_table(num_blocks: int, num_slots: int, like: Tensor) -> list[list[Tensor]]:
    """Make ``table[first][last]``: how often the blocks ``first .. last-1`` read each shared buffer, [num_slots]."""
    edges = range(num_blocks + 1)
    counts = [[slot_counts(first, max(first, last), num_slots) for last in edges] for first in edges]
    return [list(row.unbind(0)) for row in torch.tensor(counts).to(like).unbind(0)]
