"""Folded memory tokens, at the same address in every denoising step, for cross-attention."""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_sparse.blocks.engine.folding import FoldedMemory
from torchrl_sparse.blocks.engine.torch.tables import Tables

__all__ = ["Memory"]


class Memory:
    """Folded memory of the current denoising step, for every row of a batch.

    Args:
        tables: of the network.
        batch: rows B.

    Attributes:
        by_layer: keys [B, (1 + To) * n_head, d], values, and bias [B, H, (1 + To) * n_head] of each layer, where
            :class:`~torchrl_sparse.blocks.engine.torch.blocks.CrossAttention` reads them.
    """

    def __init__(self, tables: Tables, batch: int) -> None:
        network, self._tables, self._batch = tables.network, tables, batch
        layers, heads, width = network.n_layer, network.n_head, network.n_emb
        horizon, observations = network.horizon, network.n_obs_steps
        new = tables.stem_weight.new_zeros
        self._vectors = new(layers, 2, batch, 1 + observations, heads, width)
        self._bias = new(layers, batch, horizon, 1 + observations, heads)
        self._hidden = new(1, 1, horizon, 1 + observations, 1)
        if tables.memory_mask is not None:
            self._hidden += tables.memory_mask[..., None]
        self.by_layer = [
            (vectors[0].flatten(1, 2), vectors[1].flatten(1, 2), bias.flatten(2))
            for vectors, bias in zip(self._vectors, self._bias, strict=True)
        ]
        self._time_vectors, self._time_bias = self._vectors[:, :, :, 0], self._bias[:, :, :, 0]
        if tables.time is None:
            tokens = batch * (1 + observations)
            self._tokens = new(tables.num_steps, tokens, width)
            self._present = new(tokens, width)
            self._scratch = tables.fold.scratch(tokens)
        else:
            self._scratch = tables.fold.scratch(batch * observations)

    def begin(self, cond: Tensor) -> None:
        """Set the observations [B, To, D] of a policy call."""
        encoder = self._tables.encoder
        if encoder.separable:
            tokens = encoder.observation_tokens(cond).flatten(0, 1)
            self._put(slice(1, None), self._tables.fold(tokens, self._scratch))
        else:
            self._tokens.copy_(encoder.memory(cond).flatten(1, 2))

    def load(self, step: int) -> None:
        """Make ``step`` the current denoising step; without time tables, :meth:`fold` has to follow."""
        if self._tables.time is None:
            self._present.copy_(self._tokens[step])
        else:
            # Every row sees the time token, so its bias has no -inf to keep.
            time = self._tables.time[step]
            self._time_vectors.copy_(time.vectors)
            self._time_bias.copy_(time.bias)

    def fold(self) -> None:
        """Fold the tokens of the current step, which :meth:`load` has put in place."""
        self._put(slice(None), self._tables.fold(self._present, self._scratch))

    def _put(self, tokens: slice, folded: FoldedMemory) -> None:
        self._vectors[:, :, :, tokens] = folded.vectors.unflatten(2, (self._batch, -1))
        bias = folded.bias.unflatten(1, (self._batch, 1, -1))
        torch.add(self._hidden[:, :, :, tokens], bias, out=self._bias[:, :, :, tokens])
