"""The three blocks as the PyTorch engine runs them: few large operations on prepared weights, no gradients.

Tokens of a batch are rows, [B * H, d]. A block reads the centred residual stream ``x`` and returns what it adds to it
(:mod:`torchrl_sparse.blocks.engine.folding` has the algebra). It works in the memory of a :class:`Workbench` and
allocates nothing, except that on a CPU each product with large f32 weights returns memory of its own
(:mod:`torchrl_sparse.blocks.engine.torch.linear` says why).
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchrl_sparse.blocks.engine.folding import after_length, centred
from torchrl_sparse.blocks.engine.torch.linear import make_linear
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion

__all__ = ["Block", "CrossAttention", "FeedForward", "SelfAttention", "Workbench"]


class Workbench:
    """Memory for the intermediate results of one block, shared by all of them.

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
        """What is left of a layer norm: ``x`` [N * H, d] through its length."""
        torch.linalg.vector_norm(x, 2, -1, True, out=self._length)
        self._length.hypot_(self._smallest)
        return torch.div(x, self._length, out=self._direction)


Block = Callable[..., Tensor]


class SelfAttention:
    """SA: ``W_o attention(W_qkv LN(x))``.

    Args:
        network: the denoiser.
        index: of the layer.
    """

    def __init__(self, network: TransformerForDiffusion, index: int) -> None:
        layer, horizon = network.decoder.layers[index], network.horizon
        attention = layer.self_attn
        weight, bias = after_length(layer.norm1, attention.in_proj_weight, attention.in_proj_bias)
        scale = weight.new_ones(3, 1)
        scale[0] = (network.n_emb // network.n_head) ** -0.5
        scale = scale.expand(3, network.n_emb).flatten()
        self._project = make_linear(weight * scale[:, None], bias * scale)
        self._output = make_linear(centred(attention.out_proj.weight.T).T, centred(attention.out_proj.bias))
        hidden = (
            torch.full((horizon, horizon), -torch.inf).tril(-1) if network.causal_attn else torch.zeros(1)
        )
        self._hidden = hidden.to(weight)  # [key, query]: a later key

    def __call__(self, x: Tensor, out: Tensor, bench: Workbench) -> Tensor:
        """What the block adds to ``x`` [N * H, d], perhaps in ``out``."""
        qkv = self._project(bench.normalise(x), bench.qkv)
        bench.heads.copy_(qkv.view(bench.qkv_by_token).permute(2, 0, 3, 1, 4))
        torch.baddbmm(self._hidden, bench.key, bench.query, out=bench.scores)
        torch.softmax(bench.scores, 1, out=bench.weights)
        torch.bmm(bench.weights_by_query, bench.value, out=bench.mixed)
        bench.joined_by_head.copy_(bench.mixed_by_token)
        return self._output(bench.joined, out)


class CrossAttention:
    """CA on folded memory.

    Args:
        network: the denoiser.
        index: of the layer.
    """

    def __init__(self, network: TransformerForDiffusion, index: int) -> None:
        self._bias = centred(network.decoder.layers[index].multihead_attn.out_proj.bias)

    def __call__(
        self, x: Tensor, out: Tensor, bench: Workbench, keys: Tensor, values: Tensor, bias: Tensor
    ) -> Tensor:
        """What the block adds to ``x`` [N * H, d], in ``out``.

        Args:
            x: residual stream.
            out: [N * H, d].
            bench: for N rows.
            keys: [N, (1 + To) * n_head, d].
            values: the same shape.
            bias: [N, H, (1 + To) * n_head], with -inf where a token is hidden.
        """
        bench.normalise(x)
        torch.baddbmm(bias, bench.direction_by_row, keys.mT, out=bench.cross_scores)
        torch.softmax(bench.cross_scores_by_head, 2, out=bench.cross_weights_by_head)
        torch.baddbmm(self._bias, bench.cross_weights, values, out=out.view(bench.direction_by_row.shape))
        return out


class FeedForward:
    """FFN: ``W_2 gelu(W_1 LN(x))``.

    Args:
        network: the denoiser.
        index: of the layer.
    """

    def __init__(self, network: TransformerForDiffusion, index: int) -> None:
        layer = network.decoder.layers[index]
        self._inner = make_linear(
            *after_length(layer.norm3, layer.linear1.weight, layer.linear1.bias), gelu=True
        )
        self._outer = make_linear(centred(layer.linear2.weight.T).T, centred(layer.linear2.bias))

    def __call__(self, x: Tensor, out: Tensor, bench: Workbench) -> Tensor:
        """What the block adds to ``x`` [N * H, d], perhaps in ``out``."""
        return self._outer(self._inner(bench.normalise(x), bench.hidden), out)
