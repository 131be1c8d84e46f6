"""The three block types of the PyTorch engine: few large operations on prepared weights, no gradients.

Tokens of a batch are rows, [B * H, d]. A block reads the centred residual stream ``x`` and returns what it adds to it
(:mod:`torchrl_sparse.blocks.engine.torch.norms` says why). It works in the memory of a :class:`BlockScratch` and
allocates nothing, except that on a CPU each product with large f32 weights returns memory of its own
(:mod:`torchrl_sparse.blocks.engine.torch.linear` says why).
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_sparse.blocks.engine.folding import FoldedLayer
from torchrl_sparse.blocks.engine.torch.linear import make_linear
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion

__all__ = ["BlockScratch", "CrossAttention", "FeedForward", "SelfAttention"]


class BlockScratch:
    """Scratch memory for one block's intermediate results, shared by all blocks.

    Args:
        network: the denoiser.
        batch: N, rows of the batch that a block computes.
    """

    def __init__(self, network: TransformerForDiffusion, batch: int) -> None:
        like, heads = network.pos_emb.detach(), network.n_head
        horizon, width, tokens = network.horizon, network.n_emb, 1 + network.n_obs_steps
        size, rows = width // heads, batch * horizon
        self._smallest = like.new_tensor((width * network.ln_f.eps) ** 0.5)
        self._length = like.new_empty(rows, 1)
        self._direction = like.new_empty(rows, width)
        # Of self-attention; its scores lie as [key, query], the order in which PyTorch's softmax is fastest.
        self.qkv = like.new_empty(rows, 3 * width)
        self.qkv_by_token = (batch, horizon, 3, heads, size)
        self.heads = like.new_empty(3, batch, heads, horizon, size)
        query, self.key, self.value = self.heads.flatten(1, 2).unbind(0)
        self.query = query.mT
        self.scores = like.new_empty(batch * heads, horizon, horizon)
        self.weights = torch.empty_like(self.scores)
        self.weights_by_query = self.weights.mT
        self.mixed = torch.empty_like(self.key)
        self.mixed_by_token = self.mixed.view(batch, heads, horizon, size).transpose(1, 2)
        self.joined = like.new_empty(rows, width)
        self.joined_by_head = self.joined.view(batch, horizon, heads, size)
        # Of cross-attention.
        self.direction_by_row = self._direction.view(batch, horizon, width)
        self.cross_scores = like.new_empty(batch, horizon, tokens * heads)
        self.cross_weights = torch.empty_like(self.cross_scores)
        by_head = (batch, horizon, tokens, heads)
        self.cross_scores_by_head = self.cross_scores.view(by_head)
        self.cross_weights_by_head = self.cross_weights.view(by_head)
        # Of the feed-forward network, and of whoever has no other place for what a block adds.
        self.hidden = like.new_empty(rows, 4 * width)
        self.output = like.new_empty(rows, width)

    def normalise(self, x: Tensor) -> Tensor:
        """Divide ``x`` [N * H, d] by its length: all that remains of a layer norm after folding."""
        torch.linalg.vector_norm(x, 2, -1, True, out=self._length)
        self._length.hypot_(self._smallest)
        return torch.div(x, self._length, out=self._direction)


class SelfAttention:
    """SA: ``W_o attention(W_qkv LN(x))``.

    Args:
        network: the denoiser.
        layer: one of its layers, without norms.
    """

    def __init__(self, network: TransformerForDiffusion, layer: FoldedLayer) -> None:
        like, horizon = network.pos_emb.detach(), network.horizon
        self._project = make_linear(
            layer.qkv.weight.flatten(0, 2).to(like), layer.qkv.bias.flatten().to(like)
        )
        self._output = make_linear(layer.out.weight.flatten(1).to(like), layer.out.bias.to(like))
        hidden = (
            torch.full((horizon, horizon), -torch.inf).tril(-1) if network.causal_attn else torch.zeros(1)
        )
        self._hidden = hidden.to(like)  # [key, policy call]: a later key

    def __call__(self, x: Tensor, out: Tensor, scratch: BlockScratch) -> Tensor:
        """Return what the block adds to ``x`` [N * H, d], perhaps in ``out``."""
        qkv = self._project(scratch.normalise(x), scratch.qkv)
        scratch.heads.copy_(qkv.view(scratch.qkv_by_token).permute(2, 0, 3, 1, 4))
        torch.baddbmm(self._hidden, scratch.key, scratch.query, out=scratch.scores)
        torch.softmax(scratch.scores, 1, out=scratch.weights)
        torch.bmm(scratch.weights_by_query, scratch.value, out=scratch.mixed)
        scratch.joined_by_head.copy_(scratch.mixed_by_token)
        return self._output(scratch.joined, out)


class CrossAttention:
    """CA on folded memory.

    Args:
        network: the denoiser.
        layer: one of its layers, without norms.
    """

    def __init__(self, network: TransformerForDiffusion, layer: FoldedLayer) -> None:
        self._bias = layer.cross_out.bias.to(network.pos_emb)

    def __call__(
        self, x: Tensor, out: Tensor, scratch: BlockScratch, keys: Tensor, values: Tensor, bias: Tensor
    ) -> Tensor:
        """Return what the block adds to ``x`` [N * H, d], in ``out``.

        Args:
            x: residual stream.
            out: [N * H, d].
            scratch: for N rows.
            keys: [N, (1 + To) * n_head, d].
            values: the same shape.
            bias: [N, H, (1 + To) * n_head], with -inf where a token is hidden.
        """
        scratch.normalise(x)
        torch.baddbmm(bias, scratch.direction_by_row, keys.mT, out=scratch.cross_scores)
        torch.softmax(scratch.cross_scores_by_head, 2, out=scratch.cross_weights_by_head)
        torch.baddbmm(self._bias, scratch.cross_weights, values, out=out.view(scratch.direction_by_row.shape))
        return out


class FeedForward:
    """FFN: ``W_2 gelu(W_1 LN(x))``.

    Args:
        network: the denoiser.
        layer: one of its layers, without norms.
    """

    def __init__(self, network: TransformerForDiffusion, layer: FoldedLayer) -> None:
        like = network.pos_emb.detach()
        self._inner = make_linear(layer.up.weight.to(like), layer.up.bias.to(like), gelu="none")
        self._outer = make_linear(layer.down.weight.to(like), layer.down.bias.to(like))

    def __call__(self, x: Tensor, out: Tensor, scratch: BlockScratch) -> Tensor:
        """Return what the block adds to ``x`` [N * H, d], perhaps in ``out``."""
        return self._outer(self._inner(scratch.normalise(x), scratch.hidden), out)
